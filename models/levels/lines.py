"""Lines in narrow bands that the healthy machine did not have: of gears, blades, bearings, whatever turns.

The level of a band says little where the healthy machine was loud in it in one condition and quiet in another. How its
power is spread says more, and is the same in all of them: of n independent bins of Gaussian noise the strongest has
(ln n + γ)/n of the power, γ = 0.577, for that is the mean of the largest of n exponentials; of a line two thirds.
"""

from collections.abc import Sequence

import numpy as np

from models.levels.bands import BandLevels
from models.signals.block import FloatArray

LINE, _OVER_HEALTHY = 0.2, 2.0
"""Least part of its band that a line has, and times the largest of the healthy machine."""
OF_BIN = 1.5
"""Power of a line over that of its strongest bin, where it is in the middle of it."""
_HAD_ONE = 0.25
"""Part from which on the healthy machine is taken to have a line there; a narrow resonance has less."""
_NOISE, _STEADY = 2.0, 1e-3
"""Where healthy hops of one window differed by more than this in speed, lines were spread over several bins, and become
narrower when it is steadier: what had more than so many times the part of noise may be one."""
_LOUD = 0.02
"""Part of a channel's power without 1x from which on a line is told, as of the lines of `models.diagnosis.lines`."""


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
        bins = bands.freedom / (2 * hops)
        noise = (np.log(bins) + np.euler_gamma) / bins
        largest[largest > _NOISE * noise[:, None]] = 1.0
    return largest


def new_line(
    levels: BandLevels,
    parts: FloatArray,
    healthy: FloatArray,
    quietest: FloatArray,
    power: FloatArray,
    turning_hz: float,
) -> tuple[int, tuple[float, float], float] | None:
    """The new line that has most of its channel's power; None where there is none.

    Parameters
    ----------
    parts : ndarray, shape (n_bands, n)
        Part of each band's power that the strongest bin of a hop has.
    healthy : ndarray, shape (n_bands, n)
        See `learn_lines`; nan where it is not known.
    quietest : ndarray, shape (n_bands, n)
        Level of each band in the healthy window in which it is least: a line that is no louder may have been there,
        under noise, or spread by a speed that varied within a hop.
    power : ndarray, shape (n,)
        Mean square of each channel without 1x.
    turning_hz : float
        At which there is 1x, which an unbalance lifts; 0 where it is not known.

    Returns
    -------
    tuple of int, (float, float) and float, or None
        Column, edges of the band, Hz, and part of that power.
    """
    padded = np.pad(healthy, ((1, 1), (0, 0)), mode="edge")  # a line moves to the next band when the speed does
    before = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    new = (before < _HAD_ONE) & (parts > np.maximum(LINE, _OVER_HEALTHY * before))  # not where it is not known
    least = np.pad(quietest**2, ((1, 1), (0, 0)))  # a line that is spread over an edge is in both bands
    power_of_line = OF_BIN * parts * levels.rms**2
    new &= power_of_line > least[1:-1] + np.maximum(least[:-2], least[2:])
    # The taper spreads a line over the edges of its band.
    new[(turning_hz > 0.97 * levels.edges_hz[:-1]) & (turning_hz < 1.03 * levels.edges_hz[1:])] = False
    share = np.divide(power_of_line, power, out=np.zeros(parts.shape), where=new & (power > 0))
    band, column = divmod(int(share.argmax()), share.shape[1])
    part, (low_hz, high_hz) = min(1.0, float(share[band, column])), levels.edges_hz[band : band + 2].tolist()
    return None if part < _LOUD else (column, (low_hz, high_hz), part)
