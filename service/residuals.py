"""Evaluation of one window: several diagnosticians side by side, and whether they agree."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from models.diagnosis.likelihood.lengths import LengthFits
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.networks.relation import RelationDiagnostician
from models.diagnosis.readings import Diagnosis, Diagnostician, EquationReading, ParameterReading
from models.diagnosis.verdict.agreement import Agreement, agreements
from models.diagnosis.verdict.determined import determined
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine

__all__ = ["Evaluation", "Opinion", "WindowEvaluator"]

_STEADY = 0.05
"""Range of speed within a window, relative: what the changing 1x leaves behind then stays next to the excluded line."""


@dataclass(frozen=True, slots=True)
class Opinion:
    """What a diagnostician beside the deciding one says.

    Attributes
    ----------
    by : str
        Who.
    parameters : tuple of ParameterReading
        What it reads.
    agreement : tuple of Agreement
        How that compares with the likelihood.
    reason : str
        Why it could say nothing of this window; empty if it could.
    """

    by: str
    parameters: tuple[ParameterReading, ...] = ()
    agreement: tuple[Agreement, ...] = ()
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What the diagnosticians say about a window.

    Attributes
    ----------
    deciding : Diagnosis
        The likelihood's, every parameter in the order of `PARAMETERS`.
    short : dict of int to Diagnosis
        The same of the latest hops, by how many; without those that could not be evaluated.
    equations : tuple of EquationReading
        Every equation of the table, by its network, or why not.
    opinions : tuple of Opinion
        What the others say.
    speed_rad_s : float or None
        Mean speed.
    """

    deciding: Diagnosis
    short: Mapping[int, Diagnosis]
    equations: tuple[EquationReading, ...]
    opinions: tuple[Opinion, ...]
    speed_rad_s: float | None


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
        self._place = f"{machine.site}/{machine.name}"
        self._likelihood = LengthFits(machine)
        others: list[Diagnostician] = []
        if bundle is not None and bundle.amortised is not None:
            others.append(NetworkDiagnostician(machine, bundle.amortised))
        others.append(RelationDiagnostician(machine, () if bundle is None else bundle.networks))
        self._others = tuple(others)

    def evaluate(self, window: WindowStatistics, short: Mapping[int, WindowStatistics]) -> Evaluation:
        """Evaluate one window.

        Parameters
        ----------
        window : WindowStatistics
            The full window.
        short : mapping of int to WindowStatistics
            Its latest hops, by how many.

        Raises
        ------
        EstimationError
            If the window cannot be evaluated: outside the speed range, speed not steady, no fluctuation in a channel.
        """
        speed = self._speed(window)
        deciding = self._decide(window, self._likelihood.window)
        evaluated = {}
        for hops, statistics in short.items():
            try:
                evaluated[hops] = self._decide(statistics, partial(self._likelihood.short, hops))
            except EstimationError:
                continue  # too little data for itself; the window has said what there is to say
        equations: tuple[EquationReading, ...] = ()
        opinions = []
        for other in self._others:
            try:
                diagnosis = other.diagnose(window)
            except (EstimationError, np.linalg.LinAlgError) as error:
                opinions.append(Opinion(other.by, reason=str(error)))
                continue
            equations = diagnosis.equations or equations
            opinions.append(_opinion(deciding, diagnosis))
        return Evaluation(deciding, evaluated, equations, tuple(opinions), speed)

    def _speed(self, window: WindowStatistics) -> float | None:
        """Mean speed, if it is one that is evaluated."""
        if not np.isfinite(window.speed_rad_s):
            return None
        operation, speed = self._machine.operation, float(window.speed_rad_s)
        if abs(speed / operation.speed_rad_s - 1) > operation.speed_tolerance:
            raise EstimationError(
                f"{self._place}: speed is {speed * 30 / np.pi:.0f} rpm, evaluated are "
                f"{operation.speed_rpm:.0f} rpm ± {operation.speed_tolerance:.0%}"
            )
        slowest, fastest = window.speed_range
        if fastest - slowest > _STEADY * operation.speed_rad_s:
            raise EstimationError(
                f"{self._place}: speed went from {slowest * 30 / np.pi:.0f} to "
                f"{fastest * 30 / np.pi:.0f} rpm within the window, evaluated is a steady speed (± {_STEADY / 2:.1%})"
            )
        return speed

    def _decide(self, window: WindowStatistics, diagnose: Callable[[WindowStatistics], Diagnosis]) -> Diagnosis:
        """The likelihood's diagnosis with what these sensors do not determine taken out."""
        try:
            diagnosis = diagnose(window)
        except np.linalg.LinAlgError as error:
            raise EstimationError(f"{self._place}: {error} in this window") from error
        return determined(diagnosis, window, self._machine.window.length_s)


def _opinion(deciding: Diagnosis, other: Diagnosis) -> Opinion:
    """What another diagnostician says; one that could read nothing says why, once."""
    if other.evaluable:
        return Opinion(other.by, other.parameters, agreements(deciding, other))
    reasons = dict.fromkeys(reading.reason for reading in other.parameters)
    return Opinion(other.by, other.parameters, reason="; ".join(reasons) or "nothing to read")
