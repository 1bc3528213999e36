"""Comparison of each channel's autocorrelation function with its healthy shape: whether it changed, not why or where.

A channel's autocorrelation over its own variance, ρ(τ), depends on the machine and on the colour of the excitation, not
on its level. Its deviation from the healthy mean is projected on the few directions in which it scatters most. These
are found and scaled from the scatter of the hops within windows, so they are independent of the scatter between
windows, which decides: it includes both sampling and changes of the excitation from window to window. For n healthy
windows and a new one at a distance d,

    |d|² / ((1 + 1/n) tr S)  ~  F(f, f (n - 1)),   f = (tr S)² / tr S²

with the windows' covariance S in these directions: Brunner's ANOVA-type statistic, used for prediction. It needs no
inverse of S, which few windows do not determine, and has the heavier tail that few windows require. If the scatter is
equal in all directions, there are fewer false alarms than declared (a third with six windows, half with twelve); if one
direction has nearly all of it, up to 1.3 times as many at 1 %.

References
----------
E. Brunner, H. Dette, A. Munk, "Box-type approximations in nonparametric factorial designs", JASA 92 (1997).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, model_validator
from scipy.special import fdtrc, fdtri, ndtri

from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray
from rotorwatch.records.windows import Shape

SEEN_GROWTH = 8.0
"""A channel's shape is not evaluable if noise that makes it so many times as loud would not be detected."""
_POWER_Z = float(ndtri(0.95))
_MOST_WINDOWS = 100
FEWEST_WINDOWS = 4  # least number of healthy windows; six or more are advised, from several recordings
_DIRECTIONS = 3
_LAG_TOLERANCE_S = 1e-9
_LEAST_P = 1e-300


class ShapeSpread(BaseModel, extra="forbid", frozen=True, strict=True):
    """Healthy shape of one channel and its spread."""

    channel: str = Field(min_length=1)
    mean: tuple[FiniteFloat, ...] = Field(min_length=2)  # ρ at the lags
    # Each maps a deviation of ρ to a coordinate that has unit variance from sampling alone.
    directions: tuple[tuple[FiniteFloat, ...], ...] = Field(min_length=1)
    variance: float = Field(gt=0, allow_inf_nan=False)  # tr S of the healthy windows in these coordinates
    freedom: float = Field(ge=1, allow_inf_nan=False)  # f, between 1 and the number of directions

    @model_validator(mode="after")
    def _alike(self) -> "ShapeSpread":
        lengths = {len(self.mean), *(len(direction) for direction in self.directions)}
        if len(lengths) > 1:
            raise ValueError(f"channel {self.channel}: mean and directions have {sorted(lengths)} lags, expected one")
        return self


class HealthyShape(BaseModel, extra="forbid", frozen=True, strict=True):
    """Healthy shapes of all channels."""

    windows: int = Field(ge=FEWEST_WINDOWS)  # healthy windows it was learned from
    window_s: float = Field(gt=0, allow_inf_nan=False)  # length of the shortest of them
    lags_s: tuple[FiniteFloat, ...] = Field(min_length=2)
    speed_rad_s: tuple[FiniteFloat, FiniteFloat] | None  # slowest and fastest of them; None without a phase reference
    channels: tuple[ShapeSpread, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _alike(self) -> "HealthyShape":
        for one in self.channels:
            if len(one.mean) != len(self.lags_s):
                raise ValueError(f"channel {one.channel}: {len(one.mean)} values for {len(self.lags_s)} lags")
        return self

    def powers(self, rate: float) -> dict[str, "ShapePower"]:
        """White noise that would be called a change of each channel's shape, at the rate of `judge`.

        Noise that makes a channel g times as loud moves its shape 1 - 1/g² of the way to the shape of white noise.
        """
        own_rate = self._own_rate(rate)
        return {one.channel: _power(one, self.windows, np.array(self.lags_s), own_rate) for one in self.channels}

    def _own_rate(self, rate: float) -> float:
        return -math.expm1(math.log1p(-rate) / len(self.channels))

    def judge(self, window: WindowStatistics, rate: float = 0.01) -> tuple[Shape, ...]:
        """Compare every channel of a window with its healthy shape, or say why it cannot be compared.

        The rate is the declared probability that any channel of an unchanged machine is called changed in one window.
        """
        window, own_rate = window.as_mounted, self._own_rate(rate)
        common = self._not_comparable(window)
        return tuple(self._judged(one, window, common, own_rate) for one in self.channels)

    def _not_comparable(self, window: WindowStatistics) -> str:
        """Why no channel of the window can be compared; empty if they can."""
        lags = np.array(self.lags_s)
        if window.lags_s.shape != lags.shape or np.any(np.abs(window.lags_s - lags) > _LAG_TOLERANCE_S):
            return f"its lags differ from the {len(lags)} lags up to {lags[-1]:g} s that were learned"
        return "" if self.speed_rad_s is None else window.speed_beyond(*self.speed_rad_s)

    def _judged(self, one: ShapeSpread, window: WindowStatistics, common: str, rate: float) -> Shape:
        reason = common or ("" if one.channel in window.states else "not measured")
        rho = None if reason else _shape(window, one.channel)
        limit = -float(ndtri(rate))
        stated = partial(Shape, state=one.channel, limit=limit)
        if rho is None:
            reason = reason or "it does not move, or its correlation is not finite"
            return stated(verdict="not evaluable", z=None, text=f"{one.channel}: not evaluable, {reason}")
        d = np.array(one.directions) @ (rho - np.array(one.mean))
        # a shorter window scatters more; a longer one is not assumed to scatter less
        wider = (1 + 1 / self.windows) * max(1.0, self.window_s / window.duration_s)
        statistic = float(d @ d) / (wider * one.variance)
        p = float(fdtrc(one.freedom, one.freedom * (self.windows - 1), statistic))
        z = -float(ndtri(min(max(p, _LEAST_P), 1 - 1e-16)))
        figures = f"{z:.1f} standard deviations, limit {limit:.1f}"
        if p < rate:
            text = (
                f"{one.channel}: its correlation function has changed shape ({figures}); this comparison cannot tell "
                "whether the machine or its excitation has"
            )
            return stated(verdict="changed", z=z, text=text)
        if not _power(one, self.windows, np.array(self.lags_s), rate).growth <= SEEN_GROWTH:
            text = (
                f"{one.channel}: not evaluable, with {self.windows} healthy windows not even noise that makes it "
                f"{SEEN_GROWTH:g} times as loud would change its shape beyond chance"
            )
            return stated(verdict="not evaluable", z=z, text=text)
        text = f"{one.channel}: its correlation function has its healthy shape ({figures})"
        return stated(verdict="not changed", z=z, text=text)


@dataclass(frozen=True, slots=True)
class ShapePower:
    """How small a change of one channel's shape is detected."""

    # Factor on the rms of the channel at which white noise is called a change with 95 % probability; infinite if no
    # noise is.
    growth: float
    # Healthy windows with which `SEEN_GROWTH` is detected, if all scatter as these do; None if 99 are too few.
    windows: int | None


def _power(one: ShapeSpread, windows: int, lags_s: FloatArray, rate: float) -> ShapePower:
    white = np.where(lags_s == 0, 1.0, 0.0)
    distance = float(np.linalg.norm(np.array(one.directions) @ (white - np.array(one.mean)))) / math.sqrt(one.variance)

    def part(count: int) -> float:
        """Part of the way to the shape of white noise at which a change is detected."""
        wider = math.sqrt(1 + 1 / count)
        limit = math.sqrt(float(fdtri(one.freedom, one.freedom * (count - 1), 1 - rate)))
        return wider * (limit + _POWER_Z) / distance if distance > 0 else math.inf

    own = part(windows)
    enough = (count for count in range(FEWEST_WINDOWS, _MOST_WINDOWS) if part(count) <= 1 - SEEN_GROWTH**-2)
    return ShapePower(1 / math.sqrt(1 - own) if own < 1 else math.inf, next(enough, None))


def learn_shape(windows: Sequence[WindowStatistics]) -> HealthyShape:
    """Learn the shape of every channel from healthy windows that do not overlap.

    They must include all conditions that count as healthy: a colour of excitation that is in none of them is called a
    change.

    Raises
    ------
    EstimationError
        If they are too few, differ in their lags, or no channel moves in all of them.
    """
    windows = [window.as_mounted for window in windows]
    count = len(windows)
    if count < FEWEST_WINDOWS:
        raise EstimationError(
            f"{count} healthy window{'' if count == 1 else 's'}: {FEWEST_WINDOWS} that do not overlap are needed to "
            "know how far correlation functions scatter, six or more are advised"
        )
    first = windows[0]
    for number, window in enumerate(windows):
        if window.lags_s.shape != first.lags_s.shape or not np.allclose(
            window.lags_s, first.lags_s, atol=_LAG_TOLERANCE_S
        ):
            raise EstimationError(f"healthy window {number}: its lags differ from those of the first one")
        if window.hop_correlation.shape[0] < 2:
            raise EstimationError(f"healthy window {number}: it has one hop, at least two are needed")
    if first.lags_s.size < 2:
        raise EstimationError("healthy windows: correlations at lag zero alone have no shape")
    spreads = [spread for name in first.states if (spread := _spread(windows, name)) is not None]
    if not spreads:
        raise EstimationError("healthy windows: no channel moves in all of them")
    speeds = [window.speed_rad_s for window in windows]
    return HealthyShape(
        windows=count,
        window_s=min(window.duration_s for window in windows),
        lags_s=tuple(first.lags_s.tolist()),
        speed_rad_s=(min(speeds), max(speeds)) if all(map(math.isfinite, speeds)) else None,
        channels=tuple(spreads),
    )


def _shape(window: WindowStatistics, channel: str) -> FloatArray | None:
    """ρ at the lags; None if the channel does not move or its correlation is not finite."""
    column = window.states.index(channel)
    R = window.correlation[:, column, column]
    if not np.all(np.isfinite(R)) or R[0] <= 0:
        return None
    return np.asarray(R / R[0], dtype=np.float64)


def _spread(windows: Sequence[WindowStatistics], channel: str) -> ShapeSpread | None:
    shapes, deviations, hops = [], [], 0
    for window in windows:
        rho = _shape(window, channel) if channel in window.states else None
        if rho is None:
            return None
        column = window.states.index(channel)
        R = window.hop_correlation[:, :, column, column]
        # to first order in the hop's deviation; the mean over the window is zero
        deviations.append((R - R[:, :1] * rho) / np.mean(R[:, 0]) / len(R))
        shapes.append(rho)
        hops += len(R)
    scatter = np.concatenate(deviations)
    # each of a window's n hops contributes 1/n of its shape; one degree of freedom goes to the mean of each window
    per_window = hops / len(windows)
    within = scatter.T @ scatter * per_window / (hops - len(windows))
    values, vectors = np.linalg.eigh(within)
    kept = [n for n in np.argsort(values)[::-1][:_DIRECTIONS] if values[n] > 1e-12 * values[-1]]
    if not kept or values[-1] <= 0:
        return None
    directions = (vectors[:, kept] / np.sqrt(values[kept])).T
    mean = np.mean(shapes, axis=0)
    coordinates = (np.array(shapes) - mean) @ directions.T
    S = coordinates.T @ coordinates / (len(windows) - 1)
    total = float(np.trace(S))
    if total <= 0:
        return None
    return ShapeSpread(
        channel=channel,
        mean=tuple(mean.tolist()),
        directions=tuple(tuple(row) for row in directions.tolist()),
        variance=total,
        freedom=min(max(1.0, total**2 / float(np.sum(S**2))), float(len(kept))),
    )
