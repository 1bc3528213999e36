"""Lines in narrow bands that the healthy machine did not have: of gears, blades, bearings, whatever turns.

The level of a band says little where the healthy machine was loud in it in one condition and quiet in another. How its
power is spread says more, and is the same in all of them: of n independent bins of Gaussian noise the strongest has
(ln n + γ)/n of the power, γ = 0.577, for that is the mean of the largest of n exponentials; of a line two thirds.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from models.levels.bands import LINE, OF_BIN, BandLevels, BandReference, band_in_words, widened
from models.levels.measures import WindowLevels
from models.signals.block import FloatArray

_OVER_HEALTHY = 2.0
"""Times the largest part that the strongest bin of a band had on the healthy machine, from which on it is a line."""
_HAD_ONE = 0.25
"""Part from which on the healthy machine is taken to have a line there; a narrow resonance has less."""
_NOISE, _STEADY = 2.0, 1e-3
"""Where healthy hops of one window differed by more than this in speed, lines were spread over several bins, and become
narrower when it is steadier: what had more than so many times the part of noise may be one."""
_MOVED = 1.35
"""Times its natural frequency by which a mode may be off that of the machine file, or have changed."""
_OTHERS = 0.16
"""Part that the strongest bin of any band may have by theory: a machine has modes that its file knows nothing of."""
_SCATTERS, _MODE, _LIKE_A_LINE = 1.8, 0.2, 0.45
"""Times the mean part of a mode's power that its strongest bin may have in a window, the most that is reckoned with,
and the mean from which on a mode cannot be told from a line. On the rotor kits, 36 windows in conditions of their own
(seed 20261341), the strongest bins had up to 0.26 where modes are damped by 0.1 % and 0.40 would be the mean, and 0.21
where 0.15 would."""
_LOUD = 0.02
"""Part of a channel's power without 1x from which on a line is told, as of the lines that diagnosis leaves out."""


def learn_lines(windows: Sequence[FloatArray], bands: BandLevels, hops: float, unsteady: float) -> FloatArray:
    """Largest part of each band's power that healthy windows have in one bin, shape (n_bands, n); 1 where it may grow.

    Parameters
    ----------
    windows : sequence of ndarray, shape (n_bands, n)
        Part of each band's power that the strongest bin of a hop has.
    bands : BandLevels
        Of one of them.
    hops : float
        Of which a window has the mean.
    unsteady : float
        From the slowest hop of a window to its fastest, relative to the speed.
    """
    largest = np.asarray(np.max(windows, axis=0), dtype=np.float64)
    if unsteady > _STEADY:
        largest[largest > _NOISE * _of_noise(_bins(bands, hops))[:, None]] = 1.0
    return largest


def expected_lines(bands: BandLevels, hops: float, modes: Sequence[tuple[float, float]]) -> FloatArray:
    """The same by theory of a linear machine that is shaken at random; shape (n_bands,).

    Modes are natural frequency, Hz, and damping ratio.
    """
    bins = _bins(bands, hops)
    parts, bin_hz = np.maximum(_of_noise(bins), _OTHERS), np.diff(bands.edges_hz) / bins
    for natural_hz, damping in modes:
        near = (bands.edges_hz[1:] > natural_hz / _MOVED) & (bands.edges_hz[:-1] < natural_hz * _MOVED)
        of_mode = _of_noise(np.maximum(np.pi * damping * natural_hz / bin_hz, 1.0))  # bins that it is as wide as
        most = np.where(of_mode < _LIKE_A_LINE, np.minimum(_SCATTERS * of_mode, _MODE), 1.0)
        parts[near] = np.maximum(parts, most)[near]
    return parts


def _bins(bands: BandLevels, hops: float) -> FloatArray:
    """Bins of each band."""
    return np.asarray(np.maximum(bands.freedom / (2 * hops), 1.0), dtype=np.float64)


def _of_noise(bins: FloatArray) -> FloatArray:
    """Part of the power of noise that the strongest of so many bins has in the mean."""
    return np.asarray((np.log(bins) + np.euler_gamma) / bins, dtype=np.float64)


def new_line(
    levels: WindowLevels,
    channels: Sequence[str],
    healthy_parts: Mapping[str, Sequence[float]],
    healthy_bands: Mapping[str, BandReference],
    unlike: str = "the healthy machine did not have",
) -> str:
    """The new line that has most of its channel's power; empty if there is none.

    Parameters
    ----------
    healthy_parts : mapping of str to sequence of float, shape (n_bands,)
        By channel, see `learn_lines`.
    healthy_bands : mapping of str to BandReference
        By channel. A line that is no louder than its band was in the quietest window may have been there, under noise,
        or spread by a speed that varied within a hop.
    unlike : str
        How the sentence goes on: what no such line is of.
    """
    bands, parts = levels.bands, levels.line_parts
    if bands is None or parts is None or levels.moments is None:
        return ""
    known = [name in healthy_bands and len(healthy_bands[name].low) == len(parts) for name in channels]
    if not all(known) or any(len(healthy_parts.get(name, ())) != len(parts) for name in channels):
        return ""
    before = widened(np.array([healthy_parts[name] for name in channels]).T)
    new = (before < _HAD_ONE) & (parts > np.maximum(LINE, _OVER_HEALTHY * before))
    quietest = np.array([healthy_bands[name].low for name in channels]).T
    least = np.pad(quietest**2, ((1, 1), (0, 0)))  # a line that is spread over an edge is in both bands
    power = OF_BIN * parts * bands.rms**2
    new &= power > least[1:-1] + np.maximum(least[:-2], least[2:])
    turning_hz = abs(levels.speed_rad_s or 0.0) / (2 * math.pi)
    # 1x is lifted by an unbalance, goes where the speed goes, and the taper spreads it over the edges of its band.
    off = 0.03 + min(levels.unsteady if math.isfinite(levels.unsteady) else 0.0, 0.5)
    of_1x = (turning_hz * (1 + off) > bands.edges_hz[:-1]) & (turning_hz * (1 - off) < bands.edges_hz[1:])
    new[of_1x] = False
    without_1x = levels.values["not_x1"] ** 2
    total = np.where(np.isnan(without_1x), levels.moments[0].mean(axis=0), without_1x)  # the rotation may not be known
    share = np.divide(power, total, out=np.zeros(parts.shape), where=new & (total > 0))
    band, column = divmod(int(share.argmax()), share.shape[1])
    part, (low_hz, high_hz) = min(1.0, float(share[band, column])), bands.edges_hz[band : band + 2].tolist()
    if part < _LOUD:
        return ""
    times = without = ""
    if turning_hz:
        times = f"{low_hz / turning_hz:.3g} to {high_hz / turning_hz:.3g} times running speed, "
        without = " without its 1x"
    return (
        f"a line within {band_in_words((low_hz, high_hz))} ({times}{part:.0%} of the vibration of {channels[column]}"
        f"{without}) that {unlike}: gears, blades, a bearing, mains hum or a neighbouring machine"
    )
