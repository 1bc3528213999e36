"""Converts the rows of a file to samples of the machine's channels, in pieces without a gap."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from models.machine import MachineFile
from models.signals.block import FloatArray
from models.signals.channels import Quantity, same_unit, unit_factor
from service.interchange.clock import Clock, check_order
from service.interchange.mapping import Column, Mapping, of_voltage
from service.interchange.source import Array, Reference, Source, SourceError, as_numbers

# Largest number of isolated rows, i.e. with a gap on both sides, as part of all and in any file.
_MOST_ALONE, _MANY_ALONE = 0.1, 100_000


@dataclass(frozen=True, slots=True)
class Signal:
    """Conversion of a column to a channel: sample = number · factor + offset, in the channel's unit."""

    reference: Reference  # column with the numbers
    factor: float
    offset: float
    integrations: int  # how often it is integrated: 0, or 1 or 2 for an accelerometer
    is_angle: bool  # whether it is an angle, which wraps at 2π
    largest: float = float(np.finfo(np.float64).max)  # largest value of the machine's dtype
    doubt: str = ""  # note that the unit in the file is not understood, and which unit is assumed


@dataclass(frozen=True, slots=True)
class Piece:
    """Rows without a gap."""

    begins: bool  # whether it starts a stretch (first piece, or after a gap); otherwise it continues the last piece
    time_ns: FloatArray  # (n,), nanoseconds since the first row of the file
    samples: FloatArray  # (n, n_channels), in the units of the channels; NaN where a channel is missing


@dataclass(frozen=True, slots=True)
class Gap:
    """Time without rows: expected and actual time of the next row, nanoseconds since the first row."""

    from_ns: float
    to_ns: float
    row: int  # row of the file after the gap
    file: str


@dataclass(slots=True)
class Read:
    """Summary of what was read, updated during reading."""

    files: int = 1
    rows: int = 0  # total of all files
    # Rows of the shortest and longest of several files; 0 for a single file.
    shortest: int = 0
    longest: int = 0
    gaps: list[Gap] = field(default_factory=list)
    filled: int = 0  # rows inserted into short gaps
    # Rows left out because a cell (every cell, if channels may be missing) is empty, NaN, infinite or beyond the dtype.
    left_out: int = 0
    cut: list[str] = field(default_factory=list)  # names of files that end before what was begun is complete


def check_one_rate(path: Path, clock: Clock, read: Read) -> None:
    """Refuse rows of which too many are isolated; raises `SourceError`."""
    alone = [one.row for one, following in pairwise(read.gaps) if following.row == one.row + 1]
    if len(alone) > min(_MOST_ALONE * read.rows, _MANY_ALONE):
        raise SourceError(
            f"{path}: from row {alone[0] + 1} on, rows are isolated at {clock.rate_hz:.9g} Hz, "
            f"{len(alone)} of them; expected one rate throughout: import what has another rate by itself, "
            "with time.resample = true in the mapping, or fill such gaps with time.fill_gaps_up_to_s"
        )


def signals_of(source: Source, mapping: Mapping, machine: MachineFile) -> list[Signal]:
    """Conversions for the machine's channels, in the order of the machine file, without that of the keyphasor.

    Raises
    ------
    SourceError
        If a column is missing, or its unit is missing, wrong, or contradicts that in the file.
    """
    found = []
    for channel in machine.sensors:
        integrated = channel.name in mapping.accelerations
        column = mapping.accelerations.get(channel.name) or mapping.channels.get(channel.name)
        if column is None:
            continue
        quantity = Quantity.ACCELERATION if integrated else channel.quantity
        unit, doubt = _unit(source, column, channel.name, quantity)
        si = unit_factor(quantity, unit) / channel.to_si
        found.append(
            Signal(
                Reference(column.column, column.index),
                column.sign * _scale(source, column) * si,
                column.sign * column.offset * si,
                (1 if channel.quantity is Quantity.VELOCITY else 2) if integrated else 0,
                channel.quantity is Quantity.SHAFT_ANGLE,
                float(np.finfo(machine.dtype).max),
                doubt,
            )
        )
    return found


def pieces(source: Source, signals: Sequence[Signal], clock: Clock, mapping: Mapping, read: Read) -> Iterator[Piece]:
    """Read the file once, in pieces cut at gaps, and update `read`.

    Raises
    ------
    SourceError
        If times do not ascend or a cell is no number, naming row and column.
    """
    read.cut += [source.path.name] if source.cut else []
    splitter = _Splitter(clock, mapping, signals, read)
    columns = [signal.reference for signal in signals]
    asked = columns if clock.column is None else [clock.column, *columns]
    for chunk in source.chunks(asked):
        entries, numbers = (None, chunk) if clock.column is None else (chunk[0], chunk[1:])
        samples = np.empty((numbers[0].size, len(signals)))
        for number, signal in enumerate(signals):
            values = as_numbers(source.path, signal.reference, numbers[number], read.rows)
            samples[:, number] = values * signal.factor + signal.offset
        yield from splitter.cut(entries, samples)


class _Splitter:
    """Cuts rows at gaps, also between consecutive chunks."""

    def __init__(self, clock: Clock, mapping: Mapping, signals: Sequence[Signal], read: Read) -> None:
        self._clock, self._base, self._signals, self._read = clock, mapping.time, signals, read
        self._step_ns = 1e9 / clock.rate_hz
        self._angles = [number for number, signal in enumerate(signals) if signal.is_angle]
        self._largest = np.array([signal.largest for signal in signals])
        self._last: Piece | None = None

    def cut(self, entries: Array | None, samples: FloatArray) -> Iterator[Piece]:
        """Take the next rows of the file."""
        first_row = self._read.rows
        time_ns = self._clock.times(entries, first_row, samples.shape[0])
        self._read.rows += samples.shape[0]
        rows = np.arange(first_row, self._read.rows)
        self._check_times(time_ns, entries, first_row)
        there = np.abs(samples) <= self._largest
        if not there.all():
            if self._base.not_finite == "refuse":
                self._refuse_missing(samples, first_row)
            samples = np.where(there, samples, np.nan)
            finite = there.any(axis=1) if self._base.not_finite == "missing" else there.all(axis=1)
            self._read.left_out += int(np.count_nonzero(~finite))
            time_ns, samples, rows = time_ns[finite], samples[finite], rows[finite]
        if not time_ns.size:
            return
        steps = self._steps(time_ns, rows)
        cuts = np.flatnonzero(steps > 1)
        for begin, end in zip([0, *cuts], [*cuts, time_ns.size], strict=True):
            if begin == end:
                continue
            piece = Piece(False, time_ns[begin:end], samples[begin:end])
            yield from self._joined(piece, int(steps[begin]), int(rows[begin]))

    def _check_times(self, time_ns: FloatArray, entries: Array | None, first_row: int) -> None:
        path, column = self._clock.path, self._clock.column
        lost = np.flatnonzero(~np.isfinite(time_ns))
        if lost.size and entries is not None:
            at = int(lost[0])
            raise SourceError(
                f"{path}: row {first_row + at + 1}, column {column}: found {entries[at]}, expected a time"
            )
        check_order(path, column, time_ns, first_row)
        if self._last is not None and time_ns.size:
            check_order(path, column, np.array([self._last.time_ns[-1], time_ns[0]]), first_row - 1)

    def _refuse_missing(self, samples: FloatArray, first_row: int) -> None:
        row, number = (int(where) for where in np.argwhere(~(np.abs(samples) <= self._largest))[0])
        most = f" up to {self._largest[number]:.3g}" if np.isfinite(samples[row, number]) else ""
        raise SourceError(
            f"{self._clock.path}: row {first_row + row + 1}, column {self._signals[number].reference}: found "
            f'{samples[row, number]}, expected a finite number{most} (time.not_finite = "missing" keeps the other '
            'channels, "gap" leaves such rows out)'
        )

    def _steps(self, time_ns: FloatArray, rows: npt.NDArray[np.intp]) -> npt.NDArray[np.int64]:
        """Sampling steps from the previous row to each row: 1 if contiguous, 2 or more after a gap."""
        before = self._last.time_ns[-1] if self._last is not None else time_ns[0] - self._step_ns
        passed = np.diff(time_ns, prepend=before) / self._step_ns
        steps = np.rint(passed).astype(np.int64)
        odd = np.flatnonzero(np.abs(passed - 1) > self._base.jitter)
        for at in odd[passed[odd] < 1.5]:
            raise SourceError(
                f"{self._clock.path}: row {int(rows[at]) + 1}, column {self._clock.column}: comes {passed[at]:.3g} "
                f"sampling steps after the row before, expected 1 within {self._base.jitter:g} (time.jitter)"
            )
        return steps

    def _joined(self, piece: Piece, steps: int, row: int) -> Iterator[Piece]:
        """Append a piece to the last one; short gaps are filled."""
        last, self._last = self._last, piece
        if last is None:
            yield replace(piece, begins=True)
        elif steps == 1:
            yield piece
        elif (steps - 1) * self._step_ns <= self._base.fill_gaps_up_to_s * 1e9:
            self._read.filled += steps - 1
            yield self._bridge(last, piece, steps)
            yield piece
        else:
            self._read.gaps.append(Gap(last.time_ns[-1] + self._step_ns, piece.time_ns[0], row, self._clock.path.name))
            if len(self._read.gaps) % _MANY_ALONE == 0:  # before they fill the memory
                check_one_rate(self._clock.path, self._clock, self._read)
            yield replace(piece, begins=True)

    def _bridge(self, last: Piece, piece: Piece, steps: int) -> Piece:
        """Interpolate linearly across a gap; angles continue at their previous speed."""
        part = np.arange(1, steps)[:, None] / steps
        change = piece.samples[0] - last.samples[-1]
        for number in self._angles:
            turn = 2 * np.pi
            history = last.samples[-2:, number]
            speed = (np.diff(history)[0] + np.pi) % turn - np.pi if history.size == 2 else 0.0
            expected = speed * steps
            change[number] = (change[number] - expected + np.pi) % turn - np.pi + expected
        time_ns = last.time_ns[-1] + part[:, 0] * (piece.time_ns[0] - last.time_ns[-1])
        return Piece(False, time_ns, last.samples[-1] + part * change)


def _unit(source: Source, column: Column, name: str, quantity: str) -> tuple[str, str]:
    """Unit of a column, and a note of doubt about it, or an empty string.

    The mapping must not contradict the file. If the file states a unit that is not one of the quantity, such as volts,
    and the mapping does not scale it, the note says so.
    """
    reference = Reference(column.column, column.index)
    stated = source.unit(reference) if reference.column in source.names() else ""
    if column.unit is None:
        source.named(reference.column)
        if not stated:
            raise SourceError(
                f"{source.path}: column {reference}: the file states no unit for channel {name}; give unit in the "
                "mapping"
            )
        try:
            unit_factor(quantity, stated)
        except ValueError as error:
            told = f"{source.path}: column {reference}, channel {name}: {error}{of_voltage(stated)}"
            raise SourceError(told) from error
        return stated, ""
    if not stated or column.scale != 1 or column.scale_from is not None:
        return column.unit, ""
    if not same_unit(quantity, column.unit, stated):
        raise SourceError(
            f"{source.path}: column {reference} is in {stated!r} according to the file, but in {column.unit!r} "
            f"according to the mapping of channel {name}"
        )
    try:
        unit_factor(quantity, stated)
    except ValueError:
        told = f"the file says {stated!r}, channel {name} takes its numbers as {column.unit}"
        return column.unit, f"note: column {reference}: {told}"
    return column.unit, ""


def _scale(source: Source, column: Column) -> float:
    """Scale of a column; from an array of several scales, that at the column's index is taken."""
    if column.scale_from is None:
        return column.scale
    scales = np.ravel(source.values(column.scale_from)).astype(np.float64)
    place = 0 if scales.size == 1 else column.index
    if place is None or place >= scales.size or not np.isfinite(scales[place]) or scales[place] == 0:
        raise SourceError(
            f"{source.path}: scale_from {column.scale_from} has {scales.size} scales, expected one, or one other "
            f"than 0 for index {column.index}"
        )
    return column.scale * float(scales[place])
