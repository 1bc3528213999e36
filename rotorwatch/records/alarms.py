"""Alarms: current states, and events."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

from rotorwatch.records.fields import EXAMPLE_NS, BundleIdentity, MachineHash, Number, OfMachine, Record


class Severity(StrEnum):
    """How serious a raised alarm is."""

    ALERT = "alert"
    DANGER = "danger"


class EventKind(StrEnum):
    """What happened to an alarm, in the log."""

    RAISED = "raised"
    ESCALATED = "escalated"
    CLEARED = "cleared"
    ACKNOWLEDGED = "acknowledged"
    RESET = "reset"
    SHELVED = "shelved"
    UNSHELVED = "unshelved"
    SUPPRESSED = "suppressed"
    UNSUPPRESSED = "unsuppressed"
    REMOVED_FROM_SERVICE = "removed-from-service"
    RETURNED_TO_SERVICE = "returned-to-service"


class AlarmState(StrEnum):
    """State of an alarm in its life cycle."""

    NORMAL = "normal"
    UNACKNOWLEDGED = "unacknowledged"
    ACKNOWLEDGED = "acknowledged"
    RETURNED = "returned"
    LATCHED_UNACKNOWLEDGED = "latched-unacknowledged"
    LATCHED_ACKNOWLEDGED = "latched-acknowledged"
    SHELVED = "shelved"
    SUPPRESSED = "suppressed"
    OUT_OF_SERVICE = "out-of-service"

    @property
    def annunciated(self) -> bool:
        """Whether operators are notified of the alarm."""
        return self not in {AlarmState.SHELVED, AlarmState.SUPPRESSED, AlarmState.OUT_OF_SERVICE}


_STATE_TEXT = (
    "normal, unacknowledged, acknowledged, returned (cleared, not acknowledged), latched-unacknowledged or "
    "latched-acknowledged (cleared, to be reset), shelved, suppressed (by a rule), out-of-service"
)

_AlarmName = Annotated[
    str,
    Field(
        description="k_by, c_by, k_bz, c_bz, e, EI, changed (not certain what), model (outside the model), shape "
        "(vibration changed), level:CHANNEL (vibration levels), data-... (data health, by kind), monitor-... (fault "
        "or overload of the monitor) or stream-lost",
        examples=["k_by"],
    ),
]
_AlarmChange = Annotated[
    Number, Field(description="deciding relative change; null if not about a parameter", examples=[-0.247])
]
_AlarmError = Annotated[Number, Field(description="standard error of the relative change", examples=[0.0071])]
_AlarmInterval = Annotated[
    tuple[float, float] | None, Field(description="95 % interval of the relative change", examples=[(-0.261, -0.233)])
]
_LowConfidence = Annotated[
    bool,
    Field(
        description="named with low confidence: another cause is possible, such as one outside the model",
        examples=[False],
    ),
]
_Note = Annotated[
    str,
    Field(
        description="what else is known, in words, such as size and direction of a change of unbalance", examples=[""]
    ),
]


class Evidence(Record):
    """The data an alarm was decided on."""

    start_ns: int = Field(description="oldest data", examples=[EXAMPLE_NS - 20_000_000_000])
    end_ns: int = Field(description="end of the newest data", examples=[EXAMPLE_NS])
    confidence: Number = Field(
        default=None,
        description="probability that exactly the named parameters changed; null if none is computed",
        examples=[0.996],
    )


_Evidence = Annotated[
    Evidence | None,
    Field(description="data on which the alarm was decided; null if it was not decided on a window, or not at all yet"),
]


class Shelf(Record):
    """Why an alarm is shelved, and until when."""

    until_ns: int = Field(
        description="data time at which shelving ends at the latest", examples=[EXAMPLE_NS + 3_600_000_000_000]
    )
    one_shot: bool = Field(description="shelving ends when the condition clears, if that is earlier", examples=[False])
    by: str = Field(description="who shelved the alarm", examples=["anna"])
    reason: str = Field(description="why the alarm was shelved", examples=["sensor cable is being replaced"])


class Alarm(Record):
    """One alarm of a machine: about a parameter, the model, a channel, the data, the stream or the monitor."""

    name: _AlarmName
    text: str = Field(description="what the alarm is about, in words", examples=["bearing stiffness, horizontal"])
    state: AlarmState = Field(description=_STATE_TEXT, examples=["unacknowledged"])
    pending: bool = Field(
        description="the condition has begun, but must last for the on-delay to raise the alarm", examples=[False]
    )
    clearing: bool = Field(
        description="the condition has ended, but must stay away for the off-delay to clear the alarm", examples=[False]
    )
    present: bool = Field(description="the condition is present, on-delay and off-delay included", examples=[True])
    raised: bool = Field(
        description="the condition is present and shown to operators: not shelved, suppressed or out of service",
        examples=[True],
    )
    severity: Severity = Field(
        description="severity of the present occurrence, or of the last one if the condition is not present",
        examples=["alert"],
    )
    since_ns: int = Field(description="data time at which `state` was entered", examples=[EXAMPLE_NS])
    raised_ns: int | None = Field(description="data time at which the present occurrence began", examples=[EXAMPLE_NS])
    occurrence: int = Field(description="how often the condition has begun, across restarts", examples=[1])
    relative_change: _AlarmChange
    standard_error: _AlarmError
    interval_95: _AlarmInterval
    low_confidence: _LowConfidence
    note: _Note
    evidence: _Evidence
    shelf: Shelf | None = Field(description="only while shelved", examples=[None])
    suppressed_by: str = Field(description="rules that now suppress the alarm, in words; empty if none", examples=[""])
    out_of_service_by: str = Field(description="who took it out of service; empty otherwise", examples=[""])
    out_of_service_reason: str = Field(description="why it was taken out of service", examples=[""])
    version: int = Field(
        description="sequence number of the alarm's latest event, -1 before the first; send it with an operation, so "
        "that this is done only if nothing has happened in between",
        examples=[0],
    )


class AlarmStates(OfMachine):
    """The alarms of one machine that are not normal; on request, all that have ever occurred."""

    alarms: tuple[Alarm, ...] = Field(description="one entry per alarm")
    sequence: int = Field(
        description="sequence number of the machine's latest event; -1 before the first", examples=[0]
    )
    bundle: BundleIdentity
    machine_hash: MachineHash


class AlarmEventData(OfMachine):
    """What happened to an alarm."""

    name: _AlarmName
    text: str = Field(
        description="the event in a sentence",
        examples=["ALERT: bearing stiffness, horizontal (k_by) changed by -24.7% ± 1.4%"],
    )
    kind: EventKind = Field(
        description="raised, escalated (alert to danger), cleared; or what an operator or a rule did: acknowledged, "
        "reset, shelved, unshelved, suppressed, unsuppressed, removed-from-service, returned-to-service",
        examples=["raised"],
    )
    before: AlarmState = Field(description="state of the alarm before the event", examples=["normal"])
    state: AlarmState = Field(description="state of the alarm after the event", examples=["unacknowledged"])
    annunciated: bool = Field(
        description="operators are notified: the alarm is not shelved, suppressed or out of service", examples=[True]
    )
    severity: Severity = Field(description="alert or danger", examples=["alert"])
    time_ns: int = Field(description="data time of the event", examples=[EXAMPLE_NS])
    raised_ns: int | None = Field(description="data time at which this occurrence began", examples=[EXAMPLE_NS])
    occurrence: int = Field(description="how often the condition of the alarm has begun, across restarts", examples=[1])
    sequence: int = Field(
        description="counts the machine's events from 0, without a gap, across restarts", examples=[0]
    )
    relative_change: _AlarmChange
    standard_error: _AlarmError
    interval_95: _AlarmInterval
    low_confidence: _LowConfidence
    note: _Note
    evidence: _Evidence
    actor: str = Field(description="who caused the event; empty for the monitor itself", examples=[""])
    reason: str = Field(description="why, in the words of the actor or the rule", examples=[""])
    bundle: BundleIdentity
    machine_hash: MachineHash
    program_version: str = Field(description="version of the monitor that wrote the event", examples=["0.1.0"])


class AlarmCloudEvent(Record):
    """An alarm event as a CloudEvent 1.0 in structured JSON form."""

    specversion: Literal["1.0"] = Field(description="version of CloudEvents", examples=["1.0"])
    id: str = Field(
        description="the same in every delivery of the event: machine, sequence, alarm, kind",
        examples=["demo/lab/0/k_by/raised"],
    )
    source: str = Field(description="the machine", examples=["/rotorwatch/demo/lab"])
    type: str = Field(description="org.rotorwatch.alarm.<kind>", examples=["org.rotorwatch.alarm.raised"])
    subject: str = Field(description="name of the alarm", examples=["k_by"])
    time: str = Field(description="data time, RFC 3339, microseconds", examples=["2026-01-01T00:03:25.000000Z"])
    datacontenttype: Literal["application/json"] = Field(description="type of `data`", examples=["application/json"])
    sequence: str = Field(
        description="CloudEvents extension: counts the machine's events without a gap, across restarts; sorts as text",
        examples=["00000000000000000000"],
    )
    data: AlarmEventData = Field(description="what happened")


class AlarmLogPage(OfMachine):
    """Part of a machine's alarm log, from a given sequence number on: the answer to a query on ``alarm/event``."""

    events: tuple[AlarmCloudEvent, ...] = Field(description="events after the given sequence, in order, without a gap")
    latest: int = Field(
        description="sequence number of the machine's latest event; -1 before the first. While the last event "
        "received has a smaller number, ask again from there",
        examples=[0],
    )
