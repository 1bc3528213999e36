"""Fisher scoring: the search for the maximum of one window's Whittle likelihood."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from models.diagnosis.likelihood.motions import AVERAGES_PER_BIN
from models.diagnosis.likelihood.spectral_model import COLUMNS, ROWS, ModelPoint, SpectralModel, Speeds, packed
from models.signals.block import ComplexArray, FloatArray

# Usual noise density of a channel, relative to its mean density in the band (3 % in amplitude).
LOG_NOISE = float(np.log(1e-3))
# Weak pull of levels and noise towards their usual values: without it the search wanders off where an excitation of low
# rank, or a channel without visible noise, leaves them undetermined.
_WEAK = 0.05
_COLOUR = 1.0  # the same for the noise's colour
# Strengths with which the forces' colours may be pulled towards none. The evidence of the window selects one (D. J. C.
# MacKay, Neural Computation 4 (1992)) for the colour that all forces share and one for their differences, so forces of
# one low-pass cost next to nothing, and a hump is not suppressed.
_STRENGTHS = np.geomspace(0.5, 2000, 24)
# How often a search re-estimates the strengths, and the change of their logarithms that is not worth more steps.
_LOOKS, _SAME_STRENGTH = 3, 0.5
# Pulls on the low-pass: the logarithms of cutoff and order have standard deviations of 1 and 0.3. A model without
# colours of the forces keeps the order fixed: on coarse groups a filter of order near zero would fit anything.
_CUTOFF, _ORDER, _FIXED = 1.0, 10.0, 1e4
# Indices of the bearing's stiffness and damping in y and in z; and the pull on those of a plane without a sensor: their
# logarithms have a standard deviation of 0.3.
_OF_PLANES, _UNSHOWN = (slice(0, 2), slice(2, 4)), 10.0


@dataclass(frozen=True, slots=True)
class Whitened:
    """Spectra whitened with the Cholesky factors S = L Lᴴ of the expected spectra at a point."""

    point: ModelPoint
    L_inverse: ComplexArray  # (n_groups, n, n)
    excess: ComplexArray  # (n_groups, n, n), L⁻¹ Ŝ L⁻ᴴ - I: zero where theory and estimate agree


@dataclass(frozen=True, slots=True)
class Derivatives:
    """Derivatives at the end of an earlier search, which save most of the first step of a search that starts there."""

    slopes: FloatArray  # (size, n_groups, n²), whitened
    information: FloatArray  # (size, size), made of them: of the data without pulls, levels as elements of C
    speed_rad_s: Speeds  # speed for which they were computed


@dataclass(frozen=True, slots=True)
class Maximum:
    """Where a search ended."""

    information: FloatArray  # (size, size), Fisher information there, on the elements of C (not of T)
    derivatives: Derivatives  # of the window's own speed, or of the search whose slopes were reused
    whitened: Whitened  # theory and estimate there
    steps: int  # steps tried
    fitted: float  # effective number of parameters that the window determined, not the weak pulls
    # (n_diagnosed,): step of the diagnosed parameters that the search would still take; a small part of a standard
    # error if it has converged
    remaining: FloatArray
    covariance: FloatArray | None = None  # (size, size), inverse of the information where that is known already

    @property
    def theta(self) -> FloatArray:
        """The parameter point."""
        return self.whitened.point.theta


class Weights:
    """Weight of a window's data, and of the pulls towards usual values for what the data leave undetermined.

    Estimated spectra are means of `n_segments` segments. The cutoff is pulled weakly to the usual one, in case the band
    does not show it; `strengths` pull the forces' colours (the common one, their differences) towards none, by default
    as weakly as possible.
    """

    def __init__(
        self, model: SpectralModel, n_segments: int, usual_cutoff_hz: float, strengths: FloatArray | None = None
    ) -> None:
        self._level_at = model.level_at
        self.averages: FloatArray = AVERAGES_PER_BIN * n_segments * model.groups.bins
        self.ridge = np.full(model.size, _WEAK)
        self.ridge[: model.cutoff_at] = 0.0  # diagnosed parameters are not pulled
        for plane, own in enumerate(_OF_PLANES):  # except in a plane without a sensor, which leaves them undetermined
            if not np.any(model.motions.dofs // 3 == plane):
                self.ridge[own] = _UNSHOWN
        self.ridge[model.colour_at] = _COLOUR
        self.colours = model.common_at, model.own_at
        self.strengths = np.full(2, _STRENGTHS[0]) if strengths is None else strengths.copy()
        for at, own in zip(self.colours, self.strengths, strict=True):
            self.ridge[at] = own
        self.ridge[model.cutoff_at] = _CUTOFF
        self.ridge[model.order_at] = _ORDER if model.shapes else _FIXED
        self.centre = np.zeros(model.size)
        self.centre[model.noise_at] = LOG_NOISE
        self.centre[model.cutoff_at] = np.log(usual_cutoff_hz)
        self.centre[model.order_at] = np.log(2)

    @property
    def pull(self) -> FloatArray:
        """Pulls as added to the information on C: for the levels just enough to keep it invertible."""
        pull = self.ridge.copy()
        pull[self._level_at] = 1e-3
        return pull


class FisherScoring:
    """Fisher scoring with Levenberg-Marquardt damping: a step counts only if the likelihood rises.

    The levels are stepped as T of C = T Tᵀ. Where the data call for less excitation in a direction, the curvature of
    T Tᵀ is added to the information; without it the small columns of a low-rank excitation overshoot and hold up every
    other parameter. `observed`, the estimated cross-spectra, shape (n_groups, n, n), are in the model's units. The
    `strengths` (see `Weights`) apply until they are re-estimated from the window.
    """

    def __init__(
        self,
        model: SpectralModel,
        observed: ComplexArray,
        n_segments: int,
        speed_rad_s: Speeds,
        usual_cutoff_hz: float,
        strengths: FloatArray | None = None,
    ) -> None:
        self._model, self._observed, self._speed_rad_s = model, observed, speed_rad_s
        self.weights = Weights(model, n_segments, usual_cutoff_hz, strengths)
        shape = (model.size, model.groups.bins.size, model.n * model.n)
        self._slopes, self._weighted = np.empty(shape), np.empty(shape)  # filled by every step

    def maximise(
        self,
        theta: FloatArray,
        most_steps: int,
        near: float,
        gain: float,
        derivatives: Derivatives | None = None,
        hopeless: Callable[[int, Whitened], bool] | None = None,
    ) -> Maximum:
        """Search from a starting point, shape (size,), where `derivatives` are known if an earlier search ended there.

        The search has converged when a full step would move no diagnosed parameter by more than `near` standard errors
        and would gain less than `gain` in log-likelihood. `hopeless` says whether to give up, from the steps tried and
        where they have led. Raises LinAlgError if the window says nothing about a parameter, so that the information is
        singular.
        """
        model = self._model
        diagnosed, damping, steps, looks = slice(model.cutoff_at), 1e-3, 0, 0
        value, whitened = self._value(theta)
        if whitened is None:
            raise np.linalg.LinAlgError("the starting point makes no valid spectrum")
        gradient, information, on_levels, reached = self._scores(theta, whitened, derivatives)
        while True:
            covariance: FloatArray = np.asarray(np.linalg.inv(information), dtype=np.float64)
            full_step = np.asarray(covariance @ gradient, dtype=np.float64)
            is_near = np.all(full_step[diagnosed] ** 2 < near**2 * np.diag(covariance)[diagnosed])
            if steps == most_steps or damping > 1e8 or (hopeless is not None and hopeless(steps, whitened)):
                break
            if is_near and gradient @ full_step / 2 < gain:
                if not model.shapes or looks == _LOOKS or not self._learn_strengths(theta, covariance):
                    break
                looks += 1
                value, _ = self._value(theta, whitened)
                # At the same point, unless an earlier search's derivatives are of another speed.
                gradient, information, on_levels, reached = self._scores(
                    theta, whitened, None if reached is derivatives else reached
                )
                continue
            steps += 1
            damped = information + damping * np.diag(np.diag(information))
            trial = model.moved(theta, np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64))
            trial_value, trial_whitened = self._value(trial)
            if trial_whitened is not None and trial_value > value:
                theta, value, whitened = trial, trial_value, trial_whitened
                gradient, information, on_levels, reached = self._scores(theta, whitened)
                damping = max(damping / 8, 1e-7)
            else:
                damping *= 8
        fitted = model.size - float(self.weights.ridge @ np.diag(covariance))
        reached = replace(reached, information=on_levels - np.diag(self.weights.pull))
        return Maximum(on_levels, reached, whitened, steps, fitted, full_step[diagnosed])

    def _learn_strengths(self, theta: FloatArray, covariance: FloatArray) -> bool:
        """Set the strengths that have the largest evidence for the colours found; False if they hardly changed.

        Around the current maximum the profile log-likelihood of the colours is quadratic, so the evidence of every
        strength has a closed form.
        """
        weights, changed = self.weights, False
        for number, at in enumerate(weights.colours):
            old = weights.strengths[number]
            precision = np.linalg.inv(covariance[at, at])
            eigenvalues, vectors = np.linalg.eigh(precision)
            left = np.maximum(eigenvalues - old, 0)[:, None] + _STRENGTHS
            slope = vectors.T @ (precision @ theta[at])
            evidence = np.sum(np.log(_STRENGTHS / left) + slope[:, None] ** 2 / left, axis=0)
            new = _STRENGTHS[np.argmax(evidence)]
            weights.strengths[number] = weights.ridge[at] = new
            changed |= bool(abs(np.log(new / old)) > _SAME_STRENGTH)
        return changed

    def _value(self, theta: FloatArray, whitened: Whitened | None = None) -> tuple[float, Whitened | None]:
        """Log-likelihood with the weak pulls, up to a constant, and the whitened spectra, which may be known."""
        whitened = whitened or whitened_at(self._model.at(theta, self._speed_rad_s), self._observed)
        if whitened is None:
            return -np.inf, None
        log_determinant = -2 * np.log(np.einsum("fii->fi", whitened.L_inverse).real).sum(axis=1)
        trace = np.einsum("fii->f", whitened.excess).real  # without the constant n
        pull = self.weights.ridge @ (theta - self.weights.centre) ** 2 / 2
        return float(-self.weights.averages @ (log_determinant + trace) - pull), whitened

    def _scores(
        self, theta: FloatArray, whitened: Whitened, derivatives: Derivatives | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray, Derivatives]:
        """Gradient and information with respect to T, information with respect to C, and the derivatives without pulls.

        The derivatives may be known.
        """
        model = self._model
        if derivatives is None:
            slopes = model.slopes(whitened.point, whitened.L_inverse, self._slopes)
            derivatives = Derivatives(slopes, information_of(slopes, self.weights, self._weighted), self._speed_rad_s)
        gradient = gradient_of(derivatives.slopes, packed(whitened.excess), self.weights)
        levels = model.level_at
        chain = _levels_by_factor(model.factor(theta))
        information = derivatives.information.copy()
        information[levels] = chain.T @ information[levels]
        information[:, levels] = information[:, levels] @ chain
        information[levels, levels] += _curvature(gradient[levels])
        gradient[levels] = chain.T @ gradient[levels]
        gradient -= self.weights.ridge * (theta - self.weights.centre)
        information[np.diag_indices(model.size)] += self.weights.ridge
        return gradient, information, derivatives.information + np.diag(self.weights.pull), derivatives


def gradient_of(slopes: FloatArray, rest: FloatArray, weights: Weights) -> FloatArray:
    """Gradient of the data's log-likelihood with respect to every parameter, levels as elements of C."""
    weighted = (rest * weights.averages[:, None]).ravel()
    return np.asarray(slopes.reshape(slopes.shape[0], -1) @ weighted, dtype=np.float64)


def information_of(slopes: FloatArray, weights: Weights, out: FloatArray | None = None) -> FloatArray:
    """Fisher information of the data, without pulls, from packed slopes; `out` is a buffer of the shape of `slopes`."""
    weighted = np.multiply(slopes, np.sqrt(weights.averages)[:, None], out=out).reshape(slopes.shape[0], -1)
    information: FloatArray = weighted @ weighted.T
    return information


def whitened_at(point: ModelPoint, observed: ComplexArray) -> Whitened | None:
    """Whiten estimated spectra with the Cholesky factors of the expected ones; None if those are no valid spectra."""
    try:
        L_inverse = inverse_factor(point.S)
    except np.linalg.LinAlgError:
        return None
    excess = L_inverse @ observed @ L_inverse.conj().swapaxes(1, 2)
    diagonal = np.arange(excess.shape[-1])
    excess[:, diagonal, diagonal] -= 1
    return Whitened(point, L_inverse, excess)


def inverse_factor(S: ComplexArray) -> ComplexArray:
    """L⁻¹ of S = L Lᴴ, shape (n_groups, n, n); raises LinAlgError if S are no valid spectra."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(S)), dtype=np.complex128)


def _levels_by_factor(T: FloatArray) -> FloatArray:
    """∂C/∂T of C = T Tᵀ between the lower triangles, shape (21, 21)."""
    unit = np.zeros((ROWS.size, 6, 6))
    unit[np.arange(ROWS.size), ROWS, COLUMNS] = 1
    change = unit @ T.T
    change = change + change.swapaxes(1, 2)
    return np.asarray(change[:, ROWS, COLUMNS].T, dtype=np.float64)


def _curvature(gradient: FloatArray) -> FloatArray:
    """Second-derivative term of T Tᵀ in the information: 2 tr(δTᵀ N δT), N the positive part of -∂/∂C."""
    N = np.zeros((6, 6))
    N[ROWS, COLUMNS] = N[COLUMNS, ROWS] = -gradient * np.where(ROWS == COLUMNS, 1.0, 0.5)
    values, vectors = np.linalg.eigh(N)
    N = (vectors * np.maximum(values, 0)) @ vectors.T
    return np.asarray(2 * N[np.ix_(ROWS, ROWS)] * (COLUMNS[:, None] == COLUMNS), dtype=np.float64)
