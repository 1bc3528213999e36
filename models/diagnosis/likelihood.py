"""Physical parameters by maximum likelihood from a window's cross-spectra (Whittle), with their standard errors.

References
----------
P. Whittle, "Estimation and information in stationary time series", Arkiv för Matematik 2 (1953). Equation numbers are
the paper's: the theory compared with is Eqs. (1)-(12) and (17)-(18).
"""

from dataclasses import dataclass, replace

import numpy as np

from models.diagnosis.moments import ComplexArray
from models.diagnosis.scoring import LOG_NOISE, FisherScoring
from models.diagnosis.spectral_model import STRUCTURAL, SpectralModel
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.signals.block import FloatArray

__all__ = ["LikelihoodEstimate", "LikelihoodFit"]

_AVERAGES_PER_SEGMENT = 0.53
"""Independent averages per half-overlapped Hann segment and bin: 1 / Σ of the squared correlations of neighbouring
segments (|ρ|² = 1/36) and bins (|ρ|² = 4/9, 1/36)."""

_COLD_STEPS, _WARM_STEPS = 120, 20
_SYNCHRONOUS_BINS = 3


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
        Mean of (trace(S⁻¹ Ŝ) / n - 1): how much more power there is than the fitted theory says.
    """

    names: tuple[str, ...]
    change: FloatArray
    standard_error: FloatArray
    steps: int
    misfit: float


@dataclass(frozen=True, slots=True)
class _Start:
    """Where a search starts: the parameter point and the units it is in."""

    theta: FloatArray
    scale: FloatArray
    force_scale: float


class LikelihoodFit:
    """Fits window after window, each from where the last one ended.

    The state kept between windows is only the starting point; the result does not depend on it beyond the convergence
    tolerance.

    Parameters
    ----------
    machine : Machine
        Nominal rotor and unbalance phase.
    """

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._start: _Start | None = None

    def reset(self) -> None:
        """Start the next window cold."""
        self._start = None

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
        if not np.all(power > 0):
            dead = [name for name, value in zip(window.states, power, strict=True) if not value > 0]
            raise EstimationError(
                f"{self._machine.name}: no fluctuation in {', '.join(dead)}: nothing to compare with theory"
            )
        speed = window.speed_rad_s if np.isfinite(window.speed_rad_s) else self._machine.operation.speed_rad_s
        cold = self._start is None
        start = (
            self._cold_start(window.states, window.frequencies_hz[keep], observed, power, speed)
            if (self._start is None)
            else self._start
        )
        model = SpectralModel(self._machine, window.states, window.frequencies_hz[keep], start.scale, start.force_scale)
        observed = observed / np.outer(start.scale, start.scale)
        averages = _AVERAGES_PER_SEGMENT * window.n_segments
        search = FisherScoring(model, observed, averages, speed)
        try:
            theta, information, steps = search.maximise(start.theta, _COLD_STEPS if cold else _WARM_STEPS)
            covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        except np.linalg.LinAlgError as error:
            self.reset()
            raise EstimationError(f"{self._machine.name}: the likelihood has no maximum for this window") from error
        self._start = replace(start, theta=theta)
        n = len(STRUCTURAL)
        ratio = np.exp(theta[:n])
        change = np.asarray(ratio - 1, dtype=np.float64)
        deviation = np.asarray(ratio * np.sqrt(np.diag(covariance)[:n]), dtype=np.float64)
        names: tuple[str, ...] = STRUCTURAL
        if window.synchronous is not None:
            e, e_error = self._eccentricity(model, theta, covariance[:n, :n], window, speed)
            names, change, deviation = (*names, "e"), np.append(change, e), np.append(deviation, e_error)
        point = model.at(theta, speed)
        trace = np.einsum("fij,fji->f", np.linalg.inv(point.S), observed).real
        return LikelihoodEstimate(names, change, deviation, steps, float(np.mean(trace) / model.n - 1))

    def _usable_bins(self, window: WindowStatistics) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """All bins but the neighbourhood of the rotation: what is left of its line there is not stochastic."""
        speed = window.speed_rad_s if np.isfinite(window.speed_rad_s) else self._machine.operation.speed_rad_s
        width = _SYNCHRONOUS_BINS * (window.frequencies_hz[1] - window.frequencies_hz[0])
        return np.asarray(np.abs(window.frequencies_hz - speed / (2 * np.pi)) > width)

    def _cold_start(
        self,
        states: tuple[str, ...],
        frequencies_hz: FloatArray,
        observed: ComplexArray,
        power: FloatArray,
        speed: float,
    ) -> "_Start":
        """Nominal rotor, mid cutoff, a little noise, equal independent sources that explain the mean power."""
        scale = np.sqrt(power)
        model = SpectralModel(self._machine, states, frequencies_hz, scale)
        theta = np.zeros(model.size)
        low, high = self._machine.condition.cutoff_hz
        theta[model.cutoff_at] = np.log(np.sqrt(low * high))
        theta[model.noise_at] = LOG_NOISE
        theta[model.level_at] = np.eye(6)[np.tril_indices(6)]
        bare = model.at(theta, speed).S - np.exp(LOG_NOISE) * np.eye(model.n)
        explained = np.einsum("fii->", bare).real / np.einsum("fii,i->", observed, 1 / power).real
        return _Start(theta, scale, float(explained**-0.5))

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
        return float(weight @ q2) / precision - 1, precision**-0.5
