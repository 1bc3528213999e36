"""Kurtosis of the vibration without the orders of running speed, compared with that of the healthy machine.

It is 3 on a linear machine under random excitation: whatever the stiffness, damping and unbalance, the random part is
Gaussian. A rub or a stop clips it and lowers the kurtosis; impacts, as of a loose part or a damaged raceway, raise it
(ISO 13373-3). Cumulants of independent parts add up: a line of amplitude a takes 3/8 a⁴ from the fourth one.

`HopReference` and `departure` serve the statistic of `models.levels.contact` as well.
"""

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, Field

from models.levels.bands import BEYOND_RANGE, LINE, OF_BIN, BandLevels, BandReference
from models.signals.block import BoolArray, ComplexArray, FloatArray

GAUSSIAN = 3.0
_LEAST_SHARE = 0.05
"""Share of the random part below which noise at the orders, rather than the random part's own cumulant, makes kurtosis
scatter: in white noise it then grows with the root of the share."""
_PIECES, _APART = 20, 2
"""Pieces of a hop whose levels are compared, each with the next but one: in between, ringing after an impact dies."""


def swell(rest: FloatArray) -> FloatArray:
    """Part of the fourth moment due to a level that varies within a hop, as under a cycling load, shape (n,).

    It is three times the variance of the level (a mean square), estimated by the covariance of pieces two apart. Unlike
    the variance over the pieces, this is next to zero on average if levels differ by chance or by single impacts. It
    may be negative. `rest`, shape (n, n_samples), are deviations from the mean without the orders of running speed: an
    order that beats with a line beside it does not count as a varying level.
    """
    n, size = rest.shape[0], rest.shape[1] // _PIECES
    if not size:
        return np.zeros(n)
    pieces = rest[:, : size * _PIECES].reshape(n, _PIECES, size)
    levels = np.vecdot(pieces, pieces) / size
    levels -= levels.mean(axis=1, keepdims=True)
    return np.asarray(3 * np.vecdot(levels[:, :-_APART], levels[:, _APART:]) / (_PIECES - _APART), dtype=np.float64)


def random_kurtosis(square: FloatArray, fourth: FloatArray, lines: ComplexArray) -> FloatArray:
    """Kurtosis of each hop, corrected for lines, shape (n_hops, n); NaN where their amplitudes are not known.

    Second and fourth moments about the mean, shape (n_hops, n), the latter less `swell`; amplitudes of the lines, shape
    (n_hops, n_lines, n).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (fourth + 0.375 * (np.abs(lines) ** 4).sum(axis=1)) / square**2
    return np.asarray(found, dtype=np.float64)


def random_share(square: FloatArray, lines: ComplexArray) -> FloatArray:
    """Share of the power that is not in the lines, shape (n_hops, n); arguments as of `random_kurtosis`.

    Its square scales the random part's fourth cumulant, and the scatter of that, in the kurtosis of the whole.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        found = 1 - (np.abs(lines) ** 2).sum(axis=1) / (2 * square)
    return np.asarray(found, dtype=np.float64)


class HopReference(BaseModel, extra="forbid", frozen=True, strict=True):
    """A statistic of a channel's hops in the healthy windows: kurtosis, or contact (`models.levels.contact`)."""

    mean: float = Field(allow_inf_nan=False)
    scatter: float = Field(ge=0, allow_inf_nan=False)  # standard deviation of one hop
    hops: int = Field(ge=2)  # how many were seen
    range: float = Field(ge=0, allow_inf_nan=False)  # largest distance of a window's mean from `mean`
    # Of kurtosis: root mean square of the `random_share`; older commissionings did not keep it.
    share: float | None = Field(default=None, ge=0, allow_inf_nan=False, exclude_if=lambda found: found is None)

    def growth(self, shares: FloatArray) -> float:
        """Factor by which kurtosis scatters more by chance if the random part has these shares of the power; 1 or more.

        The newest half of the hops counts by itself, because the share may have grown within the window.
        """
        if self.share is None:
            return 1.0
        now = max(float(shares.mean()), float(shares[len(shares) // 2 :].mean()))
        return max(1.0, now / max(self.share, _LEAST_SHARE)) ** 2


def learn_hops(windows: Sequence[FloatArray], shares: Sequence[FloatArray] = ()) -> HopReference | None:
    """Learn from a channel's hops in healthy windows; None if one has no value, or there are fewer than two.

    `shares` are their `random_share`, if the statistic is a kurtosis.
    """
    values = np.concatenate(windows)
    if values.size < 2 or not np.all(np.isfinite(values)):
        return None
    mean, scatter = float(values.mean()), float(values.std(ddof=1))
    farthest = max(abs(float(window.mean()) - mean) for window in windows)
    share = float(np.sqrt(np.mean(np.concatenate(shares) ** 2))) if shares else None
    return HopReference(mean=mean, scatter=scatter, hops=values.size, range=farthest, share=share)


_STEADIER = 0.3
"""A band holds a line if its power scatters by less than this fraction of the scatter of noise; 1 % of noise does."""
_STEPS = 2
"""Number of largest differences between hops to ignore: the hop in which a line begins differs from both neighbours."""


def fallen_by_lines(
    bands: BandLevels,
    in_bands: FloatArray,
    orders: ComplexArray,
    speed_rad_s: float,
    healthy: BandReference | None,
    healthy_parts: Sequence[float] = (),
    strongest: FloatArray | None = None,
) -> tuple[FloatArray, float]:
    """How much lines that have begun or grown, such as a gear mesh, lower a channel's kurtosis, shape (n_hops,).

    The power of a line beside an order, such as mains hum beside 2x, is that of the order's bands less the order's own.
    Last, the variance of the mean square of a hop over its square if all bands hold noise, see `fallen_by_beats`.

    Parameters
    ----------
    in_bands : ndarray, shape (n_hops, n_bands)
        Mean squares in the bands.
    orders : ndarray of complex, shape (n_hops, n_orders)
        Amplitudes of the first multiples of running speed, for which the kurtosis is already corrected.
    healthy_parts : sequence of float
        Largest share of each band's power that the strongest bin had on the healthy machine.
    strongest : ndarray, shape (n_hops, n_bands), optional
        Mean squares of each band's strongest bin, which measure a line in a band of noise better.
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
    apart = ~near.any(axis=0)
    lines = apart & _holds_line(of_lines, freedom_of_lines)
    fallen = np.maximum((of_lines[:, lines] / total[:, None]) ** 2 - before[lines] ** 2, 0.0).sum(axis=1)
    beside = np.maximum(in_bands @ near.T - np.abs(orders) ** 2 / 2, 0.0)
    fallen += ((beside / total[:, None]) ** 2)[:, _holds_line(beside, near @ freedom)].sum(axis=1)
    noise = np.hstack([in_bands[:, apart], beside]).mean(axis=0) / total.mean()
    varies = noise**2 @ (2 / np.maximum(np.append(freedom[apart], near @ freedom), 1.0))
    return np.asarray(1.5 * fallen, dtype=np.float64), float(varies)


def varied(square: FloatArray) -> float:
    """Variance of the mean square of a hop, shape (n_hops,), over its square, without a slow change of the load."""
    steps = float(np.mean(np.diff(square) ** 2)) if len(square) > 1 else 0.0
    return steps / 2 / max(float(square.mean()) ** 2, np.finfo(float).tiny)


def fallen_by_beats(varies: float, healthy: HopReference) -> float:
    """How much the beats of narrow modes lower a channel's kurtosis by more than on the healthy machine.

    They make the mean square of a hop vary by chance. By this variance, over its square, the mean of its square, the
    denominator of kurtosis, exceeds the square of its mean.
    """
    return max(0.0, GAUSSIAN * varies - max(0.0, GAUSSIAN - healthy.mean))


def _holds_line(power: FloatArray, freedom: FloatArray) -> BoolArray:
    """Which columns hold the power of a line: the same in every hop, except where it begins or ends.

    The power of noise with `freedom` degrees of freedom in a hop has a relative scatter of √(2/freedom).
    """
    differences = np.diff(power, axis=0) ** 2
    by_noise = 2 / np.maximum(freedom, 1.0) * (power[1:] ** 2 + power[:-1] ** 2)
    steps = _STEPS if len(power) > 2 * _STEPS else 0
    order = differences.argsort(axis=0)[: len(differences) - steps]
    found, noise = (np.take_along_axis(one, order, axis=0).sum(axis=0) for one in (differences, by_noise))
    return np.asarray(found < _STEADIER**2 * noise)


def without_lines(healthy: HopReference) -> HopReference:
    """Reference of the noise alone, once a line that lowered the healthy kurtosis has gone: it scatters more."""
    share = min(1.0, np.sqrt(max(0.0, (GAUSSIAN - healthy.mean) / 1.5)))  # of the power
    scatter = healthy.scatter / max(1 - share, 0.1) ** 2
    return healthy.model_copy(update={"mean": GAUSSIAN, "scatter": float(scatter)})


def departure(hops: FloatArray, reference: HopReference, n_errors: float, growth: float = 1.0) -> float:
    """Difference of a window's newest half, or all of it, from the healthy mean; 0 within `n_errors` standard errors.

    It must persist without the hop that departs most: a hop in which the level steps, or the machine stops, mixes two
    vibrations and has a large kurtosis of its own, and a single impact is no state of a machine. What rises must exceed
    a scatter greater than the healthy one by the factor `growth`.
    """

    def beyond(kept: FloatArray) -> float:
        difference = float(kept.mean()) - reference.mean
        # What falls and scatters more is no clipping: the random part has grown, or its resonances are narrower.
        scatter = reference.scatter * growth if difference > 0 else max(reference.scatter, float(kept.std()))
        by_chance = n_errors * scatter * np.sqrt(1 / len(kept) + 1 / reference.hops)
        limit = max(by_chance, BEYOND_RANGE * reference.range * np.sqrt(len(hops) / len(kept)))
        return difference if abs(difference) > limit else 0.0

    for count in (max(1, len(hops) // 2), len(hops)):
        newest = hops[-count:]
        if found := beyond(newest):
            rest = np.delete(newest, np.abs(newest - reference.mean).argmax())
            if len(rest) == 0 or (found := beyond(rest)):
                return found
    return 0.0
