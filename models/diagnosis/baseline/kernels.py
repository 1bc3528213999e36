"""Smooth kernels over lags, and their derivatives: the differentiator that stands behind every row.

The kernels are shifted copies of one another by a whole number of lags. What moments under them scatter by then depends
on the distance of two kernels alone.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from models.signals.block import FloatArray

__all__ = ["LONGEST_LAG_STEP_S", "Kernels", "gain", "kernels", "passband_hz"]

LONGEST_LAG_STEP_S = 0.00126
"""Spacing of the lags beyond which a kernel has too few points."""

_SPACING_S = 0.004
_FALLEN_TO = 0.1


@dataclass(frozen=True, slots=True)
class _Shape:
    """cosᵖ over a width; as a sum of cosines of multiples of the width's frequency."""

    power: int
    width_s: float

    @property
    def cosines(self) -> FloatArray:
        """Weights of cos(2π m u), m = 0 … p/2."""
        half = self.power // 2
        row = np.array([_binomial(self.power, half + m) for m in range(half + 1)]) / 2**self.power
        row[1:] *= 2
        return np.asarray(row, dtype=np.float64)


_SHAPES = {2: _Shape(4, 0.010), 4: _Shape(8, 0.014)}
"""By the most derivatives that the kernel bears on lags of about a millisecond."""


def _binomial(n: int, k: int) -> float:
    value = 1.0
    for i in range(1, k + 1):
        value *= (n - k + i) / i
    return value


def _shape(deepest: int) -> _Shape:
    return _SHAPES[min(depth for depth in _SHAPES if deepest <= depth)]


@dataclass(frozen=True, slots=True, eq=False)
class Kernels:
    """Kernels over the lags of a window.

    Attributes
    ----------
    values : tuple of ndarray, each shape (n_kernels, n_lags)
        Kernels and their derivatives with alternating sign, (-1)ⁿ κ⁽ⁿ⁾, times the lags' spacing.
    centres_s : ndarray, shape (n_kernels,)
    """

    values: tuple[FloatArray, ...]
    centres_s: FloatArray

    @property
    def spacing_s(self) -> float:
        """Distance of neighbours."""
        return float(self.centres_s[1] - self.centres_s[0])


def kernels(lags_s: FloatArray, lag_from_s: float, deepest: int) -> Kernels:
    """Kernels beyond a shortest lag.

    Parameters
    ----------
    lags_s : ndarray, shape (n_lags,)
        Equally spaced.
    lag_from_s : float
        Where the first kernel begins.
    deepest : int
        Most derivatives that are asked for, at most 4.
    """
    return _kernels(lags_s.tobytes(), lag_from_s, deepest)


@lru_cache(maxsize=256)
def _kernels(lags: bytes, lag_from_s: float, deepest: int) -> Kernels:
    lags_s, shape = np.frombuffer(lags), _shape(deepest)
    step_s = float(lags_s[1] - lags_s[0])
    spacing_s = max(1, round(_SPACING_S / step_s)) * step_s
    width_s = shape.width_s
    centres = np.arange(lag_from_s + width_s / 2, lags_s[-1] - width_s / 2 + 1e-9, spacing_s)
    u = (lags_s[None, :] - centres[:, None]) / width_s
    inside = np.abs(u) < 0.5
    values = []
    for order in range(deepest + 1):
        value = np.zeros_like(u)
        for m, weight in enumerate(shape.cosines):
            # d/dτ of cos(2π m u) turns its phase by a quarter
            value += weight * (2 * np.pi * m / width_s) ** order * np.cos(2 * np.pi * m * u + order * np.pi / 2)
        values.append(np.where(inside, (-1) ** order * value, 0.0) * (step_s / width_s))
    return Kernels(tuple(values), centres)


def gain(frequencies_hz: FloatArray, deepest: int) -> FloatArray:
    """Fourier transform of a kernel, shape (n_bins,): real, as the kernel is even."""
    shape = _shape(deepest)
    x = np.asarray(frequencies_hz, dtype=np.float64) * shape.width_s
    total = np.zeros_like(x)
    for m, weight in enumerate(shape.cosines):
        total += weight * (np.sinc(x - m) + np.sinc(x + m)) / 2
    return total


def passband_hz(deepest: int) -> float:
    """Frequency, Hz, up to which the kernels let through at least a tenth: the end of the differentiator's valid band.

    Parameters
    ----------
    deepest : int
        Most derivatives on a kernel (`Formation.deepest`).
    """
    f = np.linspace(0.0, 1000.0, 4001)
    through = gain(f, deepest)
    return float(f[np.argmax(through < _FALLEN_TO * through[0])])
