"""Lines that are not the rotation, such as those of a neighbouring machine, a gear or whirl.

A line has the same strength in every segment, noise does not: for a steady line the mean fourth power of the Fourier
coefficient is the square of the mean second power, for noise twice that. A line also turns by the same angle from each
segment to the next, while a resonance loses its phase: the coherence of segments is 1 for a line, and c or more for n
segments of noise with the probability (1 - c²)ⁿ⁻¹. A narrow resonance rings through some segments; so the more there
are, the further apart the compared ones are. A line too faint to be certain in one window is certain if two windows
that do not overlap have it: no resonance lasts from one to the other, so the probabilities multiply.

Next to a multiple of the speed a line beats with it. In coordinates that turn with the shaft, the multiple stands still
and the line turns. Without the mean, a single rotation holds nearly all of the rest; with n segments of noise it holds
a part p or more with the probability (1 - p)ⁿ⁻². A change of the multiple itself, a step or a pulsation, turns both
ways alike, and a drift does not complete a turn. What rings from one segment to the next turns one way for a while, so
a line must keep its phase as well.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its sub-packages are loaded when they are first used

from models.checkpoint import checked
from models.diagnosis.window.excluded import FEWEST_SEGMENTS, LINE_TOLERANCE, LOBE, KnownLine, phases_of
from models.diagnosis.window.moments import HopMoments, Plan
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import ComplexArray, FloatArray

_MOST_SPREAD = 1.35  # fourth power over the square of the second: 2 for noise, 1 for a line; between with little data
_SPREAD_OF_SEGMENT = 0.0058
"""How far it may exceed 1, for each segment, in a line that does not keep its phase: 11 to 65 segments of noise have
less in one of a hundred thousand cases, whereas 25 have less than `_MOST_SPREAD` in one of three hundred."""
_MOST_FAINT_SPREAD = 1.8
"""The same: 1.2 to 1.4 for a faint line, over 2.2 for what rings in a few segments and keeps its phase there."""
_STANDS_OUT, _FAINT = 8.0, 4.0  # power over that of its surroundings, for a line seen in one window alone, and in two
_NEIGHBOURHOOD_HZ = 4.0
_HARMONICS = 12
_CHANCE = 1e-9
# Segments whose phases are compared are an eighth of all apart, at least two, and at most this time: a mode at 10 Hz
# that is damped by 0.15 % falls to a seventh in it. Over longer times, a neighbouring machine's line may wander, too.
_PART_APART, _MOST_APART_S = 8, 20.0
_NEARLY_ALL, _OTHER_WAY, _TURNS = 0.8, 0.2, 1.5
"""Least part that turns one way, largest part of that which turns the other way, and least number of turns."""
_LOUD = 0.02  # part of a channel's random power above which a new line is reported


@dataclass(frozen=True, slots=True)
class Line:
    """A spectral line."""

    state: str  # where it is strongest
    frequency_hz: float
    share: float  # of that channel's power without the part that turns with the shaft
    certain: bool  # whether noise cannot be as coherent
    beside: int = 0  # the multiple of the speed it is next to, within three bins of the spectra; 0 if next to none
    likely: bool = False  # whether a second window with it makes it certain, as noise is seldom as coherent

    def known(self, speed_rad_s: float) -> KnownLine:
        """Its rounded frequency and order, for later comparison."""
        return round(self.frequency_hz, 4), round(self.frequency_hz * 2 * np.pi / abs(speed_rad_s), 4)


def steady_lines(
    plan: Plan, hops: Sequence[HopMoments], window: WindowStatistics, faulty: Collection[str] = ()
) -> tuple[Line, ...]:
    """Lines in the hops of a window that are neither noise nor a multiple of the speed, strongest first.

    `faulty` sensors are ignored.
    """
    window = window.as_mounted
    states = plan.mounted
    every = np.concatenate([hop.segments for hop in hops], dtype=np.complex128)
    if plan.equaliser is not None:
        every[:, :, : len(states)] /= plan.equaliser.response(plan.frequencies_hz)
    segments = every[:, :, : len(states)]
    segments[:, :, np.isin(states, list(faulty))] = 0
    if segments.shape[0] < FEWEST_SEGMENTS:
        return ()
    power = segments.real**2 + segments.imag**2
    mean = power.mean(axis=0)
    frequencies_hz = plan.frequencies_hz
    step_hz = float(frequencies_hz[1] - frequencies_hz[0])
    size = max(5, 2 * round(_NEIGHBOURHOOD_HZ / step_hz / 2) + 1)
    floor = scipy.ndimage.median_filter(mean, size=(size, 1), mode="nearest")
    total = np.maximum(np.diag(window.correlation[0]), np.finfo(float).tiny)
    speed_hz = abs(window.speed_rad_s) / (2 * np.pi)
    multiples_hz = speed_hz * np.arange(1, _HARMONICS + 1)  # nan, and near none, where the speed is not known
    rotation = np.asarray((np.abs(frequencies_hz[:, None] - multiples_hz) <= (LOBE + 1) * step_hz).any(axis=1))
    every_s = plan.segment // 2 / plan.rate_hz
    apart = max(2, min(segments.shape[0] // _PART_APART, round(_MOST_APART_S * max(1.0, plan.time_scale) / every_s)))
    found: dict[int, Line] = {}
    for at, column in np.argwhere((mean > _FAINT * floor) & ~rotation[:, None]):
        lobe = slice(max(0, at - LOBE), at + LOBE + 1)
        if mean[at, column] < mean[lobe, column].max():
            continue
        spread = float((power[:, at, column] ** 2).mean() / mean[at, column] ** 2)
        clear = mean[at, column] > _STANDS_OUT * floor[at, column] and spread < _MOST_SPREAD
        chance = _chance(segments[:, at, column], apart)
        likely = spread < _MOST_FAINT_SPREAD and chance < math.sqrt(_CHANCE)
        certain = bool(clear and chance < _CHANCE)
        if likely or certain or (clear and spread < 1 + _SPREAD_OF_SEGMENT * len(segments)):
            share = min(1.0, float(2 * step_hz * mean[lobe, column].sum() / total[column]))
            line = Line(states[column], float(frequencies_hz[at]), share, certain, likely=likely)
            # A channel in which the line is certain goes before one in which it is louder.
            found[at] = max(found.get(at, line), line, key=lambda one: (one.certain, one.likely, one.share))
    lines = [*found.values(), *_beside_multiples(plan, window, every, mean, total, apart)]
    return tuple(sorted(lines, key=lambda line: -line.share))


def _beside_multiples(
    plan: Plan, window: WindowStatistics, every: ComplexArray, mean: FloatArray, total: FloatArray, apart: int
) -> Iterator[Line]:
    """The strongest certain line beside each multiple of the speed, if the speed is steady.

    `every` has shape (n_segments, n_bins, n_states + n_regressors); `mean`, the power in each bin, (n_bins, n_states).
    The noise is the median of bins around a multiple: the multiple reaches none of them, and a line beside it few.
    """
    if window.speed_source != "phase reference" or window.removed_by_hop:
        return
    frequencies_hz, states = plan.frequencies_hz, plan.mounted
    step_hz, speed_hz = float(frequencies_hz[1] - frequencies_hz[0]), abs(window.speed_rad_s) / (2 * np.pi)
    if speed_hz <= (2 * LOBE + 1) * step_hz:  # a multiple would look like a line beside the next one
        return
    turning = phases_of(every[:, np.abs(frequencies_hz - speed_hz).argmin(), len(states) + 1])
    for order in range(1, _HARMONICS + 1):
        away_hz = np.abs(frequencies_hz - order * speed_hz)
        near = away_hz <= (LOBE + 1) * step_hz
        around = ~near & (away_hz <= (LOBE + 1) * step_hz + _NEIGHBOURHOOD_HZ)
        if not (near.any() and around.any()):
            continue
        left = every[:, near, : len(states)] * (turning.conj() ** order)[:, None, None]
        left -= left.mean(axis=0)
        own = (left.real**2 + left.imag**2).mean(axis=0)
        stands_out = (own > _STANDS_OUT * np.median(mean[around], axis=0)).any(axis=0)
        shares = np.where(stands_out, 2 * step_hz * own.sum(axis=0) / total, 0.0)
        if not shares.any():
            continue
        column = int(shares.argmax())
        at, multiple_hz = int(own[:, column].argmax()), order * speed_hz
        every_s = plan.segment // 2 / plan.rate_hz
        offset_hz, certain = _turning(left[:, :, column], at, every_s, frequencies_hz[near][at] - multiple_hz, apart)
        # Otherwise the multiple may have changed, which is no reason to refuse a recording and hides no line.
        if certain:
            yield Line(states[column], multiple_hz + offset_hz, min(1.0, float(shares[column])), certain, order)


def new_line(
    lines: Sequence[Line], known: Sequence[KnownLine], speed_rad_s: float, *, beside: bool = True
) -> Line | None:
    """The strongest line that the healthy machine did not have, at its frequency or order; None without one.

    `beside` says whether `known` includes lines next to a multiple of the speed; if not, such lines are passed over.
    """
    told = (line for line in lines if line.certain and line.share > _LOUD and (beside or not line.beside))
    return next((line for line in told if not _is_known(line, known, speed_rad_s)), None)


class LatestLines:
    """The lines of the latest windows, to confirm those that are too faint for one window."""

    def __init__(self) -> None:
        self._seen: list[tuple[int, KnownLine]] = []  # by the end of the window

    def take(self, lines: Sequence[Line], window: WindowStatistics) -> tuple[Line, ...]:
        """Add a window and return its lines; a likely one is certain if a window that ended before this one had it."""
        length_ns = window.end_ns - window.start_ns
        # Later lines are from before the clock was set back. Where clocks run apart, a window begins a little early.
        self._seen = [one for one in self._seen if window.start_ns - length_ns <= one[0] < window.end_ns]
        before = [line for end_ns, line in self._seen if end_ns <= window.start_ns + length_ns // 100]
        self._seen += [(window.end_ns, line.known(window.speed_rad_s)) for line in lines if line.likely]
        return tuple(
            replace(line, certain=True) if line.likely and _is_known(line, before, window.speed_rad_s) else line
            for line in lines
        )

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything as named arrays."""
        ends = np.array([end_ns for end_ns, _ in self._seen], dtype=np.int64)
        return {"lines_end_ns": ends, "lines": np.array([line for _, line in self._seen]).reshape(-1, 2)}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue where `checkpoint` was called."""
        ends = checked(arrays, "lines_end_ns", np.int64, (None,)).tolist()
        lines = checked(arrays, "lines", np.float64, (len(ends), 2)).tolist()
        self._seen = [(end_ns, (hz, order)) for end_ns, (hz, order) in zip(ends, lines, strict=True)]


def _is_known(line: Line, known: Sequence[KnownLine], speed_rad_s: float) -> bool:
    """Whether a line is one of these, at its frequency or order."""
    own = line.known(speed_rad_s)
    return any(abs(now - then) <= LINE_TOLERANCE * then for one in known for now, then in zip(own, one, strict=True))


def _chance(own: ComplexArray, apart: int) -> float:
    """Probability that noise keeps its phase as these segments do; they overlap, so every second one is evidence."""
    earlier, later = own[:-apart], own[apart:]
    norms = np.linalg.norm(earlier) * np.linalg.norm(later)
    coherence = min(1.0, float(abs(np.vdot(earlier, later)) / norms))
    return float((1 - coherence**2) ** (earlier.size / 2 - 1))


def _turning(left: ComplexArray, at: int, every_s: float, near_hz: float, apart: int) -> tuple[float, bool]:
    """Frequency at which most of a bin turns, the alias nearest to `near_hz`; and whether only a line does that."""
    n_segments = left.shape[0]
    size = 16 * n_segments
    rotations = np.abs(np.fft.fft(left, size, axis=0)) ** 2
    most = int(rotations[:, at].argmax())
    own = left[:, at]
    part = min(1.0, float(rotations[most, at]) / (n_segments * float((own.real**2 + own.imag**2).sum())))
    found_hz = most / size / every_s
    # Segments overlap, so every second one is evidence.
    one_way = part > _NEARLY_ALL and (1 - part) ** (n_segments / 2 - 2) < _CHANCE
    # The two sides of a pulsation may be in different bins, or look alike from one segment to the next.
    there, back = rotations[[most, -most]].sum(axis=1)
    one_way &= bool(back < _OTHER_WAY * there) and min(most, size - most) * n_segments >= _TURNS * size
    # A resonance that rings from one segment to the next turns one way for a while.
    return found_hz + round((near_hz - found_hz) * every_s) / every_s, one_way and _chance(own, apart) < _CHANCE
