"""The vibration levels of one machine: taken of every window, and judged against limits and reference."""

import hashlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from models.alarm_names import LEVEL
from models.checkpoint import checked
from models.commissioning.commissioned import Installed
from models.diagnosis.likelihood.motions import natural_frequencies
from models.diagnosis.window.lines import LatestLines, new_line, steady_lines
from models.diagnosis.window.moments import HopMoments, Plan
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.levels.bands import NEIGHBOURHOOD
from models.levels.contact import LatestContact
from models.levels.judgement import Foreign, LevelJudge, channel_state, fallen
from models.levels.measures import STANDS_RAD_S, WindowLevels
from models.levels.orders import ORDERS
from models.levels.reference import FirstWindows, LevelReference, expected_levels
from models.machine import Machine, MachineFile
from models.signals.channels import state_name, with_channel_names
from rotorwatch.records.alarms import Evidence
from rotorwatch.records.levels import ChannelLevels
from service.monitor.alarms.book import AlarmBook

_DEPENDS_ON: Any = {
    **dict.fromkeys(("sensors", "rate_hz", "operation", "schedule"), True),
    "window": {"hop_s"},
    "levels": {"band_hz", "reference", "reference_windows", "reference_since"},
}
"""Of a machine file: what levels of first windows depend on. They outlast any other change, and another program."""
_WINDOWS_OF_CONTACT = 4
_STILL_RAD = 0.1
"""Less than this in a hop is no turning: an encoder may waver. The slowest kilns turn further."""
_NEARLY_ALL = 0.9
"""Part of a channel's random vibration from which on a new line hides what the machine does by itself."""
_OF_THE_ANGLE = {*ORDERS, "not_x1", "x1_phase_lag_deg", "x2_phase_lag_deg"}


class LevelWatch:
    """Judges the levels of every window, of a plan with levels."""

    def __init__(self, plan: Plan, machine: MachineFile, installed: Installed) -> None:
        if plan.levels is None:
            raise ValueError(f"{machine.title}: no levels are planned")
        self._columns, self._pairs = plan.columns, plan.levels.pairs
        channels = [machine.sensors[column] for column in plan.columns]
        self._judge = LevelJudge(plan.levels, channels, machine.levels)
        of = machine.levels.reference or ("first windows" if installed.watching else "commissioned")
        self._takes_first = of == "first windows"
        self._commissioned = None if installed.commissioned is None else installed.commissioned.levels
        self._by_theory = installed.known if installed.commissioned is None else None
        self._expected: LevelReference | None = None
        self._by_angle = plan.angle_column is not None
        self._first = FirstWindows(
            [one.name for one in channels],
            machine.levels.reference_windows,
            turns=self._by_angle or plan.speed_rad_s is not None,
            since=machine.levels.reference_since,
            of=hashlib.sha256(machine.model_dump_json(include=_DEPENDS_ON).encode()).hexdigest()[:16],
        )
        self._contact = LatestContact(_WINDOWS_OF_CONTACT * plan.hops)
        self._lines = LatestLines()
        self._moved, self._moved_ns = False, 0  # from when on all has been at about the newest speed
        self.latest: tuple[ChannelLevels, ...] = ()  # of the latest window; empty before the first hop
        self._found: WindowLevels | None = None
        self._to_learn: tuple[int, int, WindowLevels] | None = None  # if the shaft angle is in order
        self._states = [state_name(channel) for channel in channels]
        self._machine = machine
        self._hop_ns = round(machine.window.hop_s * 1e9)

    @property
    def reference(self) -> LevelReference | None:
        """What relative limits refer to; None while there is nothing."""
        return self._first.reference if self._takes_first else self._commissioned

    @property
    def _several_speeds(self) -> bool:
        """Whether lines lay in different bands at the speeds of the reference."""
        states = () if self.reference is None else self.reference.states
        speeds = [abs(edge) for state in states for edge in state.speed_rad_s or ()]
        return bool(speeds) and max(speeds) / (1 + NEIGHBOURHOOD) > min(speeds)

    def judged(self, levels: WindowLevels) -> tuple[ChannelLevels, ...]:
        """Levels, channel by channel, against what limits there are."""
        return self._judge.judge(levels, self.reference)

    def take(self, window: SlidingWindow, missing: Collection[str] = ()) -> None:
        """Take the levels of the window as it is after a hop, in which some channels lacked numbers."""
        self._to_learn = None
        found = window.levels(errors=self._takes_first and self._first.learning)
        if found is None:
            return
        self._moved, columns = self._has_moved(found, window.hops), self._at(missing)
        self.latest = self._judge.judge(found, self.reference, moved=self._moved, missing=columns)
        self._found = found
        stood = any(abs(hop.turned_rad) < _STILL_RAD for hop in window.hops)  # not where there is no angle: nan
        if self._takes_first and window.filled == 1 and not stood:
            learned = found.without(columns, self._pairs)
            self._to_learn = window.hops[0].start_ns, window.hops[-1].end_ns, learned

    def _at(self, states: Collection[str]) -> list[int]:
        """Columns of some channels."""
        return [column for column, state in enumerate(self._states) if state in states]

    def _has_moved(self, found: WindowLevels, hops: Sequence[HopMoments]) -> bool:
        """Whether lines lay in other bands for a part of the window, as they did in no healthy one."""
        speeds = found.speeds_rad_s
        if speeds is not None:
            turns = abs(speeds[-1]) > STANDS_RAD_S
            apart = np.abs(speeds / speeds[-1] - 1) > NEIGHBOURHOOD if turns else np.full(speeds.shape, False)
            if self._several_speeds:  # one that is not known, as in a run-up without a shaft angle, may be any of them
                apart |= np.isnan(speeds)
            if apart.any():  # the hop after them may have begun as they were
                self._moved_ns = hops[min(int(np.flatnonzero(apart)[-1]) + 1, len(hops) - 1)].end_ns
            elif self._moved_ns <= hops[-1].end_ns:  # those that were not known were at this speed but for the oldest
                self._moved_ns = min(self._moved_ns, hops[0].end_ns)
        if self.reference is not None and self.reference.at(found.speed_rad_s)[0].varied:
            return False
        return hops[0].start_ns < self._moved_ns <= hops[-1].end_ns  # it is later where the clock was set back

    def foreign(
        self, window: SlidingWindow, statistics: WindowStatistics, *, named: bool, faulty: Collection[str] = ()
    ) -> Foreign:
        """What the latest window shows that no change of a parameter makes: a new line, or see `LevelJudge.foreign`.

        Nothing is made of what `faulty` channels show.
        """
        turned = self.reference is not None and any(state.speed_rad_s for state in self.reference.states)
        if self._found is None:
            return Foreign()
        healthy, speed_rad_s = self.reference, statistics.speed_rad_s
        judge = partial(self._judge.foreign, named=named, faulty=self._at(faulty))
        if not statistics.settled.all() or (turned and statistics.speed_source == "unknown"):
            # What turns with the shaft is in the random part, too, and in lines: what pushes it back is told by hop.
            bare = replace(self._found, moments=None, lines=None)
            return judge(bare, self.latest, healthy, self._contact)
        if healthy is not None and healthy.lines is not None and math.isfinite(speed_rad_s) and speed_rad_s:
            lines = steady_lines(window.plan, window.hops, statistics, faulty)
            if healthy.faint:
                lines = self._lines.take(lines, statistics)
            line = new_line(lines, healthy.lines, speed_rad_s, beside=healthy.beside)
            if line is not None:
                order = f"{line.known(speed_rad_s)[1]:.{3 if line.beside else 2}f}"
                beats = ""
                if line.beside:
                    every_s = 1 / abs(line.frequency_hz - line.beside * abs(speed_rad_s) / (2 * math.pi))
                    # Two digits, without a power of ten.
                    beats = f", beats with the {line.beside}x every {float(f'{every_s:.2g}'):g} s"
                text = (
                    f"a line at {line.frequency_hz:.4g} Hz ({order} times running speed, {line.share:.0%} of the "
                    f"random vibration of {line.state}{beats}) that the healthy machine did not have: a neighbouring "
                    "machine, whirl or looseness"
                )
                return Foreign(with_channel_names(text, self._machine.sensors), hides=line.share >= _NEARLY_ALL)
        if self._by_theory is not None:
            healthy = self._expected or self._by_file(self._by_theory, self._found)
            if self._found.contact is not None and self._found.lines is not None:  # all of it can be told
                self._expected = healthy
        return judge(self._found, self.latest, healthy, self._contact)

    def _by_file(self, machine: Machine, levels: WindowLevels) -> LevelReference:
        """What theory says of a machine that nobody has commissioned."""
        operation, names = machine.operation, [machine.sensors[column].name for column in self._columns]
        slowest, fastest = (operation.speed_rad_s * (1 + sign * operation.speed_tolerance) for sign in (-1, 1))
        modes = zip(*(each.tolist() for each in natural_frequencies(machine)), strict=True)
        return expected_levels(names, levels, (slowest, fastest), tuple(modes))

    def checkpoint(self) -> dict[str, np.ndarray]:
        """What is remembered, as named arrays: the first windows, and what the latest had of a contact and of lines."""
        moved = {"moved_ns": np.array(self._moved_ns, dtype=np.int64)}
        return {**self._first.checkpoint(), **self._contact.checkpoint(), **self._lines.checkpoint(), **moved}

    def restore(self, arrays: Mapping[str, np.ndarray], *, first_alone: bool) -> None:
        """Go on where `checkpoint` was called, or with the first windows alone, which outlast a commissioning.

        Raises
        ------
        CheckpointError
            If the arrays are damaged, or of other channels.
        """
        self._first.restore(arrays)
        if not first_alone:
            self._contact.restore(arrays)
            self._lines.restore(arrays)
            self._moved_ns = int(checked(arrays, "moved_ns", np.int64, ()))

    def tell(
        self,
        alarms: AlarmBook,
        end_ns: int,
        *,
        faulty: Collection[str] = (),
        explained: bool = False,
        standing: bool = False,
    ) -> None:
        """Let operators hear of what is beyond its limits at the end of a hop.

        Parameters
        ----------
        faulty : collection of str
            States whose sensors are at fault: what they show may be no vibration, so only what is dangerously loud
            counts. Of a faulty shaft angle (``theta``) that is what turns with the shaft, in every channel: a hop in
            which the angle was lost has it at no multiple of its speed. It is not stated then, and nothing is compared
            with the machine as it was at several speeds.
        standing : bool
            Whether the machine stood in the window. The same counts then, unless the reference holds a machine that
            stands; without a shaft angle that says so what has fallen counts too, for its sensors may have no supply.
        explained : bool
            Whether alarms on parameters, without reserve, say what has become louder, and why: an alert is not raised
            beside them. What is raised already stays, and a danger is always told.
        """
        evidence = Evidence(start_ns=end_ns - self._hop_ns, end_ns=end_ns)
        turning = "theta" not in faulty
        if turning and self._to_learn is not None:
            self._first.take(*self._to_learn)
        known = () if self.reference is None else self.reference.states
        unlike = standing and all(one.speed_rad_s is not None for one in known)
        pairs = ((self._states[first], self._states[second]) for first, second in self._pairs)
        halved = {pair[0] for pair in pairs if not set(pair).isdisjoint(faulty)}
        self.latest = tuple(
            self._known(levels, turning=turning, halved=state in halved)
            for state, levels in zip(self._states, self.latest, strict=False)
        )
        for state, levels in zip(self._states, self.latest, strict=False):
            now, name = channel_state(levels), f"{LEVEL}{levels.channel}"
            held = state in faulty or (explained and not alarms.present(name))
            held |= unlike and (self._by_angle or not fallen(levels))
            beyond = now.beyond and (now.absolute or now.danger or not held)
            # In the deadband, while a sensor is at fault, or growth or s_max cannot be told, an alarm stays as it is.
            small = now.small and not self._moved and turning and state not in halved.union(faulty)
            alarms.update_state(name, beyond, end_ns, now.text, evidence=evidence, danger=now.danger, small=small)

    def _known(self, levels: ChannelLevels, *, turning: bool, halved: bool) -> ChannelLevels:
        """The same without what takes the angle, where it is at fault, or both probes of a place, where one is."""
        gone = (set() if turning else _OF_THE_ANGLE) | ({"s_max"} if halved else set())
        usual = turning or not self._several_speeds  # else the reference may be that of another speed
        kept = (one for one in levels.limits if one.measure not in gone and (usual or one.absolute))
        return levels.model_copy(update=dict.fromkeys(gone) | {"limits": tuple(kept)}) if gone else levels
