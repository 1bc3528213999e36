"""Lines in narrow bands that the healthy machine did not have, as from gears, blades or bearings.

A band's level says little if the healthy machine was loud in it in one condition and quiet in another. How its power is
spread over the bins does not depend on the level: the strongest of n independent bins of Gaussian noise has a share of
(ln n + γ)/n on average, γ = 0.577 (the mean of the largest of n exponential variables), that of a line two thirds.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from models.levels.bands import LINE, OF_BIN, BandLevels, BandReference, band_in_words, widened
from models.levels.measures import WindowLevels
from models.signals.block import FloatArray

_OVER_HEALTHY = 2.0
"""A new line has more than this times the largest share of its band's power that one bin had on the healthy machine."""
_HAD_ONE = 0.25
"""Share from which on the healthy machine is taken to have had a line in the band; a narrow resonance has less."""
_NOISE, _STEADY = 2.0, 1e-3
"""If the speed varied by more than `_STEADY` (relative) between the healthy hops of a window, lines were spread over
several bins, and become narrower at a steadier speed: a share above `_NOISE` times that of noise may have been one."""
_MODE_SHIFT = 1.35
"""Factor by which a mode's natural frequency may differ from that of the machine file, or have changed."""
_OTHER_MODES_SHARE = 0.16
"""Share that theory allows the strongest bin of any band: a machine has modes that its file does not describe."""
_SCATTERS, _MODE, _LIKE_A_LINE = 1.8, 0.2, 0.45
"""Share allowed in a window over the mean share of a mode's strongest bin; the most that is allowed; and the mean share
from which on a mode cannot be distinguished from a line. In 36 windows of the rotor kits, each in conditions of its own
(seed 20261341), the strongest bins had up to 0.26 where modes are damped by 0.1 % and the mean would be 0.40, and up to
0.21 where it would be 0.15."""
_LEAST_SHARE = 0.02
"""Least share of its channel's power without 1x that a reported line has, as of lines that diagnosis leaves out."""


def learn_lines(windows: Sequence[FloatArray], bands: BandLevels, hops: float, unsteady: float) -> FloatArray:
    """Largest share of each band's power that one bin has in healthy windows, shape (n_bands, n); 1 where it may grow.

    Each window holds the share of each band's power that the strongest bin of a hop has, shape (n_bands, n), as the
    mean of `hops` hops. `bands` are those of one window; `unsteady` is the largest range of the speed over the hops of
    a window, relative to the speed.
    """
    largest = np.asarray(np.max(windows, axis=0), dtype=np.float64)
    if unsteady > _STEADY:
        largest[largest > _NOISE * _noise_share(_bins(bands, hops))[:, None]] = 1.0
    return largest


def expected_lines(bands: BandLevels, hops: float, modes: Sequence[tuple[float, float]]) -> FloatArray:
    """The same share for a linear machine under random excitation, by theory; shape (n_bands,).

    Each mode is a natural frequency, Hz, and a damping ratio.
    """
    bins = _bins(bands, hops)
    parts, bin_hz = np.maximum(_noise_share(bins), _OTHER_MODES_SHARE), np.diff(bands.edges_hz) / bins
    for natural_hz, damping in modes:
        near = (bands.edges_hz[1:] > natural_hz / _MODE_SHIFT) & (bands.edges_hz[:-1] < natural_hz * _MODE_SHIFT)
        off_hz = np.abs(bands.edges_hz - natural_hz)
        # A band that ends beside the mode holds half of it.
        cut = np.minimum(off_hz[:-1], off_hz[1:]) < 2 * damping * natural_hz + bin_hz
        width = np.pi * damping * natural_hz / bin_hz / np.where(cut, 2, 1)  # noise bandwidth, bins
        of_mode = _noise_share(np.maximum(width, 1.0))
        most = np.where(of_mode < _LIKE_A_LINE, np.minimum(_SCATTERS * of_mode, _MODE), 1.0)
        parts[near] = np.maximum(parts, most)[near]
    return parts


def _bins(bands: BandLevels, hops: float) -> FloatArray:
    """Number of independent bins in each band."""
    return np.asarray(np.maximum(bands.freedom / (2 * hops), 1.0), dtype=np.float64)


def _noise_share(bins: FloatArray) -> FloatArray:
    """Mean share of the power of noise that the strongest of `bins` independent bins has."""
    return np.asarray((np.log(bins) + np.euler_gamma) / bins, dtype=np.float64)


def new_line(
    levels: WindowLevels,
    channels: Sequence[str],
    healthy_parts: Mapping[str, Sequence[float]],
    healthy_bands: Mapping[str, BandReference],
    unlike: str = "the healthy machine did not have",
) -> str:
    """Describe the new line with the largest share of its channel's power; empty if there is none.

    Parameters
    ----------
    healthy_parts : mapping of str to sequence of float, shape (n_bands,)
        By channel, see `learn_lines`.
    healthy_bands : mapping of str to BandReference
        By channel. A line that is no louder than its band was in the quietest window may have been there, under noise,
        or spread by a speed that varied within a hop.
    unlike : str
        Relative clause of the text: what has or makes no such line.
    """
    bands, parts = levels.bands, levels.line_parts
    if parts is None or levels.moments is None:
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
    # An unbalance raises 1x, which moves with the speed, and the taper spreads it over the edges of its band.
    off = 0.03 + min(levels.unsteady if math.isfinite(levels.unsteady) else 0.0, 0.5)
    of_1x = (turning_hz * (1 + off) > bands.edges_hz[:-1]) & (turning_hz * (1 - off) < bands.edges_hz[1:])
    new[of_1x] = False
    without_1x = levels.values["not_x1"] ** 2
    total = np.where(np.isnan(without_1x), levels.moments[0].mean(axis=0), without_1x)  # the rotation may not be known
    share = np.divide(power, total, out=np.zeros(parts.shape), where=new & (total > 0))
    band, column = divmod(int(share.argmax()), share.shape[1])
    part, (low_hz, high_hz) = min(1.0, float(share[band, column])), bands.edges_hz[band : band + 2].tolist()
    if part < _LEAST_SHARE:
        return ""
    times = without = ""
    if turning_hz:
        times = f"{low_hz / turning_hz:.3g} to {high_hz / turning_hz:.3g} times running speed, "
        without = " without its 1x"
    return (
        f"a line within {band_in_words((low_hz, high_hz))} ({times}{part:.0%} of the vibration of {channels[column]}"
        f"{without}) that {unlike}: gears, blades, a bearing, mains hum or a neighbouring machine"
    )
