"""The evaluator of a machine's windows, chosen by what is known of the machine.

A machine whose parameters are known, given or identified, is compared with theory (`KnownMachineEvaluator`). One with
healthy recordings only is compared with its baseline (`BaselineEvaluator`) or, where its sensors allow no equation,
channel by channel with its healthy shape.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from models.checkpoint import checked
from models.commissioning.commissioned import Commissioned, Installed
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.rows import evaluable_rows
from models.diagnosis.readings import Diagnosis, no_reading
from models.diagnosis.sensors.disagreement import is_drift
from models.diagnosis.sensors.reference import Naming
from models.diagnosis.verdict.isolation import misfit_beside
from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest
from models.diagnosis.verdict.stretch import apart, determined, stretch_of, with_shared_error
from models.diagnosis.window.moments import Plan, plan_for, states_of
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import MachineFile
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from rotorwatch.records.windows import Equation, NaturalFrequency, SensorFault
from service.monitor.evaluation import Evaluation, LatestRotation, Newest, WindowEvaluator, settled
from service.monitor.known_machine import KnownMachineEvaluator

_SHAPE, _ROTATION, _MODES = "shape", "rotation", "modes"
# Standard deviations of the misfit: up to which a window holds no change and a shorter stretch is explained, and by how
# many a stretch's misfit must be below its share of the window's to be of another machine than the rest.
_MOST_MISFIT_Z, _LESS = 2.0, 3.0
_STRADDLES = "the machine changed within the window: its latest data fit for themselves, all of it together does not"
_NO_EQUATION = "no equation can be evaluated on this machine; natural frequencies or channels are compared instead"


def evaluator_for(installed: Installed) -> WindowEvaluator:
    """The evaluator that fits what is known of the machine."""
    known, commissioned = installed.known, installed.commissioned
    if known is not None:
        return KnownMachineEvaluator(known, installed.bundle, commissioned)
    if commissioned is None:
        return NoEvaluator()
    return BaselineEvaluator(installed.machine, commissioned)


class NoEvaluator(WindowEvaluator):
    """For a machine of which nothing is known: its levels are watched, and nothing is diagnosed."""

    by = "nobody"
    needs_lags = False

    def evaluate(self, window: WindowStatistics, newest: Newest | None = None) -> Evaluation:
        """Say that there is nothing to evaluate, see `WindowEvaluator`."""
        _ = window, newest
        raise EstimationError("only vibration levels are watched: the machine is neither known nor commissioned")


class BaselineEvaluator(WindowEvaluator):
    """Compares the windows of one machine with what was learned on it when it was healthy.

    That is a baseline, or at least the healthy shape of every channel.
    """

    needs_lags = True  # relations hold between correlation functions

    def __init__(self, machine: MachineFile, commissioned: Commissioned) -> None:
        self._place, self._operation = machine.title, machine.operation
        self._rotation = LatestRotation()
        self._conditions = commissioned.conditions
        self._naming = Naming(machine.sensors)
        self._diagnosed = states_of(machine) != ()
        self._lines = commissioned.lines != ()  # without any, relations were learned with all lines left in
        self._modes = commissioned.modes
        # A force unlike the recorded ones changes shapes, too: they are used only where nothing else was learned.
        self._shape = None if commissioned.baselines or commissioned.modes else commissioned.shape
        self._beyond_ns = (0,) * (0 if self._modes is None else len(self._modes.modes))
        self._length_s, self._on_delay_ns = machine.window_data_s, round(machine.alarms.on_delay_s * 1e9)
        self._shape_rate = SequentialSettings.for_machine(machine, short=False).shape_rate
        self._baselines = tuple((one.conditions, BaselineDiagnostician(one.baseline)) for one in commissioned.baselines)
        self.by = self._baselines[0][1].by if self._baselines else _SHAPE
        self.takes_short = self._baselines != ()
        self._plan = plan_for(machine)

    def spared(self, plan: Plan, findings: Sequence[SensorFault]) -> tuple[str, ...] | None:
        """Also despite gains that have drifted a little: readings are widened by them."""
        return super().spared(plan, [one for one in findings if not (self._baselines and is_drift(one))])

    def suffices(self, left: Sequence[str], plan: Plan) -> bool:
        """Whether a relation was learned between these states alone, see `WindowEvaluator`."""
        _ = plan
        return any(one.reads(left) for _, one in self._baselines)

    def evaluate(self, window: WindowStatistics, newest: Newest | None = None) -> Evaluation:
        """Evaluate one window, see `WindowEvaluator`; outside the commissioned conditions it is not evaluable."""
        window, latest = settled(self._place, window, newest)
        outside = self._conditions.outside(window, self._naming)
        if outside:
            here = "not evaluable here" if self._diagnosed else "levels are judged as at the nearest commissioned speed"
            raise EstimationError(f"{self._place}: {here}: {outside}")
        speed = float(window.speed_rad_s) if np.isfinite(window.speed_rad_s) else None
        short: dict[int, Diagnosis] = {}
        if self._baselines:
            deciding = self._diagnose(window)
            self._rotation.take(window)
            unfit = deciding.unexplained != "" or not deciding.evaluable or (deciding.misfit_z or 0.0) > _MOST_MISFIT_Z
            if unfit and self._operation is not None and (lost := self._rotation.lost(window, self._operation)):
                raise EstimationError(f"{self._place}: {lost}")
            if newest is not None:
                deciding, short = self._newest(*newest, deciding, latest, window.lost)
                deciding = self._with_latest_misfit(*newest, deciding, latest, window.lost)
        else:
            nothing = tuple(no_reading(name, _SHAPE, _NO_EQUATION) for name in PARAMETERS)
            deciding = Diagnosis(_SHAPE, nothing, covariance=np.zeros((0, 0)))
        alike = None if deciding.evaluable or window.lost else self._shape
        shapes = () if alike is None else alike.judge(window, self._shape_rate)
        modes: tuple[NaturalFrequency, ...] = ()
        if self._modes is not None and not window.lost:
            modes, self._beyond_ns = self._modes.judge(window.without_lines, self._beyond_ns, self._shape_rate)
        rows = _row_readings(deciding, window)
        return Evaluation(deciding, short, rows, (), speed, shapes, modes, alone=not short)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Power of the rotation line, see `LatestRotation`, and since when natural frequencies are beyond limits."""
        modes = {_MODES: np.array(self._beyond_ns)} if self._beyond_ns else {}
        return {_ROTATION: np.array(self._rotation.power), **modes}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue from where `checkpoint` was called, see `WindowEvaluator`."""
        self._rotation.power = float(checked(arrays, _ROTATION, np.float64, ()))
        if self._beyond_ns:
            self._beyond_ns = tuple(checked(arrays, _MODES, np.int64, (len(self._beyond_ns),)).tolist())

    def _diagnose(self, window: WindowStatistics) -> Diagnosis:
        baseline = self._baseline_for(window)
        clear = (window.without_lines if self._lines else window).with_steady_rotation
        read = baseline.diagnose(clear)
        if self.drifts:
            wrong = [self._square_of(one, read, baseline, clear) for one in self.drifts]
            read = with_shared_error(read, np.diag(np.sum(wrong, axis=0)))
        return determined(read, window, self._length_s)

    def _square_of(
        self, drift: SensorFault, read: Diagnosis, baseline: BaselineDiagnostician, window: WindowStatistics
    ) -> FloatArray:
        """Mean square error of each parameter by a gain that has drifted, (6,), in the scale of `with_shared_error`.

        It is the change by a correction of the sensor or, if either of two may be wrong, of each with equal
        probability. What cannot be read then is taken to change by as much as the gain.
        """
        gain, unaffected = 1 + (drift.value or 0.0), self._plan.states_without(drift.states)
        planes = {state[0] for state in self._plan.states if state not in unaffected}
        kept = [self._plan.states.index(state) for state in window.states]
        unread = [gain - 1 if name[-1] in {"e", *planes} else 0.0 for name in PARAMETERS]
        squares = np.zeros(len(PARAMETERS))
        for state, factor in zip(reversed(drift.states), (1 / gain, gain), strict=False):
            corrected = baseline.diagnose(window.turned(self._plan.gain(state, factor)[np.ix_(kept, kept)]))
            changes = apart(read, corrected)
            squares += np.where(np.isnan(changes), unread, changes) ** 2 / len(drift.states)
        return squares

    def _newest(
        self, sliding: SlidingWindow, test: SequentialTest, deciding: Diagnosis, latest: int, lost: tuple[str, ...]
    ) -> tuple[Diagnosis, dict[int, Diagnosis]]:
        """Diagnoses of the window and, if it may straddle a change, of its newest hops by their number, up to `latest`.

        A short stretch has little power: on a machine that no parameter describes, its misfit is smaller just because
        it is shorter, which is no evidence of changed parameters. So where the window is outside the model, a stretch
        counts only if some of the window was explained before, and if it is well inside with a misfit clearly below its
        share of the window's. The window then straddles a change.
        """
        found: dict[int, Diagnosis] = {}
        whole, misfit_z = test.settings.window_hops, deciding.misfit_z or 0.0
        if misfit_z <= _MOST_MISFIT_Z and test.wanted() == test.settings.short_hops:
            return deciding, found
        limit, start_ns = test.settings.thresholds(whole).outside, sliding.hops[0].start_ns
        outside = misfit_z > limit
        before = [one for one in test.state.sums.get(1, ()) if one.end_ns > start_ns and not one.unexplained]
        if outside and not any((one.misfit_z or 0.0) <= limit for one in before):
            return deciding, found
        for hops in filter(latest.__ge__, test.wanted()):
            with suppress(EstimationError):  # too little data for itself, or outside the commissioned conditions
                if (statistics := sliding.statistics(hops, lagged=True, lost=lost)) is not None:
                    read = self._diagnose(statistics)
                    most = min(_MOST_MISFIT_Z, misfit_z * (hops / whole) ** 0.5 - _LESS) if outside else _MOST_MISFIT_Z
                    if not read.unexplained and (read.misfit_z or 0.0) < most:
                        found[hops] = read
        if found and outside and not deciding.unexplained:
            deciding = replace(deciding, unexplained=_STRADDLES)
        return deciding, found

    def _with_latest_misfit(
        self, sliding: SlidingWindow, test: SequentialTest, deciding: Diagnosis, latest: int, lost: tuple[str, ...]
    ) -> Diagnosis:
        """The window's diagnosis, with the misfit of its latest hops if an unbalance is named and theirs is larger.

        Where a foundation goes soft, an unbalance stands out first: while most of the window is from before the change,
        it fits, but its latest hops alone do not, or only if parameters that are not named have changed. They are
        evaluated once an alarm is due, as an unbalance may be the first guess for a bearing, too.
        """
        names, hops = test.astride, min(test.settings.short_hops, default=latest + 1)
        due_ns = sliding.hops[-1].end_ns - self._on_delay_ns
        due = any(one.name == "e" and one.found_ns <= due_ns for one in test.state.findings)
        if not due or "e" not in names or latest < hops:
            return deciding
        with suppress(EstimationError):
            if (statistics := sliding.statistics(hops, lagged=True, lost=lost)) is not None:
                misfit_z = misfit_beside(stretch_of(self._diagnose(statistics), 0, 1), names)
                return replace(deciding, misfit_z=max(misfit_z, deciding.misfit_z or 0.0))
        return deciding

    def _baseline_for(self, window: WindowStatistics) -> BaselineDiagnostician:
        """The baseline that was learned in the window's conditions."""
        reasons = []
        for conditions, baseline in self._baselines:
            if not (outside := conditions.outside(window, self._naming)):
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
        read = () if reason else own
        found.append(
            Equation(equation=row.number, title=row.title, evaluable=not reason, parameters=read, reason=reason)
        )
    return tuple(found)
