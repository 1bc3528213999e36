"""Kurtosis of what is not at running speed: 3 where a linear machine is shaken at random, and compared with healthy.

No change of stiffness, damping or unbalance makes the random part of a vibration anything but Gaussian. A rub or a stop
clips it, and its kurtosis falls; what knocks, like a loose part or a damaged raceway, lifts it (ISO 13373-3). Cumulants
of independent parts add up: a line of amplitude a takes 3/8 a⁴ from the fourth one.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

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
