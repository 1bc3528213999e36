"""Evaluation of one window: physical parameters by likelihood, the equations' networks beside them."""

from dataclasses import dataclass

import numpy as np

from models.diagnosis.bundle import Bundle
from models.diagnosis.equations import EQUATIONS
from models.diagnosis.likelihood import LikelihoodFit
from models.diagnosis.networks import read_equation
from models.diagnosis.readings import EquationReading, ParameterReading
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.physics.parameters import PARAMETERS

__all__ = ["Evaluation", "WindowEvaluator"]

_VAGUE = 0.2
"""A larger standard error is no longer one: the reading says nothing."""

_PLANES = {"k_by": "y", "c_by": "y", "k_bz": "z", "c_bz": "z"}
"""Plane in which a bearing parameter acts."""

_STEADY = 0.05
"""Range of speed within a window, relative: what the changing 1x leaves behind then stays next to the excluded line."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What the diagnosticians say about a window.

    Attributes
    ----------
    parameters : tuple of ParameterReading
        Every parameter, by likelihood, in the order of `PARAMETERS`.
    equations : tuple of EquationReading
        Every equation of the table, by its network, or why not.
    speed_rad_s : float or None
        Mean speed.
    misfit : float
        How much worse the theory fits than sampling alone explains.
    """

    parameters: tuple[ParameterReading, ...]
    equations: tuple[EquationReading, ...]
    speed_rad_s: float | None
    misfit: float


class WindowEvaluator:
    """Evaluates the windows of one machine.

    Parameters
    ----------
    machine : Machine
    bundle : Bundle or None
        Without it the equations are reported as not evaluable.
    """

    def __init__(self, machine: Machine, bundle: Bundle | None) -> None:
        self._machine = machine
        self._networks = {} if bundle is None else {network.equation.number: network for network in bundle.networks}
        self._likelihood = LikelihoodFit(machine)

    def evaluate(self, window: WindowStatistics) -> Evaluation:
        """Evaluate one window.

        Raises
        ------
        EstimationError
            If the window cannot be evaluated: outside the speed range, speed not steady, no fluctuation in a channel.
        """
        operation = self._machine.operation
        speed = float(window.speed_rad_s) if np.isfinite(window.speed_rad_s) else None
        if speed is not None and abs(speed / operation.speed_rad_s - 1) > operation.speed_tolerance:
            raise EstimationError(
                f"{self._machine.site}/{self._machine.name}: speed is {speed * 30 / np.pi:.0f} rpm, evaluated are "
                f"{operation.speed_rpm:.0f} rpm ± {operation.speed_tolerance:.0%}"
            )
        slowest, fastest = window.speed_range
        if speed is not None and fastest - slowest > _STEADY * operation.speed_rad_s:
            raise EstimationError(
                f"{self._machine.site}/{self._machine.name}: speed went from {slowest * 30 / np.pi:.0f} to "
                f"{fastest * 30 / np.pi:.0f} rpm within the window, evaluated is a steady speed (± {_STEADY / 2:.1%})"
            )
        try:
            estimate, equations = self._likelihood.fit(window), self._equations(window)
        except np.linalg.LinAlgError as error:
            raise EstimationError(f"{self._machine.site}/{self._machine.name}: {error} in this window") from error
        values = {
            name: (float(change), float(error))
            for name, change, error in zip(estimate.names, estimate.change, estimate.standard_error, strict=True)
        }
        parameters = tuple(_reading(name, values.get(name), window.states) for name in PARAMETERS)
        return Evaluation(parameters, equations, speed, estimate.misfit)

    def _equations(self, window: WindowStatistics) -> tuple[EquationReading, ...]:
        readings = []
        for equation in EQUATIONS:
            trained = self._networks.get(equation.number)
            if trained is None:
                readings.append(EquationReading(equation.number, equation.title, reason="no trained network"))
            else:
                readings.append(read_equation(trained, window, self._machine))
        return tuple(readings)


def _reading(name: str, value: tuple[float, float] | None, states: tuple[str, ...]) -> ParameterReading:
    """The likelihood's reading of one parameter, or why these sensors do not determine it."""
    plane = _PLANES.get(name)
    if value is None:
        return ParameterReading(name, "likelihood", reason="no phase reference")
    if plane is not None and not any(state.startswith(plane) for state in states):
        return ParameterReading(name, "likelihood", reason=f"no displacement or velocity measured in {plane}")
    change, error = value
    if not error < _VAGUE:
        return ParameterReading(
            name, "likelihood", reason=f"not determined in this window (standard error {error:.0%})"
        )
    return ParameterReading(name, "likelihood", change, error)
