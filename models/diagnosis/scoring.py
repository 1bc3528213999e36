"""Fisher scoring: the search for the maximum of one window's Whittle likelihood."""

import numpy as np

from models.diagnosis.moments import ComplexArray
from models.diagnosis.spectral_model import SpectralModel
from models.signals.block import FloatArray

__all__ = ["LOG_NOISE", "FisherScoring"]

LOG_NOISE = float(np.log(1e-3))
"""Usual noise density of a channel, relative to its mean density in the band (3 % in amplitude)."""

_WEAK, _COLOUR = 0.05, 1.0
"""Weak pull of levels, noise and its colour towards their usual values: without it the search wanders off where an
excitation of low rank, or a channel without visible noise, leaves them undetermined."""

_GAIN = 5e-3
"""Converged when a full step would gain less than this in log-likelihood: 0.1 standard errors over all parameters together."""


class FisherScoring:
    """Fisher scoring with Levenberg-Marquardt damping: a step counts only if the likelihood rises.

    Parameters
    ----------
    model : SpectralModel
    observed : ndarray, shape (n_bins, n, n)
        Estimated cross-spectra in units of the model's scale.
    averages : float
        Independent averages in each of them.
    speed_rad_s : float
    """

    def __init__(self, model: SpectralModel, observed: ComplexArray, averages: float, speed_rad_s: float) -> None:
        self._model, self._observed, self._averages, self._speed_rad_s = model, observed, averages, speed_rad_s
        self._ridge = np.zeros(model.size)
        self._ridge[model.level_at] = self._ridge[model.noise_at] = _WEAK
        self._ridge[model.colour_at] = _COLOUR
        self._centre = np.zeros(model.size)
        self._centre[model.noise_at] = LOG_NOISE

    def maximise(self, theta: FloatArray, most_steps: int) -> tuple[FloatArray, FloatArray, int]:
        """Search from a starting point.

        Returns
        -------
        theta : ndarray, shape (size,)
            The maximum.
        information : ndarray, shape (size, size)
            Fisher information there.
        steps : int
            Steps tried.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the information is singular: the window says nothing about a parameter.
        """
        damping = 1e-3
        value = self._value(theta)
        gradient, information = self._scores(theta)
        steps = 0
        while steps < most_steps and gradient @ np.linalg.solve(information, gradient) / 2 > _GAIN:
            steps += 1
            damped = information + damping * np.diag(np.diag(information))
            step = np.linalg.solve(damped, gradient)
            step *= min(1.0, 1.0 / float(np.max(np.abs(step))))  # e-fold at most: far from the data theory misleads
            trial_value = self._value(theta + step)
            if trial_value > value:
                theta, value = theta + step, trial_value
                gradient, information = self._scores(theta)
                damping = max(damping / 8, 1e-9)
            elif damping > 1e8:
                break
            else:
                damping *= 8
        return theta, information, steps

    def _value(self, theta: FloatArray) -> float:
        """Log-likelihood and the weak pulls, up to a constant."""
        try:
            L = np.linalg.cholesky(self._model.at(theta, self._speed_rad_s).S)
        except np.linalg.LinAlgError:
            return -np.inf
        log_determinant = 2 * np.log(np.einsum("fii->fi", L).real).sum()
        white = np.linalg.solve(L, self._observed)
        trace = np.einsum("fij,fij->", np.linalg.inv(L).conj(), white).real
        return float(-self._averages * (log_determinant + trace) - self._ridge @ (theta - self._centre) ** 2 / 2)

    def _scores(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient and Fisher information."""
        model = self._model
        point = model.at(theta, self._speed_rad_s)
        L_inverse = np.asarray(np.linalg.inv(np.linalg.cholesky(point.S)), dtype=np.complex128)
        derivatives = model.whitened_derivatives(point, L_inverse)
        excess = L_inverse @ self._observed @ L_inverse.conj().swapaxes(1, 2) - np.eye(model.n)
        flat = derivatives.transpose(1, 0, 2, 3).reshape(model.size, -1)
        slopes: FloatArray = np.concatenate([flat.real, flat.imag], axis=1)
        misfit: FloatArray = np.concatenate([excess.real.ravel(), excess.imag.ravel()])
        gradient = self._averages * (slopes @ misfit) - self._ridge * (theta - self._centre)
        information = self._averages * (slopes @ slopes.T)
        information[np.diag_indices(model.size)] += self._ridge
        return gradient, information
