"""JSON of the HTTP API beyond what is also published: lists with cursors, orders of operators, the audit log.

Conventions as in `service.schemas`.
"""

from typing import Annotated

from pydantic import BaseModel, Field

from models.machine import MachineFile, load_machine
from service.alarm_schemas import EXAMPLE_NS, Alarm, AlarmCloudEvent, BundleIdentity, MachineHash, Name, Site
from service.alarms.life_cycle import AlarmState
from service.schemas import MachineDescription, Report, example
from service.window_schemas import JSON

__all__ = [
    "AlarmEventList",
    "Alive",
    "AuditList",
    "AuditRecord",
    "MachineConfiguration",
    "MachineList",
    "OperationDone",
    "OperationOrder",
    "Reading",
    "ReadingBucket",
    "ReadingList",
    "ReasonedOrder",
    "ReportList",
    "ShelveOrder",
    "configuration_example",
]

_LONGEST_REASON = 500
_PRINTABLE = r"^[^\x00-\x1f\x7f]*$"


class Alive(BaseModel):
    """The process answers."""

    model_config = JSON

    alive: bool = Field(description="always true", examples=[True])


class MachineList(BaseModel):
    """Every monitored machine."""

    model_config = JSON

    machines: tuple[MachineDescription, ...] = Field(description="in the order of the settings")


class MachineConfiguration(BaseModel):
    """What a machine is monitored with."""

    model_config = JSON

    site: Site
    machine: Name
    file: MachineFile = Field(description="the machine file, what it leaves out filled in")
    bundle: BundleIdentity
    machine_hash: MachineHash


class ReportList(BaseModel):
    """Window reports, the latest to arrive first."""

    model_config = JSON

    reports: tuple[Report, ...] = Field(description="the latest to arrive first")
    next_before: int | None = Field(
        description="pass it as `before` to get what is older; null if nothing older is kept", examples=[4711]
    )


class AlarmEventList(BaseModel):
    """Alarm events in the order of their sequence, or, without `after`, in the reverse order."""

    model_config = JSON

    events: tuple[AlarmCloudEvent, ...] = Field(description="with `after` oldest first, otherwise newest first")
    next_before: int | None = Field(
        description="pass it as `before` to get what is older; null if there is nothing older, and with `after`",
        examples=[17],
    )
    next_after: int | None = Field(
        description="pass it as `after` to go on from here, now or later; null without `after`", examples=[None]
    )


class Reading(BaseModel):
    """One number of one window."""

    model_config = JSON

    number: int = Field(description="counts the machine's windows in the order of arrival", examples=[4711])
    end_ns: int = Field(description="end of the window", examples=[EXAMPLE_NS])
    value: float = Field(description="as in the report", examples=[-0.247])
    standard_error: float | None = Field(description="its standard error; null if there is none", examples=[0.0071])


class ReadingBucket(BaseModel):
    """Readings of one name over a stretch of time."""

    model_config = JSON

    name: str = Field(description="which parameter or equation", examples=["k_by"])
    start_ns: int = Field(description="windows that end from here on", examples=[EXAMPLE_NS - 60_000_000_000])
    length_ns: int = Field(description="for so long", examples=[60_000_000_000])
    count: int = Field(description="how many readings", examples=[12])
    minimum: float = Field(description="smallest value", examples=[-0.251])
    mean: float = Field(description="mean value", examples=[-0.246])
    maximum: float = Field(description="largest value", examples=[-0.239])
    mean_standard_error: float | None = Field(
        description="mean of the standard errors of those that have one; null if none has", examples=[0.0072]
    )


class ReadingList(BaseModel):
    """Readings of one quantity over time: one by one, or reduced to buckets of equal length."""

    model_config = JSON

    quantity: str = Field(
        description="parameter (relative change), equation (mean squared difference), misfit (standard deviations) or "
        "speed (rad/s)",
        examples=["parameter"],
    )
    readings: tuple[Reading, ...] = Field(description="in the order of arrival; empty with `points`")
    buckets: tuple[ReadingBucket, ...] = Field(
        description="with `points`, by name and time; those without a reading are left out", examples=[()]
    )
    next_after: int | None = Field(
        description="pass it as `after` to go on; null if there is no more yet, and with `points`", examples=[4711]
    )


_Reason = Annotated[
    str,
    Field(
        max_length=_LONGEST_REASON,
        pattern=_PRINTABLE,
        description="why; it goes into the log of alarms and the audit log",
        examples=["sensor cable is being replaced"],
    ),
]
_GivenReason = Annotated[_Reason, Field(pattern=r"^[^\x00-\x1f\x7f]*[^\x00-\x20\x7f][^\x00-\x1f\x7f]*$")]
_ExpectedState = Annotated[
    AlarmState | None,
    Field(description="state in which you saw the alarm; needed without If-Match", examples=["unacknowledged"]),
]


class OperationOrder(BaseModel):
    """What an operator says when acknowledging, unshelving, resetting, or returning to service."""

    model_config = JSON

    reason: _Reason = ""
    expected_state: _ExpectedState = None


class ReasonedOrder(BaseModel):
    """What is said when taking an alarm out of service."""

    model_config = JSON

    reason: _GivenReason
    expected_state: _ExpectedState = None


class ShelveOrder(BaseModel):
    """What an operator says when shelving."""

    model_config = JSON

    reason: _GivenReason
    duration_s: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="for how long, data time; left out: as long as the machine file allows (`longest_shelf_s`)",
        examples=[3600.0],
    )
    one_shot: bool = Field(
        default=False, description="end it when the condition clears, if that is earlier", examples=[False]
    )
    expected_state: _ExpectedState = None


class OperationDone(BaseModel):
    """What came of an operation."""

    model_config = JSON

    alarm: Alarm = Field(description="as it is afterwards; its version is the new ETag")
    events: tuple[AlarmCloudEvent, ...] = Field(description="what happened")


class AuditRecord(BaseModel):
    """One entry of the audit log."""

    model_config = JSON

    number: int = Field(description="counts the entries", examples=[291])
    at_ns: int = Field(
        description="when the request arrived, this computer's time; the same for the entry before and after the deed",
        examples=[EXAMPLE_NS],
    )
    actor: str = Field(description="name of the token; empty for nobody in particular", examples=["anna"])
    address: str = Field(description="where the request came from", examples=["127.0.0.1"])
    method: str = Field(description="HTTP method", examples=["POST"])
    path: str = Field(description="path of the request", examples=["/api/v1/machines/demo/lab/alarms/k_by/acknowledge"])
    status: int = Field(description="HTTP status of the answer; 0 before the deed", examples=[200])
    action: str = Field(description="what was meant, in one word; started before the deed", examples=["acknowledge"])
    machine: str = Field(description="site/machine it was done to; empty if none", examples=["demo/lab"])
    alarm: str = Field(description="alarm it was done to; empty if none", examples=["k_by"])
    reason: str = Field(description="why, or why it was refused", examples=["seen, inspection is ordered"])


class AuditList(BaseModel):
    """Entries of the audit log, newest first."""

    model_config = JSON

    entries: tuple[AuditRecord, ...] = Field(description="newest first")
    next_before: int | None = Field(
        description="pass it as `before` to get what is older; null if there is nothing older", examples=[291]
    )


def configuration_example() -> dict[str, object]:
    """A configuration of the shipped machine ``lab``."""
    plain = load_machine("lab").model_dump(mode="json")
    heading = {name: example(MachineDescription)[name] for name in ("site", "machine", "bundle", "machine_hash")}
    return {**heading, "file": plain}
