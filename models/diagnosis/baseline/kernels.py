"""Smooth kernels over lags, and their derivatives: the differentiator that stands behind every row.

The kernels are shifted copies of one another by a whole number of lags. What moments under them scatter by then depends
on the distance of two kernels alone.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np

from models.signals.block import FloatArray

__all__ = ["LONGEST_LAG_STEP_S", "Kernels", "Shape", "gain", "kernels", "passband_hz", "shape_for"]

LONGEST_LAG_STEP_S = 0.00126
"""Spacing of the lags beyond which a kernel has too few points."""

_SPACING_S = 0.004
_FALLEN_TO = 0.1
_FALLEN_AT = 3.0  # width times the band's end for cos⁸: a tenth is left there, and a seventieth a third further up
_LEAD = 0.375


@dataclass(frozen=True, slots=True)
class Shape:
    """cosᵖ over a width: a sum of cosines of multiples of the width's frequency.

    Attributes
    ----------
    lead_s : float
        From the shortest lag to the first kernel's centre; what lies before it weighs less than a thousandth.
    """

    power: int
    width_s: float
    lead_s: float

    @property
    def cosines(self) -> FloatArray:
        """Weights of cos(2π m u), m = 0 … p/2."""
        half = self.power // 2
        row = np.array([comb(self.power, half + m) for m in range(half + 1)]) / 2**self.power
        row[1:] *= 2
        return np.asarray(row, dtype=np.float64)


def shape_for(deepest: int, band_to_hz: float) -> Shape:
    """Shape of the kernels that bear some derivatives.

    One derivative is borne by a narrow kernel. Every further one lifts the sensors' noise by another power of the
    frequency: kernels are then so wide that they pass nothing beyond the band of the spectra, or the spectra would not
    know what the moments scatter by.

    Parameters
    ----------
    deepest : int
        Most derivatives on a kernel (`Formation.deepest`), at most 4.
    band_to_hz : float
        Highest frequency of the window's spectra.
    """
    if deepest <= 1:
        return Shape(4, 0.010, 0.005)
    width_s = _FALLEN_AT / band_to_hz
    return Shape(8, width_s, _LEAD * width_s)


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


def kernels(lags_s: FloatArray, lag_from_s: float, shape: Shape, deepest: int) -> Kernels:
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
    return _kernels(lags_s.tobytes(), lag_from_s, shape, deepest)


@lru_cache(maxsize=256)
def _kernels(lags: bytes, lag_from_s: float, shape: Shape, deepest: int) -> Kernels:
    lags_s = np.frombuffer(lags)
    step_s = float(lags_s[1] - lags_s[0])
    spacing_s = max(1, round(_SPACING_S / step_s)) * step_s
    width_s = shape.width_s
    centres = np.arange(lag_from_s + shape.lead_s, lags_s[-1] - width_s / 2 + 1e-9, spacing_s)
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


def gain(frequencies_hz: FloatArray, shape: Shape) -> FloatArray:
    """Fourier transform of a kernel, shape (n_bins,): real, as the kernel is even."""
    x = np.asarray(frequencies_hz, dtype=np.float64) * shape.width_s
    total = np.zeros_like(x)
    for m, weight in enumerate(shape.cosines):
        total += weight * (np.sinc(x - m) + np.sinc(x + m)) / 2
    return total


def passband_hz(deepest: int, band_to_hz: float) -> float:
    """Frequency, Hz, up to which the kernels let through at least a tenth: the end of the differentiator's valid band.

    Parameters
    ----------
    deepest : int
        Most derivatives on a kernel (`Formation.deepest`).
    band_to_hz : float
        Highest frequency of the window's spectra.
    """
    f = np.linspace(0.0, 2000.0, 8001)
    through = gain(f, shape_for(deepest, band_to_hz))
    return float(min(band_to_hz, f[np.argmax(through < _FALLEN_TO * through[0])]))
