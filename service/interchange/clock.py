"""Time of each row, from a column or a rate; checks rates and order of times for all formats."""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np

from models.ingest import lasting
from models.machine import MachineFile
from models.signals.block import FloatArray
from models.signals.channels import time_unit_ns
from service.interchange.mapping import TimeBase
from service.interchange.source import Array, Reference, Source, SourceError, Timing

_MOST_RATIO = 2000
_LATEST_NS = 9_214_646_400 * 10**9  # 2262: nanoseconds since 1970 fill 64 bits soon after
_MOST_RATE_DIFFERENCE = 1e-4
"""Largest relative difference of the mapping's and the file's rate: UFF rounds steps to six digits."""
_HOUR_NS = 3_600e9
_YEAR_NS = 31_556_952e9


@dataclass(frozen=True, slots=True)
class Clock:
    """Time base of a file: conversion of its times, and its rate."""

    path: Path  # the file, for messages
    column: Reference | None  # column with the times; None if rows are equally spaced
    unit_ns: float  # nanoseconds per unit of that column
    origin_ns: int  # time of the first row, nanoseconds since 1970-01-01 UTC
    first: Array  # the first row's entry in the column, shape (1,); times are counted from it
    rate_hz: float  # rows per second
    ratio: Fraction  # the machine's rate over `rate_hz`; other than 1 if the file is to be resampled

    def times(self, entries: Array | None, first_row: int, count: int) -> FloatArray:
        """Times of `count` rows, nanoseconds since the first row of the file; NaN where there is none.

        `entries` is the time column of these rows, if there is one.
        """
        if entries is None:
            return np.asarray((first_row + np.arange(count)) * (1e9 / self.rate_hz))
        return _since(entries, self.first, self.unit_ns)

    def after(self, first: "Clock") -> "Clock":
        """Return the clock of a later file of a folder, without counting the offset between files twice.

        If a time column continues from file to file, it already contains the offset that the files' names, or their
        places in a schedule, state; then the column alone decides.
        """
        if self.column is None or first.first.dtype.kind == "M":
            return self
        ran_ns = _nanoseconds(self.first[0], self.unit_ns) - _nanoseconds(first.first[0], self.unit_ns)
        told_ns = self.origin_ns - first.origin_ns - ran_ns
        return replace(self, origin_ns=first.origin_ns + ran_ns) if 2 * ran_ns > told_ns > 0 else self

    def pulse_times(self, entries: Array, unit_ns: float) -> FloatArray:
        """Times of pulses, nanoseconds since the first row; `entries` are counted from the same zero as the rows."""
        zero = self.first.astype(np.float64)[0] * self.unit_ns if self.column is not None else 0.0
        return np.asarray(entries.astype(np.float64) * unit_ns - zero)


def clock_for(
    source: Source, columns: list[Reference], base: TimeBase, machine: MachineFile, start_ns: int | None = None
) -> Clock:
    """Determine rate and start of the rows (`start_ns` if it is known), and check the rate against the machine.

    Raises
    ------
    SourceError
        If file and mapping lack the rate or start or contradict each other, or the rate is not the machine's.
    """
    path, timing = source.path, source.timing(columns)
    column, unit_ns = timing.time, 1e9
    if base.column is not None:
        column, unit_ns = Reference(base.column, base.index), 1.0 if base.is_datetime else time_unit_ns(base.unit)
        _check_unit(source, column, base)
    declared = _declared_rate(source, base, timing)
    if column is None:
        if declared is None:
            raise SourceError(f"{path}: the rate is not known; give time.column or time.rate_hz in the mapping")
        first, measured, tolerance = np.zeros(1), declared, 0.0
        origin_ns = _start_ns(path, base, timing, start_ns)
    else:
        entries = _first_times(source, column, columns)
        first = entries[:1]
        if base.is_datetime and first.dtype.kind != "M":
            raise SourceError(
                f"{path}: column {column} holds numbers ({first.dtype}) such as {first[0]}, expected dates (time.unit "
                'is "datetime"); for numbers, give s, ms, d, ... as time.unit and when they are 0 as time.start'
            )
        if first.dtype.kind == "M" and base.start is not None:
            raise SourceError(
                f"{path}: column {column} holds dates such as {first[0]}, expected no time.start but time.unit = "
                '"datetime" in the mapping'
            )
        measured, tolerance = _measured_rate(path, column, _since(entries, first, unit_ns))
        if first.dtype.kind == "M":
            origin_ns = int(first.astype("datetime64[ns]").astype(np.int64)[0])
        else:
            origin_ns = _start_ns(path, base, timing, start_ns) + _nanoseconds(first[0], unit_ns)
    tolerance += machine.ingest.rate_tolerance
    if declared is not None and abs(measured / declared - 1) > tolerance:
        raise SourceError(
            f"{path}: column {column} has {measured:.9g} rows per second, but {declared:.9g} are declared; "
            "expected the same"
        )
    if not 0 <= origin_ns < _LATEST_NS:
        year = round(1970 + origin_ns / _YEAR_NS)
        raise SourceError(
            f"{path}: the first row is of about the year {year}, expected 1970 to 2261 (time.start, unit)"
        )
    rate_hz = declared if declared is not None else measured
    ratio = _ratio(path, rate_hz, tolerance, base, machine)
    return Clock(path, column, unit_ns, origin_ns, first, rate_hz, ratio)


def _check_unit(source: Source, column: Reference, base: TimeBase) -> None:
    """Refuse a unit of time other than the file's: with resampling, the wrong rate would go unnoticed."""
    stated = source.unit(column) if column.column in source.names() else ""
    with suppress(ValueError):  # an unknown unit is no contradiction
        if not base.is_datetime and time_unit_ns(stated) != time_unit_ns(base.unit):
            raise SourceError(
                f"{source.path}: column {column} is in {stated!r} according to the file, but time.unit in the mapping "
                f"is {base.unit!r}; expected the same"
            )


def _declared_rate(source: Source, base: TimeBase, timing: Timing) -> float | None:
    """Rate that the mapping or the file states; if both do, they must agree."""
    told = base.rate_hz
    if base.rate_from is not None:
        found = np.ravel(source.values(base.rate_from)).astype(np.float64)
        if found.size != 1 or not 0 < found[0] <= 1e6:
            raise SourceError(
                f"{source.path}: {base.rate_from} is {found[:5]}, expected one rate above 0 and at most 1e6 Hz"
            )
        told = float(found[0])
    if told is None or timing.rate_hz is None:
        return timing.rate_hz if told is None else told
    if abs(told - timing.rate_hz) > max(_MOST_RATE_DIFFERENCE * timing.rate_hz, timing.rounded_hz):
        raise SourceError(
            f"{source.path}: the file says {timing.rate_hz:.9g} samples per second, the mapping {told:.9g}; expected "
            "the same"
        )
    return told


def _start_ns(path: Path, base: TimeBase, timing: Timing, known_ns: int | None) -> int:
    for told_ns in (known_ns, base.start_ns, timing.start_ns):
        if told_ns is not None:
            return told_ns
    raise SourceError(
        f"{path}: the time of the first row is not known; give time.start in the mapping, such as "
        'start = "2026-01-31T12:00:00Z"; files of a folder may have it in their names, such as 20260131T120000'
    )


def _first_times(source: Source, column: Reference, columns: list[Reference]) -> Array:
    pieces: Iterator[tuple[Array, ...]] = source.chunks([column, *columns[:1]])
    entries = next(pieces, (np.empty(0),))[0]
    if entries.dtype.kind not in "fiuM":
        raise SourceError(f"{source.path}: column {column} holds {entries.dtype}, expected times")
    if entries.size < 2:
        raise SourceError(f"{source.path}: has {entries.size} rows, expected at least two to tell the rate")
    missing = np.flatnonzero(np.isnat(entries) if entries.dtype.kind == "M" else ~(np.abs(entries) < _LATEST_NS))
    if missing.size:
        raise SourceError(
            f"{source.path}: row {int(missing[0]) + 1}, column {column}: found {entries[missing[0]]}, expected a time"
        )
    return entries


def _measured_rate(path: Path, column: Reference, times: FloatArray) -> tuple[float, float]:
    """Rate of a time column, gaps left out, to its first uncertain digit; and its relative error from jitter."""
    steps = np.diff(times)
    check_order(path, column, times, 0)
    usual = float(np.percentile(steps, 50, method="lower"))  # a step that occurs, even if others are as many
    within = steps[np.abs(steps - usual) <= 0.5 * usual]
    step = float(within.mean())
    rate_hz, error = 1e9 / step, 2 * float(np.abs(within - step).max()) / (step * within.size)
    return (round(rate_hz, math.ceil(-math.log10(rate_hz * error))) if error else rate_hz), error


def check_order(path: Path, column: Reference | None, times: FloatArray, first_row: int) -> None:
    """Check that times ascend.

    Raises
    ------
    SourceError
        Naming the first row whose time repeats or goes back.
    """
    wrong = np.flatnonzero(np.diff(times) <= 0)
    if wrong.size:
        at = int(wrong[0]) + 1
        back_ns = times[at - 1] - times[at]
        what = "repeats the time of the row before" if back_ns == 0 else f"goes back by {lasting(back_ns / 1e9)}"
        hint = "" if back_ns else "; times written with too few decimals? Leave the column out and give time.rate_hz"
        if abs(back_ns - _HOUR_NS) < _HOUR_NS / 60:
            hint = "; the end of summer time? Leave the column out and give time.start and time.rate_hz"
        raise SourceError(f"{path}: row {first_row + at + 1}, column {column}: {what}, expected ascending times{hint}")


def _ratio(path: Path, rate_hz: float, tolerance: float, base: TimeBase, machine: MachineFile) -> Fraction:
    if abs(rate_hz / machine.rate_hz - 1) <= tolerance:
        return Fraction(1)
    if not base.resample:
        raise SourceError(
            f"{path}: has {rate_hz:.9g} samples per second, the machine file says rate_hz = {machine.rate_hz:.9g}; "
            "expected the same, or time.resample = true in the mapping"
        )
    ratio = Fraction(machine.rate_hz / rate_hz).limit_denominator(_MOST_RATIO)
    if ratio.numerator > _MOST_RATIO or abs(float(ratio) * rate_hz / machine.rate_hz - 1) > tolerance:
        raise SourceError(
            f"{path}: {rate_hz:.9g} and {machine.rate_hz:.9g} samples per second are not in a ratio of whole numbers "
            f"up to {_MOST_RATIO}, so the file cannot be resampled; is time.rate_hz exact?"
        )
    return ratio


def _since(entries: Array, first: Array, unit_ns: float) -> FloatArray:
    """Nanoseconds since the first entry; integers are subtracted before conversion to float, which would round them."""
    if entries.dtype.kind == "M":
        since = (entries.astype("datetime64[ns]") - first.astype("datetime64[ns]")).astype(np.int64)
        return np.where(np.isnat(entries), np.nan, since.astype(np.float64))
    if entries.dtype.kind in "iu":
        return np.asarray((entries.astype(np.int64) - first.astype(np.int64)) * unit_ns, dtype=np.float64)
    numbers = np.where(np.abs(entries) < _LATEST_NS, entries, np.nan)  # larger numbers are no valid times in any unit
    return np.asarray((numbers.astype(np.float64) - first.astype(np.float64)) * unit_ns)


def _nanoseconds(entry: np.generic, unit_ns: float) -> int:
    if entry.dtype.kind in "iu":
        return round(int(entry) * Fraction(unit_ns))
    return round(Fraction(float(entry)) * Fraction(unit_ns))
