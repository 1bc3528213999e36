"""Evaluation of a machine whose parameters are known, given or identified: its windows are compared with theory."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Literal

import numpy as np

from models.checkpoint import checked, prefixed, unprefixed
from models.commissioning.commissioned import Commissioned, in_sense
from models.diagnosis.likelihood.lengths import LengthFits
from models.diagnosis.misfit import Rival
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.networks.relation import RelationDiagnostician
from models.diagnosis.readings import Diagnosis, Diagnostician, beyond, no_reading, reversed_signs
from models.diagnosis.sensors.disagreement import is_drift
from models.diagnosis.sensors.reference import implicated
from models.diagnosis.verdict.calibration import beside
from models.diagnosis.verdict.sequential import SequentialTest
from models.diagnosis.verdict.stretch import apart, determined, with_shared_error
from models.diagnosis.window.moments import STEADY, Plan
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError, UnexplainedError
from models.machine import Machine
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from rotorwatch.records.windows import Equation, Opinion, SensorFault
from service.monitor.evaluation import Evaluation, LatestRotation, Newest, WindowEvaluator, opinion_of, settled

_LIKELIHOOD, _EXPLAINED, _SENSE, _DIRECTED, _ROTATION = "likelihood", "explained_ns", "sense", "directed", "rotation"
_MOST_SPEED_RANGE = 0.15
"""Relative range of speed within a window up to which removing the rotation hop by hop leaves nothing behind: on the
rotor kit readings stay unbiased at ramps of 5, 10 and 15 % (16 seeds each,
``tests/diagnosis/window/test_window.py``)."""

_MOST_MISFIT_Z, _LEAST_MISFIT_DROP, _LEAST_FOREIGN_MISFIT = 2.0, 3.0, 8.0
"""Standard deviations of the misfit: up to which a window is explained beyond doubt, by which one explanation must be
better than another, and assigned at least to a window that is outside the model for other reasons than its spectra."""
_MOST_UNBALANCE_RATIO, _LEAST_STANDARD_ERRORS = 20.0, 3.0
"""Largest credible multiple of the machine file's unbalance, and by how many standard errors it must be exceeded: a
lost blade makes ten times the unbalance, millimetres in place of micrometres a thousand times."""
_LEAST_MISFIT_TO_SPLIT = 4.0
"""Standard deviations of the misfit from which the short stretches of a window are tested on their own."""
_MOST_DRIFTS = 2  # pairs of sensors one of which has drifted: every choice of those to leave out takes a fit


class KnownMachineEvaluator(WindowEvaluator):
    """Compares the windows of one machine with theory.

    Without a bundle the equations are reported as not evaluable. A commissioning gives the uncertainty of identified
    parameters, which is part of every reading, and the healthy windows' misfit, with which that of others is compared.
    """

    by = "likelihood"
    takes_short = True
    despite_drift = "without one of them"

    def __init__(self, machine: Machine, bundle: Bundle | None, commissioned: Commissioned | None = None) -> None:
        identified = None if commissioned is None else commissioned.identified
        self._shared = None if identified is None else identified.matrix()
        self._commissioned = commissioned is not None
        # A commissioned machine's unbalance has a known size only if the commissioning identified it.
        self._sized = commissioned is None or (identified is not None and "e" in identified.names)
        self._healthy_misfit = None if commissioned is None else commissioned.misfit
        self.needs_lags = bundle is not None  # only the networks look at lags
        self._explained_ns: int | None = None
        self._given, self._bundle = machine, bundle
        # The sense of the gyroscopic moments is open until a window has been explained.
        self._sense_open, self._sense_opposite = commissioned is None, False
        # If the file gives no angle of the heavy spot, the assumed one is checked in the first window that shows it.
        given = "unbalance_phase_rad" in machine.operation.model_fields_set
        self._angle_unchecked = commissioned is None and not given
        self._tried_ns, self._tried_in_vain = 0, False  # end of the window on which the other sense was tried
        self._rotation = LatestRotation()
        self._drift_error: FloatArray | None = None  # of the latest window, for `with_shared_error`
        self._reversed = ""  # why the latest window and its newest hops say nothing of the unbalance
        self._compare_with(machine)

    def _compare_with(self, machine: Machine) -> None:
        self._machine, bundle = machine, self._bundle
        self._likelihood = LengthFits(machine, sized=self._sized)
        others: list[Diagnostician] = []
        if bundle is not None and bundle.amortised is not None:
            others.append(NetworkDiagnostician(machine, bundle.amortised))
        others.append(RelationDiagnostician(machine, () if bundle is None else bundle.networks))
        self._others = tuple(others)

    def spared(self, plan: Plan, findings: Sequence[SensorFault]) -> tuple[str, ...] | None:
        """Also despite gains that have drifted a little: one sensor of each pair is left out, see `WindowEvaluator`."""
        drifts = [one for one in findings if is_drift(one) and not set(one.states).issubset(plan.others)]
        lost = super().spared(plan, [one for one in findings if one not in drifts])
        if lost is None or not drifts:
            return lost
        named = {*lost, *implicated([one for one in drifts if len(one.states) == 1])}
        pairs = [one.states for one in drifts if named.isdisjoint(one.states)]
        left = plan.states_without({*named, *(first for first, _ in pairs)})
        can = plan.angle_column is not None and len(pairs) <= _MOST_DRIFTS and self.suffices(left, plan)
        return tuple(sorted(named)) if can else None

    def suffices(self, left: Sequence[str], plan: Plan) -> bool:
        """Whether most states are left, as the theory holds for any set of sensors; see `WindowEvaluator`."""
        return len(left) > len(plan.states) / 2

    def evaluate(self, window: WindowStatistics, newest: Newest | None = None) -> Evaluation:
        """Evaluate one window, see `WindowEvaluator`."""
        window, latest = settled(self._machine.title, window, newest)
        speed = self._speed(window)
        self._rotation.take(window)
        self._reversed = reversed_signs(window)
        window = self._without_drifted(window, newest)
        window = window if self.directed else replace(window, directed=False)
        deciding = self._diagnose_window(window)
        if self._sense_open:
            deciding = self._try_other_sense(window, deciding)
        if self._contradicts_assumed_angle(deciding):
            self.directed, window = False, replace(window, directed=False)
            deciding = self._diagnose_window(window)
        deciding = self._require_steady_speed(window, self._check_unbalance(deciding))
        short = {} if newest is None else self._newest(window, *newest, deciding, latest)
        if not deciding.unexplained:
            self._explained_ns = window.end_ns
        elif self._explained_ns is None and not self._commissioned:
            advice = "if this is its healthy state, commission it"
            deciding = replace(deciding, unexplained=f"{deciding.unexplained}; {advice}")
        equations: tuple[Equation, ...] = ()
        opinions = []
        for other in self._others:
            try:
                diagnosis = other.diagnose(window)
            except (EstimationError, np.linalg.LinAlgError) as error:
                opinions.append(Opinion(by=other.by, reason=str(error)))
                continue
            equations = diagnosis.equations or equations
            opinions.append(opinion_of(deciding, beside(deciding, diagnosis)))
        sense: Literal["", "opposite"] = "opposite" if self._machine.rotor.I2p_kg_m2 < 0 else ""
        return Evaluation(deciding, short, equations, tuple(opinions), speed, gyroscopic=sense)

    def _without_drifted(self, window: WindowStatistics, newest: Newest | None) -> WindowStatistics:
        """Leave out one of each two sensors that have come apart in gain: that without which the window misfits less.

        If that does not tell, it is always the same one, and the mean square of what any other choice would change is
        added to the errors.
        """
        self._drift_error = None
        there = set() if newest is None else set(newest[0].plan.mounted).difference(window.lost)
        pairs = [one.states for one in self.drifts if len(one.states) > 1 and there.issuperset(one.states)]
        if newest is None or not pairs:
            return window
        sliding, test = newest
        choices = [tuple(sorted({*window.lost, *one})) for one in product(*(reversed(pair) for pair in pairs))]
        left_out = choices[0]
        # A window that straddles a change misfits without either; its newest hops then do not.
        for hops in (None, *sorted(test.settings.short_hops)):
            read: list[tuple[float, tuple[str, ...], Diagnosis]] = []
            for lost in choices:
                with suppress(EstimationError):
                    if (part := sliding.statistics(hops, lost=lost)) is not None:
                        decided = self._decide(replace(part, directed=self.directed), self._likelihood.apart)
                        read.append((max(0.0, _misfit_z(decided)), lost, decided))
            least = min((misfit_z for misfit_z, _, _ in read), default=np.inf)
            if least <= _MOST_MISFIT_Z:
                likely = [(lost, one) for misfit_z, lost, one in read if misfit_z <= least + _LEAST_MISFIT_DROP]
                left_out = likely[0][0]
                changes = [np.nan_to_num(apart(likely[0][1], one)) for _, one in likely]
                self._drift_error = np.mean([np.outer(change, change) for change in changes], axis=0)
                break
        return sliding.statistics(lost=left_out) or window

    def _contradicts_assumed_angle(self, deciding: Diagnosis) -> bool:
        """Whether the first window with a readable 1x vector contradicts the assumed angle of the heavy spot.

        Only if the file gives no angle. A turn cannot be read then, and the unbalance is judged by its size.
        """
        vector = deciding.unbalance
        if not self._angle_unchecked or self._sense_open or deciding.unexplained or vector is None or vector.foreign:
            return False
        self._angle_unchecked = vector.turned_error_deg is None
        return self.directed and vector.turned

    def _diagnose_window(self, window: WindowStatistics) -> Diagnosis:
        try:
            return self._decide(window, self._likelihood.window)
        except UnexplainedError as error:
            nothing = tuple(no_reading(name, self.by, str(error)) for name in PARAMETERS)
            return Diagnosis(self.by, nothing, covariance=np.zeros((0, 0)), unexplained=str(error))

    def _try_other_sense(self, window: WindowStatistics, given: Diagnosis) -> Diagnosis:
        """The diagnosis with the sense of the gyroscopic moments that explains the window; `given` if neither does.

        The other sense takes a search from scratch, so it is tried once in a window's length.
        """
        misfit_z = _misfit_z(given)
        tried = window.start_ns < self._tried_ns <= window.end_ns and (self._tried_in_vain or np.isinf(misfit_z))
        if misfit_z <= _MOST_MISFIT_Z or tried:
            self._sense_open = misfit_z > _MOST_MISFIT_Z
            return given
        # A window that neither sense explains, such as a disturbance, decides nothing: try the next that is read.
        self._tried_ns, self._tried_in_vain = window.end_ns, bool(np.isfinite(misfit_z))
        before = self._machine, self._likelihood, self._others
        self._compare_with(in_sense(self._given, "opposite"))
        try:
            other = self._diagnose_window(window)
            self._sense_opposite = _misfit_z(other) <= min(_LEAST_MISFIT_TO_SPLIT, misfit_z - _LEAST_MISFIT_DROP)
        except EstimationError:
            other = given
        finally:
            if not self._sense_opposite:
                self._machine, self._likelihood, self._others = before
        self._sense_open = not self._sense_opposite
        return other if self._sense_opposite else given

    def _check_unbalance(self, decided: Diagnosis) -> Diagnosis:
        """The diagnosis, marked as unexplained if its unbalance is so large that units or e_m must be wrong."""
        vector, e = decided.unbalance, next((one for one in decided.evaluable if one.name == "e"), None)
        if decided.unexplained:
            return decided
        if vector is not None and not vector.foreign:
            times, error = 1 + vector.magnitude_change, vector.magnitude_error
        elif vector is None and e is not None:
            times, error = 1 + (e.relative_change or 0.0), e.standard_error or 0.0
        else:
            return decided
        if times - _LEAST_STANDARD_ERRORS * error < _MOST_UNBALANCE_RATIO:
            return decided
        of, check = "of the machine file", "check the units of the channels and e_m"
        if self._commissioned:
            of, check = "of the commissioning", "a part may be lost; if not, check the scales of the channels"
        why = f"{self._machine.title}: it would take {times:.1f} times the unbalance {of}, the limit is"
        why = f"{why} {_MOST_UNBALANCE_RATIO:g} times: {check}"
        return replace(decided, suspect="", unexplained=why)

    def _require_steady_speed(self, window: WindowStatistics, decided: Diagnosis) -> Diagnosis:
        """Return the diagnosis, unless it fits badly and the speed changed too fast for the rotation to be removed.

        A shaft that is switched off, or changes its speed at once, leaves part of its rotation in a hop or two. A
        diagnosis that fits all the same is accepted.

        Raises
        ------
        EstimationError
            If it fits badly, and the speed changed too fast or the rotation was not found in every hop.
        """
        if not decided.unexplained and (decided.misfit_z or 0.0) <= _MOST_MISFIT_Z:
            return decided
        if lost := self._rotation.lost(window, self._machine.operation):
            raise EstimationError(f"{self._machine.title}: {lost}")
        adjoin = np.isfinite(window.hop_jump_rad[1:])  # hops adjoin, and the shaft angle is measured
        steps = np.abs(np.diff(window.hop_speed_rad_s))[adjoin] / self._machine.operation.speed_rad_s
        fastest = float(np.max(steps, initial=0.0))
        # Per hop of a ramp as long as a window.
        limit = max(STEADY, round(_MOST_SPEED_RANGE / max(1, self._machine.window.hops - 1), 3))
        if fastest <= limit:
            return decided
        told, most = beyond(100 * fastest, 100 * limit)
        raise EstimationError(
            f"{self._machine.title}: the speed changed by {told} % of nominal from one hop to the next, evaluation "
            f"limit {most} %"
        )

    def _newest(
        self, window: WindowStatistics, sliding: SlidingWindow, test: SequentialTest, deciding: Diagnosis, latest: int
    ) -> dict[int, Diagnosis]:
        """Diagnose the newest hops alone, at each length (hops, up to `latest`) that the sequential test asks for."""
        wanted, evaluated = tuple(hops for hops in test.wanted() if hops <= latest), {}
        # A window outside the model may straddle a change; its newest hops are then inside.
        closely = deciding.misfit_z is not None and deciding.misfit_z > _LEAST_MISFIT_TO_SPLIT
        if deciding.unexplained:
            # If some of the window's data were explained, it may straddle a change: the shortest stretch shows that.
            straddles = self._explained_ns is not None and window.start_ns < self._explained_ns
            dated = wanted != test.settings.short_hops
            wanted = wanted[: len(wanted) if straddles and dated else int(straddles)]
        elif test.unchanged and not closely and not self._likelihood.has_news(sliding, window, wanted):
            return {}
        for hops in wanted:
            with suppress(EstimationError):  # too little data on its own: the window's diagnosis has to do
                if (statistics := sliding.statistics(hops, lost=window.lost)) is not None:
                    statistics = replace(statistics, directed=self.directed, lines=window.lines)
                    decided = self._decide(statistics, partial(self._likelihood.short, hops, closely=closely))
                    evaluated[hops] = self._require_steady_speed(statistics, self._check_unbalance(decided))
        return evaluated

    def rivals(self, *, wanted: bool) -> tuple[Rival, ...]:
        """Causes outside the model that the latest window might show, see `WindowEvaluator`."""
        return self._likelihood.rivals(wanted=wanted)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Starting points of the likelihood search, and what was found out so far; networks have no state."""
        explained = np.array([] if self._explained_ns is None else [self._explained_ns], dtype=np.int64)
        sense = [self._sense_open, self._sense_opposite, self._tried_in_vain, self._tried_ns, self._angle_unchecked]
        return prefixed(_LIKELIHOOD, self._likelihood.checkpoint()) | {
            _EXPLAINED: explained,
            _SENSE: np.array(sense, dtype=np.int64),
            _DIRECTED: np.array(self.directed),
            _ROTATION: np.array(self._rotation.power),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue from where `checkpoint` was called, see `WindowEvaluator`."""
        explained = checked(arrays, _EXPLAINED, np.int64, (None,)).tolist()
        still_open, opposite, in_vain, tried_ns, sought = checked(arrays, _SENSE, np.int64, (5,)).tolist()
        directed = bool(checked(arrays, _DIRECTED, np.bool_, ()))
        machine = in_sense(self._given, "opposite" if opposite else "Eq. 27")
        likelihood = LengthFits(machine, sized=self._sized)
        likelihood.restore(unprefixed(_LIKELIHOOD, arrays))
        self._compare_with(machine)
        self._likelihood, self._explained_ns = likelihood, next(iter(explained), None)
        self._sense_open, self._sense_opposite, self._angle_unchecked = bool(still_open), bool(opposite), bool(sought)
        self._tried_ns, self._tried_in_vain, self.directed = tried_ns, bool(in_vain), directed
        self._rotation.power = float(checked(arrays, _ROTATION, np.float64, ()))

    def _speed(self, window: WindowStatistics) -> float | None:
        """Mean speed, rad/s, None if unknown; raises `EstimationError` if it is out of range or not steady."""
        if not np.isfinite(window.speed_rad_s):
            return None
        operation, speed = self._machine.operation, float(window.speed_rad_s)
        off = abs(speed / operation.speed_rad_s - 1)
        if off > operation.speed_tolerance:
            text, limit = beyond(100 * off, 100 * operation.speed_tolerance)
            falls = "; the shaft angle falls: send 2π minus the angle" if speed < 0 else ""
            raise EstimationError(
                f"{self._machine.title}: speed is {speed * 30 / np.pi:.0f} rpm, off {operation.speed_rpm:g} rpm "
                f"by {text} %, evaluation limit {limit} %{falls}"
            )
        slowest, fastest = window.speed_range
        varied = (fastest - slowest) / operation.speed_rad_s
        if varied > _MOST_SPEED_RANGE:
            text, limit = beyond(100 * varied, 100 * _MOST_SPEED_RANGE)
            raise EstimationError(
                f"{self._machine.title}: speed went from {slowest * 30 / np.pi:.0f} to {fastest * 30 / np.pi:.0f} rpm "
                f"within the window, by {text} % of nominal, evaluation limit {limit} %"
            )
        return speed

    def _decide(self, window: WindowStatistics, diagnose: Callable[[WindowStatistics], Diagnosis]) -> Diagnosis:
        """The likelihood's diagnosis without the parameters that these sensors do not determine."""
        try:
            diagnosis = diagnose(window)
        except np.linalg.LinAlgError as error:
            raise EstimationError(f"{self._machine.title}: {error} in this window") from error
        stated = determined(diagnosis, window, self._machine.window_data_s)
        if self._healthy_misfit is not None and stated.goodness is not None:
            left = self._healthy_misfit.beyond(stated.goodness, window.duration_s / self._machine.window_data_s)
            suspect = left.suspected(unexplained=bool(stated.unexplained))
            stated = replace(stated, misfit_z=left.misfit_z, suspect=suspect)
        vector = stated.unbalance
        if vector is not None and self._reversed:
            vector = replace(vector, foreign=self._reversed)
            stated = replace(stated, unbalance=vector)
        seen = any(state.endswith("_dot") for state in window.states)  # displacements alone may have run-out
        usable = not (self._commissioned or stated.unexplained)
        if vector is not None and vector.foreign and seen and usable and stated.misfit_z is not None:
            # Not on a commissioned machine: its levels are compared with the healthy 1x.
            misfit_z = max(stated.misfit_z, _LEAST_FOREIGN_MISFIT)
            stated = replace(stated, misfit_z=misfit_z, suspect=stated.suspect or vector.foreign)
        for shared in (self._shared, self._drift_error):
            stated = stated if shared is None else with_shared_error(stated, shared)
        return stated


def _misfit_z(diagnosis: Diagnosis) -> float:
    return np.inf if diagnosis.unexplained or diagnosis.misfit_z is None else diagnosis.misfit_z
