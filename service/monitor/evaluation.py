"""Evaluation of one window: several diagnosticians side by side, and whether they agree."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from models.diagnosis.readings import Diagnosis, no_reading
from models.diagnosis.sensors.level import at_range_end
from models.diagnosis.sensors.reference import Naming, implicated
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
from rotorwatch.records.windows import Equation, Opinion, Parameter, SensorFault, Shape

_INSIDE = 2.0  # standard deviations of the misfit within which nothing has to be explained

Newest = tuple[SlidingWindow, SequentialTest]
"""Where the window is the latest, and what wants its latest hops evaluated."""


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
    gyroscopic: Literal["", "opposite"] = ""  # where it is not that of Eq. (27): sense of the moments in theory
    alone: bool = False  # whether only later windows can say that this one is astride a change

    def calm(self, *, outside: bool, without: bool = False) -> HealthState:
        """State without raised alarms: healthy only if something was read that could have said otherwise.

        Not if it was evaluated `without` some of the sensors: those that are at fault come first.
        """
        if outside:
            return HealthState.OUTSIDE_MODEL
        if without:
            return HealthState.DATA_HEALTH
        if self.deciding.evaluable:
            return HealthState.HEALTHY
        states = {shape.verdict for shape in self.shapes}
        if "not changed" in states and "changed" not in states:
            return HealthState.UNCHANGED
        return HealthState.NOT_EVALUABLE

    @property
    def read(self) -> dict[str, Any]:
        """What a report has of it as it is."""
        return {
            "speed_rad_s": self.speed_rad_s,
            "parameters": self.readings,
            "equations": self.equations,
            "opinions": self.opinions,
            "gyroscopic": self.gyroscopic,
        }

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
    def _doubtful(self) -> bool:
        return self.deciding.unexplained != "" or (self.deciding.misfit_z or 0.0) > _INSIDE

    def rivals(self, foreign: Foreign) -> tuple[str, ...]:
        """Parameters one of which explains the window as well as a wrong gain of a place does.

        A gain changes stiffness and damping as they are read by one factor, and 1x as `left_of_1x` says. Below its
        resonance a bearing looks like that, too, where its damping is not known well.
        """
        names = tuple(f"{of}_b{foreign.direction}" for of in "kc")
        left = self.deciding.left_by(names) if foreign.direction else None
        return names if left is not None and left.single <= left.common + foreign.unlike else ()

    @property
    def unlike_healthy(self) -> str:
        """What has been seen, where no equation can be evaluated."""
        return "; ".join(filter(None, (self.deciding.suspect, *self._changed)))

    @property
    def _changed(self) -> list[str]:
        return [shape.text for shape in self.shapes if shape.verdict == "changed"]

    def reason(self, *, told: bool) -> str:
        """Why no parameter could be read, every reason once; first what has changed, where channels alone are compared.

        It is told already where the verdict says it: what has changed explains a window astride the change.
        """
        if self.deciding.unexplained or self.deciding.evaluable:
            return "" if told else self.deciding.unexplained
        reasons = (one.reason for one in self.deciding.parameters if one.reason)
        return "; ".join(dict.fromkeys([*self._changed, *reasons]))

    def named(
        self, channels: Sequence[Channel], window: WindowStatistics, foreign: str, faulty: Collection[str] = ()
    ) -> "Evaluation":
        """The same with sentences in the names of a machine's channels.

        What was seen that no change of a parameter makes (`foreign`, empty if nothing) is the first suspect. Channels
        of the window that reach the end of their range explain what does not fit, too; not `faulty` ones, which it was
        evaluated without.
        """
        told = foreign or self.shapes or not self._doubtful
        limited = [] if told else at_range_end([window], Naming(channels), faulty)
        ends = f"{'; '.join(limited)}, the end of its range" if limited else ""
        suspect = foreign or ends or with_channel_names(self.deciding.suspect, channels)
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
        """Evaluate one full window, and with `newest` its latest hops for themselves, too.

        Raises
        ------
        EstimationError
            If the window cannot be evaluated: outside the speed range, speed not steady, no fluctuation in a channel.
        """

    def spared(self, plan: Plan, findings: Sequence[SensorFault]) -> tuple[str, ...] | None:
        """Sensors without which a window can be evaluated although these are at fault; None if it cannot be.

        A fault of a channel elsewhere says nothing of the equations, but it is all there is where they are none.
        """
        return () if not findings or (plan.states and implicated(findings).issubset(plan.others)) else None

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


def left_out(finding: SensorFault) -> SensorFault:
    """A fault of a sensor that the others are evaluated without."""
    return finding.model_copy(update={"text": f"{finding.text}; the machine is diagnosed without it"})


def settled(place: str, window: WindowStatistics, newest: Newest | None) -> tuple[WindowStatistics, int]:
    """The window without the hops in which a drive went from one set point to another, and how many came after them.

    Without a shaft angle the rotation cannot be taken out of those. `place` is what the machine is called.

    Raises
    ------
    EstimationError
        If too little is left.
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
    """How strong the rotation was when it last stood out of the vibration, where there is no shaft angle."""

    def __init__(self) -> None:
        self.power = 0.0

    def take(self, window: WindowStatistics) -> None:
        """Go on with a window."""
        if window.speed_source == "estimated":
            found = np.isfinite(window.hop_speed_rad_s)
            strength = float(np.median(window.hop_strength[found]))
            # Found in all hops it is no chance: after balancing, or at another set point, there may be less of it.
            self.power = strength * _noise(window) if strength > STRONG or found.all() else self.power

    def lost(self, window: WindowStatistics, operation: Operation) -> str:
        """In how many hops it was found, where that is not all of them and as much of it would stand out.

        A hop in which the shaft came to its speed, or left it, has a line that is much weaker than the others'.
        """
        found = np.isfinite(window.hop_speed_rad_s) & window.settled
        if window.speed_source == "phase reference" or self.power <= STRONG * _noise(window) or found.all():
            return ""
        slowest, fastest = (operation.speed_rpm * (1 + sign * operation.speed_tolerance) for sign in (-1, 1))
        return (
            f"the rotation was found in {np.count_nonzero(found)} of {found.size} hops, evaluation limit all of them: "
            f"the speed left {slowest:.0f} to {fastest:.0f} rpm or changed too fast, or hardly any unbalance is left"
        )


def _noise(window: WindowStatistics) -> float:
    """How strong a window is without its lines, as a power: over all channels, whatever their units."""
    power = np.median(np.einsum("fii->fi", window.spectrum).real, axis=0)
    return float(np.exp(np.log(np.maximum(power, np.finfo(float).tiny)).mean()))


def opinion_of(deciding: Diagnosis, other: Diagnosis) -> Opinion:
    """What another diagnostician says; one that could read nothing says why, once."""
    if other.evaluable:
        return Opinion(by=other.by, parameters=other.parameters, agreement=agreements(deciding, other))
    reasons = dict.fromkeys(reading.reason for reading in other.parameters)
    return Opinion(by=other.by, parameters=other.parameters, reason="; ".join(reasons) or "nothing to read")
