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
from rotorwatch.records.windows import (
    Detectable,
    Equation,
    NaturalFrequency,
    Opinion,
    Parameter,
    SensorFault,
    Shape,
    Verdict,
)


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
    filled: float = Field(description="filled fraction of the window", examples=[1.0])
    speed_rad_s: Annotated[Number, Measure("speed", "rad/s")] = Field(
        default=None, description="mean speed in the window", examples=[138.23]
    )
    misfit_z: Annotated[Number, Measure("misfit", "1")] = Field(
        default=None,
        description="distance of the window from what the model can explain, in standard deviations; null if not "
        "tested",
        examples=[0.4],
    )
    suspect: str = Field(
        default="",
        description="cause that best explains data outside the model; empty if no single cause does",
        examples=[""],
    )
    verdict: Verdict | None = Field(default=None, description="what has changed; null if the window was not evaluated")
    parameters: tuple[Parameter, ...] = Field(
        default=(), description="readings of the whole window by the diagnostician that decides"
    )
    opinions: tuple[Opinion, ...] = Field(default=(), description="what the other diagnosticians read in the window")
    equations: tuple[Equation, ...] = Field(default=(), description="the networks' residuals, equation by equation")
    detectable: tuple[Detectable, ...] = Field(default=(), description="smallest changes this window would have shown")
    sensors: tuple[SensorFault, ...] = Field(
        default=(),
        description="sensor faults in the window; the machine is then not diagnosed, unless this is possible without "
        "the faulty sensors",
        examples=[()],
    )
    shapes: tuple[Shape, ...] = Field(
        default=(),
        description="if no equation can be evaluated: whether each channel vibrates as when healthy",
        examples=[()],
    )
    natural_frequencies: tuple[NaturalFrequency, ...] = Field(
        default=(),
        exclude_if=lambda value: not value,
        description="where a stiffness is read badly or not at all: whether natural frequencies are those of the "
        "healthy machine; left out otherwise",
        examples=[()],
    )
    levels: tuple[ChannelLevels, ...] = Field(default=(), description="vibration levels, channel by channel")
    level_growth: LevelGrowth | None = Field(
        default=None,
        description="in the states unchanged and watching: growth of the levels that would have raised an alert",
        examples=[None],
    )
    skipped: bool = Field(
        default=False,
        exclude_if=lambda value: not value,
        description="true if only levels and sensors of the window were judged, because the monitor could not keep "
        "up; left out otherwise",
        examples=[False],
    )
    gyroscopic: Literal["", "opposite"] = Field(
        default="",
        exclude_if=lambda value: not value,
        description="opposite if the window was compared with theory whose gyroscopic moments have the opposite sense "
        "to Eq. (27), because that explains the machine and Eq. (27) does not; left out otherwise",
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
    """Data received since the monitor started."""

    accepted_blocks: int = Field(default=0, description="blocks accepted", examples=[2051])
    refused_blocks: dict[str, int] = Field(
        default={}, description="blocks refused, by reason", examples=[{"not-finite": 3}]
    )
    gaps: int = Field(default=0, description="gaps: interruptions before accepted blocks", examples=[1])
    missing_s: float = Field(default=0.0, description="data time lost in gaps", examples=[0.3])
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
    """What is known about the publisher of the stream."""

    publisher_alive: bool = Field(
        description="a publisher's liveliness token is present; publishers need not have one", examples=[True]
    )
    silent: bool = Field(
        description="no usable block for longer than `no_data_after_s` of the machine file", examples=[False]
    )
    silent_since_ns: int | None = Field(
        description="end of the newest data during silence; null while data arrive, or if none ever did",
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
    """Current health of a machine: state, report of the latest window, alarms, quality of the data."""

    state: HealthState = Field(
        description="warming, healthy, unchanged (no equation can be evaluated, but every channel vibrates as on the "
        "healthy machine), alert, danger, outside-model, data-health (a sensor is at fault), no-data (silence, and no "
        "alarm on the machine is raised; see `stream.silent`), not-evaluable or watching (only vibration levels are "
        "watched, because the parameters are not known and the machine is not commissioned)",
        examples=["alert"],
    )
    reason: str = Field(
        description="since when no data have arrived, and why the machine is not diagnosed; empty otherwise",
        examples=[""],
    )
    filled: float = Field(description="fraction of a full window that is filled now", examples=[1.0])
    report: Report | None = Field(description="report of the latest window; null before the first hop")
    alarms: tuple[Alarm, ...] = Field(description="alarms that are not normal")
    sequence: int = Field(
        default=-1, description="sequence number of the latest event in `alarms`; -1 before the first", examples=[0]
    )
    quality: Quality = Field(description="data received since the monitor started")
    stream: StreamStatus = Field(description="what is known about the publisher")
    restart: str = Field(
        description="what became of the state saved before the latest start of the monitor; empty if none was saved",
        examples=["resumed at 2026-01-01T00:02:55Z"],
    )
    worker_errors: int = Field(description="blocks lost to an error inside the monitor", examples=[0])
    last_worker_error: str = Field(description="latest error inside the monitor; empty if none", examples=[""])
    bundle: BundleIdentity
    machine_hash: MachineHash
