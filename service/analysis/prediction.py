"""Theory for one window: spectra and correlation functions of the nominal machine, and of the machine as estimated.

Both use the same excitation, which is not measured, but estimated from the window with the estimated machine (with the
nominal one if there is no estimate), so they differ by the effect of the parameters alone. Spectra are averaged with
the spectral kernel of the segments, as the measured spectra are. Correlation functions are their Fourier transforms
(Eq. 18),

    R_ij(τ) = 2 Re ∫ S_ij(f) e^{-2πjfτ} df,

by Gauss-Legendre quadrature over panels that are narrow around the natural frequencies.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from models.diagnosis.likelihood.motions import AVERAGES_PER_BIN, BinGroups, Motions, group_bins, integrated
from models.diagnosis.likelihood.scoring import FisherScoring
from models.diagnosis.likelihood.spectral_model import SpectralModel, starting_point, usual_force
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.physics.excitation import low_pass
from models.physics.rotor import COORDINATES, PARAMETERS, RotorParameters, changed, system_A
from models.signals.block import ComplexArray, FloatArray
from rotorwatch.records.windows import Parameter

NOTHING_READ = "no parameter was read in this window"
NO_PARAMETERS = "the machine's parameters are not known, so there is no theory to predict from"
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_HALF_WIDTHS = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
"""Panel edges on either side of a natural frequency, in units of half its half-power bandwidth."""
_MOST_PANEL_CYCLES = 1.2
"""Largest width of a panel times the longest lag, i.e. periods of e^{-2πjfτ} in one panel."""
_GROWTH = 0.05
_OVER_BAND = 4.0
LEFT_OUT_BINS = 3
"""Lines on either side of 1× that are excluded: the remainder of 1× there is not stochastic."""
_GROUPS = 150
_FIXING_RIDGE = 1e9
_STEPS, _NEAR, _GAIN = 60, 0.15, 3.0
_COLOUR_RIDGE = 2000.0
"""Ridge strength on the forces' own colours: keeps them close to one common colour unless the window says otherwise."""


@dataclass(frozen=True, slots=True)
class Excitation:
    """Forces and sensor noise of one window."""

    machine: Machine  # with the rotor for which the forces were estimated
    motions: Motions  # what was measured
    theta: FloatArray  # parameters of `SpectralModel`, with all structural ratios at 0
    force_scale: float  # the model's unit of force, N/√Hz
    speed_rad_s: float  # speed of the gyroscopic terms
    # ln d₀ and b of every sensor's noise (see `_noise_density`), by state; an accelerometer's noise is given as that of
    # the velocity to which it was integrated.
    noise: dict[str, FloatArray]

    def spectra(self, rotor: RotorParameters, states: tuple[str, ...], frequencies_hz: FloatArray) -> ComplexArray:
        """Cross-spectra of a rotor's states under this excitation, two-sided, SI²/Hz, shape (n_frequencies, n, n).

        The states may be measured states and accelerations; sensor noise is included. Outside the window's band the
        forces' low-pass continues, while their colour and the noise keep the values at the band's edge.
        """
        low_hz, high_hz = self.machine.window.band_hz
        size = frequencies_hz.size
        one = np.ones((size, 1))
        lines = BinGroups(
            edges=tuple((k, k + 1) for k in range(size)),
            bins=one[:, 0],
            centre_hz=np.clip(frequencies_hz, low_hz, high_hz),
            nodes_hz=frequencies_hz[:, None],
            weights=one,
            shared=np.empty((0, 0)),
        )
        machine = self.machine.model_copy(update={"rotor": rotor})
        model = SpectralModel(machine, self.motions, lines, self.force_scale)
        point = model.at(self.theta, self.speed_rad_s)
        w = 2 * np.pi * frequencies_hz
        gain = low_pass(frequencies_hz, *model.filter(self.theta))
        dofs = [_dof(state) for state in states]
        seen = point.H[:, 0][:, dofs] * np.stack([(1j * w) ** _order(state) for state in states], axis=1)[:, :, None]
        spectra = (seen * gain[:, None, None]) @ point.C @ seen.conj().transpose(0, 2, 1)
        diagonal = np.arange(len(states))
        spectra[:, diagonal, diagonal] += np.stack([self._noise(state, frequencies_hz) for state in states], axis=1)
        return np.asarray(spectra, dtype=np.complex128)

    def _noise(self, state: str, frequencies_hz: FloatArray) -> FloatArray:
        """Noise density of one sensor, SI²/Hz; zero if the likelihood did not use the sensor."""
        low_hz, high_hz = self.machine.window.band_hz
        within_hz = np.clip(frequencies_hz, low_hz, high_hz)
        if state in self.noise:
            return _noise_density(self.noise[state], within_hz, high_hz)
        velocity = state.replace("_ddot", "_dot")
        if velocity in self.noise and velocity not in self.machine.descriptor.states:
            return (2 * np.pi * within_hz) ** 2 * _noise_density(self.noise[velocity], within_hz, high_hz)
        return np.zeros_like(frequencies_hz)


def excitation_of(machine: Machine, window: WindowStatistics) -> Excitation:
    """Estimate the excitation with which a machine best explains a window, its rotor parameters held.

    The likelihood estimates a level matrix of all forces, a low-pass, a smooth colour of each force, and the noise of
    each sensor (`models.diagnosis.likelihood.spectral_model`).

    Raises
    ------
    EstimationError
        If a channel shows no fluctuation, or the search finds no finite excitation.
    """
    window = integrated(window)
    speed = float(window.speed_rad_s) if np.isfinite(window.speed_rad_s) else machine.operation.speed_rad_s
    frequencies_hz = window.frequencies_hz
    spacing_hz = float(frequencies_hz[1] - frequencies_hz[0])
    excluded = np.abs(frequencies_hz - abs(speed) / (2 * np.pi)) <= LEFT_OUT_BINS * spacing_hz
    power = np.einsum("fii->i", window.spectrum[~excluded]).real / np.count_nonzero(~excluded)
    still = [state for state, one in zip(window.states, power, strict=True) if not one > 0]
    if still:
        raise EstimationError(f"{machine.title}: no fluctuation in {', '.join(still)}: nothing to compare with theory")
    motions = Motions(window.states, np.sqrt(power))
    low_hz, high_hz = machine.window.band_hz
    groups = group_bins(frequencies_hz, machine, np.asarray(excluded, dtype=np.bool_), (high_hz - low_hz) / _GROUPS)
    usual_cutoff_hz = math.sqrt(math.prod(machine.condition.cutoff_hz))
    force_scale = usual_force(machine, motions, groups, speed, usual_cutoff_hz)
    model = SpectralModel(machine, motions, groups, force_scale)
    observed = model.observed(groups.average(window.spectrum))
    search = FisherScoring(model, observed, window.n_segments, speed, usual_cutoff_hz, np.full(2, _COLOUR_RIDGE))
    search.weights.ridge[: model.cutoff_at] = _FIXING_RIDGE
    try:
        # Trial points may overflow: the result is checked below, so no warnings are needed.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            start = starting_point(model, observed, search.weights.centre, speed)
            theta = search.maximise(start, _STEPS, _NEAR, _GAIN).theta
    except np.linalg.LinAlgError as error:
        raise EstimationError(
            f"{machine.title}: no excitation explains this window with these parameters: {error}"
        ) from error
    if not np.all(np.isfinite(theta)):
        raise EstimationError(f"{machine.title}: no excitation explains this window with these parameters")
    theta = theta.copy()
    theta[: model.cutoff_at] = 0.0
    noise = _noise_of(machine, model, theta, window, speed)
    return Excitation(machine, motions, theta, force_scale, speed, noise)


def _noise_of(
    machine: Machine, model: SpectralModel, theta: FloatArray, window: WindowStatistics, speed: float
) -> dict[str, FloatArray]:
    """Noise parameters of every sensor: its measured density less the response to the excitation."""
    groups, point = model.groups, model.at(theta, speed)
    dofs = [_dof(state) for state in window.states]
    seen = point.H[:, :, dofs]
    power = np.einsum("gksa,ab,gksb->gks", seen, point.C, seen.conj(), optimize=True).real
    gain = low_pass(groups.nodes_hz, *model.filter(theta)) * groups.weights
    w = 2 * np.pi * groups.nodes_hz
    averages = AVERAGES_PER_BIN * window.n_segments * groups.bins
    shape = _colour(groups.centre_hz, machine.window.band_hz[1])
    measured = np.einsum("gss->gs", groups.average(window.spectrum)).real
    found = {}
    for at, state in enumerate(window.states):
        theory = np.sum(gain * w ** (2 * _order(state)) * power[:, :, at], axis=1)
        found[state] = _sensor_noise(measured[:, at], theory, averages, shape)
    return found


def _dof(state: str) -> int:
    return COORDINATES.index(state.partition("_")[0])


def _order(state: str) -> int:
    """Number of time derivatives of the coordinate in a state."""
    return {"": 0, "dot": 1, "ddot": 2}[state.partition("_")[2]]


_NOISE_STEPS, _LONGEST, _CLOSE = 30, 1.5, 0.01
_MOST_NOISE_SLOPE = 4.0
_LEAST, _USUAL = 1e-7, 1e-3
"""Noise density over the channel's mean density: lower bound of the search, and starting point."""
_NOISE_PRIOR_PRECISION = np.array([0.05, 1.0])
"""Prior precision of ln d₀ and b about their usual values: weak, for sensors whose noise is not visible."""


def _noise_density(parameters: FloatArray, frequencies_hz: FloatArray, high_hz: float) -> FloatArray:
    """Noise density d(f) of a sensor with parameters ln d₀ and b, in a band that ends at `high_hz`, SI²/Hz."""
    return np.asarray(np.exp(parameters[0] + parameters[1] * _colour(frequencies_hz, high_hz)), dtype=np.float64)


def _colour(frequencies_hz: FloatArray, high_hz: float) -> FloatArray:
    return np.asarray(np.log1p((frequencies_hz / (2 / 3 * high_hz)) ** 2), dtype=np.float64)


def _sensor_noise(measured: FloatArray, theory: FloatArray, averages: FloatArray, shape: FloatArray) -> FloatArray:
    """Estimate ln d₀ and b of one sensor's noise, shape (2,).

    `measured` are densities, each the mean of `averages` independent estimates; `theory` are those without noise, both
    SI²/Hz. `shape` is `_colour` at their frequencies. All have shape (n_groups,).
    """
    level = float(np.log(averages @ measured / averages.sum()))
    usual = np.array([level + np.log(_USUAL), 0.0])

    def seen(point: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Noise density, expected density, and the log-likelihood plus log-prior."""
        noise = np.exp(point[0] + point[1] * shape)
        expected = theory + noise
        fits = -float(averages @ (np.log(expected) + measured / expected))
        return noise, expected, fits - float(_NOISE_PRIOR_PRECISION @ (point - usual) ** 2) / 2

    found, damping = usual, 1e-3
    noise, expected, value = seen(found)
    for _ in range(_NOISE_STEPS):
        slopes = np.stack([noise / expected, shape * noise / expected])
        gradient = slopes @ (averages * (measured / expected - 1)) - _NOISE_PRIOR_PRECISION * (found - usual)
        information = (slopes * averages) @ slopes.T + np.diag(_NOISE_PRIOR_PRECISION)
        step = np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
        step = np.clip(step, -_LONGEST, _LONGEST)
        trial = np.clip(found + step, (level + np.log(_LEAST), -_MOST_NOISE_SLOPE), (level, _MOST_NOISE_SLOPE))
        there = seen(trial)
        if there[2] > value:
            found, (noise, expected, value), damping = trial, there, damping / 8
            if np.all(np.abs(step) < _CLOSE):
                break
        else:
            damping *= 8
    return found


@dataclass(frozen=True, slots=True)
class Prediction:
    """Theory for one window."""

    machine: Machine | None  # as nominal
    excitation: Excitation | None  # None if there is a `nominal_reason`
    changes: dict[str, float]  # relative changes of the machine as estimated
    # Why there is no prediction for the nominal or the estimated machine; empty if there is one.
    nominal_reason: str
    estimated_reason: str

    def spectra(
        self, states: tuple[str, ...], frequencies_hz: FloatArray
    ) -> tuple[ComplexArray | None, ComplexArray | None]:
        """Expected cross-spectra of the segments, two-sided, SI²/Hz, nominal and estimated; None without a prediction.

        The frequencies are lines of the window's spectrum, evenly spaced; the shape is (n_lines, n, n).
        """
        known, excitation = self.machine, self.excitation
        if known is None or excitation is None:
            return None, None
        spacing_hz = float(frequencies_hz[1] - frequencies_hz[0])
        none_left_out = np.zeros(frequencies_hz.size, dtype=np.bool_)
        lines = group_bins(frequencies_hz, known, none_left_out, spacing_hz)
        nodes, place = np.unique(np.round(lines.nodes_hz / spacing_hz, 6), return_inverse=True)

        def of(rotor: RotorParameters) -> ComplexArray:
            at_nodes = excitation.spectra(rotor, states, nodes * spacing_hz)[place.reshape(lines.nodes_hz.shape)]
            return np.asarray(np.einsum("lk,lkij->lij", lines.weights, at_nodes), dtype=np.complex128)

        return of(known.rotor), None if self.estimated_reason else of(changed(known.rotor, self.changes))

    def correlations(
        self,
        states: tuple[str, ...],
        pairs: list[tuple[int, int]],
        lags_s: FloatArray,
        within_hz: tuple[float, float] | None = None,
    ) -> tuple[FloatArray | None, FloatArray | None]:
        """Correlation functions R_ij(τ), SI, shape (n_lags, n_pairs), nominal and estimated; None without a prediction.

        `pairs` are indices into `states`, reference and response; `within_hz` limits the integral to a band.
        """
        known, excitation = self.machine, self.excitation
        if known is None or excitation is None:
            return None, None
        low_hz, high_hz = within_hz or (0.0, _highest_hz(known, states))

        def of(rotor: RotorParameters) -> FloatArray:
            frequencies_hz, weights = _nodes(excitation, rotor, low_hz, high_hz, float(lags_s[-1]))
            spectra = excitation.spectra(rotor, states, frequencies_hz)
            of_pairs = np.stack([spectra[:, i, j] for i, j in pairs], axis=1) * weights[:, None]
            phase = 2 * np.pi * np.outer(lags_s, frequencies_hz)
            return np.asarray(2 * (np.cos(phase) @ of_pairs.real + np.sin(phase) @ of_pairs.imag))

        return of(known.rotor), None if self.estimated_reason else of(changed(known.rotor, self.changes))


def _highest_hz(machine: Machine, states: tuple[str, ...]) -> float:
    """Upper limit of the quadrature: the Nyquist frequency, or less if the spectra are negligible above it."""
    nyquist_hz = machine.rate_hz / 2
    if any(state.endswith("_ddot") for state in states):
        return nyquist_hz
    poles = np.linalg.eigvals(system_A(machine.rotor, machine.operation.speed_rad_s))
    fastest_hz = float(np.abs(poles).max()) / (2 * np.pi)
    return min(nyquist_hz, max(_OVER_BAND * machine.window.band_hz[1], 1.5 * fastest_hz))


def _nodes(
    excitation: Excitation, rotor: RotorParameters, low_hz: float, high_hz: float, longest_s: float
) -> tuple[FloatArray, FloatArray]:
    """Frequencies, Hz, and weights of the quadrature."""
    poles = np.linalg.eigvals(system_A(rotor, excitation.speed_rad_s))
    poles = poles[poles.imag > 0]
    modes_hz, half_hz = poles.imag / (2 * np.pi), np.maximum(-poles.real / (2 * np.pi), 1e-9)
    around = (modes_hz[:, None] + half_hz[:, None] * np.concatenate([-_HALF_WIDTHS[:0:-1], _HALF_WIDTHS])).ravel()
    widest_hz = _MOST_PANEL_CYCLES / max(longest_s, 1 / excitation.machine.window.band_hz[1])
    even, at = [low_hz], low_hz
    beyond_hz = _OVER_BAND * excitation.machine.window.band_hz[1]
    while at < high_hz:
        at += widest_hz if at < beyond_hz else max(widest_hz, _GROWTH * at)
        even.append(min(at, high_hz))
    edges = np.unique(np.concatenate([even, around[(around > low_hz) & (around < high_hz)]]))
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    frequencies_hz = np.asarray((middle[:, None] + half[:, None] * _POINTS).ravel())
    return frequencies_hz, np.asarray((half[:, None] * _WEIGHTS).ravel())


def predict(
    known: Machine | None, window: WindowStatistics, readings: Iterable[Parameter], why_not: str = ""
) -> Prediction:
    """Predict a window from theory; if that is impossible, the result states the reason, and nothing is raised.

    Parameters
    ----------
    readings : iterable of Parameter
        Readings of this window by the diagnostician that decides; empty if it was not evaluated.
    """
    if known is None:
        return Prediction(None, None, {}, NO_PARAMETERS, NO_PARAMETERS)
    changes = read_changes(readings)
    estimated_reason = "" if changes else why_not or NOTHING_READ
    rotor = changed(known.rotor, changes)
    try:
        excitation = excitation_of(known.model_copy(update={"rotor": rotor}), window)
    except EstimationError as error:
        return Prediction(known, None, changes, str(error), estimated_reason or str(error))
    return Prediction(known, excitation, changes, "", estimated_reason)


def read_changes(readings: Iterable[Parameter]) -> dict[str, float]:
    """Relative changes of the parameters that were read, -0.99 at least: theory needs a remainder of each parameter."""
    read = {reading.name: reading.relative_change for reading in readings if reading.relative_change is not None}
    return {name: max(read[name], -0.99) for name in PARAMETERS if name in read}
