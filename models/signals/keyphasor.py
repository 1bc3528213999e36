"""Pulses of a keyphasor or tachometer to shaft angle.

Between two pulses the shaft is taken to turn uniformly. A missing or extra pulse is recognised by the intervals around
it; where it cannot be distinguished from a stop, the angle is left unknown instead of being guessed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy  # its sub-packages are loaded when they are first used

from models.signals.block import BoolArray, FloatArray

_NEIGHBOURS = 9
_MOST_MISSING = 3
_TOO_SHORT = 0.5
_WHOLE = 0.25


def jump_within_a_turn(steps_rad: FloatArray) -> float:
    """Largest angle by which a sampled shaft angle jumps, between two samples or in one turn of the mark, rad.

    Two turns with a jump in them are longer than the two before, and the next two are shorter by as much; after a
    change of the speed turns stay longer or shorter. Steps, shape (n,), are those from sample to sample, -π to π.

    Examples
    --------
    >>> steps = np.full(1000, 0.05)
    >>> steps[500] += 0.7
    >>> round(jump_within_a_turn(steps), 3)
    0.7
    """
    turned = np.cumsum(steps_rad)
    two = round(4 * np.pi * turned.size / abs(turned[-1])) if turned[-1] else turned.size
    if not 0 < 2 * two < turned.size:
        return 0.0
    gained = turned[2 * two :] - 2 * turned[two:-two] + turned[: -2 * two]
    first, last = int(gained.argmax()), int(gained.argmin())
    size = max(0.0, min(float(gained[first]), -float(gained[last])))
    return size if first < last else -size


class EdgeDetector:
    """Finds the pulses in a sampled tachometer signal, piece by piece, by a threshold in the unit of the signal.

    The signal must fall below it (rise above it for falling edges) by the hysteresis before the next pulse counts; 0
    counts every crossing.
    """

    def __init__(self, threshold: float, hysteresis: float, *, rising: bool) -> None:
        self._sign = 1.0 if rising else -1.0
        self._threshold = self._sign * threshold
        self._rearm = self._threshold - hysteresis
        self._last: tuple[float, float] | None = None
        self._armed = False

    def interrupt(self) -> None:
        """State that the next piece does not continue the last one: no pulse lies between them."""
        self._last, self._armed = None, False

    def feed(self, time: FloatArray, signal: FloatArray) -> FloatArray:
        """Times of the pulses in the next piece, shape (n_pulses,), interpolated between samples at ascending times."""
        if time.size == 0:
            return np.empty(0)
        value = self._sign * signal
        if self._last is not None:
            time = np.concatenate([[self._last[0]], time])
            value = np.concatenate([[self._last[1]], value])
        low = value < self._rearm if self._rearm < self._threshold else value < self._threshold
        lows = np.cumsum(low) + int(self._armed)
        crossings = np.flatnonzero((value[:-1] < self._threshold) & (value[1:] >= self._threshold))
        before = np.concatenate([[0], lows[crossings[:-1]]]) if crossings.size else lows[:0]
        counted = crossings[lows[crossings] > before]
        since = crossings[-1] + 1 if crossings.size else 0
        self._armed = bool(low[since:].any()) or (not crossings.size and self._armed)
        self._last = (float(time[-1]), float(value[-1]))
        step = value[counted + 1] - value[counted]
        part = (self._threshold - value[counted]) / step
        return np.asarray(time[counted] + part * (time[counted + 1] - time[counted]))


@dataclass(frozen=True, slots=True)
class PulseTrain:
    """Pulses after repair."""

    times: FloatArray  # (n,), ascending
    counts: npt.NDArray[np.int64]  # (n,), number of each pulse, with the missing ones counted
    known: BoolArray  # (n - 1,), whether the shaft turned without doubt from this pulse to the next
    pulses_per_turn: int
    # Pulses that were missing and are bridged; pulses too many, which are left out.
    missing: int
    extra: int

    @property
    def interruptions(self) -> int:
        """Intervals in which the angle is unknown."""
        return int(np.count_nonzero(~self.known))


def pulse_train(times: FloatArray, pulses_per_turn: int = 1) -> PulseTrain:
    """Judge each interval between pulses by the median of the nine around it.

    An interval below half of it has a pulse too many. One within a quarter of 2, 3 or 4 times the median has that many
    pulses missing. What is longer, or in between, is an interruption.

    Raises
    ------
    ValueError
        If there are fewer than two pulses or their times do not ascend; the message names the first that does not.
    """
    if times.size < 2:
        raise ValueError(f"{times.size} pulses, expected at least two to tell the speed")
    if not np.isfinite(times).all():
        raise ValueError(f"pulse {int(np.flatnonzero(~np.isfinite(times))[0]) + 1} has no finite time")
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if backwards.size:
        first = int(backwards[0])
        raise ValueError(f"pulse {first + 2} at {times[first + 1]:.9g} is not later than the one before it")
    kept = _without_extra(times)
    intervals = np.diff(kept)
    ratio = intervals / _usual(intervals)
    turns = np.maximum(np.rint(ratio), 1).astype(np.int64)
    known = (ratio < 1.5) | ((np.abs(ratio - turns) <= _WHOLE) & (turns <= _MOST_MISSING + 1))
    steps = np.where(known, turns, pulses_per_turn)
    counts = np.concatenate([[0], np.cumsum(steps)])
    # After an interruption the next pulse is number 0 of a turn again.
    for gap in np.flatnonzero(~known):
        counts[gap + 1 :] += -counts[gap + 1] % pulses_per_turn
    missing = int(np.sum(turns[known] - 1))
    return PulseTrain(kept, counts, known, pulses_per_turn, missing, times.size - kept.size)


def pulses_in_turn(trains: Sequence[PulseTrain]) -> PulseTrain:
    """Join trains, at least one, that follow each other; between two of them the angle is not known."""
    counts, end = [], 0
    for train in trains:
        counts.append(train.counts + end)
        end = -(-int(counts[-1][-1] + 1) // train.pulses_per_turn) * train.pulses_per_turn
    times, apart = np.concatenate([one.times for one in trains]), np.zeros(1, dtype=np.bool_)
    known = np.concatenate([part for one in trains for part in (apart, one.known)][1:])
    missing, extra = sum(one.missing for one in trains), sum(one.extra for one in trains)
    return PulseTrain(times, np.concatenate(counts), known, trains[0].pulses_per_turn, missing, extra)


def shaft_angle(train: PulseTrain, at: FloatArray, *, reverse: bool = False) -> FloatArray:
    """Shaft angle in [0, 2π), 0 at the (first) pulse of each turn.

    Before the first pulse, after the last and around an interruption the angle is carried on at the neighbouring
    interval's speed for one interval at most; where it is unknown, it is NaN. Times, shape (n,), are in the unit of the
    train's. In reverse, the shaft turns from z to y, and the angle falls.
    """
    times, counts = train.times, train.counts
    speed = np.where(train.known, np.diff(counts) / np.diff(times), np.nan)  # pulses per unit of time
    before = np.searchsorted(times, at, side="right") - 1
    inside = (before >= 0) & (before < speed.size)
    number = np.full(at.shape, np.nan)
    number[inside] = counts[before[inside]] + speed[before[inside]] * (at[inside] - times[before[inside]])
    lost = np.isnan(number)
    # Carried on from the pulse before, then back from the pulse after.
    for pulse, interval in ((before, before - 1), (before + 1, before + 1)):
        usable = lost & (pulse >= 0) & (pulse < times.size) & (interval >= 0) & (interval < speed.size)
        onwards = speed[interval[usable]] * (at[usable] - times[pulse[usable]])
        carried = np.where(np.abs(onwards) <= 1 + 1e-9, counts[pulse[usable]] + onwards, np.nan)
        number[usable] = np.where(np.isnan(number[usable]), carried, number[usable])
    turns = number / train.pulses_per_turn
    angle = 2 * np.pi * np.mod(-turns if reverse else turns, 1.0)
    return np.asarray(np.where(angle >= 2 * np.pi, 0.0, angle))


def _usual(intervals: FloatArray) -> FloatArray:
    """Median of the intervals around each one."""
    return np.asarray(scipy.ndimage.median_filter(intervals, size=min(_NEIGHBOURS, intervals.size), mode="nearest"))


def _without_extra(times: FloatArray) -> FloatArray:
    """Leave out pulses that come less than half an interval after another."""
    kept = times
    while kept.size > 2:
        intervals = np.diff(kept)
        usual = _usual(intervals)
        doubtful: list[int] = []
        for interval in np.flatnonzero(intervals < _TOO_SHORT * usual):
            if not doubtful or interval - doubtful[-1] > 3:  # neighbours wait for the next round
                doubtful.append(int(interval))
        if not doubtful:
            break
        kept = np.delete(kept, [_extra_of(kept, interval, float(usual[interval])) for interval in doubtful])
    return kept


def _extra_of(times: FloatArray, interval: int, usual: float) -> int:
    """Choose the pulse at either end of a short interval without which the intervals nearby are more even."""
    candidates = [pulse for pulse in (interval, interval + 1) if 0 < pulse < times.size - 1] or [interval + 1]
    first = max(interval - 2, 0)
    near = times[first : interval + 4]

    def unevenness(pulse: int) -> float:
        ratio = np.diff(np.delete(near, pulse - first)) / usual
        return float(np.sum(np.abs(ratio - np.maximum(np.rint(ratio), 1))))

    return min(candidates, key=unevenness)
