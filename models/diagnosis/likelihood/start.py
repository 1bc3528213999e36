"""Where a cold search of the likelihood starts: the forces that the nominal rotor would need to move as observed."""

import numpy as np

from models.diagnosis.likelihood.spectral_model import COLUMNS, ROWS, STRUCTURAL, SpectralModel
from models.diagnosis.moments import ComplexArray
from models.physics.excitation import low_pass
from models.signals.block import FloatArray

__all__ = ["starting_point"]

_START_NOISE = float(np.log(2e-3))
_REGULARISED = 1e-2
"""Power, relative to the forced response, below which forces are not reconstructed: noise would pass for them."""
_VISIBLE = 0.02
_LEAST_LEVEL = 1e-3


def starting_point(model: SpectralModel, observed: ComplexArray, centre: FloatArray, speed_rad_s: float) -> FloatArray:
    """Guess the excitation with the nominal rotor.

    Forces follow from the response through the regularised inverse of G, bin group by bin group; their mean, divided by
    the low-pass that fits its trace best, is the level matrix.

    Parameters
    ----------
    observed : ndarray, shape (n_groups, n, n)
        Estimated cross-spectra in units of the model's scale.
    centre : ndarray, shape (size,)
        Usual values of everything else.
    """
    groups = model.groups
    w = 2 * np.pi * groups.centre_hz
    G = model.measured(model.receptance(np.zeros(len(STRUCTURAL)), speed_rad_s, w), w) * model.force_unit
    power = np.einsum("fai,fai->f", G.conj(), G).real / model.n
    regular = G @ _H(G) + (_REGULARISED * power)[:, None, None] * np.eye(model.n)
    inverse = _H(G) @ np.linalg.inv(regular)
    forces = (inverse @ observed @ _H(inverse)).real
    total = np.einsum("fii->f", forces)
    visible = groups.bins * np.minimum(1, np.einsum("fii->f", observed).real / model.n / _VISIBLE)
    cutoff_hz = _best_cutoff(groups.centre_hz, total, visible)
    gain = low_pass(groups.centre_hz, cutoff_hz)
    weight = visible * np.minimum(1, 10 * gain)
    C = np.tensordot(weight / gain, forces, axes=1) / weight.sum()
    C += _LEAST_LEVEL * np.trace(C) / 6 * np.eye(6)
    theta = centre.copy()
    theta[model.cutoff_at] = np.log(cutoff_hz)
    theta[model.noise_at] = _START_NOISE
    theta[model.level_at] = np.linalg.cholesky(C)[ROWS, COLUMNS]
    return theta


def _best_cutoff(frequency_hz: FloatArray, total: FloatArray, weight: FloatArray) -> float:
    """Cutoff whose low-pass leaves the least scatter in the forces' logarithm, a few outliers aside."""
    scatter = {}
    for cutoff_hz in np.geomspace(frequency_hz[0] * 3, frequency_hz[-1] * 3, 24):
        rest = np.log(total / low_pass(frequency_hz, float(cutoff_hz)))
        rest = rest - weight @ rest / weight.sum()
        scatter[float(cutoff_hz)] = float(weight @ np.minimum(rest**2, 1))
    return min(scatter, key=scatter.__getitem__)


def _H(matrices: ComplexArray) -> ComplexArray:
    return np.asarray(matrices.conj().swapaxes(-1, -2), dtype=np.complex128)
