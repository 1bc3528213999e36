"""Level of each segment of a window, for random forces whose level changes within the window.

The cross-spectra of a window are treated as a mean over segments of equal level. If the level steps or drifts, few
segments dominate that mean; it scatters like a mean over fewer segments, which looks like a misfit. Scaled to one
level, segments of one rotor are alike; those with another rotor, a rub or a line are not, and remain a misfit.
"""

from collections.abc import Sequence

import numpy as np

from models.diagnosis.window.moments import ComplexArray
from models.signals.block import FloatArray

_BLOCK = 16  # bins that are compared at once: many more than channels, and few enough to share one colour
_CHANCE = 30.0  # variance of the levels, times the coefficients in each, below which a window is stationary; 3 is usual
_ROUNDS = 2  # in the first, loud segments weigh too much in the mean that all segments are compared with


def summed(segments: ComplexArray) -> ComplexArray:
    """Cross-products of Fourier coefficients, shape (..., n_segments, n), summed over segments: shape (..., n, n)."""
    return np.asarray(segments.swapaxes(-1, -2) @ segments.conj(), dtype=np.complex128)


def segment_levels(segments: ComplexArray, spectrum: ComplexArray, columns: Sequence[int]) -> FloatArray | None:
    """Powers of the segments of a window relative to their mean, shape (n_segments,); None if it is stationary.

    They are medians over the band and over uncorrelated motions, so a line that appears, or a force on a part of the
    band or of the motions, does not change them. `segments` are Fourier coefficients, shape (n_bins, n_segments, n),
    without mean and rotation, and `spectrum` is `summed` of them; `columns` are one channel of each motion.
    """
    n, count = len(columns), segments.shape[1]
    blocks = segments.shape[0] // _BLOCK
    if not n or not blocks:
        return None
    own = np.take(segments[: blocks * _BLOCK], columns, axis=2).reshape(blocks, _BLOCK, count, n)
    mean = spectrum[: blocks * _BLOCK, columns][:, :, columns].reshape(blocks, _BLOCK, n, n).sum(axis=1)
    if not np.all(np.isfinite(mean)):
        return None
    levels = np.ones(count)
    for _ in range(_ROUNDS):
        motions = own.reshape(blocks, -1, n) @ np.linalg.eigh(mean)[1].conj()
        powers = (motions.real**2 + motions.imag**2).reshape(own.shape).sum(axis=1)  # (blocks, n_segments, n)
        usual = np.maximum(powers.mean(axis=1, keepdims=True), np.finfo(float).tiny)
        levels = np.median(powers / usual, axis=(0, 2))
        levels /= max(float(levels.mean()), np.finfo(float).tiny)
        if np.mean((levels - 1) ** 2) * own[:, :, 0].size < _CHANCE or not np.all(levels > 0):
            return None
        mean = summed((own / np.sqrt(levels)[:, np.newaxis]).reshape(blocks, -1, n))
    return levels
