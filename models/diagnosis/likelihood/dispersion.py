"""Dispersion: how much more the segments of a window scatter than under stationary Gaussian excitation.

Gusts, impacts and loads that come and go within a segment leave the mean spectra as the theory expects, and so the
readings, but not their scatter. What the scatter among segments explains is then no misfit. This is the dispersion of
quasi-likelihood, estimated from replicates (P. McCullagh, J. A. Nelder, "Generalized Linear Models", 2nd ed., chapter
9): the segments' own deviations from their mean, without what parameters of the model take up. A level that all
frequencies share is taken up; a lasting deviation from the theory is in the mean and does not count.
"""

import numpy as np

from models.diagnosis.likelihood.goodness import total_excess
from models.diagnosis.likelihood.scoring import Maximum, Weights
from models.diagnosis.likelihood.spectral_model import SpectralModel, packed
from models.signals.block import ComplexArray

_FEWEST = 3  # segments
_CHANCE = 2.0  # standard deviations of the total excess
# Sum of the squared correlations of neighbouring bins over that of neighbouring bins and segments (half-overlapped
# Hann): segments that overlap differ less from each other.
_APART = 0.935


def dispersion_of(model: SpectralModel, weights: Weights, found: Maximum, segments: ComplexArray) -> float:
    """Variance of the spectra's elements over that of Gaussian segments with the same mean; at least 1.

    Where the spectra deviate from the theory by no more than chance explains, it is taken to be 1 and not computed.

    Parameters
    ----------
    segments : ndarray of complex, shape (n_bins, n_segments, n_states)
        Fourier coefficients of which the window's spectra are means, SI.
    """
    groups, count, n = model.groups, segments.shape[1], model.n
    total, expected, spread = total_excess(model, weights, found)
    if count < _FEWEST or total < expected + _CHANCE * spread:
        return 1.0
    whiten = found.whitened.L_inverse @ model.motions.combine(model.centre)
    whitened = [segments[slice(*edges)] @ one.T for edges, one in zip(groups.edges, whiten, strict=True)]
    each = np.stack([np.einsum("bsi,bsj->sij", z, z.conj()) / len(z) for z in whitened], axis=1)
    mean = each.mean(axis=0)
    apart = packed(each - mean)
    slopes, n_groups = found.derivatives.slopes.reshape(model.size, -1), len(groups.edges)
    seen = (apart * weights.averages[:, None]).reshape(count, -1) @ slopes.T
    left = apart.reshape(count, -1) - np.linalg.solve(found.information, seen.T).T @ slopes
    scatter = weights.averages @ np.sum(left.reshape(count, n_groups, -1) ** 2, axis=(0, 2)) / (count * (count - 1))
    # Of Gaussian segments: the square of the trace, without the part of it that is scatter of the mean.
    shared = np.diag(groups.shared)
    trace, square = np.einsum("fii->f", mean).real, np.einsum("fij,fji->f", mean, mean).real
    usual = shared @ (trace**2 - square * shared / weights.averages)
    usual *= 1 - found.fitted / (n**2 * shared.sum())
    return float(max(1.0, scatter / (_APART * usual))) if usual > 0 else 1.0
