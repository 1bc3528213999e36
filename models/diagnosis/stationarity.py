"""What of a window is not stationary noise: segments of another level, and steady lines.

The cross-spectra of a window are taken for a mean over segments of one level. Where the level steps or drifts, few
segments make up most of that mean; it scatters as one of fewer segments, which looks like a misfit. Segments of a rotor
that are scaled to one level are alike; those with another rotor, a rub or a line are not, and remain a misfit.

The phase of a steady line, mains hum for instance, goes on from segment to segment, that of noise does not.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # its sub-packages are loaded when they are first used

from models.diagnosis.moments import ComplexArray
from models.signals.block import FloatArray

_BLOCK = 16  # bins that are compared at once: many more than channels, and few enough for one colour
_CHANCE = 30.0  # variance of the levels, in parts of that of one value, up to which a window is stationary; 3 is usual
_ROUNDS = 2  # in the first, loud segments weigh too much in the mean that all are compared with
_LOBE = 2  # a Hann window spreads a line over two bins on either side
_BESIDE = range(_LOBE + 1, _LOBE + 4)  # bins away, that are the surroundings
_LINE = 4.0  # power of the motion that stands out most, over that of its surroundings; of noise up to 2.5
_CHANCE_OF_LINE = 1e-4  # of one bin that stands out
_FEWEST_SEGMENTS = 6
_ORDERS = 12
_MAINS_HZ, _MAINS_VARY = (50.0, 60.0), 0.004  # frequencies of electric supplies, and how far these are off, relative
_SAME = 0.02  # relative distance of a line from itself

KnownLine = tuple[float, float]
"""A line of the healthy machine: its frequency, Hz, and the same over the running speed."""


class ExcludedLine(NamedTuple):
    """A line, and how far from it its skirts are seen: the louder it is, the further."""

    frequency_hz: float
    reach_hz: float


def summed(segments: ComplexArray) -> ComplexArray:
    """Cross-products of Fourier coefficients, shape (..., n_segments, n), over the segments: shape (..., n, n)."""
    return np.asarray(segments.swapaxes(-1, -2) @ segments.conj(), dtype=np.complex128)


def segment_levels(segments: ComplexArray, spectrum: ComplexArray, columns: Sequence[int]) -> FloatArray | None:
    """Powers of the segments of a window relative to their mean; None if it is stationary.

    Parameters
    ----------
    segments : ndarray, shape (n_bins, n_segments, n)
        Fourier coefficients without mean and rotation.
    spectrum : ndarray, shape (n_bins, n, n)
        `summed` of them.
    columns : sequence of int
        Channels that count: one of each motion.

    Returns
    -------
    ndarray, shape (n_segments,), or None
        Medians over the band and over motions that do not go together: lines that come, and forces on a part of either,
        are not the level.
    """
    n, count = len(columns), segments.shape[1]
    blocks = segments.shape[0] // _BLOCK
    if not n or not blocks:
        return None
    own = segments[: blocks * _BLOCK, :, columns].reshape(blocks, _BLOCK, count, n)
    mean = spectrum[: blocks * _BLOCK, columns][:, :, columns].reshape(blocks, _BLOCK, n, n).sum(axis=1)
    if not np.all(np.isfinite(mean)):
        return None
    levels = np.ones(count)
    for _ in range(_ROUNDS):
        motions = own @ np.linalg.eigh(mean)[1].conj()[:, np.newaxis]
        powers = (motions.real**2 + motions.imag**2).sum(axis=1)  # (blocks, n_segments, n)
        usual = np.maximum(powers.mean(axis=1, keepdims=True), np.finfo(float).tiny)
        levels = np.median(powers / usual, axis=(0, 2))
        levels /= max(float(levels.mean()), np.finfo(float).tiny)
        if np.mean((levels - 1) ** 2) * own[:, :, 0].size < _CHANCE or not np.all(levels > 0):
            return None
        mean = summed((own / np.sqrt(levels)[:, np.newaxis]).reshape(blocks, -1, n))
    return levels


def excluded_lines(
    segments: ComplexArray,
    spectrum: ComplexArray,
    frequencies_hz: FloatArray,
    speed_rad_s: float,
    known: Sequence[KnownLine] | None = (),
) -> tuple[ExcludedLine, ...]:
    """Steady lines that say nothing of the machine: the healthy one had them, or they are mains hum.

    A line of a hundredth of a channel's rms matters where one force moves all channels: what is left between them is
    sensor noise alone. So all channels are looked at together, in parts of what surrounds a bin.

    Parameters
    ----------
    segments : ndarray, shape (n_bins, n_segments, n)
        Fourier coefficients without mean and rotation.
    spectrum : ndarray, shape (n_bins, n, n)
        Their cross-spectra, in any unit.
    speed_rad_s : float
        Where it is nan no line can be told from the rotation.
    known : sequence of KnownLine, optional
        Those of the healthy machine. None: all lines are taken for such, multiples of the speed too.
    """
    reach, size, step_hz = _BESIDE.stop - 1, frequencies_hz.size, frequencies_hz[1] - frequencies_hz[0]
    speed_hz = abs(speed_rad_s) / (2 * np.pi)
    enough = segments.shape[1] >= _FEWEST_SEGMENTS and segments.shape[2] and size > 2 * reach
    if not np.isfinite(speed_hz) or not enough:
        return ()
    wanted = np.ones(size, dtype=np.bool_)
    if known is not None:
        mains = np.array(_MAINS_HZ)[:, np.newaxis]
        off = np.abs(frequencies_hz - mains * np.maximum(np.round(frequencies_hz / mains), 1.0)).min(axis=0)
        wanted = off <= _MAINS_VARY * frequencies_hz + step_hz / 2
        orders = frequencies_hz[:, np.newaxis] - speed_hz * np.arange(1, _ORDERS + 1)
        wanted &= np.abs(orders).min(axis=1) > _LOBE * step_hz
        for line_hz, order in known:
            for then in (line_hz, order * speed_hz):
                wanted |= np.abs(frequencies_hz - then) <= _SAME * then
    wanted &= np.abs(frequencies_hz - speed_hz) > _LOBE * step_hz
    at = np.flatnonzero(wanted)
    beside = at + np.array([sign * k for k in _BESIDE for sign in (-1, 1)])[:, np.newaxis]
    beside = np.where((beside < 0) | (beside >= size), 2 * at - beside, beside)  # at the band's ends, of one side
    around = spectrum[beside].mean(axis=0)
    try:
        unit = np.linalg.inv(np.linalg.cholesky(around))
        powers, motions = np.linalg.eigh(unit @ spectrum[at] @ unit.conj().swapaxes(1, 2))
    except np.linalg.LinAlgError:  # a dead channel, or one that is there twice
        return ()
    strength = np.zeros(size)
    strength[at] = powers[:, -1]
    highest = scipy.ndimage.maximum_filter1d(strength, 2 * _LOBE + 1)
    lines = np.flatnonzero((strength[at] > _LINE) & (strength[at] == highest[at]))
    return tuple(
        ExcludedLine(float(frequencies_hz[at[n]]), float(step_hz * max(_LOBE + 1, 2 * powers[n, -1] ** (1 / 6))))
        for n in lines
        if _keeps_course(segments[at[n]] @ (motions[n, :, -1].conj() @ unit[n]))
    )


def _keeps_course(own: ComplexArray) -> bool:
    """Whether the phase of segments, shape (n_segments,), goes on by one angle each time, as that of noise does not.

    The frequency may be off the bin, and wander slowly. The mean of unit vectors that turn by what the angle changes is
    of length u or more with about the probability (1 - u²)ⁿ⁻⁴, of n pieces of noise that overlap by half.
    """
    unit = own / np.maximum(np.abs(own), np.finfo(float).tiny)
    length = min(1.0, float(abs(np.mean(unit[:-2] * unit[1:-1].conj() ** 2 * unit[2:]))))
    return bool((1 - length**2) ** (own.size - 4) < _CHANCE_OF_LINE)
