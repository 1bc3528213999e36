"""Kurtosis of what is not at running speed: 3 where a linear machine is shaken at random, and compared with healthy.

No change of stiffness, damping or unbalance makes the random part of a vibration anything but Gaussian. A rub or a stop
clips it, and its kurtosis falls; what knocks, like a loose part or a damaged raceway, lifts it (ISO 13373-3). Cumulants
of independent parts add up: a line of amplitude a takes 3/8 a⁴ from the fourth one.

What is learned of healthy hops here, and how far later ones depart from it, serves `models.levels.contact` as well.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field

from models.levels.bands import BEYOND_RANGE, LINE, OF_BIN, BandLevels, BandReference
from models.signals.block import FloatArray

_PIECES, _APART = 20, 2
"""Pieces of a hop whose levels are compared, each with the next but one: in between, what a knock makes ring dies."""


def swell(rest: FloatArray) -> FloatArray:
    """What a level that rises and falls within a hop, as with a load that cycles, adds to the fourth moment; (n,).

    Three times the variance of the level, by the covariance of pieces that are apart: unlike the variance of the
    pieces it is next to nothing, in the mean, where their levels differ by chance or for single knocks. It may be
    negative.

    Parameters
    ----------
    rest : ndarray, shape (n, n_samples)
        Deviations from the mean without the orders of running speed, with which a line beside them beats: that is no
        level that swells.
    """
    n, size = rest.shape[0], rest.shape[1] // _PIECES
    if not size:
        return np.zeros(n)
    pieces = rest[:, : size * _PIECES].reshape(n, _PIECES, size)
    levels = np.vecdot(pieces, pieces) / size
    levels -= levels.mean(axis=1, keepdims=True)
    return np.asarray(3 * np.vecdot(levels[:, :-_APART], levels[:, _APART:]) / (_PIECES - _APART), dtype=np.float64)


def random_kurtosis(square: FloatArray, fourth: FloatArray, lines: npt.NDArray[np.complex128]) -> FloatArray:
    """Kurtosis of each hop without what its lines take from it, shape (n_hops, n); nan where these are not known.

    Parameters
    ----------
    square, fourth : ndarray, shape (n_hops, n)
        Second and fourth moment about the mean, the latter without `swell`.
    lines : ndarray of complex, shape (n_hops, n_lines, n)
        Their amplitudes.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (fourth + 0.375 * (np.abs(lines) ** 4).sum(axis=1)) / square**2
    return np.asarray(found, dtype=np.float64)


class HopReference(BaseModel, extra="forbid", frozen=True, strict=True):
    """What a channel's hops have in the healthy windows: kurtosis, or contact (`models.levels.contact`)."""

    mean: float = Field(allow_inf_nan=False)
    scatter: float = Field(ge=0, allow_inf_nan=False)  # standard deviation of one hop
    hops: int = Field(ge=2)  # how many were seen
    range: float = Field(ge=0, allow_inf_nan=False)  # largest distance of a window's mean from `mean`


def learn_hops(windows: Sequence[FloatArray]) -> HopReference | None:
    """Learn a channel's from the hops of healthy windows; None where it is not known, or of a single hop."""
    values = np.concatenate(windows)
    if values.size < 2 or not np.all(np.isfinite(values)):
        return None
    means = [window.mean() for window in windows]
    mean = float(values.mean())
    return HopReference(
        mean=mean,
        scatter=float(values.std(ddof=1)),
        hops=values.size,
        range=float(np.max(np.abs(np.array(means) - mean))),
    )


GAUSSIAN = 3.0
_STEADIER = 0.3
"""Part of the scatter of noise from hop to hop below which what a band holds is a line: noise in one of a hundred."""
_STEPS = 2
"""Differences that may be larger: a line that begins has a hop that holds both, and one before and one after."""


def fallen_by_lines(
    bands: BandLevels,
    in_bands: FloatArray,
    orders: npt.NDArray[np.complex128],
    speed_rad_s: float,
    healthy: BandReference | None,
    healthy_parts: Sequence[float] = (),
    strongest: FloatArray | None = None,
) -> FloatArray:
    """What lines, such as a gear mesh, have taken from a channel's kurtosis since it was healthy; of each hop.

    Of lines that are no orders but near one, such as mains hum beside 2x, it is what these leave in their bands.

    Parameters
    ----------
    in_bands : ndarray, shape (n_hops, n_bands)
        Mean squares.
    orders : ndarray of complex, shape (n_hops, n_orders)
        Amplitudes of the first multiples of running speed, which have been taken out.
    healthy_parts : sequence of float
        Largest part of each band's power that the strongest bin had on the healthy machine.
    strongest : ndarray, shape (n_hops, n_bands), optional
        Mean squares of the strongest bins: a line in a band of noise is known better by these.
    """
    total = np.maximum(in_bands.sum(axis=1), np.finfo(float).tiny)
    freedom = bands.freedom / len(in_bands)
    multiples = abs(speed_rad_s) / (2 * np.pi) * np.arange(1, orders.shape[1] + 1)[:, None]
    # The taper spreads a line over the edges of its band.
    near = (multiples > 0.97 * bands.edges_hz[:-1]) & (multiples < 1.03 * bands.edges_hz[1:])
    before = np.zeros(in_bands.shape[1])
    if healthy is not None and len(healthy.mean) == before.size:
        before = np.square(healthy.mean)
        before /= max(float(before.sum()), np.finfo(float).tiny)
    of_lines, freedom_of_lines = in_bands, freedom
    if strongest is not None and strongest.size and len(healthy_parts) == before.size:
        alone = strongest.sum(axis=0) > LINE * in_bands.sum(axis=0)
        of_lines = np.where(alone, np.minimum(in_bands, OF_BIN * strongest), in_bands)
        before = np.where(alone, before * np.minimum(1.0, OF_BIN * np.array(healthy_parts)), before)
        freedom_of_lines = np.where(alone, 2.0, freedom)
    lines = ~near.any(axis=0) & _steady(of_lines, freedom_of_lines)
    fallen = np.maximum((of_lines[:, lines] / total[:, None]) ** 2 - before[lines] ** 2, 0.0).sum(axis=1)
    beside = np.maximum(in_bands @ near.T - np.abs(orders) ** 2 / 2, 0.0)
    fallen += ((beside / total[:, None]) ** 2)[:, _steady(beside, near @ freedom)].sum(axis=1)
    return np.asarray(1.5 * fallen, dtype=np.float64)


def _steady(power: FloatArray, freedom: FloatArray) -> npt.NDArray[np.bool_]:
    """In which columns the power is that of a line: it is the same in every hop, but for where it begins or ends.

    That of noise, of so many degrees of freedom in a hop, differs from hop to hop by √(2/freedom) of itself.
    """
    differences = np.diff(power, axis=0) ** 2
    by_noise = 2 / np.maximum(freedom, 1.0) * (power[1:] ** 2 + power[:-1] ** 2)
    steps = _STEPS if len(power) > 2 * _STEPS else 0
    order = differences.argsort(axis=0)[: len(differences) - steps]
    found, noise = (np.take_along_axis(one, order, axis=0).sum(axis=0) for one in (differences, by_noise))
    return np.asarray(found < _STEADIER**2 * noise)


def without_lines(healthy: HopReference) -> HopReference:
    """The same if it is below that of noise because of a line, and this has gone: noise alone scatters more."""
    share = min(1.0, np.sqrt(max(0.0, (GAUSSIAN - healthy.mean) / 1.5)))  # of the power
    scatter = healthy.scatter / max(1 - share, 0.1) ** 2
    return healthy.model_copy(update={"mean": GAUSSIAN, "scatter": float(scatter)})


def departure(hops: FloatArray, reference: HopReference, n_errors: float) -> float:
    """Difference from the healthy mean of the newest half of a window, or all of it; 0 within so many standard errors.

    It has to hold without the hop that departs most: one in which the level steps, or the machine stops, holds two
    vibrations and has a large kurtosis of its own, and one knock is no state of a machine.
    """

    def beyond(kept: FloatArray) -> float:
        difference = float(kept.mean()) - reference.mean
        by_chance = n_errors * reference.scatter * np.sqrt(1 / len(kept) + 1 / reference.hops)
        limit = max(by_chance, BEYOND_RANGE * reference.range * np.sqrt(len(hops) / len(kept)))
        return difference if abs(difference) > limit else 0.0

    for count in (max(1, len(hops) // 2), len(hops)):
        newest = hops[-count:]
        if found := beyond(newest):
            rest = np.delete(newest, np.abs(newest - reference.mean).argmax())
            if len(rest) == 0 or (found := beyond(rest)):
                return found
    return 0.0
