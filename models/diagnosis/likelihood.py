"""Physical parameters by maximum likelihood from a window's cross-spectra (Whittle), with their standard errors.

References
----------
P. Whittle, "Estimation and information in stationary time series", Arkiv för Matematik 2 (1953). Equation numbers are
the paper's: the theory compared with is Eqs. (1)-(12) and (17)-(18).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import digamma

from models.diagnosis.moments import ComplexArray
from models.diagnosis.readings import Diagnosis, ParameterReading
from models.diagnosis.scoring import FisherScoring, Maximum
from models.diagnosis.spectral_model import STRUCTURAL, SpectralModel
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.signals.block import FloatArray

__all__ = ["LikelihoodEstimate", "LikelihoodFit"]

_AVERAGES_PER_SEGMENT = 0.53
"""Independent averages per half-overlapped Hann segment and bin: 1 / Σ of the squared correlations of neighbouring
segments (|ρ|² = 1/36) and bins (|ρ|² = 4/9, 1/36)."""

_COLD_STEPS, _WARM_STEPS = 200, 20
_MOST_MISFIT = 10.0
"""Healthy and changed machines read 0.2 to 5; dead, clipped or doubled channels above 40."""
_MOST_LOG_RATIO = float(np.log(5))
"""No stiffness or damping is believed to have changed by more than a factor of five within the model."""
_SYNCHRONOUS_BINS = 3

_TIME_OVERLAP = 0.947
"""Independent averages per half-overlapped Hann segment at one frequency, 1 / (1 + 2/36)."""

_START_NOISE = 0.3
"""Noise where a cold search starts: with much of it the spectra stay positive definite while the levels are far off."""


@dataclass(frozen=True, slots=True)
class LikelihoodEstimate:
    """Relative parameter changes of one window.

    Attributes
    ----------
    names : tuple of str
        Parameters estimated: ``k_by, c_by, k_bz, c_bz, EI`` and, with a phase reference, ``e``.
    change : ndarray, shape (n,)
        Relative change from nominal.
    standard_error : ndarray, shape (n,)
        Standard error of `change`.
    steps : int
        Scoring steps taken.
    misfit : float
        How much worse the theory fits than sampling alone explains: 0 = as well as it can.
    """

    names: tuple[str, ...]
    change: FloatArray
    standard_error: FloatArray
    steps: int
    misfit: float


class LikelihoodFit:
    """Fits window after window, each from where the last one ended.

    The state kept between windows is only the starting point.

    Parameters
    ----------
    machine : Machine
        Nominal rotor and unbalance phase.
    """

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._usual_cutoff_hz = math.sqrt(machine.condition.cutoff_hz[0] * machine.condition.cutoff_hz[1])
        self._last: FloatArray | None = None

    @property
    def by(self) -> str:
        """Name under which it is reported."""
        return "likelihood"

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        """Judge one window; raises EstimationError if nothing can be said."""
        estimate = self.fit(window)
        readings = tuple(
            ParameterReading(name, self.by, float(change), float(error))
            for name, change, error in zip(estimate.names, estimate.change, estimate.standard_error, strict=True)
        )
        return Diagnosis(
            self.by, readings, covariance=np.diag(estimate.standard_error**2), misfit_z=0.0, steps=estimate.steps
        )

    def reset(self) -> None:
        """Start the next window cold."""
        self._last = None

    def fit(self, window: WindowStatistics) -> LikelihoodEstimate:
        """Estimate the parameters of one window.

        Raises
        ------
        EstimationError
            If a channel has no power in the band (a dead sensor), or the search finds no maximum.
        """
        keep = self._usable_bins(window)
        observed = window.spectrum[keep]
        power = np.einsum("fii->i", observed).real / observed.shape[0]
        twins = _twins(window.states, observed)
        if twins:
            raise EstimationError(f"{self._machine.name}: channels {' and '.join(twins)} carry the same signal")
        dead = _dead(window.states, power)
        if dead:
            raise EstimationError(
                f"{self._machine.name}: no fluctuation in {', '.join(dead)}: nothing to compare with theory"
            )
        speed = window.speed_rad_s if np.isfinite(window.speed_rad_s) else self._machine.operation.speed_rad_s
        model = self._model(window.states, window.frequencies_hz[keep], np.sqrt(power), speed)
        observed = observed / np.outer(model.scale, model.scale)
        averages = _AVERAGES_PER_SEGMENT * window.n_segments
        search = FisherScoring(model, observed, averages, speed, self._usual_cutoff_hz)
        nowhere = f"{self._machine.name}: the likelihood has no maximum for this window"
        try:
            # Trial points may lie far out; what comes of them is checked, not warned of.
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                found = self._maximise(model, search)
            covariance = np.asarray(np.linalg.inv(found.information), dtype=np.float64)
        except np.linalg.LinAlgError as error:
            self.reset()
            raise EstimationError(nowhere) from error
        theta, steps = found.theta, found.steps
        if not (np.all(np.isfinite(theta)) and np.all(np.diag(covariance) > 0)):
            self.reset()
            raise EstimationError(nowhere)
        self._last = theta
        n = len(STRUCTURAL)
        ratio = np.exp(theta[:n])
        change = np.asarray(ratio - 1, dtype=np.float64)
        # A search that has not converged adds the step it would still take to the uncertainty.
        deviation = np.asarray(ratio * np.sqrt(np.diag(covariance)[:n] + found.remaining**2), dtype=np.float64)
        names: tuple[str, ...] = STRUCTURAL
        if window.synchronous is not None:
            e, e_error = self._eccentricity(model, theta, covariance[:n, :n], window, speed)
            names, change, deviation = (*names, "e"), np.append(change, e), np.append(deviation, e_error)
        misfit = _misfit(model.at(theta, speed).S, observed, window)
        if misfit > _MOST_MISFIT or np.any(np.abs(theta[:n]) > _MOST_LOG_RATIO):
            self.reset()
            raise EstimationError(
                f"{self._machine.name}: the theory does not explain this window (misfit {misfit:.3g}, at most "
                f"{_MOST_MISFIT:g} is evaluated): a sensor is at fault, or something outside the model has changed"
            )
        return LikelihoodEstimate(names, change, deviation, steps, misfit)

    def _usable_bins(self, window: WindowStatistics) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """All bins but the neighbourhood of the rotation: what is left of its line there is not stochastic."""
        speed = window.speed_rad_s if np.isfinite(window.speed_rad_s) else self._machine.operation.speed_rad_s
        width = _SYNCHRONOUS_BINS * (window.frequencies_hz[1] - window.frequencies_hz[0])
        return np.asarray(np.abs(window.frequencies_hz - speed / (2 * np.pi)) > width)

    def _model(
        self, states: tuple[str, ...], frequencies_hz: FloatArray, scale: FloatArray, speed: float
    ) -> SpectralModel:
        """Spectral model in this window's own units.

        In these units equal independent sources of level one, through the nominal rotor, explain the mean power. A
        parameter point therefore stays a good start when the machine merely becomes louder.
        """
        model = SpectralModel(self._machine, states, frequencies_hz, scale)
        theta = self._usual(model)
        theta[model.noise_at] = -np.inf
        explained = np.einsum("fii->", model.at(theta, speed).S).real / (model.n * frequencies_hz.size)
        return SpectralModel(self._machine, states, frequencies_hz, scale, float(explained**-0.5))

    def _usual(self, model: SpectralModel) -> FloatArray:
        """Where a cold search starts: nominal rotor, mid cutoff, a little noise, equal independent sources."""
        theta = np.zeros(model.size)
        theta[model.cutoff_at] = np.log(self._usual_cutoff_hz)
        theta[model.noise_at] = np.log(_START_NOISE)
        theta[model.level_at] = np.eye(6)[np.tril_indices(6)]
        return theta

    def _maximise(self, model: SpectralModel, search: FisherScoring) -> Maximum:
        """Search from the last window's maximum, or from the usual point.

        Where an excitation of low rank makes the last steps small, a warm search may end before it has converged; the
        next window carries on from there.
        """
        if self._last is not None:
            try:
                return search.maximise(self._last, _WARM_STEPS)
            except np.linalg.LinAlgError:  # the old point makes no valid spectrum for this window
                self.reset()
        return search.maximise(self._usual(model), _COLD_STEPS)

    def _eccentricity(
        self, model: SpectralModel, theta: FloatArray, covariance: FloatArray, window: WindowStatistics, speed: float
    ) -> tuple[float, float]:
        """Relative change of e from the synchronous vector: generalised least squares with known phase.

        The vector's covariance is the stochastic part's spectrum at Ω over the window length plus what the uncertainty
        of the structural parameters makes of the predicted response.
        """
        if window.synchronous is None:
            raise EstimationError("no phase reference: the unbalance cannot be evaluated")
        W = np.array([speed])
        rotor = self._machine.rotor
        phase = np.exp(1j * self._machine.operation.unbalance_phase_rad)
        force = rotor.m2_kg * rotor.e_m * speed**2 * phase * np.array([0, 1, 0, 0, -1j, 0])

        def response(structural: FloatArray) -> ComplexArray:
            vectors = model.measured(model.receptance(structural, speed, W) @ force[:, None], W)
            return np.asarray(vectors[0, :, 0], dtype=np.complex128)

        n = len(STRUCTURAL)
        structural = theta[:n]
        g = response(structural)
        step = 1e-5
        slopes = np.stack(
            [(response(structural + step * unit) - response(structural - step * unit)) for unit in np.eye(n)]
        )
        slopes = slopes / (2 * step)
        at_speed = SpectralModel(self._machine, window.states, W / (2 * np.pi), model.scale, model.force_scale).at(
            theta, speed
        )
        noise = 4 * at_speed.S[0] / window.duration_s
        # Real representation: the structural uncertainty moves real and imaginary parts together.
        q = window.synchronous / model.scale
        stacked = np.concatenate([noise.real, noise.imag], axis=0), np.concatenate([-noise.imag, noise.real], axis=0)
        total = np.concatenate(stacked, axis=1) / 2
        e_ratio = float(np.real(np.vdot(g, np.linalg.solve(noise, q))) / np.real(np.vdot(g, np.linalg.solve(noise, g))))
        J = np.concatenate([slopes.real, slopes.imag], axis=1).T * e_ratio
        total = total + J @ covariance @ J.T
        g2, q2 = np.concatenate([g.real, g.imag]), np.concatenate([q.real, q.imag])
        weight = np.linalg.solve(total, g2)
        precision = float(weight @ g2)
        if not precision > 0:
            raise EstimationError(f"{self._machine.name}: the spectrum at the speed of rotation is not determined")
        return float(weight @ q2) / precision - 1, precision**-0.5


def _twins(states: tuple[str, ...], observed: ComplexArray) -> tuple[str, ...]:
    """Two states whose difference is nothing but rounding; empty if there are none."""
    cross = observed.real.mean(axis=0)
    power = np.diag(cross)
    for i, first in enumerate(states):
        for j in range(i):
            if power[i] + power[j] - 2 * cross[i, j] < 1e-9 * power[i]:
                return states[j], first
    return ()


def _dead(states: tuple[str, ...], power: FloatArray) -> list[str]:
    """States without fluctuation: a thousand times less than another one of their kind."""
    rates = np.array([name.endswith("_dot") for name in states])
    largest = np.where(rates, power[rates].max(initial=0.0), power[~rates].max(initial=0.0))
    return [name for name, dead in zip(states, ~(power > 1e-6 * largest), strict=True) if dead]


def _misfit(S: ComplexArray, observed: ComplexArray, window: WindowStatistics) -> float:
    """Deviance of the observed spectra from S over its expectation for complex Wishart matrices, less one.

    With ν averages of n channels, tr W - log det W - n of W = S⁻¹Ŝ has the expectation n ln ν - Σ ψ(ν - i), i < n (and
    is infinite for ν < n, where nothing can be said).
    """
    n = S.shape[1]
    nu = _TIME_OVERLAP * window.n_segments
    if nu <= n:
        return float("nan")
    W = np.linalg.solve(S, observed)
    deviance = np.einsum("fii->f", W).real - np.linalg.slogdet(W)[1] - n
    expected = n * np.log(nu) - float(np.sum(digamma(nu - np.arange(n))))
    return float(np.mean(deviance) / expected - 1)
