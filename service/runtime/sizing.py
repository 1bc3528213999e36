"""What a plant will take: processor, memory, disk and network, from measurements on several kinds of machines.

The figures are data (``costs.toml``, written by ``python benchmarks/costs.py``). A model interpolates between them. In
it every cost is a sum of non-negative terms, fitted to all kinds at once so that relative deviations are least
(non-negative least squares, C. L. Lawson, R. J. Hanson: Solving Least Squares Problems, 1974):

- processor time of a report: a constant, and terms per second of data and per sample of all channels; if the machine is
  diagnosed, a further constant and a further term per sample; a constant for its networks;
- memory of a machine, beside that of a process without machines: a constant, and a term per sample of a hop; if it is
  diagnosed, a further constant and a term per pair of channels; a constant for its networks;
- bytes of a report, wherever they go: a constant, a term per channel, and constants for diagnosis and for networks.

Computed exactly are the samples as they come in, 4 bytes each, and how long things are kept.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from pydantic import BaseModel, Field
from scipy.optimize import nnls

from models.mistakes import read_toml
from models.signals.block import FloatArray
from service.history.records import Retention
from service.runtime.shards import OF_A_SHARD
from service.settings.service import RecordingSettings

_DAY_S = 86_400.0
_SAMPLE_BYTES = 4
_BUCKET = 2.2
"""Ratio of the bytes of a bucket to those of a window's readings: 20 machines, a million windows
(benchmarks/history.py)."""
_FIGURES = Path(__file__).with_name("costs.toml")

Measured = Literal["processor_ms", "memory_mb", "written_kb", "reports_kb", "readings_kb", "told_kb"]


class Kind(BaseModel, extra="forbid", frozen=True):
    """How much data a machine sends, and how they are evaluated."""

    channels: int = Field(ge=1, description="channels of the stream, the shaft angle among them")
    rate_hz: float = Field(gt=0, le=1e6, allow_inf_nan=False, description="samples per second and channel")
    hop_s: float = Field(gt=0, le=_DAY_S, allow_inf_nan=False, description="seconds between reports")
    diagnosed: bool = Field(description="parameters are read; otherwise levels alone are watched")
    networks: bool = Field(description="trained networks beside the likelihood")

    @property
    def samples(self) -> float:
        """Samples of all channels in a hop, millions."""
        return self.channels * self.rate_hz * self.hop_s / 1e6

    def terms(self, what: Measured) -> list[float]:
        """Terms of the model, each to be multiplied by a cost that is the same for all kinds."""
        diagnosed, networks = float(self.diagnosed), float(self.networks)
        if what == "processor_ms":
            return [1.0, self.hop_s, self.samples, diagnosed, diagnosed * self.samples, networks]
        if what == "memory_mb":
            return [1.0, self.samples, diagnosed, diagnosed * self.channels**2, networks]
        return [1.0, self.channels, diagnosed, networks]


class Case(Kind):
    """A kind of machine that was measured: what one report of one machine takes, and the memory of one machine."""

    processor_ms: float = Field(gt=0)
    memory_mb: float = Field(gt=0, description="beside that of a process without machines")
    written_kb: float = Field(ge=0, description="to the disk, by the history")
    reports_kb: float = Field(gt=0, description="of the history's file, for the report")
    readings_kb: float = Field(gt=0, description="of the history's file, for the readings")
    told_kb: float = Field(gt=0, description="of the report on its topic")


class RecordingCost(BaseModel, extra="forbid", frozen=True):
    """What it takes to record samples (``python benchmarks/recording.py``)."""

    compressed: float = Field(gt=0, le=1, description="bytes in the file to bytes that came; noise hardly compresses")
    processor_s_per_mb: float = Field(ge=0)


class Costs(BaseModel, extra="forbid", frozen=True):
    """Everything that was measured, and on what."""

    computer: str
    version: str = Field(description="of this program")
    machines: int = Field(ge=1, description="of each kind, in one process")
    seconds: float = Field(gt=0, description="for which each kind was measured")
    seeds: tuple[int, ...]
    process_mb: float = Field(gt=0, description="memory of a process without machines")
    recording: RecordingCost
    cases: tuple[Case, ...] = Field(min_length=1)

    @cached_property
    def _of_terms(self) -> dict[Measured, FloatArray]:
        found: dict[Measured, FloatArray] = {}
        for what in get_args(Measured):
            measured = np.array([getattr(case, what) for case in self.cases])
            scale = np.maximum(measured, 1e-3 * max(measured.max(), 1e-9))
            terms = np.array([case.terms(what) for case in self.cases])
            found[what] = nnls(terms / scale[:, None], measured / scale)[0]
        return found

    def of(self, kind: Kind, what: Measured) -> float:
        """Cost of a kind of machine by the model."""
        cost: float = self._of_terms[what] @ np.array(kind.terms(what))
        return cost

    def deviation(self, what: Measured) -> float:
        """Largest relative difference between the model and what was measured."""
        measured: list[float] = [getattr(case, what) for case in self.cases]
        return max(abs(self.of(case, what) / one - 1) for case, one in zip(self.cases, measured, strict=True) if one)

    def outside(self, kind: Kind) -> list[str]:
        """In which respects a kind lies outside those that were measured, in words; empty if in none."""
        like = [case for case in self.cases if (case.diagnosed, case.networks) == (kind.diagnosed, kind.networks)]
        told = []
        for name, unit in (("channels", ""), ("rate_hz", " Hz"), ("hop_s", " s")):
            value, found = getattr(kind, name), [getattr(case, name) for case in like]
            if found and not min(found) <= value <= max(found):
                what = name.partition("_")[0]
                told.append(f"{what} {value:g}{unit}, measured {min(found):g} to {max(found):g}{unit}")
        return told or ([] if like else ["no machine that is diagnosed like that was measured"])


@dataclass(frozen=True, slots=True)
class Size:
    """What a number of machines of one kind take together."""

    machines: int
    cores: float
    recording_cores: float
    shards: int  # processes beside the serving one, so many that none is busier than asked for
    machine_core: float  # what one machine takes of the one core that it can use
    computers: int
    memory_mb: float
    network_in_mb_s: float
    network_out_mb_s: float  # to one subscriber of all reports
    history_written_gb_day: float
    history_gb: float
    recorded_gb_day: float
    recordings_gb: float
    recordings_days: float  # how far back they go
    alarm_recordings_gb: float  # at most


def load_costs() -> Costs:
    """Read the measured costs."""
    return Costs.model_validate(read_toml(_FIGURES))


def sized(
    costs: Costs,
    kind: Kind,
    machines: int,
    *,
    retention: Retention,
    recording: RecordingSettings,
    cores: int,
    busy: float,
) -> Size:
    """Size of a plant on computers with `cores` cores, of which a fraction `busy`, up to 1, may be used on average."""
    a_day = _DAY_S / kind.hop_s
    stream_mb_s = kind.channels * kind.rate_hz * _SAMPLE_BYTES / 1e6
    recorded_gb_day = stream_mb_s * costs.recording.compressed * _DAY_S / 1e3
    used = machines * costs.of(kind, "processor_ms") / 1e3 / kind.hop_s
    recorders = machines * stream_mb_s * costs.recording.processor_s_per_mb
    computers = min(machines, math.ceil((used + recorders) / (busy * cores)))
    in_fleet, on_one = math.ceil(machines / OF_A_SHARD), max(1, min(cores, machines // OF_A_SHARD))
    processes = in_fleet if computers > 1 else on_one  # as `fleet_count` and `shard_count` say
    # More processes may be needed, because none uses more than one core or runs on two computers.
    processes = min(machines, max(processes, math.ceil(used / busy), computers if computers > 1 else 1))
    shards = processes if processes > 1 else 0
    reports_kb, readings_kb = costs.of(kind, "reports_kb"), costs.of(kind, "readings_kb")
    kept_kb = a_day * (reports_kb * retention.reports_days + readings_kb * retention.readings_days)
    kept_kb += _BUCKET * readings_kb * _DAY_S / retention.bucket_s * retention.buckets_days
    kept_days = min(recording.keep_days, recording.keep_gb / recorded_gb_day)
    return Size(
        machines=machines,
        cores=used,
        recording_cores=recorders,
        shards=shards,
        machine_core=used / machines,
        computers=computers,
        memory_mb=costs.process_mb * (1 + shards) + machines * costs.of(kind, "memory_mb"),
        network_in_mb_s=machines * stream_mb_s,
        network_out_mb_s=machines * costs.of(kind, "told_kb") / kind.hop_s / 1e3,
        history_written_gb_day=machines * max(costs.of(kind, "written_kb"), reports_kb + readings_kb) * a_day / 1e6,
        history_gb=machines * kept_kb / 1e6,
        recorded_gb_day=machines * recorded_gb_day,
        recordings_gb=machines * kept_days * recorded_gb_day,
        recordings_days=kept_days,
        alarm_recordings_gb=machines * min(recording.alarm_keep_gb, recording.alarm_keep_days * recorded_gb_day),
    )
