"""Replays: requests, progress and results."""

from typing import Annotated, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.fields import Record, Request
from rotorwatch.records.health import Report

TOML_NAME = r"^[A-Za-z0-9][A-Za-z0-9_. -]{0,94}\.toml$"


class ReplayProgress(Record):
    """Progress of a replay."""

    fraction: float = Field(ge=0, le=1, description="fraction of the data replayed; 1 at the end", examples=[0.5])
    position_ns: int = Field(description="time that the data have reached", examples=[1767225805000000000])
    messages: int = Field(description="messages read so far", examples=[3000])
    windows: int = Field(description="windows evaluated so far; 0 if the replay only publishes", examples=[60])
    alarms: int = Field(description="alarm events so far; 0 if the replay only publishes", examples=[1])
    pass_number: int = Field(description="which repetition this is, from 1", examples=[1])
    paused: bool = Field(description="whether the replay is paused", examples=[False])


class ParameterLimits(Record):
    """Limits of a parameter's relative change, either sign."""

    raise_above: float = Field(description="alert when it is larger", examples=[0.1])
    clear_below: float = Field(description="back to normal when it is smaller", examples=[0.06])
    danger_above: float = Field(description="danger when it is larger", examples=[0.4])


class OfflineSummary(Record):
    """What an offline replay found."""

    site: str = Field(description="site of the machine whose file was used", examples=["demo"])
    machine: str = Field(description="name of the machine", examples=["lab"])
    bundle: str | None = Field(
        description="identity of the trained networks; null without", examples=["lab-3f9c1e0b7a52"]
    )
    machine_hash: str = Field(description="changes with the machine file's content", examples=["9a0c41d27be8"])
    windows: int = Field(description="number of window reports", examples=[119])
    skipped_windows: int = Field(
        default=0, description="windows not evaluated, as by the monitor during the recording", examples=[0]
    )
    alarms: int = Field(description="number of alarm events", examples=[1])
    raised: tuple[str, ...] = Field(description="alarms raised at the end", examples=[["k_by"]])
    blocks: int = Field(description="blocks accepted", examples=[6000])
    refused_blocks: dict[str, int] = Field(description="blocks refused, by reason", examples=[{"overlap": 1}])
    last_refusal: str = Field(description="latest reason for refusing a block; empty if none was", examples=[""])
    gaps: int = Field(description="gaps: interruptions before accepted blocks", examples=[0])
    missing_s: float = Field(description="data time lost in gaps", examples=[0.0])
    data_s: float = Field(description="length of the accepted blocks", examples=[600.0])
    elapsed_s: float = Field(description="how long the replay took", examples=[12.0])
    times_real_time: float = Field(description="data_s over elapsed_s", examples=[50.0])
    descriptor_differences: tuple[str, ...] = Field(
        description="how the recorded channel descriptor differs from the machine file", examples=[[]]
    )
    first_windows: str = Field(
        default="",
        description="how far the first windows have come, if levels are compared with them; else empty",
        examples=["levels are compared with the first windows, until 2026-01-01T00:05:05Z"],
    )
    limits: dict[str, ParameterLimits] = Field(
        default={},
        description="limits in use, by parameter; those of levels are in the reports",
        examples=[{"k_by": {"raise_above": 0.1, "clear_below": 0.06, "danger_above": 0.4}}],
    )
    stopped: bool = Field(description="whether the replay was stopped before the end", examples=[False])
    sha256: str = Field(description="SHA-256 of all result lines, each with its line end", examples=["9f86d081"])


class ReplayLine(Record):
    """One line of a program that replays: progress, or the summary at the end."""

    kind: Literal["progress", "summary"]
    progress: ReplayProgress | None = None
    summary: OfflineSummary | None = None


class ReplayRequest(Request):
    """A replay to be started."""

    recordings: tuple[str, ...] = Field(
        min_length=1,
        max_length=1000,
        description="ids of recordings of one machine, in any order",
        examples=[["demo/lab/20260101T000000Z.mcap"]],
    )
    mode: Literal["offline", "paced"] = Field(
        default="offline",
        description="offline: evaluated by a separate monitor at full speed; paced: published on the network below "
        "`prefix`",
        examples=["offline"],
    )
    machine: str | None = Field(
        default=None,
        description="offline: another machine file, as a shipped name or SITE/MACHINE of a monitored one",
        examples=["demo/lab"],
    )
    machine_file: str | None = Field(
        default=None,
        max_length=100_000,
        description="offline: text of another machine file for the recorded machine, instead of `machine`. It is used "
        "with the commissioning of the monitored machine; trained networks are used only if `bundle` names them",
        examples=[None],
    )
    machine_file_name: str = Field(
        default="sent.toml",
        pattern=TOML_NAME,
        description="name by which the replay refers to `machine_file`",
        examples=["stricter.toml"],
    )
    bundle: str | None = Field(
        default=None,
        description="offline: other trained networks, as a shipped name; needs `machine` or `machine_file`",
        examples=["lab"],
    )
    changes: tuple[Annotated[str, Field(max_length=500)], ...] = Field(
        default=(),
        max_length=100,
        description="offline: lines that override those of the machine file, FIELD=VALUE as in TOML",
        examples=[["alarms.parameters.k_by.raise_above=0.2", "alarms.on_delay_s=60.0"]],
    )
    from_ns: int | None = Field(
        default=None, ge=0, description="only data from this time on", examples=[1767225600000000000]
    )
    to_ns: int | None = Field(
        default=None, ge=0, description="only data before this time", examples=[1767225900000000000]
    )
    pace: float = Field(
        default=1.0, ge=0.1, le=1000.0, description="paced: seconds of data per second", examples=[10.0]
    )


class ReplayJob(Record):
    """A replay that was started over HTTP."""

    id: str = Field(description="identifies the replay until the service stops", examples=["5f2b9c0d1a7e"])
    state: Literal["running", "paused", "finished", "stopped", "failed"] = Field(
        description="finished: reached the end; stopped: ended on request; failed: see `error`", examples=["finished"]
    )
    mode: Literal["offline", "paced"] = Field(description="as requested", examples=["offline"])
    recordings: tuple[str, ...] = Field(
        description="ids of the recordings", examples=[["demo/lab/20260101T000000Z.mcap"]]
    )
    machine: str | None = Field(
        description="machine file and, after @, bundle for the evaluation; null: chosen by the recorded name",
        examples=["lab@lab"],
    )
    machine_file_sent: bool = Field(
        default=False,
        exclude_if=lambda value: not value,
        description="true if the machine file was sent with the request; left out otherwise",
        examples=[True],
    )
    changes: tuple[str, ...] = Field(
        default=(), description="lines that override those of the machine file", examples=[["alarms.on_delay_s=60.0"]]
    )
    from_ns: int | None = Field(description="as requested", examples=[1767225600000000000])
    to_ns: int | None = Field(description="as requested", examples=[1767225900000000000])
    pace: float | None = Field(
        default=None, description="seconds of data per second; null: as fast as possible", examples=[None]
    )
    prefix: str = Field(
        description="paced: prefix of every key, and namespace of a monitor for the replay; empty if offline",
        examples=[""],
    )
    started_ns: int = Field(description="when it was started, by this computer's clock", examples=[1767312000000000000])
    progress: ReplayProgress | None = Field(description="progress; null before the first message")
    summary: OfflineSummary | None = Field(description="results; null before the end, and if paced")
    error: str = Field(description="why it failed; empty otherwise", examples=[""])


class ReplaySeek(Request):
    """Position from which a replay continues: a time, or an offset from the current position."""

    model_config = ConfigDict(
        json_schema_extra={
            "if": {"properties": {"to_ns": {"type": "integer"}}, "required": ["to_ns"]},
            "then": {"properties": {"by_s": {"type": "null"}}},
            "else": {"properties": {"by_s": {"type": "number"}}, "required": ["by_s"]},
        }
    )

    to_ns: int | None = Field(default=None, ge=0, description="time of the data", examples=[1767225700000000000])
    by_s: float | None = Field(
        default=None,
        ge=-1e9,
        le=1e9,
        description="offset from the current position, back if negative; give this or `to_ns`",
        examples=[None],
    )

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.to_ns is None) == (self.by_s is None):
            raise ValueError("give either to_ns or by_s")
        return self


class ReplayList(Record):
    """Replays since the service started, the latest first."""

    replays: tuple[ReplayJob, ...] = Field(description="the latest first")


_NEXT = "pass it as offset to go on; null if there is no more yet"


class ReplayReportList(Record):
    """Window reports of a replay, in the order of the data."""

    reports: tuple[Report, ...] = Field(description="oldest first")
    next_offset: int | None = Field(description=_NEXT, examples=[100])


class ReplayAlarmList(Record):
    """Alarm events of a replay, in the order of the data."""

    events: tuple[AlarmCloudEvent, ...] = Field(description="oldest first")
    next_offset: int | None = Field(description=_NEXT, examples=[100])
