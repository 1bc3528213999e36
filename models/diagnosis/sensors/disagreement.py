"""Two sensors of one motion that disagree: wrong gain or delay of one of them, or swapped channels."""

import math
from collections.abc import Mapping
from itertools import combinations

import numpy as np

from models.diagnosis.sensors.kinematics import PairReading, banded, delay_course, gain_courses, same
from models.diagnosis.sensors.reference import PERFECT, Naming, SensorReference
from models.diagnosis.window.motion import MotionPair, motion_pairs
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import FloatArray
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

MOST_ERRORS = 5.0  # standard errors beyond which two sensors disagree
# Smaller relative differences of gain are put down to calibration: without a reference, and from the reference.
LEAST_GAIN, LEAST_GAIN_CHANGE = 0.06, 0.015
LEAST_COURSE = 0.02  # smaller relative changes of the gain within a window are not reported
# The same for delays. A delay of 0.25 ms already changes the reading of a bearing's damping by a quarter.
LEAST_DELAY_S, LEAST_DELAY_CHANGE_S = 1e-4, 3e-5
# Largest allowed phase lead of one sensor over the other, times angular frequency: that of a first-order high-pass at
# 1.1 Hz. At 1 Hz no parameter of machines of 15 to 40 Hz was taken for changed, at 2 Hz damping read up to 16 % more.
MOST_LEAD_RAD_S = 7.0
# The faulty channel's own change must match the disagreement within this part of it, and the other's stay below it.
_MATCH_TOLERANCE = 1 / 3
_SAME_SPEED = 0.01
_LEAST_COHERENCE = 0.5  # coherence of bearing and disc across the planes, and how much less it must be within them
_MOST_ERROR = 0.2  # largest standard error of a channel's own change, as part of the disagreement, to name a sensor


def is_drift(finding: SensorFault) -> bool:
    """Whether a gain has changed by no more than is put down to calibration on a machine without a reference."""
    return finding.kind is FaultKind.GAIN and abs(finding.value or 1.0) < LEAST_GAIN


class _Departure:
    """Differences of a pair's reading from its reference or, without one, from perfect agreement."""

    def __init__(
        self, reading: PairReading, reference: SensorReference | None, course: FloatArray, parts: list[list[float]]
    ) -> None:
        known = None if reference is None else reference.pair(reading.first, reading.second)
        usual = known or PERFECT
        self.reading, self.known, self.reversed = reading, known is not None, reading.polarity != usual.polarity
        self.log_gain, self.delay_s = reading.log_gain - usual.log_gain, reading.delay_s - usual.delay_s
        self.gain_z = abs(self.log_gain) / math.hypot(reading.log_gain_error, usual.log_gain_spread)
        self.delay_z = abs(self.delay_s) / math.hypot(reading.delay_error_s, usual.delay_spread_s)
        self.course = course
        (self.course_step, self.course_z), (other_step, _) = sorted(parts, key=lambda part: part[1])
        if (self.course_step > 0) != (other_step > 0):
            self.course_step, self.course_z = 0.0, 0.0  # the noise of one of the two has changed


def gain_and_delay(
    window: WindowStatistics, readings: list[PairReading], naming: Naming, reference: SensorReference | None
) -> list[SensorFault]:
    """Findings on pairs that see the same motion but differ in gain or delay."""
    if not readings:
        return []
    courses, errors = gain_courses(window, readings)
    parts = np.stack(_largest_part(courses, errors), axis=-1).swapaxes(0, 1).tolist()  # (n_pairs, 2 ways, 2)
    departures = {
        reading.pair: _Departure(reading, reference, *own)
        for reading, *own in zip(readings, courses[0], parts, strict=True)
    }
    rate_hz = window.n_samples / window.duration_s
    findings: list[SensorFault] = []
    for departure in departures.values():
        least_gain = LEAST_GAIN_CHANGE if departure.known else LEAST_GAIN
        least_delay = LEAST_DELAY_CHANGE_S if departure.known else LEAST_DELAY_S
        steady = departure.gain_z > MOST_ERRORS and abs(np.expm1(departure.log_gain)) > least_gain
        late = departure.delay_z > MOST_ERRORS and abs(departure.delay_s) > least_delay
        if late:  # a delay that changes weakens the mean cross-spectrum, like a loss of gain
            step_s, z = map(float, _largest_part(*delay_course(window, departure.reading)))
            steady &= not (z > MOST_ERRORS and abs(step_s) > least_delay)
        moving = departure.course_z > MOST_ERRORS and abs(departure.course_step) > LEAST_COURSE
        if steady or moving or departure.reversed:
            # Soon after a gain has changed, its mean over the window is little of that.
            moving &= not steady or abs(departure.course_step) > abs(departure.log_gain)
            findings.append(_gain(window, departure, departures, naming, reference, moving=moving))
        if not departure.known and abs(departure.reading.lead_rad_s) > MOST_LEAD_RAD_S:
            findings.append(_lead(departure.reading, naming))
        elif late:
            findings.append(_delay(departure, departures, naming, rate_hz))
    best: dict[tuple[tuple[str, ...], str], SensorFault] = {}  # the same of the same channels once, with its largest z
    for finding in sorted(findings, key=lambda one: -(one.z or 0.0)):
        best.setdefault((finding.states, finding.kind), finding)
    return list(best.values())


def _largest_part(course: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Most significant difference of the means after and before a hop boundary, and its size in standard errors.

    Courses and errors are of shape (…, n_hops), what is found of shape (…,).
    """
    n = course.shape[-1]
    if n < 4:
        return np.zeros(course.shape[:-1]), np.zeros(course.shape[:-1])
    if n > 5:
        steps = np.abs(np.diff(course)) / np.hypot(error[..., 1:], error[..., :-1])
        error = error * np.maximum(1.0, 1.4826 * np.median(steps, axis=-1, keepdims=True))
    weight = error**-2.0
    before, sums = np.cumsum(weight, axis=-1), np.cumsum(weight * course, axis=-1)
    before, after = before[..., :-1], before[..., -1:] - before[..., :-1]
    changes = (sums[..., -1:] - sums[..., :-1]) / after - sums[..., :-1] / before
    z = np.abs(changes) / np.sqrt(1 / before + 1 / after)
    best = z.argmax(axis=-1)[..., None]
    return np.take_along_axis(changes, best, axis=-1)[..., 0], np.take_along_axis(z, best, axis=-1)[..., 0]


def _gain(
    window: WindowStatistics,
    departure: _Departure,
    departures: dict[MotionPair, _Departure],
    naming: Naming,
    reference: SensorReference | None,
    *,
    moving: bool,
) -> SensorFault:
    reading, pair = departure.reading, departure.reading.pair
    sizes = {one: theirs.course_step if moving else theirs.log_gain for one, theirs in departures.items()}
    guilty = _by_chain(pair, sizes)
    if guilty is None and departure.course_z > MOST_ERRORS:
        guilty = _by_course(window, departure)
    if guilty is None and not moving:
        guilty = _by_level(window, departure, reference)
    size = departure.course_step if moving else float(np.expm1(departure.log_gain))
    z = departure.course_z if moving else departure.gain_z
    error = abs(size) / z if z > 0 else 0.0
    expected = "as they were on the healthy machine" if departure.known else "the same motion, 0 % apart"
    if departure.reversed:
        text = f"{naming.name(reading.second)} moves opposite to {naming.name(reading.first)}: one of them is reversed"
        return SensorFault(states=(reading.first, reading.second), kind=FaultKind.GAIN, text=text, value=-2.0, z=z)
    if guilty is not None:
        state, other = (reading.first, reading.second) if guilty == pair.first else (reading.second, reading.first)
        own = size if guilty == pair.second else float(1 / (1 + size) - 1)
        change = f"changed by {own:+.1%} within the window" if moving else f"is off by {own:+.1%}"
        text = (
            f"{naming.name(state)}: its gain {change} (± {error:.1%}) against {naming.name(other)}, expected {expected}"
        )
        return SensorFault(states=(state,), kind=FaultKind.GAIN, text=text, value=own, z=z)
    change = f"drifted apart by {size:+.1%} within the window" if moving else f"are {size:+.1%} apart"
    text = (
        f"{naming.name(reading.second)} and {naming.name(reading.first)} {change} (± {error:.1%}) in gain, expected "
        f"{expected}; which of them is wrong cannot be told"
    )
    return SensorFault(states=(reading.first, reading.second), kind=FaultKind.GAIN, text=text, value=size, z=z)


def _delay(
    departure: _Departure, departures: dict[MotionPair, _Departure], naming: Naming, rate_hz: float
) -> SensorFault:
    reading, late = departure.reading, abs(departure.delay_s)
    guilty = _by_chain(reading.pair, {pair: theirs.delay_s for pair, theirs in departures.items()})
    # If that does not tell: sensors come late, not early.
    second_is_late = departure.delay_s > 0 if guilty is None else guilty == reading.pair.second
    state, other = (reading.second, reading.first) if second_is_late else (reading.first, reading.second)
    expected = "the delay it had on the healthy machine" if departure.known else "both at the same time"
    text = (
        f"{naming.name(state)}: comes {1e3 * late:.3g} ms ({late * rate_hz:.2g} samples, ± "
        f"{1e3 * late / departure.delay_z:.2g} ms) after {naming.name(other)}, expected {expected}"
    )
    if not departure.known:
        text += "; if its signal comes late by that, or the other is sampled later, state it as delay_us"
    return SensorFault(states=(state,), kind=FaultKind.DELAY, text=text, value=late, z=departure.delay_z)


def _lead(reading: PairReading, naming: Naming) -> SensorFault:
    """Finding on a sensor that leads as behind a high-pass; its value is the lead in s, weighted with the power."""
    power, lead_rad_s = reading.bands.spectra[:, 1, 1].real, abs(reading.lead_rad_s)
    state, other = (reading.second, reading.first) if reading.lead_rad_s > 0 else (reading.first, reading.second)
    text = (
        f"{naming.name(state)}: runs ahead of {naming.name(other)} as behind a first-order high-pass at "
        f"{lead_rad_s / (2 * np.pi):.2g} Hz (AC coupling), expected at most {MOST_LEAD_RAD_S / (2 * np.pi):.2g} Hz: "
        "state corner and order of its data sheet as high_pass_hz and high_pass_order, couple both alike, or leave "
        "one of them out"
    )
    value = lead_rad_s * float(power @ reading.bands.w**-2.0 / power.sum())
    return SensorFault(states=(state,), kind=FaultKind.DELAY, text=text, value=value)


def _by_chain(pair: MotionPair, sizes: Mapping[MotionPair, float]) -> int | None:
    """Faulty column of three sensors of one motion: the one that disagrees (by these sizes) while the others agree."""
    mine = sizes[pair]
    for other, his in sizes.items():
        if other == pair or not {other.first, other.second} & {pair.first, pair.second}:
            continue
        (middle,) = {other.first, other.second} & {pair.first, pair.second}
        if abs(his) < _MATCH_TOLERANCE * abs(mine):
            return pair.first if middle == pair.second else pair.second
        if abs(his + mine) < _MATCH_TOLERANCE * abs(mine):
            return middle
    return None


def _by_level(window: WindowStatistics, departure: _Departure, reference: SensorReference | None) -> int | None:
    """Column whose 1x amplitude departs from the healthy one by the disagreement, while the other's stays."""
    vectors = window.rotation_vectors
    if vectors is None or reference is None or reference.speed_rad_s is None:
        return None
    if abs(float(np.mean(window.hop_speed_rad_s)) / reference.speed_rad_s - 1) > _SAME_SPEED:
        return None
    changes, errors = [], []
    for column in (departure.reading.pair.first, departure.reading.pair.second):
        known, sizes = reference.channel(window.states[column]), np.abs(vectors[:, column])
        seen = float(sizes.mean())
        if known is None or not known.rotation or known.rotation_spread is None or not seen > 0:
            return None
        changes.append(float(np.log(seen / known.rotation)))
        then = known.rotation_spread / np.sqrt(reference.n_hops)
        errors.append(float(np.hypot(sizes.std() / seen / np.sqrt(sizes.size), then)))
    if max(errors) > _MOST_ERROR * abs(departure.log_gain):
        return None
    return _explaining_channel(departure.reading.pair, changes, departure.log_gain)


def _by_course(window: WindowStatistics, departure: _Departure) -> int | None:
    """Column whose own level (its 1x amplitude, or its rms over other places' rms) follows the gain from hop to hop."""
    pair, course = departure.reading.pair, departure.course - departure.course.mean()
    power = float(course @ course)
    if not power > 0:
        return None
    columns = [pair.first, pair.second]
    tiny = np.finfo(float).tiny
    rms = np.log(np.maximum(window.hop_waveform.rms[:, : len(window.states)], tiny))
    own = window.states[pair.first].partition("_")[0]
    others = [column for column, name in enumerate(window.states) if name.partition("_")[0] != own]
    levels = [rms[:, columns] - (rms[:, others].mean(axis=1, keepdims=True) if others else 0.0)]
    vectors = window.rotation_vectors
    if vectors is not None and not window.removed_by_hop:  # the amplitude depends on the speed
        levels.append(np.log(np.maximum(np.abs(vectors[:, columns]), tiny)))
    best, least = None, _MOST_ERROR
    for level in levels:
        slopes = course @ level / power
        left = level - level.mean(axis=0) - np.outer(course, slopes)
        error = float(np.sqrt((left**2).sum(axis=0).min() / max(1, course.size - 2) / power))
        if error < least:
            best, least = [float(slope) for slope in slopes], error
    return None if best is None else _explaining_channel(pair, best, 1.0)


def _explaining_channel(pair: MotionPair, changes: list[float], size: float) -> int | None:
    (first, second), most = changes, _MATCH_TOLERANCE * abs(size)
    if abs(first) < most and abs(second - size) < most:
        return pair.second
    return pair.first if abs(second) < most and abs(first + size) < most else None


BROKEN = 0.9  # two sensors of one motion that share less than this do not see the same motion
_SUSPECT = 0.985  # below this, channels may be swapped: two places of a stiff shaft move much alike
_RESTORED = 0.97  # least part that both pairs must share after the exchange, over the healthy part
_LEAST_IMPROVEMENT = 5.0  # factor by which the exchange must reduce the part that the worse pair does not share
# 1x amplitudes of exchanged channels: largest difference from each other's healthy ones over that from their own.
_CROSSED = 0.25


def swapped(
    window: WindowStatistics, alike: Mapping[MotionPair, float], naming: Naming, reference: SensorReference | None
) -> tuple[list[SensorFault], set[MotionPair]]:
    """Find exchanges of two channels of one quantity that restore broken pairs; return them and the explained pairs.

    Those pairs are broken that share too little of their motion, at equal time and size, to be two sensors of one:
    `alike` says how much each shares, see `same`.
    """

    def healthy(pair: MotionPair) -> float:
        known = None if reference is None else reference.pair(window.states[pair.first], window.states[pair.second])
        return (known or PERFECT).same

    broken = [pair for pair, part in alike.items() if part < _SUSPECT * healthy(pair)]
    findings: list[SensorFault] = []
    explained: set[MotionPair] = set()
    for one, other in combinations(broken, 2):
        if one.order != other.order or {one, other} & explained:
            continue
        crossed = (MotionPair(one.first, other.second, one.order), MotionPair(other.first, one.second, one.order))
        now = min(alike[one], alike[other])
        then = float(same(banded(window, crossed)).min())
        if then < _RESTORED * min(healthy(one), healthy(other)) or 1 - now < _LEAST_IMPROVEMENT * (1 - then):
            continue
        explained |= {one, other}
        sides = [(one.first, other.first), (one.second, other.second)]
        guilty = _exchanged_side(window, sides, broken, reference)
        columns = sides[guilty] if guilty is not None else (*sides[0], *sides[1])
        states = tuple(window.states[column] for column in columns)
        pairs = " and ".join(
            f"{naming.name(window.states[p.first])} moves like {naming.name(window.states[p.second])}" for p in crossed
        )
        either = f"{naming.names(states[:2])} are swapped"
        if guilty is None:
            either += f", or {naming.names(states[2:])}"
        text = f"{either}: {pairs}, but not as they are connected (shared {then:.3f} crossed, {now:.3f} as connected)"
        findings.append(SensorFault(states=states, kind=FaultKind.SWAPPED, text=text, value=now))
    return findings, explained


def crossed_planes(window: WindowStatistics, naming: Naming) -> list[SensorFault]:
    """Find bearing and disc channels that are coherent across the planes but not within them, as swapped channels are.

    Bearings and unbalance couple the planes of a shaft only weakly: a force in one plane moves bearing and disc in it.
    Nothing is found if one source moves both planes, as then the channels are coherent within them, too.
    """
    column = {name.split("_")[0]: number for number, name in enumerate(window.states)}
    if not {"y1", "z1", "y2", "z2"} <= column.keys():
        return []
    power = np.einsum("fii->fi", window.spectrum).real
    if not np.all(power.sum(axis=0) > 0):
        return []

    def shared(first: str, second: str) -> float:
        a, b = column[first], column[second]
        both = power[:, [a, b]]
        coherence = np.abs(window.spectrum[:, a, b]) ** 2 / np.maximum(both.prod(axis=1), np.finfo(float).tiny)
        return float(np.mean(both / both.sum(axis=0), axis=1) @ coherence)

    within, crossed = max(shared("y1", "y2"), shared("z1", "z2")), min(shared("y1", "z2"), shared("z1", "y2"))
    if crossed < _LEAST_COHERENCE or within > _LEAST_COHERENCE * crossed:
        return []
    states = tuple(window.states[column[name]] for name in ("y1", "z1", "y2", "z2"))
    text = (
        f"{naming.names(states[:2])} are swapped, or {naming.names(states[2:])}: bearing and disc move together across "
        f"the planes and not within them (coherence {crossed:.2f} crossed, {within:.2f} as connected)"
    )
    return [SensorFault(states=states, kind=FaultKind.SWAPPED, text=text, value=within)]


def _exchanged_side(
    window: WindowStatistics, sides: list[tuple[int, int]], broken: list[MotionPair], reference: SensorReference | None
) -> int | None:
    """Side that was exchanged: its channels break two pairs each, or have each other's healthy 1x amplitudes."""
    for number, side in enumerate(sides):
        if all(sum(column in (pair.first, pair.second) for pair in broken) > 1 for column in side):
            return number
    chained = [any(_agrees(window, number, column) for column in side) for number, side in enumerate(sides)]
    if chained.count(True) == 1:  # the other side has a third sensor that still agrees with it
        return chained.index(False)
    vectors = window.rotation_vectors
    if vectors is None or reference is None:
        return None
    sizes = np.abs(vectors).mean(axis=0)
    alike = [_exchanged(window, sizes, side, reference) for side in sides]
    return alike.index(True) if alike.count(True) == 1 else None


def _agrees(window: WindowStatistics, side: int, column: int) -> bool:
    """Whether a column still agrees with a third sensor of its motion, on the side away from the broken pair."""
    pairs = [pair for pair in motion_pairs(window.states) if column == (pair.first if side else pair.second)]
    return bool(pairs) and bool(np.any(same(banded(window, pairs)) > _RESTORED))


def _exchanged(window: WindowStatistics, sizes: FloatArray, side: tuple[int, int], reference: SensorReference) -> bool:
    """Whether the 1x amplitudes of two channels match each other's healthy ones rather than their own."""
    known = [reference.channel(window.states[column]) for column in side]
    first, second = (None if one is None else one.rotation for one in known)
    if not first or not second:
        return False
    seen = [float(sizes[column]) for column in side]
    own = max(abs(seen[0] / first - 1), abs(seen[1] / second - 1))
    crossed = max(abs(seen[0] / second - 1), abs(seen[1] / first - 1))
    return crossed < _CROSSED * own
