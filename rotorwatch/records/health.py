"""A machine's report of each window, and its current health."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import Field

from rotorwatch.records.alarms import Alarm
from rotorwatch.records.fields import EXAMPLE_NS, BundleIdentity, MachineHash, Number, OfMachine, Reason, Record
from rotorwatch.records.levels import ChannelLevels, LevelGrowth
from rotorwatch.records.windows import Detectable, Equation, Opinion, Parameter, SensorFault, Shape, Verdict


class HealthState(StrEnum):
    """Health of a machine in one word."""

    WARMING = "warming"
    HEALTHY = "healthy"
    ALERT = "alert"
    DANGER = "danger"
    OUTSIDE_MODEL = "outside-model"
    DATA_HEALTH = "data-health"
    UNCHANGED = "unchanged"
    NO_DATA = "no-data"
    NOT_EVALUABLE = "not-evaluable"
    WATCHING = "watching"

    @property
    def alarmed(self) -> bool:
        """Whether an alarm on the machine is raised; other states, such as missing data, do not hide it."""
        return self in {HealthState.ALERT, HealthState.DANGER}


State = Annotated[HealthState, Field(description="health in one word", examples=["alert"])]


@dataclass(frozen=True, slots=True)
class Measure:
    """Marks a field of a report as a measure, which is kept over time, exported and shown."""

    name: str  # name in requests
    unit: str


class Report(OfMachine):
    """One evaluation of the sliding window."""

    start_ns: int = Field(description="oldest data in the window", examples=[EXAMPLE_NS - 60_000_000_000])
    end_ns: int = Field(description="end of the newest data in the window", examples=[EXAMPLE_NS])
    state: State
    filled: float = Field(description="fraction of a full window", examples=[1.0])
    speed_rad_s: Annotated[Number, Measure("speed", "rad/s")] = Field(
        default=None, description="mean speed in the window", examples=[138.23]
    )
    misfit_z: Annotated[Number, Measure("misfit", "1")] = Field(
        default=None,
        description="distance of the window from what the model can explain, standard deviations; null without a test",
        examples=[0.4],
    )
    suspect: str = Field(
        default="",
        description="what explains data outside the model best, if one thing does; else empty",
        examples=[""],
    )
    verdict: Verdict | None = Field(default=None, description="what has changed; null if the window was not evaluated")
    parameters: tuple[Parameter, ...] = Field(
        default=(), description="readings of the whole window by the diagnostician that decides"
    )
    opinions: tuple[Opinion, ...] = Field(default=(), description="what the other diagnosticians read in the window")
    equations: tuple[Equation, ...] = Field(default=(), description="the networks' residuals, equation by equation")
    detectable: tuple[Detectable, ...] = Field(default=(), description="what would have been found in this window")
    sensors: tuple[SensorFault, ...] = Field(
        default=(),
        description="faults of sensors in the window; nothing is said of the machine unless diagnosed without them",
        examples=[()],
    )
    shapes: tuple[Shape, ...] = Field(
        default=(), description="where no equation can be evaluated: whether each channel is as it was", examples=[()]
    )
    levels: tuple[ChannelLevels, ...] = Field(default=(), description="vibration levels, channel by channel")
    level_growth: LevelGrowth | None = Field(
        default=None,
        description="where the state is unchanged or watching: what growth of the levels would have raised an alert",
        examples=[None],
    )
    skipped: bool = Field(
        default=False,
        exclude_if=lambda value: not value,
        description="true where the window was not evaluated because the monitor could not keep up, and only its "
        "levels and sensors were judged; left out otherwise",
        examples=[False],
    )
    gyroscopic: Literal["", "opposite"] = Field(
        default="",
        exclude_if=lambda value: not value,
        description="opposite where the window was compared with theory whose gyroscopic moments have the opposite "
        "sense to Eq. (27), because they explain the machine and those do not; left out otherwise",
        examples=[""],
    )
    reason: Reason = ""
    bundle: BundleIdentity
    machine_hash: MachineHash


MEASURES: Mapping[str, tuple[str, Measure]] = MappingProxyType(
    {
        measure.name: (field, measure)
        for field, info in Report.model_fields.items()
        for measure in info.metadata
        if isinstance(measure, Measure)
    }
)
"""The fields of a report that are measures, by the name of the measure."""


class Quality(Record):
    """What came in since the monitor started."""

    accepted_blocks: int = Field(default=0, description="blocks accepted", examples=[2051])
    refused_blocks: dict[str, int] = Field(
        default={}, description="blocks refused, by reason", examples=[{"not-finite": 3}]
    )
    gaps: int = Field(default=0, description="interruptions before accepted blocks", examples=[1])
    missing_s: float = Field(default=0.0, description="data time the gaps cost", examples=[0.3])
    queue_dropped_blocks: int = Field(
        default=0, description="blocks dropped because the monitor could not keep up", examples=[0]
    )
    skipped_windows: int = Field(
        default=0, description="windows not evaluated because the monitor could not keep up", examples=[0]
    )
    link_missed_blocks: int = Field(
        default=0, description="blocks lost in transit, as far as the link knows", examples=[0]
    )
    last_refusal: str = Field(
        default="",
        description="latest reason for refusing a block",
        examples=["demo/lab: block 740, channel y1: sample 12 is nan, expected a finite number"],
    )
    last_gap: str = Field(
        default="", description="latest gap", examples=["demo/lab: 0.3 s of data are missing (3 blocks)"]
    )


class StreamStatus(Record):
    """What is known about whoever publishes the stream."""

    publisher_alive: bool = Field(
        description="a publisher's liveliness token is present; publishers need not have one", examples=[True]
    )
    silent: bool = Field(
        description="no usable block for longer than `no_data_after_s` of the machine file", examples=[False]
    )
    silent_since_ns: int | None = Field(
        description="end of the newest data, while it is silent; null while data come, or if none ever came",
        examples=[None],
    )
    data_age_s: float | None = Field(
        description="time since the last accepted block was processed; null before the first", examples=[0.04]
    )
    replay_announced: bool = Field(
        description="a replay is announced on the machine's own keys; replayed data are not evaluated", examples=[False]
    )
    descriptor_mismatch: tuple[str, ...] = Field(
        description="fields of the announced channel descriptor that differ from the machine file", examples=[()]
    )


class Health(OfMachine):
    """Where a machine stands: state, report of the latest window, alarms, quality of the data."""

    state: HealthState = Field(
        description="warming, healthy, unchanged (no equation can be evaluated, but every channel is as it was), "
        "alert, danger, outside-model, data-health (a sensor is at fault), no-data (silence, and no alarm on the "
        "machine is raised; see `stream.silent`), not-evaluable or watching (only vibration levels are watched: the "
        "machine is neither known nor commissioned)",
        examples=["alert"],
    )
    reason: str = Field(
        description="since when there are no data, and why nothing is said of the machine; empty otherwise",
        examples=[""],
    )
    filled: float = Field(description="fraction of a full window that is filled now", examples=[1.0])
    report: Report | None = Field(description="the latest window; null before the first hop")
    alarms: tuple[Alarm, ...] = Field(description="alarms that are not normal")
    sequence: int = Field(
        default=-1, description="sequence number of the latest alarm event in them; -1 before the first", examples=[0]
    )
    quality: Quality = Field(description="what came in")
    stream: StreamStatus = Field(description="what is known about the publisher")
    restart: str = Field(
        description="what became of the state from before the latest start of the monitor; empty if there was none",
        examples=["resumed at 2026-01-01T00:02:55Z"],
    )
    worker_errors: int = Field(description="blocks lost to an error inside the monitor", examples=[0])
    last_worker_error: str = Field(description="the latest of them; empty if none", examples=[""])
    bundle: BundleIdentity
    machine_hash: MachineHash
