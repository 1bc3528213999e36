"""Evaluation of one window: several diagnosticians side by side, and whether they agree.

A machine whose parameters are known, given or identified, is compared with theory (`KnownMachineEvaluator`). One of
which only healthy recordings are known is compared with its baseline (`BaselineEvaluator`), and where its sensors allow
no equation, each channel with its own healthy form.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from models.checkpoint import checked, prefixed, unprefixed
from models.commissioning.commissioned import Commissioned, Installed, in_sense
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.rows import evaluable_rows
from models.diagnosis.likelihood.lengths import LengthFits
from models.diagnosis.moments import states_of
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.networks.relation import RelationDiagnostician
from models.diagnosis.readings import Diagnosis, Diagnostician, beyond, no_reading
from models.diagnosis.sensors.reference import Naming
from models.diagnosis.sliding_window import SlidingWindow
from models.diagnosis.verdict.calibration import agreements, beside
from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest
from models.diagnosis.verdict.stretch import determined, with_shared_error
from models.diagnosis.window import WindowStatistics
from models.errors import CheckpointError, EstimationError, UnexplainedError
from models.machine import Machine, MachineFile
from models.physics.rotor import PARAMETERS
from models.signals.channels import Channel, with_channel_names
from rotorwatch.records.health import HealthState
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import Equation, Opinion, Parameter, SensorFault, Shape

Newest = tuple[SlidingWindow, SequentialTest]
"""Where the window is the latest, and what wants its latest hops evaluated."""
_LIKELIHOOD, _SHAPE, _EXPLAINED, _SENSE, _DIRECTED = "likelihood", "shape", "explained_ns", "sense", "directed"
_NO_EQUATION = "no equation can be evaluated on this machine; see what is said of each channel"
_EMPTY = np.zeros((0, 0))
_STEADY = 0.15
"""Range of speed within a window, relative, up to which the rotation taken out hop by hop leaves nothing behind: on the
rotor kit readings stay unbiased at ramps of 5, 10 and 15 % (16 seeds each, ``tests/diagnosis/test_window.py``)."""

_INSIDE, _BETTER, _SURELY_OUTSIDE = 2.0, 3.0, 8.0
"""Standard deviations of the misfit with which a window is explained beyond doubt, by which one explanation is better
than another, and of what is outside the model by something else than its spectra."""
_HEAVIEST, _SURELY = 20.0, 3.0
"""Times the unbalance of the machine file, in standard errors: a lost blade makes ten of it, millimetres in place of
micrometres a thousand."""
_OUTSIDE = 4.0
"""Standard deviations of the misfit from which the short stretches of a window are tested for themselves."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What the diagnosticians say about a window."""

    deciding: Diagnosis  # the likelihood's, every parameter in the order of `PARAMETERS`
    # The same of the latest hops, by how many; without those that have no news or could not be evaluated.
    short: Mapping[int, Diagnosis]
    equations: tuple[Equation, ...]  # every equation of the table, by its network, or why not
    opinions: tuple[Opinion, ...]  # what the others say
    speed_rad_s: float | None
    shapes: tuple[Shape, ...] = ()  # where no equation can be evaluated: whether each channel's vibration is as it was

    def calm(self, *, outside: bool) -> HealthState:
        """State without raised alarms: healthy only if something was read that could have said otherwise."""
        if outside:
            return HealthState.OUTSIDE_MODEL
        if self.deciding.evaluable:
            return HealthState.HEALTHY
        states = {shape.verdict for shape in self.shapes}
        if "not changed" in states and "changed" not in states:
            return HealthState.UNCHANGED
        return HealthState.NOT_EVALUABLE

    @property
    def readings(self) -> tuple[Parameter, ...]:
        """What the deciding diagnostician reads of the window; nothing that it cannot explain."""
        deciding, vector = self.deciding, self.deciding.unbalance
        if deciding.unexplained:
            return tuple(no_reading(one.name, one.by, deciding.unexplained) for one in deciding.parameters)
        foreign = "" if vector is None else vector.foreign
        return tuple(
            no_reading(one.name, one.by, foreign) if foreign and one.vector is not None else one
            for one in deciding.parameters
        )

    @property
    def unlike_healthy(self) -> str:
        """What has been seen, where no equation can be evaluated."""
        return "; ".join(filter(None, (self.deciding.suspect, *self._changed)))

    @property
    def _changed(self) -> list[str]:
        return [shape.text for shape in self.shapes if shape.verdict == "changed"]

    def reason(self, *, told: bool) -> str:
        """Why no parameter could be read, every reason once; first what has changed, where channels alone are compared.

        Parameters
        ----------
        told : bool
            Whether the verdict says it: what has changed explains a window astride the change.
        """
        if self.deciding.unexplained or self.deciding.evaluable:
            return "" if told else self.deciding.unexplained
        reasons = (one.reason for one in self.deciding.parameters if one.reason)
        return "; ".join(dict.fromkeys([*self._changed, *reasons]))

    def named(self, channels: Sequence[Channel], foreign: str) -> "Evaluation":
        """The same with sentences in the names of a machine's channels.

        Parameters
        ----------
        foreign : str
            What was seen that no change of a parameter makes: the first suspect. Empty if nothing.
        """
        suspect = foreign or with_channel_names(self.deciding.suspect, channels)
        return replace(
            self,
            deciding=replace(self.deciding, suspect=suspect),
            shapes=tuple(
                one.model_copy(update={"text": with_channel_names(one.text, channels)}) for one in self.shapes
            ),
        )


class WindowEvaluator(ABC):
    """Evaluates the windows of one machine.

    Unless it says otherwise, each evaluation stands for itself: only the whole window is taken, and nothing is
    remembered of it.
    """

    takes_short: bool = False
    """Whether stretches shorter than the window can be evaluated."""

    directed: bool = True
    """Whether the directions of vectors say something: the shaft angle has not jumped since the monitor was set up, and
    nothing has shown that the heavy spot is not where it was looked for without a word of the file."""

    by: str
    """Name of the diagnostician that decides."""

    needs_lags: bool
    """Whether correlations are needed at all lags, or at lag zero alone."""

    @abstractmethod
    def evaluate(self, window: WindowStatistics, newest: Newest | None = None) -> Evaluation:
        """Evaluate one window.

        Parameters
        ----------
        window : WindowStatistics
            The full window.
        newest : Newest, optional
            Where its latest hops are evaluated for themselves, too.

        Raises
        ------
        EstimationError
            If the window cannot be evaluated: outside the speed range, speed not steady, no fluctuation in a channel.
        """

    def heard(self, findings: Sequence[SensorFault]) -> None:
        """Take note of what is wrong with the sensors: what an angle that jumped costs stays lost."""
        self.directed &= ("theta", FaultKind.OFFSET) not in {(*one.states, one.kind) for one in findings}

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything that the next evaluations depend on, as named arrays; empty if each stands for itself."""
        return {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on where `checkpoint` was called: the next evaluations are the same to the last bit.

        Raises
        ------
        CheckpointError
            If the arrays are not those of such an evaluator of this machine; nothing is changed then.
        """
        if arrays:
            raise CheckpointError(f"{', '.join(sorted(arrays))} is of another diagnostician")


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


class KnownMachineEvaluator(WindowEvaluator):
    """Compares the windows of one machine with theory.

    Parameters
    ----------
    bundle : Bundle or None
        Without it the equations are reported as not evaluable.
    commissioned : Commissioned, optional
        Uncertainty of parameters that were identified, part of every reading; and the healthy windows' misfit, which
        later ones are compared with.
    """

    by = "likelihood"
    takes_short = True

    def __init__(self, machine: Machine, bundle: Bundle | None, commissioned: Commissioned | None = None) -> None:
        identified = None if commissioned is None else commissioned.identified
        self._shared = None if identified is None else identified.matrix()
        self._commissioned = commissioned is not None
        self._healthy_misfit = None if commissioned is None else commissioned.misfit
        self.needs_lags = bundle is not None  # only the networks look at lags
        self._explained_ns: int | None = None
        self._given, self._bundle = machine, bundle
        # The sense of the gyroscopic moments is open until a window has been explained.
        self._open, self._opposite = commissioned is None, False
        # Where the file does not say where the heavy spot is, it is looked for in the first window that shows it.
        given = "unbalance_phase_rad" in machine.operation.model_fields_set
        self._sought = commissioned is None and not given
        self._tried_ns, self._tried_in_vain = 0, False  # end of the window that the other one was tried on
        self._compare_with(machine)

    def _compare_with(self, machine: Machine) -> None:
        self._machine, bundle = machine, self._bundle
        self._likelihood = LengthFits(machine)
        others: list[Diagnostician] = []
        if bundle is not None and bundle.amortised is not None:
            others.append(NetworkDiagnostician(machine, bundle.amortised))
        others.append(RelationDiagnostician(machine, () if bundle is None else bundle.networks))
        self._others = tuple(others)

    def evaluate(self, window: WindowStatistics, newest: Newest | None = None) -> Evaluation:
        """Evaluate one window, see `WindowEvaluator`."""
        speed = self._speed(window)
        window = window if self.directed else replace(window, directed=False)
        deciding = self._explained(window)
        if self._open:
            deciding = self._by_sense(window, deciding)
        if self._elsewhere(deciding):
            self.directed, window = False, replace(window, directed=False)
            deciding = self._explained(window)
        deciding = self._within(deciding)
        short = {} if newest is None else self._newest(window, *newest, deciding)
        if not deciding.unexplained:
            self._explained_ns = window.end_ns
        elif self._explained_ns is None and not self._commissioned:
            deciding = replace(
                deciding, unexplained=f"{deciding.unexplained}; if it is healthy like that, commission it"
            )
        equations: tuple[Equation, ...] = ()
        opinions = []
        for other in self._others:
            try:
                diagnosis = other.diagnose(window)
            except (EstimationError, np.linalg.LinAlgError) as error:
                opinions.append(Opinion(by=other.by, reason=str(error)))
                continue
            equations = diagnosis.equations or equations
            opinions.append(_opinion(deciding, beside(deciding, diagnosis)))
        return Evaluation(deciding, short, equations, tuple(opinions), speed)

    def _elsewhere(self, deciding: Diagnosis) -> bool:
        """Whether the first window that shows the heavy spot shows it where it was only supposed not to be.

        Where the file does not say where it is, no turn of it can be told then: the unbalance is judged by its size.
        """
        vector = deciding.unbalance
        if not self._sought or self._open or deciding.unexplained or vector is None or vector.foreign:
            return False
        self._sought = vector.turned_error_deg is None
        return self.directed and vector.turned

    def _explained(self, window: WindowStatistics) -> Diagnosis:
        try:
            return self._decide(window, self._likelihood.window)
        except UnexplainedError as error:
            reason = str(error)
            nothing = tuple(no_reading(name, self.by, reason) for name in PARAMETERS)
            return Diagnosis(self.by, nothing, covariance=_EMPTY, unexplained=reason)

    def _by_sense(self, window: WindowStatistics, given: Diagnosis) -> Diagnosis:
        """The diagnosis with gyroscopic moments of that sense which explains the window, if either does.

        The other sense is a search from nothing: it is tried once in a window's length.
        """
        misfit_z = _misfit_z(given)
        tried = window.start_ns < self._tried_ns <= window.end_ns and (self._tried_in_vain or np.isinf(misfit_z))
        if misfit_z <= _INSIDE or tried:
            self._open = misfit_z > _INSIDE
            return given
        # What neither sense explains, a disturbance for instance, says nothing of it: the next that is read does.
        self._tried_ns, self._tried_in_vain = window.end_ns, bool(np.isfinite(misfit_z))
        before = self._machine, self._likelihood, self._others
        self._compare_with(in_sense(self._given, "opposite"))
        try:
            other = self._explained(window)
            self._opposite = _misfit_z(other) <= min(_OUTSIDE, misfit_z - _BETTER)
        except EstimationError:
            other = given
        finally:
            if not self._opposite:
                self._machine, self._likelihood, self._others = before
        self._open = not self._opposite
        return other if self._opposite else given

    def _within(self, decided: Diagnosis) -> Diagnosis:
        """The diagnosis, unexplained where it takes an unbalance that means wrong units, or a wrong e_m."""
        vector = decided.unbalance
        if vector is None or decided.unexplained or vector.foreign:
            return decided
        times = 1 + vector.magnitude_change
        if times - _SURELY * vector.magnitude_error < _HEAVIEST:
            return decided
        why = (
            f"{self._machine.title}: it would take {times:.1f} times the unbalance of the machine file, evaluated is at"
        )
        return replace(decided, unexplained=f"{why} most {_HEAVIEST:g} times: check the units of the channels and e_m")

    def _newest(
        self, window: WindowStatistics, sliding: SlidingWindow, test: SequentialTest, deciding: Diagnosis
    ) -> dict[int, Diagnosis]:
        """What the latest hops say for themselves, by how many."""
        wanted, evaluated = test.wanted(), {}
        # Where the window is outside the model it may be astride a change: then its newest hops are inside.
        closely = deciding.misfit_z is not None and deciding.misfit_z > _OUTSIDE
        if deciding.unexplained:
            # One machine or two in this window? If some of its data were explained, the shortest stretch says.
            straddles = self._explained_ns is not None and window.start_ns < self._explained_ns
            wanted = tuple(sorted(wanted)[: int(straddles)])
        elif test.unchanged and not closely and not self._likelihood.has_news(sliding, window, wanted):
            return {}
        for hops in wanted:
            with suppress(EstimationError):  # too little data for itself; the window has said what there is to say
                if (statistics := sliding.statistics(hops)) is not None:
                    statistics = replace(statistics, directed=self.directed, lines=window.lines)
                    decided = self._decide(statistics, partial(self._likelihood.short, hops, closely=closely))
                    evaluated[hops] = self._within(decided)
        return evaluated

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Where the likelihood's maximum is followed from, and what is known; networks remember nothing."""
        explained = np.array([] if self._explained_ns is None else [self._explained_ns], dtype=np.int64)
        sense = [self._open, self._opposite, self._tried_in_vain, self._tried_ns, self._sought]
        known = {_EXPLAINED: explained, _SENSE: np.array(sense, dtype=np.int64), _DIRECTED: np.array(self.directed)}
        return prefixed(_LIKELIHOOD, self._likelihood.checkpoint()) | known

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on where `checkpoint` was called, see `WindowEvaluator`."""
        explained = checked(arrays, _EXPLAINED, np.int64, (None,)).tolist()
        still_open, opposite, in_vain, tried_ns, sought = checked(arrays, _SENSE, np.int64, (5,)).tolist()
        directed = bool(checked(arrays, _DIRECTED, np.bool_, ()))
        machine = in_sense(self._given, "opposite" if opposite else "Eq. 27")
        likelihood = LengthFits(machine)
        likelihood.restore(unprefixed(_LIKELIHOOD, arrays))
        self._compare_with(machine)
        self._likelihood, self._explained_ns = likelihood, next(iter(explained), None)
        self._open, self._opposite, self._sought = bool(still_open), bool(opposite), bool(sought)
        self._tried_ns, self._tried_in_vain, self.directed = tried_ns, bool(in_vain), directed

    def _speed(self, window: WindowStatistics) -> float | None:
        """Mean speed, if it is one that is evaluated."""
        if not np.isfinite(window.speed_rad_s):
            return None
        operation, speed = self._machine.operation, float(window.speed_rad_s)
        off = abs(speed / operation.speed_rad_s - 1)
        if off > operation.speed_tolerance:
            text, limit = beyond(100 * off, 100 * operation.speed_tolerance)
            raise EstimationError(
                f"{self._machine.title}: speed is {speed * 30 / np.pi:.0f} rpm, off {operation.speed_rpm:g} rpm by "
                f"{text} %, evaluated is at most {limit} %"
            )
        slowest, fastest = window.speed_range
        varied = (fastest - slowest) / operation.speed_rad_s
        if varied > _STEADY:
            text, limit = beyond(100 * varied, 100 * _STEADY)
            raise EstimationError(
                f"{self._machine.title}: speed went from {slowest * 30 / np.pi:.0f} to {fastest * 30 / np.pi:.0f} rpm "
                f"within the window, by {text} % of nominal, evaluated is at most {limit} %"
            )
        return speed

    def _decide(self, window: WindowStatistics, diagnose: Callable[[WindowStatistics], Diagnosis]) -> Diagnosis:
        """The likelihood's diagnosis with what these sensors do not determine taken out."""
        try:
            diagnosis = diagnose(window)
        except np.linalg.LinAlgError as error:
            raise EstimationError(f"{self._machine.title}: {error} in this window") from error
        stated = determined(diagnosis, window, self._machine.window_data_s)
        if self._healthy_misfit is not None and stated.goodness is not None:
            left = self._healthy_misfit.beyond(stated.goodness, window.duration_s / self._machine.window_data_s)
            stated = replace(stated, misfit_z=left.misfit_z, suspect=left.suspect)
        vector = stated.unbalance
        seen = any(state.endswith("_dot") for state in window.states)  # displacements alone may have run-out
        if vector is not None and vector.foreign and seen and not self._commissioned and stated.misfit_z is not None:
            # Of a commissioned machine levels know what its 1x was.
            misfit_z = max(stated.misfit_z, _SURELY_OUTSIDE)
            stated = replace(stated, misfit_z=misfit_z, suspect=stated.suspect or vector.foreign)
        return stated if self._shared is None else with_shared_error(stated, self._shared)


def _misfit_z(diagnosis: Diagnosis) -> float:
    return np.inf if diagnosis.unexplained or diagnosis.misfit_z is None else diagnosis.misfit_z


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
            here = "not evaluable here" if self._diagnosed else "levels are judged by the nearest commissioned speed"
            raise EstimationError(f"{self._place}: {here}: {outside}")
        speed = float(window.speed_rad_s) if np.isfinite(window.speed_rad_s) else None
        if self._baselines:
            deciding = determined(self._baseline_for(window).diagnose(window), window, self._length_s)
        else:
            nothing = tuple(no_reading(name, _SHAPE, _NO_EQUATION) for name in PARAMETERS)
            deciding = Diagnosis(_SHAPE, nothing, covariance=_EMPTY)
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


def _opinion(deciding: Diagnosis, other: Diagnosis) -> Opinion:
    """What another diagnostician says; one that could read nothing says why, once."""
    if other.evaluable:
        return Opinion(by=other.by, parameters=other.parameters, agreement=agreements(deciding, other))
    reasons = dict.fromkeys(reading.reason for reading in other.parameters)
    return Opinion(by=other.by, parameters=other.parameters, reason="; ".join(reasons) or "nothing to read")
