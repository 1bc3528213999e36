"""What in a window's segments is not of the machine: lines that theory leaves out, and changes of the forces' level.

The lines are mains hum and those of the healthy machine. A line of a hundredth of a channel's rms matters where one
force moves all channels, as channels then differ by sensor noise alone. So all channels are looked at together,
relative to the bins around. The phase of a steady line advances evenly from segment to segment, and that of a multiple
of the speed follows the shaft; that of noise does neither.

The level of the random forces may change within a window, too. The cross-spectra are treated as a mean over segments of
equal level. If the level steps or drifts, few segments dominate that mean; it scatters like a mean over fewer segments,
which looks like a misfit. Scaled to one level, segments of one rotor are alike; those with another rotor, a rub or a
line are not, and remain a misfit. Sensor noise does not follow the load: motions that are mostly noise do not count for
the level, and only segments of similar level are evaluated, as scaling also scales their noise. A fault that comes and
goes raises the level as well, but changes the motion; segments in which it is different are evaluated at any level.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from models.signals.block import BoolArray, ComplexArray, FloatArray, IndexArray

LOBE = 2  # a Hann window spreads a line over two bins on either side
_BESIDE = range(LOBE + 1, LOBE + 4)  # bins away, that are the surroundings
_STANDS_OUT = 4.0  # power of the motion that stands out most, over that of its surroundings; up to 2.5 for noise
_SMOOTH = 3  # segments to either side over which the phase of a removed line is averaged
_HANN_POWER, _AT_ONE = 0.375, 1e-6  # power of a lobe over the square of the sum of its amplitudes
_CHANCE = 1e-4  # for one bin that stands out
FEWEST_SEGMENTS = 6
_ORDERS = range(2, 13)
MAINS_HZ, _MAINS_VARY = (50.0, 60.0), 0.004  # mains frequencies, and their relative tolerance
LINE_TOLERANCE = 0.02  # relative tolerance for the same line
_HUM = 0.05  # part of the random power up to which a line counts as hum; above, it is reported like any other
_HALVES = (0.5, 1.5, 2.5)  # multiples of the speed that a rub or looseness causes

KnownLine = tuple[float, float]
"""A line of the healthy machine: its frequency, Hz, and the same over the running speed."""


class ExcludedLine(NamedTuple):
    """A line, and how far from it its skirts are seen: the louder it is, the further."""

    frequency_hz: float
    reach_hz: float
    # (n, n): its own R_ij(τ) = Re{power e^{-j2π centre τ}}, if its phase is certainly not that of a resonance, as with
    # hum and multiples of the speed; and its frequency, which may lie between bins
    power: ComplexArray | None = None
    centre_hz: float = 0.0

    def known(self, speed_rad_s: float) -> KnownLine:
        """Frequency and order to three digits, so that a line found in every window is kept only once, or few times."""
        order = self.frequency_hz * 2 * np.pi / abs(speed_rad_s)
        return float(f"{self.frequency_hz:.3g}"), float(f"{order:.3g}")

    def turned(self, turn: FloatArray | ComplexArray) -> "ExcludedLine":
        """The line in other channels, ``turn @ channels``."""
        return self if self.power is None else self._replace(power=turn @ self.power @ turn.conj().T)


def excluded_lines(
    segments: ComplexArray,
    spectrum: ComplexArray,
    frequencies_hz: FloatArray,
    speeds_rad_s: tuple[float, float],
    known: Sequence[KnownLine] | None = (),
    turning: ComplexArray | None = None,
    alive: BoolArray | None = None,
) -> tuple[ExcludedLine, ...]:
    """Lines that say nothing about the machine, in Fourier coefficients without mean and rotation.

    `segments` has shape (n_bins, n_segments, n), and `spectrum`, (n_bins, n, n), are their cross-spectra in any unit.
    The speeds are those of the slowest and the fastest hop; where they are nan, or the shaft stands, no line can be
    told from the rotation. `known` are the lines of the healthy machine; if None, all lines count as such, multiples of
    the speed too. `turning`, (n_segments, n_bins), are Fourier coefficients of the cosine of the shaft angle. `alive`,
    (n,), says which channels have a signal: the rounding errors of a dead one look like lines anywhere.
    """
    if alive is not None and not alive.all():
        place = np.eye(alive.size)[:, alive]
        own = segments[:, :, alive], spectrum[:, alive][:, :, alive]
        return tuple(one.turned(place) for one in excluded_lines(*own, frequencies_hz, speeds_rad_s, known, turning))
    slowest_hz, fastest_hz = sorted(abs(speed) / (2 * np.pi) for speed in speeds_rad_s)
    enough = segments.shape[1] >= FEWEST_SEGMENTS and segments.shape[2] and frequencies_hz.size > 2 * _BESIDE.stop
    if not (slowest_hz > 0 and enough):
        return ()
    step_hz, speed_hz = frequencies_hz[1] - frequencies_hz[0], (slowest_hz + fastest_hz) / 2
    away = np.abs(frequencies_hz - np.clip(frequencies_hz, slowest_hz, fastest_hz)) > LOBE * step_hz
    mains = np.array(MAINS_HZ)[:, np.newaxis]
    off_hz = np.abs(frequencies_hz - mains * np.maximum(np.round(frequencies_hz / mains), 1.0)).min(axis=0)
    hum = (off_hz <= _MAINS_VARY * frequencies_hz + step_hz / 2) & away
    healthy = _near_known(frequencies_hz, speed_hz, known)
    found = []
    try:
        at = np.flatnonzero(hum | (healthy & away))
        strength, motions = _outstanding(spectrum, at, (at, at))
        peaks = np.zeros(frequencies_hz.size + 2 * LOBE)
        peaks[at + LOBE] = strength
        highest = peaks[at + np.arange(2 * LOBE + 1)[:, np.newaxis]].max(axis=0)
        for n in np.flatnonzero((strength > _STANDS_OUT) & (strength == highest)):
            own = segments[at[n]] @ motions[n]
            if not _phase_is_steady(own):
                continue
            line = ExcludedLine(float(frequencies_hz[at[n]]), step_hz * _skirt(strength[n]))
            phases, centre_hz = _line_phases(own, line, step_hz)
            # If a multiple of the speed is in the same lobe, the phase says which of the two it is.
            is_hum = hum[at[n]] and _beside_multiples(centre_hz, slowest_hz, fastest_hz, step_hz / 2)
            if healthy[at[n]] or (is_hum and _share(segments, int(at[n]), own) <= _HUM):
                found.append(_with_power(line, segments, frequencies_hz, phases, centre_hz) if is_hum else line)
        if turning is None:
            return tuple(found)
        rotation = phases_of(turning[:, np.abs(frequencies_hz - speed_hz).argmin()])
        for order in _ORDERS:
            half_hz = order * (fastest_hz - slowest_hz) / 2
            at = np.flatnonzero(np.abs(frequencies_hz - order * speed_hz) <= half_hz + step_hz)
            had = known is not None and any(abs(one / order - 1) <= LINE_TOLERANCE for _, one in known)
            if at.size and (had or known is None):
                strength, motions = _outstanding(spectrum, at, (at[:1], at[-1:]))
                # All bins of a lobe have the phase in the middle of the segment, with a sign that alternates.
                own = ((-1.0) ** at[:, np.newaxis] * (segments[at] @ motions[strength.argmax()])).sum(axis=0)
                if had or (strength.max() > _STANDS_OUT and _phase_follows_rotation(own, rotation, order)):
                    line = ExcludedLine(order * speed_hz, half_hz + step_hz * _skirt(strength.max()))
                    found.append(
                        _with_power(line, segments, frequencies_hz, rotation**order, order * speed_hz, half_hz)
                    )
    except np.linalg.LinAlgError:  # a dead channel, or one that is there twice
        return ()
    return tuple(found)


def _beside_multiples(line_hz: float, slowest_hz: float, fastest_hz: float, by_hz: float) -> bool:
    """Whether a line is at least `by_hz` from all multiples of the speed, half ones from a rub included."""
    orders = np.array([*_HALVES, *_ORDERS])
    return bool((np.abs(line_hz - np.clip(line_hz, orders * slowest_hz, orders * fastest_hz)) >= by_hz).all())


def _near_known(frequencies_hz: FloatArray, speed_hz: float, known: Sequence[KnownLine] | None) -> BoolArray:
    """Bins where a line of the healthy machine may be; all if this window is to say which lines it has."""
    near = np.full(frequencies_hz.size, known is None)
    for line_hz, order in known or ():
        for then in (line_hz, order * speed_hz):
            near |= np.abs(frequencies_hz - then) <= LINE_TOLERANCE * then
    return near


def _share(segments: ComplexArray, at: int, own: ComplexArray) -> float:
    """Part of the power of all channels in the band that is coherent with the line.

    In a single channel it says little: where hardly anything but the rotation moves one, faint hum is most of the rest.
    """
    lobe = slice(max(0, at - LOBE), at + LOBE + 1)
    line = np.abs(phases_of(own).conj() @ segments[lobe] / own.size) ** 2
    noise = (np.abs(segments[lobe]) ** 2).mean(axis=1) / own.size
    return float((line - noise).sum() / (np.abs(segments) ** 2).mean(axis=1).sum())


def _line_phases(own: ComplexArray, line: ExcludedLine, step_hz: float) -> tuple[ComplexArray, float]:
    """Phases of a line that advances by one angle per segment, shape (n_segments,), and its frequency.

    The phases may drift, but over more than a few segments: following every segment would follow a resonance as well.
    """
    unit = phases_of(own)
    advance = np.angle(np.mean(unit[1:] * unit[:-1].conj()))
    steady = np.exp(1j * advance * np.arange(own.size))
    wandering = np.convolve(np.pad(unit * steady.conj(), _SMOOTH, mode="edge"), np.ones(2 * _SMOOTH + 1), mode="valid")
    # Segments are half a segment apart: in that time a line between the bins turns by up to half a turn more or less.
    every_s = 1 / (2 * step_hz)
    off = np.angle(np.exp(1j * (advance - 2 * np.pi * line.frequency_hz * every_s))) / (2 * np.pi * every_s)
    return phases_of(steady * wandering), float(line.frequency_hz + off)


def _with_power(
    line: ExcludedLine,
    segments: ComplexArray,
    frequencies_hz: FloatArray,
    phases: ComplexArray,
    centre_hz: float,
    half_hz: float = 0.0,
) -> ExcludedLine:
    """The line with the power coherent with its phases in all channels; it wanders by `half_hz` to either side."""
    step_hz = frequencies_hz[1] - frequencies_hz[0]
    lobe = np.flatnonzero(np.abs(frequencies_hz - centre_hz) <= half_hz + (LOBE + 0.5) * step_hz)
    if not lobe.size:
        return line
    off = np.abs(frequencies_hz[lobe] - centre_hz) / step_hz
    hann = np.sinc(off) / np.where(np.abs(off - 1) < _AT_ONE, 2.0, 2 * (1 - off**2))
    hann = np.where(np.abs(off - 1) < _AT_ONE, 0.25, hann)
    # All bins of a lobe have the amplitude in the middle of the segment with a sign that alternates, weighted by the
    # taper or, for a line that moves through the bins, equally.
    weights = hann / (hann @ hann) if half_hz < step_hz else np.ones(lobe.size)
    middle = np.tensordot((-1.0) ** lobe * weights, segments[lobe], axes=1)
    amplitudes = phases.conj() @ middle / phases.size
    power = 2 * step_hz * _HANN_POWER * np.outer(amplitudes, amplitudes.conj())
    return line._replace(power=power, centre_hz=centre_hz)


def _outstanding(
    spectrum: ComplexArray, at: IndexArray, between: tuple[IndexArray, IndexArray]
) -> tuple[FloatArray, ComplexArray]:
    """Power of the motion that stands out most in each bin, and the weights of the channels in that motion.

    The power is relative to the bins around the first and the last of those it is `between`.
    """
    low, high = between
    size = spectrum.shape[0]
    beside = np.array([one for k in _BESIDE for one in (low - k, high + k)])
    beside = np.where((beside < 0) | (beside >= size), low + high - beside, beside)  # one side alone at the band's ends
    unit = np.linalg.inv(np.linalg.cholesky(spectrum[np.clip(beside, 0, size - 1)].mean(axis=0)))
    powers, motions = np.linalg.eigh(unit @ spectrum[at] @ unit.conj().swapaxes(1, 2))
    weights = (motions[:, :, -1:].conj().swapaxes(1, 2) @ unit)[:, 0]
    return powers[:, -1], np.asarray(weights, dtype=np.complex128)


def _skirt(strength: float) -> float:
    """Number of bins from a line at which its skirts are still seen: a Hann window's fall with the sixth power."""
    return float(max(LOBE + 1, 2 * strength ** (1 / 6)))


def _phase_is_steady(own: ComplexArray) -> bool:
    """Whether the phase of segments, shape (n_segments,), advances by the same angle each time, unlike that of noise.

    The frequency may be off the bin and drift slowly. For n segments of noise that overlap by half, the mean of unit
    vectors at the change of that angle has length u or more with about the probability (1 - u²)ⁿ⁻⁴.
    """
    unit = phases_of(own)
    return bool((1 - _mean_length(unit[:-2] * unit[1:-1].conj() ** 2 * unit[2:]) ** 2) ** (own.size - 4) < _CHANCE)


def _phase_follows_rotation(own: ComplexArray, rotation: ComplexArray, order: int) -> bool:
    """Whether the phase of segments, shape (n_segments,), follows a multiple of the rotation.

    The mean of n unit vectors has length u or more with the probability (1 - u²)ⁿ⁻¹; the segments overlap, so every
    second one is evidence.
    """
    return bool((1 - _mean_length(phases_of(own) * rotation.conj() ** order) ** 2) ** (own.size / 2) < _CHANCE)


def phases_of(coefficients: ComplexArray) -> ComplexArray:
    """Numbers of length one with the same phases."""
    return np.asarray(coefficients / np.maximum(np.abs(coefficients), np.finfo(float).tiny), dtype=np.complex128)


def _mean_length(unit: ComplexArray) -> float:
    return min(1.0, float(abs(unit.mean())))


_BLOCK = 16  # bins that are compared at once: many more than channels, and few enough to share one colour
_STEADY = 30.0  # variance of the levels, times the coefficients in each, below which a window is stationary; 3 is usual
_CLEAR, _CLEAR_BLOCKS = 4.0, 5  # power over that of noise, and the fewest blocks: a line is in two of them at most
_ALIKE = 2.0  # range of the levels evaluated together: sensor noise is scaled with the segments, and then varies itself
_OTHER = 2.5  # deviation of a segment over the usual one, above which its motion is another; at another load up to 2
_ROUNDS = 2  # in the first, loud segments weigh too much in the mean that all segments are compared with


def summed(segments: ComplexArray) -> ComplexArray:
    """Cross-products of Fourier coefficients, shape (..., n_segments, n), summed over segments: shape (..., n, n)."""
    return np.asarray(segments.swapaxes(-1, -2) @ segments.conj(), dtype=np.complex128)


def segment_levels(segments: ComplexArray, spectrum: ComplexArray, columns: Sequence[int]) -> FloatArray | None:
    """Powers of the segments of a window relative to their mean, shape (n_segments,); None if it is stationary.

    They are medians over the band and over uncorrelated motions, so a line that appears, or a force on a part of the
    band or of the motions, does not change them. `segments` are Fourier coefficients, shape (n_bins, n_segments, n),
    without mean and rotation, and `spectrum` is `summed` of them; `columns` are one channel of each motion.
    """
    n, count = len(columns), segments.shape[1]
    blocks = segments.shape[0] // _BLOCK
    if not n or not blocks:
        return None
    own = _in_blocks(segments, columns)
    mean = spectrum[: blocks * _BLOCK, columns][:, :, columns].reshape(blocks, _BLOCK, n, n).sum(axis=1)
    if not np.all(np.isfinite(mean)):
        return None
    levels = np.ones(count)
    for _ in range(_ROUNDS):
        powers = _clear_powers(own, mean)
        levels = np.median(powers, axis=0)
        levels /= max(float(levels.mean()), np.finfo(float).tiny)
        if np.mean((levels - 1) ** 2) * len(powers) * _BLOCK < _STEADY or not np.all(levels > 0):
            return None
        mean = summed((own / np.sqrt(levels)[:, np.newaxis]).reshape(blocks, -1, n))
    return levels


def _in_blocks(segments: ComplexArray, columns: Sequence[int]) -> ComplexArray:
    """Channels `columns` of the segments, shape (n_blocks, bins in a block, n_segments, n)."""
    blocks = segments.shape[0] // _BLOCK
    return np.take(segments[: blocks * _BLOCK], columns, axis=2).reshape(blocks, _BLOCK, -1, len(columns))


def _clear_powers(own: ComplexArray, spectrum: ComplexArray) -> FloatArray:
    """Powers of segments in the clear motions of `spectrum`, relative to their mean, shape (n_clear, n_segments)."""
    values, axes = np.linalg.eigh(spectrum)
    motions = own.reshape(len(own), -1, own.shape[-1]) @ axes.conj()
    powers = (motions.real**2 + motions.imag**2).reshape(own.shape).sum(axis=1)  # (n_blocks, n_segments, n)
    usual = np.maximum(powers.mean(axis=1, keepdims=True), np.finfo(float).tiny)
    return np.asarray((powers / usual).swapaxes(1, 2)[_clear(values, np.abs(axes) ** 2)], dtype=np.float64)


def _clear(values: FloatArray, shares: FloatArray) -> BoolArray:
    """Which motions stand out of the sensors' noise, whose level does not follow the load, shape (n_blocks, n).

    `values` are the powers of the motions, and `shares`, (n_blocks, n, n), those of each channel in them. A channel's
    noise is at most what the other channels do not share, where that is least. All, if motions stand out in few blocks.
    """
    powers = np.maximum(values, np.finfo(float).tiny)
    noise = (1 / (shares / powers[:, np.newaxis]).sum(axis=2)).min(axis=0)
    clear = powers > _CLEAR * (noise @ shares)
    return clear if np.count_nonzero(clear.any(axis=1)) >= _CLEAR_BLOCKS else np.ones_like(clear)


def of_one_level(segments: ComplexArray, levels: FloatArray, columns: Sequence[int]) -> ComplexArray:
    """The most segments whose levels are within a factor of two, and those of another motion, scaled to one level.

    All, if the former are less than a third. `columns` are one channel of each motion.
    """
    scaled = np.asarray(segments / np.sqrt(levels)[:, np.newaxis], dtype=np.complex128)
    order = np.argsort(levels, kind="stable")
    ends = np.searchsorted(levels[order], _ALIKE * levels[order], side="right")
    first = int(np.argmax(ends - np.arange(levels.size)))
    alike = np.isin(np.arange(levels.size), order[first : ends[first]])
    if 3 * np.count_nonzero(alike) < levels.size:
        return scaled
    own = _in_blocks(scaled, columns)
    kept = own[:, :, alike]
    powers = np.maximum(_clear_powers(own, summed(kept.reshape(len(own), -1, len(columns)))), np.finfo(float).tiny)
    apart = np.sqrt(np.mean(np.log(powers / np.median(powers[:, alike], axis=1, keepdims=True)) ** 2, axis=0))
    return scaled[:, alike | (apart > _OTHER * np.median(apart[alike]))]
