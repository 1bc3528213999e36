"""Evaluation of one window: several diagnosticians side by side, and whether they agree."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from models.diagnosis.baseline.diagnostician import OTHER_FORCE, BaselineDiagnostician
from models.diagnosis.misfit import Rival
from models.diagnosis.readings import Diagnosis, Left, no_reading
from models.diagnosis.sensors.disagreement import is_drift
from models.diagnosis.sensors.level import at_range_end
from models.diagnosis.sensors.reference import WITHOUT_SIGNAL, Naming, implicated
from models.diagnosis.verdict.calibration import agreements
from models.diagnosis.verdict.sequential import SequentialTest
from models.diagnosis.window.moments import Plan
from models.diagnosis.window.rotation import LEAST_SETTLED, STRONG
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import CheckpointError, EstimationError
from models.levels.judgement import Foreign
from models.machine import Operation
from models.signals.channels import Channel, with_channel_names
from rotorwatch.records.health import HealthState
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import Equation, NaturalFrequency, Opinion, Parameter, SensorFault, Shape, Verdict

_OR_STIFFNESS = "or the stiffness there has changed, which looks the same well below its resonance"
_TOO_LITTLE = "something changed within the window, and data since then are too few to say what"
_MOST_MISFIT_Z = 2.0  # standard deviations of the misfit within which nothing has to be explained

Newest = tuple[SlidingWindow, SequentialTest]
"""The sliding window whose latest window is evaluated, and the sequential test that asks for shorter stretches."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What the diagnosticians say about a window."""

    deciding: Diagnosis  # of the diagnostician that decides, every parameter in the order of `PARAMETERS`
    # Diagnoses of the latest hops alone, by number of hops; lengths without news or not evaluable are left out.
    short: Mapping[int, Diagnosis]
    equations: tuple[Equation, ...]  # every equation of the table, with its readings or why there are none
    opinions: tuple[Opinion, ...]  # readings of the other diagnosticians
    speed_rad_s: float | None
    shapes: tuple[Shape, ...] = ()  # where no equation can be evaluated: whether each channel's shape has changed
    modes: tuple[NaturalFrequency, ...] = ()  # where a stiffness is read badly or not at all
    gyroscopic: Literal["", "opposite"] = ""  # sense of the gyroscopic moments where it is not that of Eq. (27)
    alone: bool = False  # whether only later windows can show that this one straddles a change

    def calm(self, *, outside: bool, told: bool, without: bool = False) -> HealthState:
        """State if no alarm is raised: healthy only if a parameter was read that could have shown a change.

        If the window was evaluated `without` faulty sensors, their fault takes precedence. If the verdict has no
        readings (`told`), there are too few data since a change.
        """
        if outside:
            return HealthState.OUTSIDE_MODEL
        if without:
            return HealthState.DATA_HEALTH
        if not told and (self.deciding.evaluable or self.deciding.unexplained):
            return HealthState.WARMING
        if self.deciding.evaluable:
            return HealthState.HEALTHY
        states = {*(one.verdict for one in self.shapes), *(one.verdict for one in self.modes)}
        if "not changed" in states and "changed" not in states:
            return HealthState.UNCHANGED
        return HealthState.NOT_EVALUABLE

    @property
    def readings(self) -> tuple[Parameter, ...]:
        """Readings of the deciding diagnostician: none of an unexplained window, no unbalance if 1x is foreign."""
        deciding, vector = self.deciding, self.deciding.unbalance
        if deciding.unexplained:
            return tuple(no_reading(one.name, one.by, deciding.unexplained) for one in deciding.parameters)
        foreign = "" if vector is None else vector.foreign
        return tuple(
            no_reading(one.name, one.by, foreign) if foreign and one.vector is not None else one
            for one in deciding.parameters
        )

    def rivals(self, foreign: Foreign) -> tuple[str, ...]:
        """Stiffness and damping of a place, if a change of one explains the window as well as a wrong gain there.

        A wrong gain scales the readings of both by one factor, and 1x as `left_of_1x` says. A bearing below its
        resonance looks the same if its damping is not known well.
        """
        names, left = self._left(foreign)
        return names if left is not None and left.single <= left.common + foreign.unlike else ()

    def doubted(self, foreign: Foreign) -> Foreign:
        """The same, with the stiffness that may be the cause where none was read that would exclude it."""
        if not foreign.held or self._left(foreign)[1] is not None:
            return foreign
        return foreign._replace(text=f"{foreign.text}; {_OR_STIFFNESS}")

    def _left(self, foreign: Foreign) -> tuple[tuple[str, ...], Left | None]:
        names = tuple(f"{of}_b{foreign.direction}" for of in "kc")
        return names, self.deciding.left_by(names) if foreign.direction else None

    @property
    def unlike_healthy(self) -> str:
        """What differs from the healthy machine where no equation can be evaluated, or in natural frequencies."""
        suspect = self.deciding.suspect if self.shapes else ""  # of a reading, it is told by the alarm `model`
        return "; ".join(filter(None, (suspect, *self._changed)))

    @property
    def _changed(self) -> list[str]:
        judged: tuple[NaturalFrequency | Shape, ...] = (*self.modes, *self.shapes)
        return [one.text for one in judged if one.verdict == "changed"]

    def unfit(self, verdict: Verdict) -> str:
        """What a verdict of *outside the model* may mean where relations were learned; empty if a suspect is told."""
        learned = self.deciding.by == BaselineDiagnostician.by and not self.deciding.suspect
        return OTHER_FORCE if learned and verdict.outside_model else ""

    def reason(self, *, told: bool) -> str:
        """Why no parameter could be read, each reason once; shapes that have changed come first.

        If the verdict has readings (`told`), an unexplained window needs no reason: it straddles the change.
        """
        if self.deciding.unexplained or self.deciding.evaluable:
            return "" if told else self.deciding.unexplained or _TOO_LITTLE
        reasons = (one.reason for one in self.deciding.parameters if one.reason)
        return "; ".join(dict.fromkeys([*self._changed, *reasons]))

    def named(
        self, channels: Sequence[Channel], window: WindowStatistics, foreign: str, faulty: Collection[str] = ()
    ) -> "Evaluation":
        """Return the evaluation with its sentences in the names of a machine's channels, and with its suspect.

        The first suspect is what no change of a parameter makes (`foreign`, empty if nothing). Where the window fits
        badly, channels at the end of their range come next, except `faulty` ones, which the evaluation left out.
        """
        fits_badly = self.deciding.unexplained != "" or (self.deciding.misfit_z or 0.0) > _MOST_MISFIT_Z
        told = foreign or self.shapes or not fits_badly
        limited = [] if told else at_range_end([window], Naming(channels), faulty)
        ends = f"{'; '.join(limited)}, the end of its range" if limited else ""
        suspect = foreign or ends or with_channel_names(self.deciding.suspect, channels)
        shapes = tuple(one.model_copy(update={"text": with_channel_names(one.text, channels)}) for one in self.shapes)
        return replace(self, deciding=replace(self.deciding, suspect=suspect), shapes=shapes)


class WindowEvaluator(ABC):
    """Evaluates the windows of one machine.

    Unless a subclass says otherwise, evaluations are independent: each takes only the whole window and leaves no state.
    """

    takes_short: bool = False
    """Whether stretches shorter than the window can be evaluated."""

    directed: bool = True
    """Whether the directions of vectors mean anything: the shaft angle has not jumped since the monitor was set up, and
    no window has contradicted an angle of the heavy spot that was assumed because the machine file gives none."""

    drifts: tuple[SensorFault, ...] = ()
    """Gains that have drifted a little, of the latest window."""

    despite_drift: str = "with larger errors"
    """How a machine is diagnosed if a gain has drifted, where it is."""

    by: str
    """Name of the diagnostician that decides."""

    needs_lags: bool
    """Whether correlations are needed at all lags, or at lag zero alone."""

    @abstractmethod
    def evaluate(self, window: WindowStatistics, newest: Newest | None = None) -> Evaluation:
        """Evaluate one full window and, given `newest`, also its latest hops on their own.

        Raises
        ------
        EstimationError
            If the window cannot be evaluated: outside the speed range, speed not steady, no fluctuation in a channel.
        """

    def spared(self, plan: Plan, findings: Sequence[SensorFault]) -> tuple[str, ...] | None:
        """Sensors to leave out so that a window can be evaluated despite these faults; None if it cannot be.

        Faults of channels outside the equations do not matter, unless the machine has no equations. Sensors without a
        signal are left out while enough are left (`suffices`), but not if the speed is found in the vibration: the
        strength of its line depends on which sensors are left.
        """
        own = [one for one in findings if not plan.states or not set(one.states).issubset(plan.others)]
        lost, dead = implicated(own), all(one.kind in WITHOUT_SIGNAL for one in own)
        enough = dead and plan.angle_column is not None and "theta" not in lost
        return tuple(sorted(lost)) if not own or (enough and self.suffices(plan.states_without(lost), plan)) else None

    def suffices(self, left: Sequence[str], plan: Plan) -> bool:
        """Whether windows can be evaluated with the states `left` of a plan's; never, unless a subclass says so."""
        _ = left, plan
        return False

    def rivals(self, *, wanted: bool) -> tuple[Rival, ...]:
        """Causes outside the model that the latest window might show, if `wanted`; none unless a subclass knows any.

        To be called once after each evaluation, as it ends the window's claim on memory.
        """
        _ = wanted
        return ()

    def heard(self, findings: Sequence[SensorFault]) -> None:
        """Take note of gains that drifted; once the shaft angle has jumped, directions mean nothing any more."""
        self.directed &= ("theta", FaultKind.OFFSET) not in {(*one.states, one.kind) for one in findings}
        self.drifts = tuple(filter(is_drift, findings))

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything that the next evaluations depend on, as named arrays; empty if they are independent."""
        return {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue from where `checkpoint` was called: the next evaluations are the same to the last bit.

        Raises
        ------
        CheckpointError
            If the arrays are not those of such an evaluator of this machine; nothing is changed then.
        """
        if arrays:
            raise CheckpointError(f"{', '.join(sorted(arrays))} is of another diagnostician")


def settled(place: str, window: WindowStatistics, newest: Newest | None) -> tuple[WindowStatistics, int]:
    """Leave out hops in which a drive changed its set point; return the window and the number of hops after the last.

    Without a shaft angle the rotation cannot be removed from those hops. `place` is the machine's title.

    Raises
    ------
    EstimationError
        If less than `LEAST_SETTLED` of the hops is left.
    """
    passed = np.flatnonzero(~window.settled)
    if newest is None or not passed.size:
        return window, window.settled.size
    if window.settled.mean() < LEAST_SETTLED:
        raise EstimationError(
            f"{place}: the speed was found and steady in {np.count_nonzero(window.settled)} of {window.settled.size} "
            f"hops, evaluation limit {LEAST_SETTLED:.0%}: without a shaft angle the rotation is taken out of no others"
        )
    return newest[0].settled(window.lost), window.settled.size - 1 - int(passed[-1])


class LatestRotation:
    """Power of the rotation line when it last stood out of the vibration, where there is no shaft angle."""

    def __init__(self) -> None:
        self.power = 0.0

    def take(self, window: WindowStatistics) -> None:
        """Update the power with a window."""
        if window.speed_source == "estimated":
            found = np.isfinite(window.hop_speed_rad_s)
            strength = float(np.median(window.hop_strength[found]))
            # A weak line that is found in all hops is real: after balancing, or at another set point, less may be left.
            self.power = strength * _broadband_power(window) if strength > STRONG or found.all() else self.power

    def lost(self, window: WindowStatistics, operation: Operation) -> str:
        """In how many hops the rotation was found, if not in all although its latest power would stand out; else empty.

        A hop in which the shaft reached or left its speed counts as one without: its line is much weaker than others.
        """
        found = np.isfinite(window.hop_speed_rad_s) & window.settled
        if window.speed_source == "phase reference" or self.power <= STRONG * _broadband_power(window) or found.all():
            return ""
        slowest, fastest = (operation.speed_rpm * (1 + sign * operation.speed_tolerance) for sign in (-1, 1))
        return (
            f"the rotation was found in {np.count_nonzero(found)} of {found.size} hops, evaluation limit all of them: "
            f"the speed left {slowest:.0f} to {fastest:.0f} rpm or changed too fast, or hardly any unbalance is left"
        )


def _broadband_power(window: WindowStatistics) -> float:
    """Power of a window without its lines: geometric mean over the channels of each spectrum's median, units mixed."""
    power = np.median(np.einsum("fii->fi", window.spectrum).real, axis=0)
    return float(np.exp(np.log(np.maximum(power, np.finfo(float).tiny)).mean()))


def opinion_of(deciding: Diagnosis, other: Diagnosis) -> Opinion:
    """Readings of another diagnostician with their agreement, or each reason why it could read nothing, once."""
    if other.evaluable:
        return Opinion(by=other.by, parameters=other.parameters, agreement=agreements(deciding, other))
    reasons = dict.fromkeys(reading.reason for reading in other.parameters)
    return Opinion(by=other.by, parameters=other.parameters, reason="; ".join(reasons) or "nothing to read")
