"""Converts pieces of samples to the messages of a recording: first the shaft angle, then blocks.

The angle comes from a keyphasor's pulses, or from a column of angles.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from models.machine import MachineFile
from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import Quantity, time_unit_ns
from models.signals.keyphasor import EdgeDetector, PulseTrain, pulse_train, pulses_in_turn, shaft_angle
from models.signals.recording import RecordedMessage
from models.signals.wire import encode_block
from service.interchange.clock import Clock
from service.interchange.mapping import Keyphasor, Mapping
from service.interchange.samples import Piece, Read, Signal, pieces
from service.interchange.source import Reference, Source, SourceError

_TURN = 2 * np.pi
_BLOCK_S = 0.1
_SAME_NS = 1_000_000  # largest time between consecutive blocks, whose times are means


def pulse_times(source: Source, keyphasor: Keyphasor, clock: Clock, mapping: Mapping) -> FloatArray:
    """Read the times of a file's keyphasor pulses; a sampled signal is read through once for this purpose.

    Returns
    -------
    ndarray, shape (n_pulses,)
        Nanoseconds since the first row of the file.

    Raises
    ------
    SourceError
        If the array does not hold times.
    """
    if keyphasor.pulse_times is not None:
        what = keyphasor.pulse_times
        entries = source.values(what)
        if entries.dtype.kind not in "fiu":
            raise SourceError(f"{source.path}: {what} holds {entries.dtype}, expected times of pulses")
        return clock.pulse_times(entries, time_unit_ns(keyphasor.unit))
    detector = EdgeDetector(keyphasor.threshold or 0.0, keyphasor.hysteresis, rising=keyphasor.edge == "rising")
    found = [np.empty(0)]
    for piece in _pulse_signal(source, keyphasor, clock, mapping):
        if piece.begins:
            detector.interrupt()
        found.append(detector.feed(piece.time_ns, piece.samples[:, 0]))
    return np.concatenate(found)


def _pulse_signal(source: Source, keyphasor: Keyphasor, clock: Clock, mapping: Mapping) -> Iterator[Piece]:
    signal = Signal(Reference(keyphasor.column or "", keyphasor.index), 1.0, 0.0, 0, False)
    return pieces(source, [signal], clock, mapping, Read())


def without_pulses(source: Source, keyphasor: Keyphasor, clock: Clock, mapping: Mapping) -> str:
    """Say where a sampled signal without pulses lies relative to its threshold; empty for times of pulses."""
    if keyphasor.column is None:
        return ""
    found = [piece.samples for piece in _pulse_signal(source, keyphasor, clock, mapping)]
    if not found:
        return "; the signal holds no numbers"
    return (
        f"; the signal goes from {min(map(np.nanmin, found)):.6g} to {max(map(np.nanmax, found)):.6g}, "
        f"threshold = {keyphasor.threshold:g}, hysteresis = {keyphasor.hysteresis:g}"
    )


def read_pulses(path: Path, runs: Sequence[FloatArray], keyphasor: Keyphasor) -> PulseTrain:
    """Build the pulse train of a file or folder from `runs`, pulse times without gaps; each run is checked on its own.

    Raises
    ------
    SourceError
        If no run has two pulses, or their times do not ascend.
    """
    try:
        longest = [max(runs, key=len)] if all(run.size < 2 for run in runs) else [run for run in runs if run.size > 1]
        return pulses_in_turn([pulse_train(run, keyphasor.pulses_per_revolution) for run in longest])
    except ValueError as error:
        what = keyphasor.pulse_times or f"column {keyphasor.column}"
        raise SourceError(f"{path}: keyphasor {what}: {error}") from error


@dataclass(slots=True)
class AngleColumn:
    """Inserts the shaft angle at its column in the machine file, and wraps angles to [0, 2π).

    Rows with unknown angle are left out and leave a gap; if channels may be missing, the angle is NaN there instead.
    """

    machine: MachineFile
    pulses: PulseTrain | None
    reverse: bool  # whether the shaft turns from z to y
    partial: bool = False  # whether channels may be missing
    unknown: int = 0  # rows with unknown angle
    # Total rotation in a column of angles, rad, and its duration, ns.
    turned: float = 0.0
    passed_ns: float = 0.0

    @property
    def speed_rpm(self) -> float | None:
        """Mean speed from a column of angles, negative from z to y; None without such a column."""
        return 60e9 * self.turned / (_TURN * self.passed_ns) if self.passed_ns else None

    def feed(self, parts: Iterator[Piece]) -> Iterator[Piece]:
        """Add the shaft angle to a file's pieces."""
        column = next((n for n, c in enumerate(self.machine.sensors) if c.quantity is Quantity.SHAFT_ANGLE), None)
        pending = False
        for piece in parts:
            pending = pending or piece.begins
            if column is None:
                yield piece
                continue
            if self.pulses is None:
                samples = piece.samples.copy()
                samples[:, column] = np.mod(samples[:, column], _TURN)
                steps = np.mod(np.diff(samples[:, column]) + np.pi, _TURN) - np.pi
                self.turned += float(np.nansum(steps))
                self.passed_ns += float(np.diff(piece.time_ns)[np.isfinite(steps)].sum())
                yield Piece(piece.begins, piece.time_ns, samples)
                continue
            angle = shaft_angle(self.pulses, piece.time_ns, reverse=self.reverse)
            samples = np.insert(piece.samples, column, angle, axis=1)
            known = np.isfinite(angle)
            self.unknown += int(np.count_nonzero(~known))
            if self.partial:
                yield Piece(piece.begins, piece.time_ns, samples)
                continue
            edges = np.flatnonzero(np.diff(known)) + 1
            for rows in np.split(np.arange(angle.size), edges):
                if known[rows[0]]:
                    yield Piece(pending, piece.time_ns[rows], samples[rows])
                pending = not known[rows[0]]


@dataclass(slots=True)
class Written:
    """Summary of what was written to the recording."""

    blocks: int = 0
    samples: int = 0
    lengths: list[int] = field(default_factory=list)  # samples of each contiguous stretch
    too_short: int = 0  # samples in stretches too short for a block, left out
    missing: dict[str, list[tuple[int, int]]] = field(default_factory=dict)  # by channel, start and end times, ns
    none_whole: int = 0  # samples left out in blocks in which every channel lacks some
    # By channel: number, sum, sum of squares of its samples, and the least and the greatest of them.
    sums: FloatArray = field(default_factory=lambda: np.zeros(1))
    reach: FloatArray = field(default_factory=lambda: np.array([[np.inf], [-np.inf]]))
    # Time of the first sample, and of the sample after the last.
    start_ns: int = 0
    end_ns: int = 0


class BlockMaker:
    """Cuts pieces into blocks of 0.1 s, as a publisher would have sent them.

    A block's start time is the mean over its rows of the row's time minus its nominal offset in the block: jitter of
    single rows averages out, and a slightly fast or slow clock is followed. The first row of the file is at
    `origin_ns`. A channel that lacks some numbers in a block is missing in all of it, as a monitor requires.
    """

    def __init__(self, machine: MachineFile, origin_ns: int) -> None:
        self._machine, self._origin_ns = machine, origin_ns
        # Another run for another start: the next file is then not taken for the same publisher with its clock set.
        self._run = 1 + origin_ns // 1_000_000 % 65_521
        ingest, rate_hz = machine.ingest, machine.rate_hz
        self._least = max(1, int(np.ceil(ingest.block_from_s * rate_hz - 1e-9)))
        most = max(self._least, int(ingest.block_to_s * rate_hz + 1e-9))
        self._length = min(max(round(_BLOCK_S * rate_hz), self._least), most)
        self._hash = machine.descriptor.schema_hash
        self._angles = [n for n, channel in enumerate(machine.sensors) if channel.quantity is Quantity.SHAFT_ANGLE]
        self._sequence = 0
        self._expected_ns = 0.0
        self._new = True
        self.written = Written()

    def feed(self, parts: Iterator[Piece]) -> Iterator[RecordedMessage]:
        """Convert all pieces of a file to a descriptor and blocks."""
        time_ns, samples = np.empty(0), np.empty((0, len(self._machine.sensors)))
        for piece in parts:
            if piece.begins:
                yield from self._rest(time_ns, samples)
                time_ns, samples, self._new = piece.time_ns, piece.samples, True
            else:
                time_ns = np.concatenate([time_ns, piece.time_ns])
                samples = np.concatenate([samples, piece.samples])
            # The remainder is always long enough for a block of its own.
            whole = max(0, (time_ns.size - self._least) // self._length)
            for first in range(0, whole * self._length, self._length):
                rows = slice(first, first + self._length)
                yield from self._block(time_ns[rows], samples[rows])
            time_ns, samples = time_ns[whole * self._length :], samples[whole * self._length :]
        yield from self._rest(time_ns, samples)

    def _rest(self, time_ns: FloatArray, samples: FloatArray) -> Iterator[RecordedMessage]:
        """Convert the end of a stretch to one block, or two if one would be too long."""
        if time_ns.size < self._least:
            self.written.too_short += time_ns.size
            return
        parts = 2 if time_ns.size > self._length and time_ns.size >= 2 * self._least else 1
        for rows in np.array_split(np.arange(time_ns.size), parts):
            yield from self._block(time_ns[rows], samples[rows])

    def _missing(self, silence_s: float) -> int:
        """Number of blocks that would have filled a gap, by which the sequence advances; 0 between snapshots."""
        schedule = self._machine.schedule
        if schedule is not None:
            if schedule.is_silence(silence_s):
                return 0
            if silence_s > schedule.silence_s:
                silence_s = (silence_s - schedule.silence_s) * schedule.on_s / schedule.every_s
        return max(1, round(silence_s * self._machine.rate_hz / self._length))

    def _block(self, time_ns: FloatArray, samples: FloatArray) -> Iterator[RecordedMessage]:
        lost = np.asarray(np.isnan(samples).any(axis=0))
        if lost.all():
            self.written.none_whole += time_ns.size
            self._new = True
            return
        keys, rate_hz = self._machine.keys, self._machine.rate_hz
        since_ns = float(np.mean(time_ns - np.arange(time_ns.size) * (1e9 / rate_hz)))
        block_ns = self._origin_ns + round(since_ns)
        if self.written.blocks == 0:
            self.written.start_ns = block_ns
            descriptor = self._machine.descriptor.model_dump_json().encode()
            yield RecordedMessage(keys.descriptor, descriptor, b"", "application/json", block_ns, block_ns)
        elif self._new:
            self._sequence += self._missing((since_ns - self._expected_ns) / 1e9)
        if self._new:
            self.written.lengths.append(0)
        self._expected_ns = since_ns + time_ns.size * 1e9 / rate_hz
        columns = np.where(lost, np.nan, samples).astype(np.dtype(self._machine.dtype))
        for number in self._angles:  # rounding may reach 2π, which is 0
            columns[:, number] = np.where(columns[:, number] >= _TURN, 0.0, columns[:, number])
        block = SampleBlock(block_ns, self._sequence, self._run, rate_hz, columns)
        self._note(lost, block)
        there = np.where(lost, 0.0, samples)
        self.written.sums = self.written.sums + np.array(
            [~lost * len(there), there.sum(axis=0), (there**2).sum(axis=0)]
        )
        least, greatest = self.written.reach
        self.written.reach = np.array([np.fmin(least, samples.min(axis=0)), np.fmax(greatest, samples.max(axis=0))])
        payload, attachment, encoding = encode_block(block, self._hash)
        yield RecordedMessage(keys.stream, payload, attachment, encoding, block.end_ns, block.end_ns)
        self._sequence, self._new = self._sequence + 1, False
        self.written.blocks += 1
        self.written.samples += time_ns.size
        self.written.lengths[-1] += time_ns.size
        self.written.end_ns = block.end_ns

    def _note(self, lost: npt.NDArray[np.bool_], block: SampleBlock) -> None:
        """Record the channels that a block lacks, merging consecutive blocks into stretches."""
        for number in np.flatnonzero(lost):
            times = self.written.missing.setdefault(self._machine.sensors[number].name, [])
            continues = bool(times) and block.start_ns - times[-1][1] < _SAME_NS
            from_ns = times.pop()[0] if continues else block.start_ns
            times.append((from_ns, block.end_ns))
