"""What evaluates the windows of a machine, by what is known of it.

A machine whose parameters are known, given or identified, is compared with theory (`KnownMachineEvaluator`). One of
which only healthy recordings are known is compared with its baseline (`BaselineEvaluator`), and where its sensors allow
no equation, each channel with its own healthy form.
"""

import numpy as np

from models.commissioning.commissioned import Commissioned, Installed
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.rows import evaluable_rows
from models.diagnosis.moments import states_of
from models.diagnosis.readings import Diagnosis, no_reading
from models.diagnosis.sensors.reference import Naming
from models.diagnosis.verdict.sequential import SequentialSettings
from models.diagnosis.verdict.stretch import determined
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import MachineFile
from models.physics.rotor import PARAMETERS
from rotorwatch.records.windows import Equation
from service.monitor.evaluation import Evaluation, Newest, WindowEvaluator
from service.monitor.known_machine import KnownMachineEvaluator

_SHAPE = "shape"
_NO_EQUATION = "no equation can be evaluated on this machine; see the result for each channel"


def evaluator_for(installed: Installed) -> WindowEvaluator:
    """The evaluator that what is known of the machine allows."""
    known, commissioned = installed.known, installed.commissioned
    if known is not None:
        return KnownMachineEvaluator(known, installed.bundle, commissioned)
    if commissioned is None:
        return NoEvaluator()
    return BaselineEvaluator(installed.machine, commissioned)


class NoEvaluator(WindowEvaluator):
    """Of a machine of which nothing is known: its levels are watched, and nothing is diagnosed."""

    by = "nobody"
    needs_lags = False

    def evaluate(self, window: WindowStatistics, newest: Newest | None = None) -> Evaluation:
        """Say that there is nothing to evaluate, see `WindowEvaluator`."""
        _ = window, newest
        raise EstimationError("only vibration levels are watched: the machine is neither known nor commissioned")


class BaselineEvaluator(WindowEvaluator):
    """Compares the windows of one machine with what was learned on it when it was healthy.

    Parameters
    ----------
    commissioned : Commissioned
        With a baseline, or at least the healthy shape of every channel.
    """

    needs_lags = True  # relations hold between correlation functions

    def __init__(self, machine: MachineFile, commissioned: Commissioned) -> None:
        self._place = machine.title
        self._conditions = commissioned.conditions
        self._naming = Naming(machine.sensors)
        self._diagnosed = states_of(machine) != ()
        self._lines = commissioned.lines != ()  # without any, relations were learned with all that the windows held
        self._shape = commissioned.shape
        self._length_s = machine.window_data_s
        self._shape_rate = SequentialSettings.for_machine(machine, short=False).shape_rate
        self._baselines = tuple((one.conditions, one.baseline.diagnostician()) for one in commissioned.baselines)
        self.by = self._baselines[0][1].by if self._baselines else _SHAPE

    def evaluate(self, window: WindowStatistics, newest: Newest | None = None) -> Evaluation:
        """Evaluate one window, see `WindowEvaluator`; outside the commissioned conditions it is not evaluable."""
        _ = newest
        outside = self._conditions.outside(window, self._naming)
        if outside:
            here = "not evaluable here" if self._diagnosed else "levels are judged as at the nearest commissioned speed"
            raise EstimationError(f"{self._place}: {here}: {outside}")
        speed = float(window.speed_rad_s) if np.isfinite(window.speed_rad_s) else None
        if self._baselines:
            clear = window.without_lines if self._lines else window
            deciding = determined(self._baseline_for(window).diagnose(clear), window, self._length_s)
        else:
            nothing = tuple(no_reading(name, _SHAPE, _NO_EQUATION) for name in PARAMETERS)
            deciding = Diagnosis(_SHAPE, nothing, covariance=np.zeros((0, 0)))
        shapes = () if self._shape is None or deciding.evaluable else self._shape.judge(window, self._shape_rate)
        return Evaluation(deciding, {}, _row_readings(deciding, window), (), speed, shapes)

    def _baseline_for(self, window: WindowStatistics) -> BaselineDiagnostician:
        """The baseline of these conditions."""
        reasons = []
        for conditions, baseline in self._baselines:
            outside = conditions.outside(window, self._naming)
            if not outside:
                return baseline
            reasons.append(outside)
        raise EstimationError(f"{self._place}: not evaluable here: {'; '.join(reasons)}")


def _row_readings(deciding: Diagnosis, window: WindowStatistics) -> tuple[Equation, ...]:
    """The learned rows, each with the readings of its own parameters or why there are none."""
    readings = {reading.name: reading for reading in deciding.parameters}
    found = []
    for row, lacking in evaluable_rows(window.states, bool(np.isfinite(window.speed_rad_s))):
        own = tuple(readings[each.parameter] for each in row.own)
        reasons = dict.fromkeys(reading.reason for reading in own if reading.reason)
        reason = lacking or ("" if any(reading.relative_change is not None for reading in own) else "; ".join(reasons))
        found.append(
            Equation(
                equation=row.number,
                title=row.title,
                evaluable=not reason,
                parameters=() if reason else own,
                reason=reason,
            )
        )
    return tuple(found)
