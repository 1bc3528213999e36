"""Fisher scoring: the search for the maximum of one window's Whittle likelihood."""

from dataclasses import dataclass

import numpy as np

from models.diagnosis.moments import ComplexArray
from models.diagnosis.spectral_model import SpectralModel
from models.signals.block import FloatArray

__all__ = ["LOG_NOISE", "FisherScoring", "Maximum"]

LOG_NOISE = float(np.log(1e-3))
"""Usual noise density of a channel, relative to its mean density in the band (3 % in amplitude)."""

_WEAK, _COLOUR = 0.05, 1.0
"""Weak pull of levels, noise and its colour towards their usual values: without it the search wanders off where an
excitation of low rank, or a channel without visible noise, leaves them undetermined."""

_NEAR, _GAIN = 0.05, 1.0
"""Converged when a full step would move no diagnosed parameter by more than this many standard errors and would gain
less than this in log-likelihood. Noise levels may swing a little longer; what is diagnosed does not follow them."""


@dataclass(frozen=True, slots=True)
class Maximum:
    """Where a search ended.

    Attributes
    ----------
    theta : ndarray, shape (size,)
        The parameter point.
    information : ndarray, shape (size, size)
        Fisher information there.
    value : float
        Log-likelihood there, up to a constant.
    steps : int
        Steps tried.
    remaining : ndarray, shape (n_diagnosed,)
        Step of the diagnosed parameters that the search would still take; a small part of a standard error if it has
        converged.
    """

    theta: FloatArray
    information: FloatArray
    value: float
    steps: int
    remaining: FloatArray


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
    usual_cutoff_hz : float
        Where the cutoff is pulled, weakly, if the band does not show it.
    """

    def __init__(
        self,
        model: SpectralModel,
        observed: ComplexArray,
        averages: float,
        speed_rad_s: float,
        usual_cutoff_hz: float,
    ) -> None:
        self._model, self._observed, self._averages, self._speed_rad_s = model, observed, averages, speed_rad_s
        self._ridge = np.zeros(model.size)
        self._ridge[:] = _WEAK
        self._ridge[: model.cutoff_at] = 0.0  # what is diagnosed is pulled nowhere
        self._ridge[model.colour_at] = _COLOUR
        self._centre = np.zeros(model.size)
        self._centre[model.noise_at] = LOG_NOISE
        self._centre[model.cutoff_at] = np.log(usual_cutoff_hz)

    def maximise(self, theta: FloatArray, most_steps: int) -> Maximum:
        """Search from a starting point.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the information is singular: the window says nothing about a parameter.
        """
        damping = 1e-3
        value = self._value(theta)
        gradient, information = self._scores(theta)
        steps = 0
        while True:
            full_step: FloatArray = np.asarray(np.linalg.solve(information, gradient), dtype=np.float64)
            if steps == most_steps or self._is_near(full_step, gradient, information):
                break
            steps += 1
            damped = information + damping * np.diag(np.diag(information))
            step = np.linalg.solve(damped, gradient)
            # Logarithms move by one at most, for far from the data the theory misleads; levels are linear and free.
            step *= min(1.0, 1.0 / float(np.max(np.abs(step[: self._model.level_at.start]))))
            trial_value = self._value(theta + step)
            if trial_value > value:
                theta, value = theta + step, trial_value
                gradient, information = self._scores(theta)
                damping = max(damping / 8, 1e-9)
            elif damping > 1e8:
                break
            else:
                damping *= 8
        return Maximum(theta, information, value, steps, full_step[: self._model.cutoff_at])

    def _is_near(self, step: FloatArray, gradient: FloatArray, information: FloatArray) -> bool:
        diagnosed = slice(self._model.cutoff_at)
        variance = np.diag(np.linalg.inv(information))[diagnosed]
        return bool(np.all(step[diagnosed] ** 2 < _NEAR**2 * variance) and gradient @ step / 2 < _GAIN)

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
