"""Finding the rotation in the vibration itself, where no phase reference is measured.

The unbalance is a line that all channels share. In one hop its frequency hardly changes, so it is a sinusoid with a
linear sweep. The most likely frequency and sweep are those at which the channels together have the most power relative
to their surroundings. Whether there is a line at all is decided over several hops: the largest peak of noise is
anywhere in the band, while a shaft keeps its speed.

The speed of a machine whose governor hunts swings within a hop. Then the line has lost some of its power, most of which
a phase that swings recovers: first a sinusoid of few sizes, rates and phases, then any smooth phase that improves it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # its sub-packages are loaded when they are first used
from numpy.polynomial import Polynomial

from models.signals.block import BoolArray, ComplexArray, FloatArray, IndexArray

_MARGIN_HZ = 1.0
_SURROUNDINGS_HZ = 3.0
_SWEEP_PER_S = 0.005  # fastest sweep searched for, as a part of the expected speed per second
_PADDING = 4
_REFINEMENTS = 5
# Largest relative difference of speed between neighbouring hops of one shaft, apart from its sweep: a lightly damped
# resonance looks like a line, but its peak wanders by its width.
_MOST_SPEED_STEP = 0.004
_SWINGING_STEP = 0.02  # the same at the end of a hop in which the speed swings
_RESOLVED = 0.25  # part of a hop's frequency resolution below which no difference is believed
# Relative distance from the straight line through the speeds of most hops beyond which a peak is not the shaft's.
_MOST_OFF_TREND = 0.03
_FOLLOWED_PART = 0.8
_FEW_HOPS = 6  # fewer hops need lines that stand out by themselves
# Least number of hops in a row at one set point of a drive, and least part of a window that is in such rows.
_HELD, _HELD_PART = 4, 0.5
# Strength of a hop's line relative to the other hops' up to which a part of the hop had another speed.
_WEAKER = 0.25
# How many times as far as usual the speeds of two hops are apart where they meet if a ramp begins or ends there, and
# from which strength on: weaker lines may be as far apart by chance, and leave little behind.
_BENT, _BENT_STRENGTH = 5.0, 60.0
# Power of a hop's parts over that of the whole, less one, from which on the speed may swing, and which the swing must
# recover; the same where the line is weak; and what noise makes of it, times the strength.
_SPREAD, _SPREAD_OF_WEAK, _OF_NOISE, _PARTS = 0.1, 0.8, 10.0, 8
_SWINGS = np.geomspace(0.25, 5.0, 17)  # periods in a hop
_FEWEST_SAMPLES, _SAMPLES_OF_A_SWING = 26, 6  # of the band around the line: fewer would not determine a swing
_MOST_SWING = 0.04  # of the speed to either side
_LEFT = 0.15  # the power that parts may then still have over that of the whole: the swing holds in all of the hop
_SWING_SIZES, _SWING_PHASES = np.linspace(0.125, 1.0, 8), np.arange(16) * np.pi / 8
_REFINED = 4  # rates, the best of which is taken
# How far a swing may be off a sinusoid; what keeps the equations of its search regular; degree of the polynomial kept.
_NOT_SINUSOIDAL_RAD, _TINY, _DEGREE = 0.3, 1e-3, 24
LEAST_SETTLED = 0.5  # least part of a window that must be left where a drive goes from one set point to another
STRONG = 15.0  # strength from which a line stands out by itself: no peak of noise is as strong


@dataclass(frozen=True, slots=True)
class RotationLine:
    """The most likely line of one hop."""

    speed_rad_s: float  # its frequency in the middle of the samples; where it swings, its mean
    sweep_rad_s2: float  # how fast that changes
    # Its power over that of its surroundings, mean over the channels; about 1 where there is only noise, and some 3 to
    # 8 at the largest peak of noise.
    strength: float
    swing: tuple[float, ...] = ()  # where the speed swings: coefficients of a polynomial of time that adds to the angle

    def angle(self, t_s: FloatArray) -> FloatArray:
        """Angle at times from the middle of the samples, from an unknown zero."""
        return self.speed_rad_s * t_s + self.sweep_rad_s2 / 2 * t_s**2 + Polynomial(self.swing or (0.0,))(t_s)

    def speed(self, t_s: FloatArray) -> FloatArray:
        """Speed at times from the middle of the samples, rad/s."""
        return self.speed_rad_s + self.sweep_rad_s2 * t_s + Polynomial(self.swing or (0.0,)).deriv()(t_s)


def rotation_line(x: FloatArray, rate_hz: float, speed_rad_s: float, tolerance: float) -> RotationLine | None:
    """Find the line in one hop; None if no channel fluctuates or the range holds too few frequencies.

    `x`, shape (n, n_samples), is the hop with its history. Speeds within the relative `tolerance` of the expected one
    are searched.
    """
    n_samples = x.shape[1]
    duration_s, expected_hz = n_samples / rate_hz, speed_rad_s / (2 * np.pi)
    reach_hz = tolerance * expected_hz
    low = max(1, int(np.floor((expected_hz - reach_hz - _MARGIN_HZ) * duration_s)))
    high = min(n_samples // 2 - 1, int(np.ceil((expected_hz + reach_hz + _MARGIN_HZ) * duration_s)))
    if high - low < 8:
        return None
    spectrum = np.fft.rfft(x - x.mean(axis=1, keepdims=True))[:, low : high + 1].T
    power = np.median(np.abs(spectrum) ** 2, axis=0)
    alive = power > 0
    if not np.any(alive):
        return None
    count = high - low + 1
    base_hz, base_rate_hz = low / duration_s, count / duration_s
    baseband = np.fft.ifft(spectrum[:, alive] / np.sqrt(power[alive]), axis=0)
    t_s = (np.arange(count) + 0.5) / base_rate_hz - duration_s / 2
    # The first sample of the baseband coincides with that of x, half a step before the middle of its own cell.
    t_s -= 0.5 / base_rate_hz
    grid_hz = base_hz + base_rate_hz * np.arange(_PADDING * count) / (_PADDING * count)
    inside = np.abs(grid_hz - expected_hz) <= reach_hz
    width = round(_SURROUNDINGS_HZ / (grid_hz[1] - grid_hz[0])) | 1
    step_sweep = 2 / duration_s**2  # Hz/s: between two sweeps the phase at the ends is off by less than π/4
    most = max(1, int(np.ceil(_SWEEP_PER_S * expected_hz / step_sweep)))
    sweeps = step_sweep * np.arange(-most, most + 1)
    best = (-np.inf, 0.0, 0.0)
    for sweep in sweeps:
        turned = baseband * np.exp(-1j * np.pi * sweep * t_s**2)[:, None]
        seen = np.sum(np.abs(np.fft.fft(turned, _PADDING * count, axis=0)) ** 2, axis=1)
        ratio = np.where(inside, seen / scipy.ndimage.median_filter(seen, width, mode="nearest"), 0.0)
        at = int(ratio.argmax())
        if ratio[at] > best[0]:
            best = (float(ratio[at]), float(grid_hz[at]), float(sweep))
    strength, frequency_hz, sweep = best
    step_hz, step_sweep = float(grid_hz[1] - grid_hz[0]), float(sweeps[1] - sweeps[0])
    # Not in the band: where it ends, a line between two of its frequencies has lost some of its power.
    found_hz = frequency_hz
    turned, turned_s = _turned(x[alive] / np.sqrt(power[alive, None]), rate_hz, found_hz)
    for _ in range(_REFINEMENTS):
        frequency_hz, sweep = _climb(turned, turned_s, found_hz, frequency_hz, sweep, step_hz, step_sweep)
        step_hz, step_sweep = step_hz / 2, step_sweep / 2
    line = RotationLine(2 * np.pi * frequency_hz, 2 * np.pi * sweep, strength)
    return _swinging(line, baseband, t_s, base_hz, grid_hz[inside], min(reach_hz, _MOST_SWING * expected_hz))


def _turned(x: FloatArray, rate_hz: float, at_hz: float) -> tuple[ComplexArray, FloatArray]:
    """Channels with a frequency brought to zero, as means over pieces, shape (n_pieces, n), and their times."""
    n_samples = x.shape[1]
    size = max(1, int(rate_hz / (4 * _SURROUNDINGS_HZ)))
    used = n_samples - n_samples % size
    t_s = np.arange(used) / rate_hz - n_samples / rate_hz / 2
    turned = (x[:, :used] - x.mean(axis=1, keepdims=True)) * np.exp(-2j * np.pi * at_hz * t_s)
    return turned.reshape(len(x), -1, size).mean(axis=2).T, t_s.reshape(-1, size).mean(axis=1)


def _climb(
    y: ComplexArray, t_s: FloatArray, base_hz: float, at_hz: float, sweep: float, step_hz: float, step_sweep: float
) -> tuple[float, float]:
    """One step towards the largest power: the top of a parabola through three points, in frequency, then in sweep."""

    def power(f: float, s: float) -> float:
        turn = np.exp(-2j * np.pi * ((f - base_hz) * t_s + s / 2 * t_s**2))
        return float(np.sum(np.abs(turn @ y) ** 2))

    at_hz += _top([power(at_hz + k * step_hz, sweep) for k in (-1, 0, 1)]) * step_hz
    sweep += _top([power(at_hz, sweep + k * step_sweep) for k in (-1, 0, 1)]) * step_sweep
    return at_hz, sweep


def _swinging(
    line: RotationLine, y: ComplexArray, t_s: FloatArray, base_hz: float, grid_hz: FloatArray, most_hz: float
) -> RotationLine:
    """The line with a speed that swings within the hop, if that recovers power; else as it was."""

    def seen(angle: FloatArray) -> ComplexArray:
        return np.asarray(y * np.exp(1j * (2 * np.pi * base_hz * t_s - angle))[:, None], dtype=np.complex128)

    def power_and_lost(turned: ComplexArray) -> tuple[float, float]:
        """Power of the line in the hop, and by which part its power in parts of the hop is larger."""
        mean = turned.mean(axis=0)
        power = float(np.sum(np.abs(mean) ** 2))
        along = turned @ mean.conj() / power
        return power, float(np.mean([abs(part.mean()) ** 2 for part in np.array_split(along, _PARTS)])) - 1

    power, lost = power_and_lost(seen(line.angle(t_s)))
    near_hz = grid_hz[np.abs(2 * np.pi * grid_hz - line.speed_rad_s) <= 2 * np.pi * most_hz][::2]
    least = max(_SPREAD, _OF_NOISE / 2 / line.strength) if line.strength > STRONG else _SPREAD_OF_WEAK
    if lost < least or not near_hz.size or t_s.size < _FEWEST_SAMPLES:
        return line
    duration_s = float(t_s[1] - t_s[0]) * t_s.size
    lowest = (y * np.exp(2j * np.pi * (base_hz - near_hz[0]) * t_s)[:, None]).T[:, np.newaxis]  # at zero frequency
    tried = []
    for swings in (one for one in _SWINGS if one * _SAMPLES_OF_A_SWING <= t_s.size):
        rate = 2 * np.pi * swings / duration_s
        size = 2 * np.pi * most_hz / rate * _SWING_SIZES
        swing = (size[:, None, None] * np.sin(rate * t_s + _SWING_PHASES[:, None])).reshape(-1, t_s.size)
        turned = np.fft.fft(lowest * np.exp(-1j * swing), 2 * t_s.size)[:, :, : near_hz.size]
        powers = np.sum(turned.real**2 + turned.imag**2, axis=0)
        best, tone = np.unravel_index(powers.argmax(), powers.shape)
        tried.append((float(powers[best, tone]), float(swings), 2 * np.pi * near_hz[tone] * t_s + swing[best]))
    found, left, angle = 0.0, np.inf, line.angle(t_s)
    for _, swings, first in sorted(tried, key=lambda one: one[0])[-_REFINED:]:
        refined = _refined(seen, first, swings, line.strength)
        power_found, power_left = power_and_lost(seen(refined))
        if power_found > found:
            found, left, angle = power_found, power_left, refined
    recovered = found / power
    if left > _LEFT or recovered - 1 < max(_SPREAD, _OF_NOISE / (line.strength * recovered)):
        return line
    ends = (-duration_s / 2, duration_s / 2)
    whole = Polynomial.fit(t_s, angle, _DEGREE, domain=ends)
    speed_rad_s = float(whole(ends[1]) - whole(ends[0])) / duration_s
    coefficients = (whole.convert() - Polynomial((0.0, speed_rad_s))).coef
    return RotationLine(speed_rad_s, 0.0, line.strength * recovered, tuple(coefficients.tolist()))


def _refined(
    seen: Callable[[FloatArray], ComplexArray], angle: FloatArray, swings: float, strength: float
) -> FloatArray:
    """An angle that is nearly right, moved to the largest power.

    It moves by a swing of about the same rate whose size changes, and by Legendre polynomials for what is no sinusoid.
    These are held small: the error of the angle at one time has the variance of the noise over the line's power.
    """
    part = np.linspace(-1.0, 1.0, angle.size)
    sinusoids = np.exp(1j * np.pi * swings * part)[:, None] * np.stack([np.ones_like(part), part], axis=1)
    free = np.concatenate([part[:, None] ** [0, 1], sinusoids.real, sinusoids.imag], axis=1)
    basis = np.concatenate([free, np.polynomial.legendre.legvander(part, 4 + round(3 * swings))[:, 2:]], axis=1)
    held = np.arange(basis.shape[1]) >= free.shape[1]
    weights, away = basis.T @ basis, np.zeros(basis.shape[1])
    weights += np.diag(np.where(held, angle.size / (2 * strength) / _NOT_SINUSOIDAL_RAD**2, _TINY))
    for _ in range(_REFINEMENTS):  # where the angle is nearly right, the imaginary part is how far it is off
        turned = seen(angle + basis @ away)
        mean = turned.mean(axis=0)
        off = (turned @ mean.conj()).imag / np.sum(np.abs(mean) ** 2) + basis @ away
        away = np.linalg.solve(weights, basis.T @ off)
    return np.asarray(angle + basis @ away, dtype=np.float64)


def _top(values: list[float]) -> float:
    left, middle, right = values
    bend = left - 2 * middle + right
    if bend >= 0:
        return float(np.sign(right - left))
    return float(np.clip((left - right) / (2 * bend), -1.0, 1.0))


def followed_speeds(lines: tuple[RotationLine | None, ...], hop_s: float) -> FloatArray | None:
    """Speed of each hop if the lines are those of one shaft; nan where a hop's largest peak is not the shaft's.

    None if no line can be followed. A drive that goes from one set point to another is followed at each of them. Hops
    in which the speed swings are followed if that is most of them, about one mean: a shaft that hunts. The hops are
    consecutive but for gaps.
    """
    swings = np.array([line.speed_rad_s for line in lines if line is not None and line.swing])
    if 2 * swings.size < len(lines) or np.ptp(swings) > 2 * _MOST_SWING * np.median(swings):
        lines = tuple(None if line is None or line.swing else line for line in lines)
    speed = np.array([np.nan if line is None else line.speed_rad_s for line in lines])
    strength = np.array([0.0 if line is None else line.strength for line in lines])
    with np.errstate(invalid="ignore"):
        if len(lines) < _FEW_HOPS:
            near = np.abs(speed / np.median(speed) - 1) < _MOST_SPEED_STEP * len(lines)
            return speed if np.all(strength > STRONG) and np.all(near) else None
        near = _largest_step(speed, hop_s)
        steps = np.diff(speed)
        together = _goes_on(lines, near, hop_s)
    followed = np.append(together, False) | np.insert(together, 0, False)
    if followed.sum() > 1:
        number = np.flatnonzero(followed)
        followed[number] = np.abs(speed[number] / _speed_trend(speed, number)[number] - 1) < _MOST_OFF_TREND
    if (number := np.flatnonzero(np.isfinite(speed))).size > 1:
        # In noise the error of a line's sweep exceeds the sweep of a steady shaft. Leaving a line in a window is worse
        # than removing one from noise, and the peaks of noise do not keep to a straight line.
        steady = np.abs(speed - _speed_trend(speed, number)) < near
        followed |= steady & (steady.mean() >= _FOLLOWED_PART)
    apart = ~(together | (np.abs(steps) < near[1:]))
    lengths = np.diff(np.flatnonzero(np.concatenate([[True], apart, [True]])))
    held = np.repeat(lengths >= _HELD, lengths)
    followed = followed | held if followed.mean() >= _FOLLOWED_PART else held
    return np.where(followed, speed, np.nan) if followed.mean() >= _HELD_PART else None


def settled_hops(lines: tuple[RotationLine | None, ...], followed: FloatArray, hop_s: float) -> BoolArray:
    """Which hops had one speed from beginning to end; all if the lines do not stand out enough to tell.

    A part of a hop next to one with another speed may already have had that speed. A line that is weaker at the same
    speed as its neighbours stands in more vibration, as of a load that has grown. Where a drive begins or ends a ramp,
    the hop has not one sweep, even if the line stands out. `followed` is what `followed_speeds` returned for the lines.
    """
    strength = np.array([0.0 if line is None else line.strength for line in lines])
    found = np.isfinite(followed)
    usual = float(np.median(strength[found])) if found.any() else 0.0
    if usual <= STRONG or found.size < 2:
        return np.full(found.shape, True)
    steps = np.diff(followed)
    near = _largest_step(followed, hop_s)
    steady = np.abs(steps) < near[1:]
    held = steady | _goes_on(lines, near, hop_s)
    # The first and the last hop have only one neighbour.
    level = steady & (np.minimum(strength[1:], strength[:-1]) > _WEAKER * np.maximum(strength[1:], strength[:-1]))
    as_it_was = np.append(steady, level[-1:]) & np.insert(steady, 0, level[:1])
    settled = found & (as_it_was | (strength > _WEAKER * usual))
    held &= settled[1:] & settled[:-1]
    if usual > _BENT_STRENGTH:
        held &= ~_bent(lines, steps, hop_s)
    return np.asarray(settled & np.append(held, True) & np.insert(held, 0, True), dtype=np.bool_)


def _largest_step(speed: FloatArray, hop_s: float) -> FloatArray:
    """Largest difference of speed between neighbouring hops of one shaft, rad/s."""
    return np.asarray(np.maximum(_MOST_SPEED_STEP * speed, _RESOLVED * 2 * np.pi / hop_s), dtype=np.float64)


def _goes_on(lines: tuple[RotationLine | None, ...], near: FloatArray, hop_s: float) -> BoolArray:
    """Whether a hop begins with the speed at which the one before ends, to within `near`, shape (n_hops,)."""
    swings = np.array([0 if line is None else len(line.swing) for line in lines])
    apart, last = _apart(lines, hop_s)
    least = np.where(np.maximum(swings[1:], swings[:-1]) > 0, _SWINGING_STEP * last, near[1:])
    return np.asarray(apart < least, dtype=np.bool_)


def _apart(lines: tuple[RotationLine | None, ...], hop_s: float) -> tuple[FloatArray, FloatArray]:
    """How far the speed at which a hop begins is from that at which the one before ended, and the latter, rad/s."""
    ends = np.array([-hop_s, hop_s]) / 2
    first, last = np.array([(np.nan, np.nan) if line is None else line.speed(ends) for line in lines]).T
    return np.abs(first[1:] - last[:-1]), last[:-1]


def _bent(lines: tuple[RotationLine | None, ...], steps: FloatArray, hop_s: float) -> BoolArray:
    """Whether a ramp of a drive begins or ends in one of two neighbouring hops, shape (n_hops - 1,)."""
    sweeps = np.abs([0.0 if line is None else line.sweep_rad_s2 for line in lines])
    moves = np.maximum(np.abs(steps), hop_s * np.maximum(sweeps[1:], sweeps[:-1])) > _RESOLVED * 2 * np.pi / hop_s
    apart, _ = _apart(lines, hop_s)
    return np.asarray(moves & (apart > _BENT * np.nanmedian(apart)), dtype=np.bool_)


def _speed_trend(speed: FloatArray, number: IndexArray) -> FloatArray:
    """Robust straight line through the speeds of the hops `number`, evaluated at every hop."""
    slope, start = scipy.stats.theilslopes(speed[number], number)[:2]
    return np.asarray(start + slope * np.arange(speed.size), dtype=np.float64)


def relative_vectors(vectors: ComplexArray) -> ComplexArray:
    """Turn each hop's vectors, shape (n_hops, n), so that the channel with the clearest line is at angle zero.

    That is the channel whose relative amplitude varies least from hop to hop.
    """
    size = np.abs(vectors)
    mean = size.mean(axis=0)
    spread = size.std(axis=0) / np.where(mean > 0, mean, np.nan)
    channel = int(np.nanargmin(spread)) if np.any(np.isfinite(spread)) else 0
    turn = np.exp(-1j * np.angle(vectors[:, channel]))
    return np.asarray(vectors * turn[:, None], dtype=np.complex128)
