"""JSON that leaves the monitor, on Zenoh keys and over HTTP: its fields and what they mean.

Every number is finite or null; every field with a unit has it in its name. Relative changes, standard errors and
intervals are plain ratios: 0.01 is one per cent. Times in ns count from 1970-01-01 UTC.
"""

import json
from typing import Annotated, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field

from models.signals.channels import Channel
from service.alarm_schemas import (
    EXAMPLE_NS,
    Alarm,
    AlarmCloudEvent,
    AlarmEventData,
    AlarmStates,
    BundleIdentity,
    MachineHash,
    Name,
    Site,
)
from service.reports import HealthState
from service.window_schemas import (
    JSON,
    Agreement,
    Detectable,
    Equation,
    Finding,
    Opinion,
    Parameter,
    Reason,
    SensorFault,
    Shape,
    Verdict,
)

__all__ = [
    "Agreement",
    "Alarm",
    "AlarmCloudEvent",
    "AlarmEventData",
    "AlarmStates",
    "Detectable",
    "DetectableChanges",
    "DetectableParameter",
    "Equation",
    "Finding",
    "Health",
    "MachineDescription",
    "MachineReadiness",
    "Opinion",
    "Parameter",
    "Problem",
    "Quality",
    "Readiness",
    "Report",
    "SensorFault",
    "Shape",
    "StreamStatus",
    "Verdict",
    "example",
]

_State = Annotated[HealthState, Field(description="health in one word", examples=["alert"])]


_MisfitZ = Annotated[
    float | None,
    Field(
        description="distance of the window from what the model can explain, standard deviations; null without a test",
        examples=[0.4],
    ),
]
_Suspect = Annotated[
    str, Field(description="what explains data outside the model best, if one thing does; else empty", examples=[""])
]
_Opinions = Annotated[tuple[Opinion, ...], Field(description="what the other diagnosticians read in the window")]
_Verdict = Annotated[Verdict | None, Field(description="what has changed; null if the window was not evaluated")]
_Detectable = Annotated[tuple[Detectable, ...], Field(description="what would have been found in this window")]


_Sensors = Annotated[
    tuple[SensorFault, ...],
    Field(
        description="faults of sensors in the window; with any of them nothing is said of the machine", examples=[()]
    ),
]
_Shapes = Annotated[
    tuple[Shape, ...],
    Field(description="where no equation can be evaluated: whether each channel is as it was", examples=[()]),
]


class Report(BaseModel):
    """One evaluation of the sliding window."""

    model_config = JSON

    site: Site
    machine: Name
    start_ns: int = Field(description="oldest data in the window", examples=[EXAMPLE_NS - 60_000_000_000])
    end_ns: int = Field(description="end of the newest data in the window", examples=[EXAMPLE_NS])
    state: _State
    filled: float = Field(description="fraction of a full window", examples=[1.0])
    speed_rad_s: float | None = Field(description="mean speed in the window", examples=[138.23])
    misfit_z: _MisfitZ
    suspect: _Suspect
    verdict: _Verdict
    parameters: tuple[Parameter, ...] = Field(
        description="readings of the whole window by the diagnostician that decides"
    )
    opinions: _Opinions
    equations: tuple[Equation, ...] = Field(description="the networks' residuals, equation by equation")
    detectable: _Detectable
    sensors: _Sensors
    shapes: _Shapes
    reason: Reason
    bundle: BundleIdentity
    machine_hash: MachineHash


class Quality(BaseModel):
    """What came in since the monitor started."""

    model_config = JSON

    accepted_blocks: int = Field(description="blocks accepted", examples=[2051])
    refused_blocks: dict[str, int] = Field(description="blocks refused, by reason", examples=[{"not-finite": 3}])
    gaps: int = Field(description="interruptions before accepted blocks", examples=[1])
    missing_s: float = Field(description="data time the gaps cost", examples=[0.3])
    queue_dropped_blocks: int = Field(description="blocks dropped because the monitor could not keep up", examples=[0])
    link_missed_blocks: int = Field(description="blocks lost on the way, as far as the link knows", examples=[0])
    last_refusal: str = Field(
        description="latest reason for refusing a block",
        examples=["demo/lab: block 740, channel y1: sample 12 is nan, expected a finite number"],
    )
    last_gap: str = Field(description="latest gap", examples=["demo/lab: 0.3 s of data are missing (3 blocks)"])


class StreamStatus(BaseModel):
    """What is known about whoever publishes the stream."""

    model_config = JSON

    publisher_alive: bool = Field(
        description="a publisher's liveliness token is there; publishers need not have one", examples=[True]
    )
    data_age_s: float | None = Field(
        description="time since the last accepted block was processed; null before the first", examples=[0.04]
    )
    descriptor_mismatch: tuple[str, ...] = Field(
        description="fields of the announced channel descriptor that differ from the machine file", examples=[()]
    )


class Health(BaseModel):
    """Where a machine stands: state, latest window, alarms, quality of the data."""

    model_config = JSON

    site: Site
    machine: Name
    state: HealthState = Field(
        description="warming, healthy, unchanged (no equation can be evaluated, but every channel is as it was), "
        "alert, danger, outside-model, data-health (a sensor is at fault), no-data (silence; outranks everything, see "
        "`alarms`) or not-evaluable",
        examples=["alert"],
    )
    reason: str = Field(description="why the state is no-data or not-evaluable; empty otherwise", examples=[""])
    filled: float = Field(description="fraction of a full window that is there now", examples=[1.0])
    window_start_ns: int | None = Field(
        description="oldest data of the latest window", examples=[EXAMPLE_NS - 60_000_000_000]
    )
    window_end_ns: int | None = Field(description="end of the latest window", examples=[EXAMPLE_NS])
    speed_rad_s: float | None = Field(description="mean speed in the latest window", examples=[138.23])
    misfit_z: _MisfitZ
    suspect: _Suspect
    verdict: _Verdict
    parameters: tuple[Parameter, ...] = Field(description="parameters in the latest window")
    opinions: _Opinions
    equations: tuple[Equation, ...] = Field(description="equations in the latest window")
    detectable: _Detectable
    sensors: _Sensors
    shapes: _Shapes
    alarms: tuple[Alarm, ...] = Field(description="alarms that are not normal")
    quality: Quality = Field(description="what came in")
    stream: StreamStatus = Field(description="what is known about the publisher")
    restart: str = Field(
        description="what became of the state from before the latest start of the monitor; empty if there was none",
        examples=["went on where it stood at 2026-01-01T00:02:55Z"],
    )
    worker_errors: int = Field(description="blocks lost to an error inside the monitor", examples=[0])
    last_worker_error: str = Field(description="the latest of them; empty if none", examples=[""])
    bundle: BundleIdentity
    machine_hash: MachineHash


class MachineDescription(BaseModel):
    """A monitored machine: what it is, what its stream looks like, where to find what is said about it."""

    model_config = JSON

    site: Site
    machine: Name
    description: str = Field(description="from the machine file", examples=["Rotor kit with an overhung disc"])
    state: _State
    speed_rpm: float | None = Field(
        description="nominal speed, null where the machine file gives none", examples=[1320.0]
    )
    rate_hz: float = Field(description="samples per second and channel", examples=[2000.0])
    channels: tuple[Channel, ...] = Field(
        description="columns of the stream",
        examples=[({"name": "y1", "quantity": "displacement", "location": "bearing", "direction": "y", "unit": "um"},)],
    )
    window_length_s: float = Field(description="length of the sliding window", examples=[60.0])
    window_hop_s: float = Field(description="data time between reports", examples=[5.0])
    keys: dict[str, str] = Field(
        description="Zenoh keys by name",
        examples=[{"stream": "rotorwatch/demo/lab/stream", "health": "rotorwatch/demo/lab/health"}],
    )
    bundle: BundleIdentity
    machine_hash: MachineHash


class DetectableParameter(BaseModel):
    """What it takes to find a change of one parameter."""

    model_config = JSON

    name: str = Field(description="k_by, c_by, k_bz, c_bz, e or EI", examples=["k_by"])
    text: str = Field(description="the parameter in words", examples=["bearing stiffness, horizontal"])
    loss: float = Field(description="smallest relative change downwards found in one window", examples=[-0.025])
    gain: float = Field(description="smallest relative change upwards found in one window", examples=[0.026])
    length_s: float | None = Field(
        description="data it takes to find the wished `change`; null without a wish", examples=[16.0]
    )


class DetectableChanges(BaseModel):
    """What would be found on this machine as it runs now, with 95 % probability."""

    model_config = JSON

    site: Site
    machine: Name
    window_end_ns: int | None = Field(description="end of the window this is computed from", examples=[EXAMPLE_NS])
    window_length_s: float = Field(description="length of the window", examples=[60.0])
    false_alarms_per_month: float = Field(description="declared in the machine file", examples=[1.0])
    change: float | None = Field(description="relative change asked for; null without", examples=[-0.05])
    parameters: tuple[DetectableParameter, ...] = Field(description="one entry per parameter that can be read")
    reason: str = Field(description="why there is no entry; empty otherwise", examples=[""])
    bundle: BundleIdentity
    machine_hash: MachineHash


class MachineReadiness(BaseModel):
    """Whether one machine's monitor works."""

    model_config = JSON

    site: Site
    machine: Name
    state: _State
    worker_alive: bool = Field(description="the thread that evaluates the machine's blocks runs", examples=[True])
    worker_errors: int = Field(description="blocks lost to an error inside the monitor", examples=[0])
    last_worker_error: str = Field(description="the latest of them; empty if none", examples=[""])
    worker_busy_s: float = Field(
        description="how long the thread has been at work on the same block; more than 60 is a reason", examples=[0.0]
    )
    history_waiting: int = Field(description="steps that are not in the history yet", examples=[0])
    recording: str = Field(
        description="off, idle (nothing has arrived), recording, or failing: why. Monitoring goes on all the same",
        examples=["recording"],
    )


class Readiness(BaseModel):
    """Whether the service can do its work; machines without data are no reason against it."""

    model_config = JSON

    ready: bool = Field(description="there is no reason against it", examples=[True])
    reasons: tuple[str, ...] = Field(description="what is wrong, one sentence each; empty if ready", examples=[()])
    session_open: bool = Field(description="the Zenoh session is open", examples=[True])
    history_open: bool = Field(description="the database is connected, its tables are up to date", examples=[True])
    history_trouble: str = Field(description="why the history cannot be written; empty if it can", examples=[""])
    failing_webhooks: tuple[str, ...] = Field(
        description="webhooks that fail or are disabled, each with what is wrong; no reason against readiness",
        examples=[()],
    )
    machines: tuple[MachineReadiness, ...] = Field(description="machine by machine")


class Problem(BaseModel):
    """What went wrong with a request, after RFC 9457."""

    model_config = ConfigDict(extra="allow", frozen=True)

    type: str = Field(default="about:blank", description="kind of problem", examples=["about:blank"])
    title: str = Field(description="short, the same for every problem of the kind", examples=["Not Found"])
    status: int = Field(description="HTTP status", examples=[404])
    detail: str = Field(description="what went wrong this time", examples=["no machine demo/pump; there are: demo/lab"])
    instance: str = Field(description="path of the request", examples=["/api/v1/machines/demo/pump"])


def example(model: type[BaseModel]) -> dict[str, object]:
    """Build one valid JSON object of a model out of the examples of its fields."""
    return {name: _field_example(field.examples, field.annotation) for name, field in model.model_fields.items()}


def _field_example(examples: list[object] | None, annotation: object) -> object:
    if examples:
        return json.loads(json.dumps(examples[0]))
    item = next((part for part in get_args(annotation) if part is not Ellipsis), annotation)
    if not (isinstance(item, type) and issubclass(item, BaseModel)):
        raise TypeError(f"no example for {annotation}")
    return [example(item)] if get_origin(annotation) is tuple else example(item)
