"""Kurtosis of what is not at running speed: 3 where a linear machine is shaken at random, and compared with healthy.

No change of stiffness, damping or unbalance makes the random part of a vibration anything but Gaussian. A rub or a stop
clips it, and its kurtosis falls; what knocks, like a loose part or a damaged raceway, lifts it (ISO 13373-3). Cumulants
of independent parts add up: a line of amplitude a takes 3/8 a⁴ from the fourth one.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from models.levels.bands import BandLevels, BandReference
from models.signals.block import FloatArray


def random_kurtosis(square: FloatArray, fourth: FloatArray, lines: npt.NDArray[np.complex128]) -> FloatArray:
    """Kurtosis of each hop without what its lines take from it, shape (n_hops, n); nan where these are not known.

    Parameters
    ----------
    square, fourth : ndarray, shape (n_hops, n)
        Second and fourth moment about the mean.
    lines : ndarray of complex, shape (n_hops, n_lines, n)
        Their amplitudes.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (fourth + 0.375 * (np.abs(lines) ** 4).sum(axis=1)) / square**2
    return np.asarray(found, dtype=np.float64)


class KurtosisReference(BaseModel):
    """That of one channel in the healthy windows."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    mean: float = Field(allow_inf_nan=False)
    scatter: float = Field(ge=0, allow_inf_nan=False)  # standard deviation of one hop
    hops: int = Field(ge=2)  # how many were seen
    range: float = Field(ge=0, allow_inf_nan=False)  # largest distance of a window's mean from `mean`


def learn_kurtosis(windows: Sequence[FloatArray]) -> KurtosisReference | None:
    """Learn a channel's from the hops of healthy windows; None where the lines are not known, or of a single hop."""
    values = np.concatenate(windows)
    if values.size < 2 or not np.all(np.isfinite(values)):
        return None
    means = [window.mean() for window in windows]
    mean = float(values.mean())
    return KurtosisReference(
        mean=mean,
        scatter=float(values.std(ddof=1)),
        hops=values.size,
        range=float(np.max(np.abs(np.array(means) - mean))),
    )


GAUSSIAN = 3.0
_LINES = 3
"""Orders whose lines are taken out."""
_STEADIER = 0.5
"""Part of the scatter of noise from hop to hop below which what a band holds is a line."""


def fallen_by_lines(
    bands: BandLevels, in_bands: FloatArray, column: int, speed_rad_s: float, healthy: BandReference | None
) -> float:
    """What lines at other frequencies, such as a gear mesh, have taken from a channel's kurtosis since it was healthy.

    A line has the same power in every hop, noise has not: relative to its mean, of f degrees of freedom, √(2/f).

    Parameters
    ----------
    in_bands : ndarray, shape (n_hops, n_bands, n)
        Mean squares of each hop.
    """
    own = in_bands[:, :, column]
    power, total = own.mean(axis=0), max(float(own.mean(axis=0).sum()), np.finfo(float).tiny)
    steady = own.std(axis=0) < _STEADIER * power * np.sqrt(2 * len(own) / bands.freedom)
    multiples = abs(speed_rad_s) / (2 * np.pi) * np.arange(1, _LINES + 1)[:, None]
    # The taper spreads a line over the edges of its band.
    rotation = ((multiples > 0.97 * bands.edges_hz[:-1]) & (multiples < 1.03 * bands.edges_hz[1:])).any(axis=0)
    before = np.zeros_like(power)
    if healthy is not None and len(healthy.mean) == power.size:
        before = np.square(healthy.mean)
        before /= max(float(before.sum()), np.finfo(float).tiny)
    more = np.maximum((power / total) ** 2 - before**2, 0.0)
    return float(1.5 * more[steady & ~rotation].sum())


def without_lines(healthy: KurtosisReference) -> KurtosisReference:
    """The same if it is below that of noise because of a line, and this has gone: noise alone scatters more."""
    share = min(1.0, np.sqrt(max(0.0, (GAUSSIAN - healthy.mean) / 1.5)))  # of the power
    scatter = healthy.scatter / max(1 - share, 0.1) ** 2
    return healthy.model_copy(update={"mean": GAUSSIAN, "scatter": float(scatter)})


def departure(hops: FloatArray, reference: KurtosisReference, beyond_range: float, n_errors: float) -> float:
    """Difference from the healthy mean, of the newest half of a window or of all of it; 0 within its limit.

    Parameters
    ----------
    beyond_range : float
        No limit is nearer than that, times the healthy range.
    n_errors : float
        Nor nearer than so many standard errors.
    """
    for count in (max(1, len(hops) // 2), len(hops)):
        difference = float(hops[-count:].mean()) - reference.mean
        by_chance = n_errors * reference.scatter * np.sqrt(1 / count + 1 / reference.hops)
        if abs(difference) > max(by_chance, beyond_range * reference.range * np.sqrt(len(hops) / count)):
            return difference
    return 0.0
