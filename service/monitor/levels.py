"""The vibration levels of one machine: measured in every window, and judged against limits and reference."""

import hashlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from models.alarm_names import LEVEL
from models.checkpoint import checked
from models.commissioning.commissioned import Installed
from models.diagnosis.window.lines import LatestLines, new_line, steady_lines
from models.diagnosis.window.moments import HopMoments, Plan
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.levels.bands import NEIGHBOURHOOD
from models.levels.contact import LatestContact
from models.levels.judgement import Foreign, LevelJudge, channel_state, fallen
from models.levels.measures import STANDS_RAD_S, WindowLevels
from models.levels.orders import ORDERS
from models.levels.reference import QUIET, FirstWindows, LevelReference, expected_levels
from models.machine import Machine, MachineFile
from models.physics.rotor import natural_frequencies
from models.signals.channels import state_name, with_channel_names
from rotorwatch.records.alarms import Evidence
from rotorwatch.records.levels import ChannelLevels
from rotorwatch.records.windows import SensorFault
from service.monitor.alarms.book import AlarmBook

_DEPENDS_ON: Any = {
    **dict.fromkeys(("sensors", "rate_hz", "operation", "schedule"), True),
    "window": {"hop_s"},
    "levels": {"band_hz", "reference", "reference_windows", "reference_since"},
}
"""Fields of a machine file on which the levels of first windows depend; these outlast other changes and updates."""
_WINDOWS_OF_CONTACT = 4
_LEAST_TURN_RAD = 0.1
"""A smaller turn in a hop counts as standstill: an encoder may waver. The slowest kilns turn further."""
_LEAST_HIDING_SHARE = 0.9
"""Share of a channel's random vibration from which a new line hides the machine's own vibration."""
_MEASURES_OF_ANGLE = {*ORDERS, "not_x1", "x1_phase_lag_deg", "x2_phase_lag_deg"}


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
        self._moved, self._moved_ns = False, 0  # time from which all data are at about the newest speed
        self.latest: tuple[ChannelLevels, ...] = ()  # of the latest window; empty before the first hop
        self._levels: WindowLevels | None = None
        self._to_learn: tuple[int, int, WindowLevels] | None = None  # learned unless the shaft angle is at fault
        self._states = [state_name(channel) for channel in channels]
        self._machine = machine
        self._hop_ns = round(machine.window.hop_s * 1e9)

    @property
    def reference(self) -> LevelReference | None:
        """Reference of the relative limits; None while there is none."""
        return self._first.reference if self._takes_first else self._commissioned

    @property
    def first_windows(self) -> str:
        """How far the first windows have come, in words; empty if they are not the reference."""
        return self._first.progress if self._takes_first else ""

    @property
    def _several_speeds(self) -> bool:
        """Whether the reference holds speeds so far apart that lines lay in different bands."""
        states = () if self.reference is None else self.reference.states
        speeds = [abs(edge) for state in states for edge in state.speed_rad_s or ()]
        return bool(speeds) and max(speeds) / (1 + NEIGHBOURHOOD) > min(speeds)

    def judged(self, levels: WindowLevels) -> tuple[ChannelLevels, ...]:
        """Judge levels, channel by channel, against the limits there are."""
        return self._judge.judge(levels, self.reference)

    def take(self, window: SlidingWindow, missing: Collection[str] = ()) -> None:
        """Take the levels of the window after a hop; `missing` channels had no signal in it."""
        self._to_learn = None
        found = window.levels(errors=self._takes_first and self._first.learning)
        if found is None:
            return
        self._moved, columns = self._has_moved(found, window.hops), self._columns_of(missing)
        self.latest = self._judge.judge(found, self.reference, moved=self._moved, missing=columns)
        self._levels = found
        stood = any(abs(hop.turned_rad) < _LEAST_TURN_RAD for hop in window.hops)  # False without a shaft angle: nan
        if self._takes_first and window.filled == 1 and not stood:
            learned = found.without(columns, self._pairs)
            self._to_learn = window.hops[0].start_ns, window.hops[-1].end_ns, learned

    def _columns_of(self, states: Collection[str]) -> list[int]:
        """Columns of the channels that measure these states."""
        return [column for column, state in enumerate(self._states) if state in states]

    def _has_moved(self, found: WindowLevels, hops: Sequence[HopMoments]) -> bool:
        """Whether the speed moved lines to other bands within the window, as in no healthy window."""
        speeds = found.speeds_rad_s
        if speeds is not None:
            turns = abs(speeds[-1]) > STANDS_RAD_S
            apart = np.abs(speeds / speeds[-1] - 1) > NEIGHBOURHOOD if turns else np.full(speeds.shape, False)
            unknown = np.isnan(speeds)
            # An unknown speed, as in a run-up without a shaft angle, may be any of several.
            apart |= unknown & (self._several_speeds or _starts_or_stops(found))
            if apart.any():  # the next hop may have begun at the other speed
                self._moved_ns = hops[min(int(np.flatnonzero(apart)[-1]) + 1, len(hops) - 1)].end_ns
            elif self._moved_ns <= hops[-1].end_ns and not unknown.all():
                # Hops of unknown speed were at this one, except the oldest.
                self._moved_ns = min(self._moved_ns, hops[0].end_ns)
        if self.reference is not None and self.reference.at(found.speed_rad_s)[0].varied:
            return False
        return hops[0].start_ns < self._moved_ns <= hops[-1].end_ns  # later only if the clock was set back

    def foreign(
        self, window: SlidingWindow, statistics: WindowStatistics, *, named: bool, faulty: Collection[str] = ()
    ) -> Foreign:
        """What the latest window shows that no change of a parameter makes: a new line, or see `LevelJudge.foreign`.

        `faulty` channels are ignored.
        """
        turned = self.reference is not None and any(state.speed_rad_s for state in self.reference.states)
        if self._levels is None:
            return Foreign()
        healthy, speed_rad_s = self.reference, statistics.speed_rad_s
        judge = partial(self._judge.foreign, named=named, faulty=self._columns_of(faulty))
        if not statistics.settled.all() or (turned and statistics.speed_source == "unknown"):
            # Rotation has leaked into the random part and the lines, so leave both out; contact is judged hop by hop.
            bare = replace(self._levels, moments=None, lines=None)
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
                return Foreign(with_channel_names(text, self._machine.sensors), hides=line.share >= _LEAST_HIDING_SHARE)
        if self._by_theory is not None:
            healthy = self._expected or self._theoretical_reference(self._by_theory, self._levels)
            if self._levels.contact is not None and self._levels.lines is not None:  # the reference is complete
                self._expected = healthy
        return judge(self._levels, self.latest, healthy, self._contact)

    def _theoretical_reference(self, machine: Machine, levels: WindowLevels) -> LevelReference:
        """Reference from theory, for a machine that has not been commissioned."""
        operation, names = machine.operation, [machine.sensors[column].name for column in self._columns]
        slowest, fastest = (operation.speed_rad_s * (1 + sign * operation.speed_tolerance) for sign in (-1, 1))
        modes = zip(*(each.tolist() for each in natural_frequencies(machine.rotor, operation.speed_rad_s)), strict=True)
        return expected_levels(names, levels, (slowest, fastest), tuple(modes))

    def rewired(self) -> tuple[SensorFault, ...]:
        """Which places' sensors were exchanged or reversed, as the latest window shows; see `LevelJudge.rewired`."""
        if self._levels is None or self.reference is None:
            return ()
        found = self._judge.rewired(self._levels, self.reference)
        return () if found is None else (found,)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """State as named arrays: the first windows, and contact and lines in the latest ones."""
        moved = {"moved_ns": np.array(self._moved_ns, dtype=np.int64)}
        return {**self._first.checkpoint(), **self._contact.checkpoint(), **self._lines.checkpoint(), **moved}

    def restore(self, arrays: Mapping[str, np.ndarray], *, first_alone: bool) -> None:
        """Continue from a checkpoint, or (`first_alone`) from its first windows only, which outlast a commissioning.

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
        """Update the alarms on levels at the end of a hop.

        Parameters
        ----------
        faulty : collection of str
            States whose sensors are at fault. Their signal may not be vibration, so only absolute limits and dangers
            count. If the shaft angle (``theta``) is at fault, order levels of all channels are left out, as a hop
            that lost the angle has them at no multiple of its speed, and nothing is compared with a reference of
            several speeds.
        standing : bool
            Whether the machine stood in the window. The same limits count then, unless the reference holds a standing
            machine; without a shaft angle, fallen levels count too, as the sensors may have lost their supply.
        explained : bool
            Whether alarms on parameters already explain, without reserve, what has become louder. No new alert is
            raised then; present ones stay, and absolute limits and dangers always count.
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
            self._without_unmeasurable(levels, turning=turning, halved=state in halved)
            for state, levels in zip(self._states, self.latest, strict=False)
        )
        for state, levels in zip(self._states, self.latest, strict=False):
            now, name = channel_state(levels), f"{LEVEL}{levels.channel}"
            held = state in faulty or (explained and not alarms.present(name))
            held |= unlike and (self._by_angle or not fallen(levels))
            beyond = now.beyond and (now.absolute or now.danger or not held)
            # An alarm stays as it is in the deadband, while a sensor is at fault, and without growth or s_max.
            small = now.small and not self._moved and turning and state not in halved.union(faulty)
            alarms.update_state(name, beyond, end_ns, now.text, evidence=evidence, danger=now.danger, small=small)

    def _without_unmeasurable(self, levels: ChannelLevels, *, turning: bool, halved: bool) -> ChannelLevels:
        """Drop measures that need the shaft angle if not `turning`, or both probes of a place if `halved`."""
        gone = (set() if turning else _MEASURES_OF_ANGLE) | ({"s_max"} if halved else set())
        usual = turning or not self._several_speeds  # else the reference may be that of another speed
        kept = (one for one in levels.limits if one.measure not in gone and (usual or one.absolute))
        return levels.model_copy(update=dict.fromkeys(gone) | {"limits": tuple(kept)}) if gone else levels


def _starts_or_stops(levels: WindowLevels) -> npt.NDArray[np.bool_]:
    """Hops in which a machine without a shaft angle seems to start or stop, if their speed is unknown; shape (n_hops,).

    Either no hop before, or none after, has the speed of the others; between hops of one speed only the line is lost.
    Or every channel vibrates much less than in the newest hop, as before a run-up.
    """
    if levels.settled is None or levels.moments is None:
        return np.array(False)
    lost, square = ~levels.settled, levels.moments[0]
    ends = np.logical_and.accumulate(lost) | np.logical_and.accumulate(lost[::-1])[::-1]
    return np.asarray(ends | ~(square > QUIET**2 * square[-1]).any(axis=1))
