"""The per-equation network: one hidden layer of fifteen neurons (Eq. 32), evaluated in numpy.

Training needs torch, evaluation does not: the monitor starts without it and gives the same numbers everywhere.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field

from models.diagnosis.networks.equations import EQUATIONS, Equation, StatisticsView, SynchronousEquation, missing
from models.diagnosis.readings import Diagnosis, no_reading, possible_reading
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine
from models.signals.block import FloatArray
from rotorwatch.records.windows import Equation as EquationReading
from rotorwatch.records.windows import Parameter

HIDDEN = 15  # neurons of the hidden layer, as in the paper
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@dataclass(frozen=True, slots=True)
class Network:
    """A multi-layer perceptron with one hidden layer and one output."""

    input_scale: FloatArray  # (n_inputs,), divisors of the inputs
    W1: FloatArray
    b1: FloatArray
    W2: FloatArray  # (15,)
    b2: FloatArray  # (1,)

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """Output for each row of inputs, shape (…, n_rows)."""
        hidden = inputs @ (2 * self.W1 / self.input_scale[:, np.newaxis])
        hidden += 2 * self.b1
        with np.errstate(over="ignore"):  # tanh x = 1 - 2 / (e²ˣ + 1), in half the time of numpy's
            np.exp(hidden, out=hidden)
        hidden += 1
        return np.asarray(self.W2.sum() + self.b2[0] - 1 / hidden @ (2 * self.W2), dtype=np.float64)


class Healthy(BaseModel, extra="forbid", frozen=True):
    """Calibration of an equation on windows that training did not see, by own parameter."""

    windows: int = Field(ge=1)
    msd: float = Field(ge=0)  # mean of the mean squared deviation
    # Factor on the scatter over the hops with which, together with `floor`, 95 % intervals contain 95 %.
    z_scale: tuple[_Positive, ...]
    spread: tuple[_NotNegative, ...]  # robust standard deviation of each own parameter's reading
    # Error of the relative change that all hops of a window share, so that their scatter misses it; empty for none.
    floor: tuple[_NotNegative, ...] = ()
    # Part of a change that is read, as the network explains the rest by itself; empty if all is read.
    gain: tuple[_Positive, ...] = ()
    freedom: tuple[_Positive, ...] = ()  # degrees of freedom of the errors (Student's t); empty if normal


@dataclass(frozen=True, slots=True)
class EquationNetwork:
    """A trained network with its equation and, once calibrated, its calibration."""

    equation: Equation | SynchronousEquation
    network: Network
    healthy: Healthy | None


def window_view(window: WindowStatistics, machine: Machine, *, by_hop: bool = False) -> StatisticsView:
    """Statistics of the window that equations need; `by_hop`, and then those of each hop, along the first axis.

    Lags start at ``lag_from_s``, because shorter ones contain the excitation itself.
    """
    first = int(np.searchsorted(window.lags_s, machine.window.lag_from_s - 1e-9))
    speed = window.speed_rad_s if np.isfinite(window.speed_rad_s) else machine.operation.speed_rad_s
    correlation, synchronous = window.correlation[first:], window.synchronous
    if by_hop:
        correlation = np.concatenate([correlation[np.newaxis], window.hop_correlation[:, first:]])
        vectors = window.hop_synchronous
        synchronous = None if synchronous is None or vectors is None else np.vstack([synchronous, vectors])
    return StatisticsView(window.states, correlation, synchronous, speed)


def read_equation(
    trained: EquationNetwork, window: WindowStatistics, machine: Machine, view: StatisticsView | None = None
) -> EquationReading:
    """Evaluate one equation on one window, whose `view` by hops may be known already.

    The residual is projected on the signatures of the equation's own parameters: this detects a change, assigns it to a
    parameter and sizes it in one step. The standard error comes from the scatter over the window's hops and, from the
    calibration, the error that all hops share.
    """
    equation = trained.equation
    absent = missing(equation, window.states if window.synchronous is None else (*window.states, "theta"))
    if absent:
        return not_read(equation, f"not measured: {', '.join(absent)}")
    rows = equation.rows(view or window_view(window, machine, by_hop=True), machine)
    norm = replace(rows, target=rows.target[0]).norm
    if not norm > 0:
        return not_read(equation, "the target correlation is zero")
    residuals = rows.target / norm - trained.network(rows.inputs / norm)
    projection = np.linalg.pinv(rows.signatures[0] / norm)
    change, hops = projection @ residuals[0], residuals[1:] @ projection.T
    error = hops.std(axis=0, ddof=1) / np.sqrt(hops.shape[0])
    healthy = trained.healthy
    if healthy is not None:
        change = change / (healthy.gain or 1.0)
        error = np.hypot(np.multiply(healthy.z_scale, error), healthy.floor or 0.0)
    readings = zip(equation.parameters, change.tolist(), error.tolist(), strict=True)
    return EquationReading(
        equation=equation.number,
        title=equation.title,
        evaluable=True,
        msd=float(np.mean(residuals[0] ** 2)),
        msd_healthy=None if healthy is None else healthy.msd,
        parameters=tuple(possible_reading(name, "relation", value, spread) for name, value, spread in readings),
    )


def equation_by_number(number: str) -> Equation | SynchronousEquation:
    """Look up an equation; KeyError if its number is not in the table."""
    return {equation.number: equation for equation in EQUATIONS}[number]


def not_read(equation: Equation | SynchronousEquation, reason: str) -> EquationReading:
    """Reading of an equation that cannot be evaluated, with the reason."""
    return EquationReading(equation=equation.number, title=equation.title, evaluable=False, reason=reason)


class RelationDiagnostician:
    """Reads the parameters of a window from the residuals of equations (28)-(31)."""

    by = "relation"

    def __init__(self, machine: Machine, networks: tuple[EquationNetwork, ...]) -> None:
        self._machine = machine
        self._networks = {trained.equation.number: trained for trained in networks}
        self._freedom = {
            name: freedom
            for trained in networks
            if trained.healthy is not None and trained.healthy.freedom
            for name, freedom in zip(trained.equation.parameters, trained.healthy.freedom, strict=True)
        }
        self._taken_for = {
            trained.equation.parameters[0]: trained.equation.taken_for(machine)
            for trained in networks
            if isinstance(trained.equation, SynchronousEquation)
        }

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        """Judge one window; never raises: an equation that cannot be evaluated carries its reason."""
        equations: list[EquationReading] = []
        parameters: list[Parameter] = []
        view = window_view(window, self._machine, by_hop=True)
        for equation in EQUATIONS:
            trained, reading = self._networks.get(equation.number), not_read(equation, "no trained network")
            if trained is not None:
                reading = read_equation(trained, window, self._machine, view)
            equations.append(reading)
            parameters += reading.parameters or [
                no_reading(name, self.by, reading.reason) for name in equation.parameters
            ]
        return Diagnosis(self.by, tuple(parameters), tuple(equations), freedom=self._freedom, taken_for=self._taken_for)
