"""Amortised networks: one per equation, from a window's features to the equation's own parameters and their errors.

Like the paper's per-equation networks they start from estimated correlations, but instead of a residual each network
returns the mean and covariance of a normal distribution of the logarithmic ratio to nominal of its equation's own
parameters. It is trained once to invert the theory, Eqs. (1)-(18), over random machines and conditions, and evaluates
in microseconds; its standard errors are calibrated on windows simulated in the time domain.
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field
from scipy.linalg import block_diag

from models.diagnosis.networks.features import FeatureBasis, ForceFeatures, condensed
from models.diagnosis.readings import Diagnosis, beyond, no_reading, not_determined, parameter_reading
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine
from models.physics.rotor import PARAMETERS, changed
from models.signals.block import Float32Array, FloatArray
from rotorwatch.records.windows import Parameter

OWN = {"28": ("k_by", "c_by"), "29": ("e",), "30": ("EI",), "31": ("k_bz", "c_bz")}  # own parameters of each equation
# Largest remainders, as logarithms, that the second reading is trained for: at least five times those after the first.
NEAR = {"k_by": 0.12, "c_by": 0.25, "k_bz": 0.12, "c_bz": 0.25, "EI": 0.08, "e": 0.25}
LAYERS = (256, 128, 64)  # neurons of the hidden layers
LIMIT = 8.0  # inputs are clipped at this multiple of their usual deviation
# Largest relative difference of displacement and rate at one place, in the band where they agree best; beyond it one
# gain is wrong. In 99 % of 1400 simulated windows with 1 to 5 % sensor noise it is below 0.2 %; the largest is 3.2 %.
_MOST_APART = 0.05
_VAGUE = 0.25  # largest standard error of a reading: beyond it, sensors or window do not determine the parameter


@dataclass(frozen=True, slots=True)
class AmortisedNetwork:
    """Hidden layers with y = x / (1 + e⁻ˣ), and a parallel linear path to the means."""

    equation: str  # the paper's number
    weights: tuple[Float32Array, ...]  # of the hidden layers and the output
    biases: tuple[Float32Array, ...]
    direct: Float32Array  # (n_inputs, n_parameters), from the inputs to the means

    def __call__(self, inputs: Float32Array) -> tuple[FloatArray, FloatArray]:
        """Means, shape (n, p), and Cholesky factors of the covariance, shape (n, p, p), of the logarithmic ratios."""
        hidden = inputs
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = hidden @ weight + bias
            hidden = hidden / (1 + np.exp(-hidden))
        out = (hidden @ self.weights[-1] + self.biases[-1]).astype(np.float64)
        p = len(OWN[self.equation])
        mean = out[:, :p] + inputs @ self.direct
        deviation = np.exp(out[:, p : 2 * p])
        factor = deviation[:, :, None] * np.eye(p)
        if p == 2:
            factor[:, 1, 0] = deviation[:, 1] * out[:, 4]
        return mean, factor


class Calibration(BaseModel, extra="forbid", frozen=True):
    """Calibration of one parameter of a network, from windows simulated in the time domain."""

    bias: float = Field(allow_inf_nan=False)  # median error of the logarithmic ratio, to be subtracted
    # Logarithms of stated standard errors in ascending order (knots), and at each the factor on the standard error with
    # which its 95 % interval contains 95 %.
    log_deviation: tuple[Annotated[float, Field(allow_inf_nan=False)], ...] = Field(min_length=1)
    z_scale: tuple[Annotated[float, Field(gt=0, allow_inf_nan=False)], ...] = Field(min_length=1)
    # Degrees of freedom of the scaled errors (Student's t); None for a normal distribution.
    freedom: float | None = Field(default=None, gt=0, allow_inf_nan=False)

    def scale(self, deviation: FloatArray) -> FloatArray:
        """Factor for stated standard errors."""
        return np.asarray(np.interp(np.log(deviation), self.log_deviation, self.z_scale), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class NearNetworks:
    """Networks of the second reading: forces are computed with the machine as read first, and the remainder is read."""

    basis: FeatureBasis  # without novelty, which the first reading's basis judges
    networks: tuple[AmortisedNetwork, ...]


@dataclass(frozen=True, slots=True)
class AmortisedNetworks:
    """All amortised networks of one machine."""

    states: tuple[str, ...]  # measured states they were trained with
    basis: FeatureBasis
    networks: tuple[AmortisedNetwork, ...]
    calibration: dict[str, Calibration]  # for every parameter; empty before calibration
    novelty_limit: float  # largest `FeatureBasis.novelty` that is evaluated
    log_range: float  # parameters were drawn up to this logarithmic ratio, either sign
    # Calibration for windows whose forces are as coherent as those of one source; empty if the same as for others.
    coherent: dict[str, Calibration] = field(default_factory=dict)
    coherence_limit: float = 1.0  # mean squared coherence of the forces beyond which `coherent` applies
    near: NearNetworks | None = None

    def calibration_at(self, coherence: float) -> dict[str, Calibration]:
        """Calibration for a window with this mean squared coherence of the forces."""
        return self.coherent if self.coherent and coherence > self.coherence_limit else self.calibration


def around(machine: Machine, log_ratio: FloatArray) -> Machine:
    """The machine with its parameters changed by these logarithmic ratios, in the order of `PARAMETERS`."""
    changes = dict(zip(PARAMETERS, np.expm1(log_ratio).tolist(), strict=True))
    return machine.model_copy(update={"rotor": changed(machine.rotor, changes)})


class NetworkDiagnostician:
    """Reads all parameters of a window from the amortised networks."""

    by = "network"

    def __init__(self, machine: Machine, amortised: AmortisedNetworks) -> None:
        self._machine, self._amortised = machine, amortised
        self._features = ForceFeatures(machine, amortised.states)

    def inputs(self, window: WindowStatistics) -> tuple[Float32Array, float] | None:
        """Inputs of the first reading; None if the window lacks a state that the networks were trained with.

        These are the standardised inputs, shape (1, n_inputs), with those of equation 29 only if there is a phase
        reference, and the mean squared coherence of the forces on the nominal machine, over all pairs and frequencies,
        0 to 1.
        """
        if any(name not in window.states for name in self._amortised.states):
            return None
        none = np.empty((1, 0), dtype=np.float32)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # a dead channel shows as novelty
            inputs, series = self._standardised(window, self._amortised.basis, self._features, none)
            return inputs, self._features.coherence(series)

    def _standardised(
        self, window: WindowStatistics, basis: FeatureBasis, features: ForceFeatures, centre: Float32Array
    ) -> tuple[Float32Array, Float32Array]:
        """Standardised inputs, and the functions of frequency from which they are condensed."""
        spectrum, synchronous = window.spectrum_without_lines[None], window.synchronous
        if window.states != self._amortised.states:
            columns = [window.states.index(name) for name in self._amortised.states]
            spectrum = spectrum[:, :, columns][:, :, :, columns]
            synchronous = None if synchronous is None else synchronous[columns]
        speed = np.array([window.speed_rad_s])
        series = features.series(features.force(spectrum))
        parts = [condensed(series, basis.mean, basis.directions), centre, features.consistency(spectrum, speed)]
        if synchronous is not None and basis.centre.size > basis.n_common:
            parts.append(features.unbalance(spectrum, synchronous[None], speed))
        return basis.standardised(np.concatenate(parts, axis=1)), series

    def stated(self, window: WindowStatistics, inputs: Float32Array) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Uncalibrated mean and Cholesky factor of the logarithmic ratios, for every equation that has its inputs.

        They are those of the second reading, unless a parameter is too uncertain in the first or out of range in
        either; then those of the first.
        """
        first, near = _outputs(self._amortised.networks, inputs), self._amortised.near
        if near is None:
            return first
        centre, own = np.zeros(len(PARAMETERS)), {name: [PARAMETERS.index(one) for one in OWN[name]] for name in first}
        trained = np.array([NEAR[name] for name in PARAMETERS])
        for equation, (mean, factor) in first.items():
            sharp = np.all(np.linalg.norm(factor, axis=1) <= trained[own[equation]])
            if not (sharp and np.all(np.abs(mean) <= self._amortised.log_range)):  # false for NaN, too
                return first
            centre[own[equation]] = mean
        features = self._features.around(around(self._machine, centre))
        again, _ = self._standardised(window, near.basis, features, centre[None].astype(np.float32))
        remainder = _outputs(near.networks, again)
        if not all(np.all(np.abs(mean) <= trained[own[name]]) for name, (mean, _) in remainder.items()):
            return first
        return {name: (centre[own[name]] + mean, factor) for name, (mean, factor) in remainder.items()}

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        """Judge one window; never raises: a parameter that cannot be read carries the reason."""
        amortised = self._amortised
        seen = self.inputs(window)
        if seen is None:
            absent = ", ".join(name for name in amortised.states if name not in window.states)
            return self._refused(f"not measured: {absent}")
        inputs, coherence = seen
        apart = self._disagreement(inputs)
        if apart:
            return self._refused(f"displacement and rate disagree: {apart}; at most {_MOST_APART:.0%} is evaluated")
        novelty = float(amortised.basis.novelty(inputs)[0]) if np.all(np.isfinite(inputs)) else np.inf
        if not novelty <= amortised.novelty_limit:
            text, limit = beyond(novelty, float(f"{amortised.novelty_limit:.3g}"))
            return self._refused(
                f"the window is unlike what the networks were trained on ({text} apart, evaluation limit {limit})"
            )
        readings: list[Parameter] = []
        blocks: list[FloatArray] = [np.empty((0, 0))]
        calibration = amortised.calibration_at(coherence)
        stated = self.stated(window, inputs)
        for network in amortised.networks:
            if network.equation not in stated:
                readings += [no_reading(name, self.by, "no phase reference") for name in OWN[network.equation]]
                continue
            read, covariance = self._read(network.equation, *stated[network.equation], calibration)
            readings += read
            blocks.append(covariance)
        freedom = {name: one.freedom for name, one in calibration.items() if one.freedom is not None}
        return Diagnosis(self.by, tuple(readings), covariance=block_diag(*blocks), freedom=freedom)

    def _disagreement(self, inputs: Float32Array) -> str:
        """Displacements that differ too much from their rates, and by how much; empty if none does."""
        basis, n = self._amortised.basis, self._features.n_consistency
        own = slice(basis.n_common - n, basis.n_common)
        raw = inputs[:, own] * basis.scale[own] + basis.centre[own]
        apart = {name: float(value[0]) for name, value in self._features.disagreement(raw).items()}
        far = {name: value for name, value in apart.items() if value > _MOST_APART}
        return ", ".join(f"{name} by {beyond(100 * value, 100 * _MOST_APART)[0]} %" for name, value in far.items())

    def _read(
        self, equation: str, mean: FloatArray, factor: FloatArray, calibrations: dict[str, Calibration]
    ) -> tuple[list[Parameter], FloatArray]:
        """Readings of one equation's parameters, and the covariance of those with a number."""
        covariance, most = factor @ factor.T, self._amortised.log_range
        readings, kept, scales = [], [], []
        for position, name in enumerate(OWN[equation]):
            log_ratio, deviation = float(mean[position]), float(np.sqrt(covariance[position, position]))
            calibration, scale = calibrations.get(name), 1.0
            if calibration is not None:
                log_ratio -= calibration.bias
                scale = float(calibration.scale(np.array(deviation)))
            ratio = float(np.exp(log_ratio))
            error = ratio * scale * deviation
            if abs(log_ratio) > most:
                reason = f"beyond the changes trained for ({np.expm1(-most):+.0%} to {np.expm1(most):+.0%})"
                readings.append(no_reading(name, self.by, reason))
            elif not error < _VAGUE:
                readings.append(no_reading(name, self.by, not_determined(error, _VAGUE)))
            else:
                readings.append(parameter_reading(name, self.by, ratio - 1, error))
                kept.append(position)
                scales.append(ratio * scale)
        return readings, covariance[np.ix_(kept, kept)] * np.outer(scales, scales)

    def _refused(self, reason: str) -> Diagnosis:
        names = [name for network in self._amortised.networks for name in OWN[network.equation]]
        return Diagnosis(self.by, tuple(no_reading(name, self.by, reason) for name in names))


def _outputs(networks: tuple[AmortisedNetwork, ...], inputs: Float32Array) -> dict[str, tuple[FloatArray, FloatArray]]:
    found: dict[str, tuple[FloatArray, FloatArray]] = {}
    for network in networks:
        n_inputs = network.direct.shape[0]
        if inputs.shape[1] >= n_inputs:
            mean, factor = network(np.clip(inputs[:, :n_inputs], -LIMIT, LIMIT))
            found[network.equation] = mean[0], factor[0]
    return found
