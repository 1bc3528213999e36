"""A scenario as a stream of sample blocks and truth records, the messages they are sent as, and recording them.

The same scenario and seed give bit-identical samples whatever the length of the blocks: samples are made in pieces on a
grid of their own and only then cut into blocks. A piece ends at a change of the plant, but not at one of a sensor, so
that a sensor's fault or setting never changes the motion of the machine.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field

from models.machine import Machine, MachineFile
from models.signals.block import SampleArray, SampleBlock
from models.signals.recording import RecordedMessage, RecordingWriter
from models.signals.wire import encode_arrow, encode_block
from simulator.plant import NONLINEAR, NonlinearPlant, Plant, theoretical_moments
from simulator.scenario import NamedSource, Scenario
from simulator.sensors import SensorBank
from simulator.timeline import Condition, compile_timeline


class TruthRecord(BaseModel, extra="forbid", frozen=True):
    """True condition from a given time on; sent at the start, at every change, and every second during a ramp."""

    time_ns: int = Field(description="acquisition time of the first sample for which this is true, ns since 1970 UTC")
    data_s: float = Field(description="the same time in seconds from the first sample")
    run: int
    machine: str
    scenario: str
    seed: int
    relative_changes: dict[str, float] = Field(description="change of every parameter from the original machine")
    speed_rpm: float
    sources: tuple[NamedSource, ...]
    excitation_level: float = Field(default=1.0, description="factor on the white noise that drives all sources")
    anomalies: dict[str, float] = Field(default={}, description="size of a crack, a rub, added mass; absent if none")
    sensor_faults: dict[str, dict[str, float | None]] = Field(
        description="active faults and their values by channel; null if the kind has no value"
    )
    ramping: tuple[str, ...] = Field(
        description="what is still changing: parameters, sources, sensors, anomalies, 'speed', …"
    )

    @property
    def text(self) -> str:
        """One short line for a progress display.

        Examples
        --------
        >>> TruthRecord(time_ns=0, data_s=0, run=1, machine="lab", scenario="s", seed=1, speed_rpm=1320, sources=(),
        ...             relative_changes={"k_by": -0.2}, sensor_faults={}, ramping=()).text
        'k_by -20 %'
        """
        changes = [(name, round(100 * change, 6)) for name, change in self.relative_changes.items()]
        parts = [f"{name} {change:+.3g} %" for name, change in changes if change]
        parts += [f"{kind.replace('_', ' ')} {100 * size:.3g} %" for kind, size in self.anomalies.items()]
        parts += [f"{channel} {'+'.join(faults)}" for channel, faults in self.sensor_faults.items()]
        return ", ".join(parts) or "no fault"


JSON_ENCODING = "application/json"
BlockEncoding = Literal["raw", "arrow"]
BlockStream = Iterator[tuple[SampleBlock, tuple[TruthRecord, ...]]]  # what `simulator.stream.blocks` returns


@dataclass(frozen=True, slots=True)
class RunSummary:
    """What has been sent or recorded so far."""

    blocks: int = 0
    data_s: float = 0.0  # data seconds in these blocks
    elapsed_s: float = 0.0  # seconds since the first block
    truth: TruthRecord | None = None  # the latest one
    # Whether somebody subscribes to the stream; None as long as it is not known, and for a recording.
    heard: bool | None = None

    @property
    def pace(self) -> float:
        """Data seconds per second."""
        return self.data_s / self.elapsed_s if self.elapsed_s > 0 else 0.0


def block_message(block: SampleBlock, schema_hash: str, encoding: BlockEncoding) -> tuple[bytes, bytes, str]:
    """Payload, attachment and encoding string of a block."""
    return encode_block(block, schema_hash) if encoding == "raw" else encode_arrow(block, schema_hash)


def descriptor_payload(machine: MachineFile) -> bytes:
    """Encode the channel descriptor as JSON."""
    return machine.descriptor.model_dump_json().encode()


# 2026-01-01T00:00:00Z: a fixed start, so that the same scenario makes the same bytes.
DEFAULT_START_NS = 1_767_225_600_000_000_000
_PIECE = 4000  # samples that are simulated at a time


def blocks(
    scenario: Scenario, machine: Machine, block_s: float = 0.1, start_ns: int = DEFAULT_START_NS, run: int = 1
) -> BlockStream:
    """Simulate a scenario with the original machine: each block, and the truth records that begin within it, ascending.

    The last block may be shorter than `block_s`. The first sample is acquired at `start_ns`, ns since 1970-01-01 UTC;
    the run number in every block is 0 to 65535.

    Raises
    ------
    MachineFileError
        If the scenario names a channel the machine does not have.
    ValueError
        If a block would hold no sample.
    """
    scenario.check_channels(machine)
    n_block = round(block_s * machine.rate_hz)
    if n_block < 1:
        raise ValueError(f"block_s {block_s} holds no sample at {machine.rate_hz} Hz")
    return _cut(scenario, machine, n_block, start_ns, run)


def _cut(scenario: Scenario, machine: Machine, n_block: int, start_ns: int, run: int) -> BlockStream:
    simulation = _Simulation(scenario, machine, start_ns, run)
    for sequence, (first, last) in enumerate(_spans(machine, simulation.n_samples, n_block)):
        simulation.skip(first)
        samples = simulation.take(last - first)
        truth = simulation.truth(last)
        start = simulation.time_ns(first)
        yield SampleBlock(start, sequence, run, machine.rate_hz, samples), truth


def _spans(machine: MachineFile, n_samples: int, n_block: int) -> Iterator[tuple[int, int]]:
    """First sample of each block and the one after its last; with a schedule, only blocks within snapshots."""
    schedule, rate_hz = machine.schedule, machine.rate_hz
    period = n_samples if schedule is None else round(schedule.every_s * rate_hz)
    length = n_samples if schedule is None else round(schedule.on_s * rate_hz)
    for start in range(0, n_samples, period):
        end = min(start + length, n_samples)
        for first in range(start, end, n_block):
            yield first, min(first + n_block, end)


class _Simulation:
    """Plant, sensors and truth of one run, in pieces."""

    def __init__(self, scenario: Scenario, machine: Machine, start_ns: int, run: int) -> None:
        self._scenario, self._machine, self._start_ns, self._run = scenario, machine, start_ns, run
        self.n_samples = max(1, round(scenario.duration_s * machine.rate_hz))
        timeline = compile_timeline(scenario, machine)
        self._conditions = deque(timeline.conditions)
        self._past: list[tuple[int, Condition]] = [self._conditions.popleft()]
        self._truth = deque(entry for entry in timeline.truth if entry[0] < self.n_samples)
        plant_seed, *sensor_seeds = np.random.SeedSequence(scenario.seed).spawn(1 + len(machine.sensors))
        initial = self._past[0][1]
        # The exact linear plant wherever it serves: only a crack or a rub needs the other one.
        nonlinear = any(NONLINEAR & set(condition.anomalies) for _, condition in timeline.conditions)
        plant = NonlinearPlant if nonlinear else Plant
        self._plant = plant(machine, initial, np.random.default_rng(plant_seed))
        moments, rngs = theoretical_moments(machine, initial), [np.random.default_rng(seed) for seed in sensor_seeds]
        self._sensors = SensorBank(machine, scenario.sensors, moments, timeline.sensor_faults, rngs)
        self._made = self._taken = 0
        self._rest = np.empty((0, len(machine.sensors)), dtype=machine.dtype)

    def skip(self, first: int) -> None:
        """Discard the samples before `first`; the machine goes on moving in them."""
        while self._taken < first:
            self.take(min(_PIECE, first - self._taken))

    def take(self, n_samples: int) -> SampleArray:
        """Next samples of all channels."""
        self._taken += n_samples
        parts = [self._rest]
        held = len(self._rest)
        while held < n_samples:
            parts.append(self._make())
            held += len(parts[-1])
        samples = np.concatenate(parts)
        self._rest = samples[n_samples:]
        return samples[:n_samples]

    def _make(self) -> SampleArray:
        first = self._made
        if self._conditions and self._conditions[0][0] == first:
            self._past.append(self._conditions.popleft())
            self._plant.change(self._past[-1][1])
        end = (first // _PIECE + 1) * _PIECE
        if self._conditions:
            end = min(end, self._conditions[0][0])
        self._made = end
        return self._sensors.measure(self._plant.advance(end - first), first)

    def truth(self, last: int) -> tuple[TruthRecord, ...]:
        """Take the records that are due before sample `last`."""
        records = []
        while self._truth and self._truth[0][0] < last:
            records.append(self._record(*self._truth.popleft()))
        while len(self._past) > 1 and self._past[1][0] <= last:
            del self._past[0]
        return tuple(records)

    def _record(self, sample: int, ramping: tuple[str, ...]) -> TruthRecord:
        condition = [condition for at, condition in self._past if at <= sample][-1]
        return TruthRecord(
            time_ns=self.time_ns(sample),
            data_s=sample / self._machine.rate_hz,
            run=self._run,
            machine=self._machine.name,
            scenario=self._scenario.name,
            seed=self._scenario.seed,
            relative_changes=dict(condition.relative_changes),
            speed_rpm=condition.speed_rpm,
            sources=condition.sources,
            excitation_level=condition.excitation_level,
            anomalies=dict(condition.anomalies),
            sensor_faults={name: dict(faults) for name, faults in self._sensors.faults_at(sample).items()},
            ramping=ramping,
        )

    def time_ns(self, sample: int) -> int:
        return self._start_ns + round(sample * 1e9 / self._machine.rate_hz)


def record(
    machine: MachineFile,
    stream: BlockStream,
    path: Path,
    *,
    encoding: BlockEncoding = "raw",
    overwrite: bool = False,
    stop: Event | None = None,
    on_block: Callable[[RunSummary], None] | None = None,
) -> RunSummary:
    """Record descriptor, truth and blocks under the keys a publisher would use.

    All times in the file are data time: a block is logged at the time of the sample after its last one, when a real
    machine could have sent it at the earliest. The file is ``.part`` until complete; when `stop` is set, it ends after
    the current block and is complete. Raises `RecordingError` if it cannot be written.
    """
    keys, schema_hash = machine.keys, machine.descriptor.schema_hash
    begin = time.monotonic()
    summary = RunSummary()
    first_ns: int | None = None
    with RecordingWriter(path, overwrite=overwrite) as writer:

        def write(key: str, time_ns: int, payload: bytes, attachment: bytes = b"", form: str = JSON_ENCODING) -> None:
            writer.write(RecordedMessage(key, payload, attachment, form, time_ns, time_ns))

        for block, truth in stream:
            if first_ns is None:
                first_ns = block.start_ns
                write(keys.descriptor, first_ns, descriptor_payload(machine))
            for entry in truth:
                write(keys.truth, entry.time_ns, entry.model_dump_json().encode())
            write(keys.stream, block.end_ns, *block_message(block, schema_hash, encoding))
            data_s, latest = (block.end_ns - first_ns) / 1e9, truth[-1] if truth else summary.truth
            summary = RunSummary(summary.blocks + 1, data_s, time.monotonic() - begin, latest)
            if on_block is not None:
                on_block(summary)
            if stop is not None and stop.is_set():
                break
    return summary
