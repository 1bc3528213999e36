"""The data path of one machine: block in, report out. Read this first.

::

    payload -> Arrivals -> Gate -> SlidingWindow -> WindowEvaluator -> SequentialTest -> AlarmBook -> MonitorReport
               (order)   (ingest)  (correlations)     (residuals)     (what changed)     (alarms)

`MachineMonitor` knows no network, clock or thread: all times are the data's own. Live running and replay are two ways
of feeding it, and the same blocks give the same reports. What it remembers can be taken out between two blocks and put
into another one, which goes on as if nothing had happened.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from models.alarm_names import SHAPE
from models.arrivals import Arrivals, Arrived, Senders
from models.checkpoint import checked, prefixed, texts, unprefixed
from models.commissioning.commissioned import Installed
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.missing import MissingNumbers, completed
from models.diagnosis.sensors.reference import implicated
from models.diagnosis.sensors.standstill import Standstill
from models.diagnosis.verdict.calibration import detectable_changes
from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest
from models.diagnosis.verdict.sequential_state import SequentialState
from models.diagnosis.verdict.stretch import stretch_of
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import CheckpointError, EstimationError, WireError
from models.ingest import Admission, Gate, Reason, lasting
from models.levels.judgement import growth_seen
from models.signals.block import NewestBlocks, SampleBlock
from models.signals.wire import decode_block
from rotorwatch.records.alarms import Evidence
from rotorwatch.records.fields import finite
from rotorwatch.records.health import HealthState, Quality, Report
from service.monitor.alarms.alarm import AlarmEvent
from service.monitor.alarms.book import AlarmBook
from service.monitor.alarms.data_path import DataPathAlarms
from service.monitor.alarms.operation import OperatorAction
from service.monitor.evaluation import left_out
from service.monitor.evaluators import evaluator_for
from service.monitor.levels import LevelWatch
from service.monitor.parts import divided, joined
from service.monitor.reports import MachineHealth, MonitorReport, MonitorState, counted, identity_of

_RPM = 30 / np.pi
_SKIPPED = "not evaluated: this computer cannot keep up; levels and sensors were judged"


class MachineMonitor:
    """Monitors one machine.

    Parameters
    ----------
    skips : callable
        Takes the end of a hop and says whether its window is not to be evaluated: live, because the computer cannot
        keep up; in a replay, because the live monitor did not.
    remembered : bool
        Whether `state` will be asked for; what is only for that takes time with every hop.

    Attributes
    ----------
    used : bool
        Whether the latest message was itself used at once, and not one that waited for it.
    end_ns : int or None
        End of the newest data; None before the first.
    """

    def __init__(
        self, installed: Installed, skips: Callable[[int], bool] = lambda _: False, *, remembered: bool = True
    ) -> None:
        self.machine = machine = installed.machine
        self.identity = identity_of(installed)
        self._skips = skips
        self._evaluator = judge = evaluator_for(installed)
        self._sensors = None if installed.commissioned is None else installed.commissioned.sensors
        self._standstill = Standstill(self._sensors)
        self._plan = plan = plan_for(machine, lagged=judge.needs_lags, levels=True, thorough=installed.thorough)
        self.watching = installed.watching or not plan.states
        self._levels = LevelWatch(plan, machine, installed)
        self._senders, self._arrivals = Senders(), Arrivals(machine.ingest.reorder_blocks)
        self._due: deque[Arrived] = deque()
        self._done: list[MonitorReport] = []
        self._gate, self._missing = Gate(machine, partial=True), MissingNumbers(machine.sensors)
        channels = len(machine.sensors)
        self._window = SlidingWindow(plan, remembered=remembered, lines=installed.lines, channels=channels)
        self._test = SequentialTest(SequentialSettings.for_machine(machine, short=judge.takes_short), by=judge.by)
        self._alarms = AlarmBook(machine.alarms)
        self._data_path = DataPathAlarms(self._alarms, machine)
        self._parts = (
            ("gate", self._gate), ("evaluator", judge), ("standstill", self._standstill),
            ("data_path", self._data_path), ("missing", self._missing),
        )  # fmt: skip
        self._quality, self._accepted = Quality(), 0
        self._latest: Report | None = None
        self._calm = HealthState.WARMING
        self.end_ns: int | None = None
        self._reached_ns: int | None = None
        self._kept_is_valid = True
        self._not_recalled = self._dropped = 0
        self._held: list[tuple[bytes, bytes, str]] = []
        self._drops: dict[tuple[int, int], int] = {}
        self._fault = ""
        self._defect: Exception | None = None
        self.window: Callable[[], WindowStatistics] | None = None  # makes that of the latest report, if it was full
        self._newest = NewestBlocks(20_000)
        self._used: SampleBlock | None = None
        self.used, self.could_use, self.begin = False, self._gate.could_use, self._gate.begin

    def step_payload(
        self, payload: bytes, attachment: bytes, encoding: str, dropped_before: int = 0
    ) -> tuple[MonitorReport, ...]:
        """Decode a message of the stream and take what is in order now as `step` does.

        Parameters
        ----------
        payload, attachment, encoding : bytes, bytes, str
            See `models.signals.wire`.
        dropped_before : int
            Messages before this one that this computer could not keep up with.

        Returns
        -------
        tuple of MonitorReport
            One per block that was taken: none while a block waits for an earlier one, several when that has come.
            Undecodable bytes are a refusal like any other.
        """
        self._dropped += dropped_before
        self.used = False
        try:
            block, schema_hash = decode_block(payload, attachment, encoding)
        except WireError as error:
            return (MonitorReport(self._count(Admission(Reason.MALFORMED, f"{self.machine.title}: {error}"))),)
        if (misshapen := self._gate.form(block, schema_hash)) is not None:  # before its run and number are used
            return (MonitorReport(self._count(misshapen)),)
        if self._window.lacks or self._gate.had(block):  # the latter is no news, and no fault of the publisher
            if self._gate.knows(block):
                self._recall(block)
            else:  # one that is known may have been overtaken
                self._held.append((payload, attachment, encoding))
            return self._released()
        if self._disputed(block):
            text = f"block {block.sequence} of run {block.run} arrived in two versions; neither is used"
            verdict = Admission(Reason.CONFLICT, f"{self.machine.title}: {text}")
            return (MonitorReport(self._count(verdict), events=self._alarms.take()),)
        if self._dropped:
            self._drops[block.run, block.sequence], self._dropped = self._dropped, 0
        self._due.extend(self._arrivals.take(block, schema_hash))
        done, self.used = self._step_due(), self._used is block
        return done

    def recall(self, payload: bytes, attachment: bytes, encoding: str) -> bool:
        """Take a message of a recording, for the window that a restored monitor lacks; nothing else comes of it.

        Returns whether it is the newest block that the monitor has had: what was recorded after it is new.
        """
        try:
            block, schema_hash = decode_block(payload, attachment, encoding)
        except WireError:
            return False
        return self._gate.form(block, schema_hash) is None and self._gate.knows(block) and self._recall(block)

    def _recall(self, block: SampleBlock) -> bool:
        newest = self._gate.is_newest(block)
        self._window.recall(completed(block).samples, block.start_ns, newest=newest)
        return newest

    @property
    def recalled(self) -> str:
        """What became of a window that was to be recalled, in words; empty if nothing of it is missing."""
        if self._window.lacks:
            return "there is no window until its samples are received again"
        lost = self._not_recalled
        return f"{lost} hops of the window were not received again, and it is filling anew" if lost else ""

    def _released(self) -> tuple[MonitorReport, ...]:
        """New blocks that came while the window was recalled, once it is there or not waited for any longer."""
        if self._window.lacks and len(self._held) <= self.machine.ingest.reorder_blocks:
            return ()
        self._not_recalled += self._window.give_up()
        held, self._held = self._held, []
        return tuple(report for one in held for report in self.step_payload(*one))

    def flush(self) -> tuple[MonitorReport, ...]:
        """Take the blocks that wait for earlier ones: those will not come any more."""
        self._not_recalled += self._window.give_up()
        self._done += self._released()
        self._due.extend(self._arrivals.flush())
        return self._step_due()

    def _disputed(self, block: SampleBlock) -> bool:
        """Whether a block contradicts one that has come; what is known of publishers is brought to the alarm."""
        disputed = self._senders.take(block)
        if disputed and not self._arrivals.withdraw(block.run, block.sequence):
            self._window.gap()  # the other version may be in the unfinished hop
        if conflict := self._senders.conflict:
            self._data_path.conflict(conflict, block.end_ns if self.end_ns is None else self.end_ns, at_once=True)
        return disputed

    def _step_due(self) -> tuple[MonitorReport, ...]:
        """Take what is due; a defect that one block brings to light leaves the others for the next time."""
        while self._due:
            one = self._due.popleft()
            self._done.append(self.step(one.block, None))
        done, self._done = tuple(self._done), []
        return done

    def step(self, block: SampleBlock, schema_hash: str | None = "") -> MonitorReport:
        """Take one block: gate, window, evaluation, alarms.

        Parameters
        ----------
        schema_hash : str or None
            Hash of the channel descriptor the sender named, see `Gate.judge`.

        Returns
        -------
        MonitorReport
            Immutable; refused blocks, gaps and defects of the monitor are stated in it, never raised.
        """
        dropped = self._drops.pop((block.run, block.sequence), 0)
        verdict = self._judged(block, schema_hash, dropped)
        if not verdict.accepted:
            self._dropped += dropped
            return MonitorReport(verdict)
        self._used, block = block, self._missing.take(block)
        windows: list[Report] = []
        try:
            windows.extend(map(self._evaluate, self._hops(block, verdict, dropped)))  # each before the next hop
        except Exception as error:  # whatever it is, the machine must not look healthy on account of it
            self._window.gap()
            self._failed(error, block.end_ns)
        fault, self._defect = self._defect, None
        return MonitorReport(verdict, tuple(windows), self._alarms.take(), len(block.samples) / block.rate_hz, fault)

    def _hops(self, block: SampleBlock, verdict: Admission, dropped: int) -> Iterable[int]:
        """Take an accepted block into the window; ends of the hops that it completes, each to be evaluated in turn."""
        self._not_recalled += self._window.give_up()
        joined = verdict.continuous and not verdict.new_snapshot
        if not joined:
            self._window.gap()
        self._newest.add(self._used or block, continuous=joined and not verdict.clock_step_s)
        if verdict.clock_step_s:
            self._window.clear()
            self._kept_is_valid = False  # hops may end at the same times as before
            self._test.clear()
            self._alarms.clock_stepped(block.start_ns, round(verdict.clock_step_s * 1e9))
        elif self.end_ns is None and self._reached_ns is not None:
            # Until now the time of day was all there was; shelving goes on by the time of the data.
            self._alarms.clock_stepped(block.start_ns, block.start_ns - self._reached_ns)
        self._alarms.passed(block.start_ns)
        self._fault = self._data_path.accepted(verdict, block.start_ns, dropped) or self._fault
        self.end_ns = block.end_ns
        return self._window.feed(block.samples, block.start_ns)

    def fault(self, what: str, time_ns: int) -> tuple[AlarmEvent, ...]:
        """Raise the alarm on the monitor itself, at a data time; it clears once windows are evaluated again."""
        self._data_path.fault(what, time_ns)
        return self._alarms.take()

    def _failed(self, error: Exception, time_ns: int) -> None:
        """A defect: nothing can be said of the machine until a window is evaluated again."""
        self._defect = error
        self._fault = f"a defect in the monitor, not in the machine: {type(error).__name__}: {error}"
        self._data_path.fault(self._fault, time_ns)

    def passed(self, time_ns: int) -> tuple[AlarmEvent, ...]:
        """Take note of time that has passed, with data or without.

        Parameters
        ----------
        time_ns : int
            Data time that has been reached by now, as far as anybody knows.
        """
        self._reached_ns = time_ns
        self._alarms.passed(time_ns)
        self._data_path.passed(time_ns, self.end_ns)
        return self._alarms.take()

    @property
    def blocks_to_hop(self) -> int:
        """How many more blocks like the latest one complete a hop, at least one: little is news before."""
        return 1 if self._used is None else max(1, -(-self._window.lacking // self._used.samples.shape[0]))

    @property
    def blocks(self) -> tuple[SampleBlock, ...]:
        """The newest blocks, without a gap, about 20 000 samples at most."""
        return self._newest.blocks

    @property
    def next_sequence(self) -> int:
        """Number the next alarm event will have."""
        return self._alarms.next_sequence

    def operate(self, operation: OperatorAction, time_ns: int) -> tuple[AlarmEvent, ...]:
        """Do what an operator asks for, see `AlarmBook.operate`."""
        self._reached_ns = time_ns
        self._alarms.operate(operation, time_ns)
        return self._alarms.take()

    def take_events(self) -> tuple[AlarmEvent, ...]:
        """What has happened and was never handed over, because a defect came in between."""
        return self._alarms.take()

    def state(self, kept: Collection[str] = (), *, whole: bool = False) -> MonitorState:
        """What is remembered, without parts named in `kept`; with `whole` the window too, megabytes."""
        arrays = {
            **prefixed("window", self._window.checkpoint(whole=whole)),
            **prefixed("test", self._test.state.checkpoint()),
            **prefixed("levels", self._levels.checkpoint()),
            **{key: one for name, part in self._parts for key, one in prefixed(name, part.checkpoint()).items()},
            "calm": np.array([self._calm.value]),
            "end_ns": np.array([] if self.end_ns is None else [self.end_ns], dtype=np.int64),
        }
        state, new, names = divided(arrays, self._test.state.hops(), kept if self._kept_is_valid else ())
        self._kept_is_valid = True
        return MonitorState(self._alarms.checkpoint(), state, new, names, self.end_ns)

    def restore(self, state: bytes, parts: Collection[bytes] = (), *, levels_alone: bool = False) -> None:
        """Go on where another monitor of the same machine, files and version stood; alarms are restored by themselves.

        With `levels_alone` these may differ: of all that was remembered only the first windows are taken.

        Raises
        ------
        CheckpointError
            If the bytes are damaged or of another form; this monitor is of no use then.
        """
        arrays, hops = joined(state, parts)
        self._levels.restore(unprefixed("levels", arrays), first_alone=levels_alone)
        if levels_alone:
            return
        test = SequentialState.restored(unprefixed("test", arrays), hops)
        calm = texts(arrays, "calm")
        if calm not in {(state.value,) for state in HealthState}:
            raise CheckpointError(f"calm is {calm}, expected one of {', '.join(HealthState)}")
        end_ns = next(iter(checked(arrays, "end_ns", np.int64, (None,)).tolist()), None)
        self._window.restore(unprefixed("window", arrays))
        for name, part in self._parts:
            part.restore(unprefixed(name, arrays))
        self._test.state = test
        self.end_ns, self._calm = end_ns, HealthState(*calm)
        self._arrivals.resume(self._gate.courses)

    def restore_alarms(self, alarms: str, next_sequence: int | None = None, end_ns: int | None = None) -> None:
        """Go on with the alarms of another monitor, see `AlarmBook.restore`.

        Parameters
        ----------
        end_ns : int, optional
            End of the newest data of the other monitor, where nothing else of it was restored: the times of the alarms
            are of the same clock.
        """
        self._alarms.restore(alarms, next_sequence)
        self.end_ns = end_ns if self.end_ns is None else self.end_ns

    def health(self) -> MachineHealth:
        """Where the machine stands now."""
        return MachineHealth(
            self._state(HealthState.NOT_EVALUABLE if self._fault else self._calm),  # what operators did counts at once
            self._window.filled,
            self._latest,
            self._alarms.alarms,
            self._quality.model_copy(update={"accepted_blocks": self._accepted}),
            self._alarms.next_sequence - 1,
            self._fault or ("" if self._latest is None else self._latest.reason),
            self.end_ns,
        )

    def _judged(self, block: SampleBlock, schema_hash: str | None, dropped: int) -> Admission:
        """What the gate says; of the data that another monitor had before this one it knows nothing."""
        anew = not self._gate.courses
        verdict = self._gate.judge(block, schema_hash)
        if anew and verdict.accepted and self.end_ns is not None:
            name, ingest = self.machine.title, self.machine.ingest
            late_s = (block.start_ns - self.end_ns) / 1e9
            if abs(late_s) > ingest.max_jump_s:
                text = f"{name}: the stream's clock is {lasting(late_s)} from where it was before the restart"
                verdict = Admission(text=text, clock_step_s=late_s, new_run=block.sequence == 0)
            elif late_s > ingest.time_tolerance_s:
                text = f"{name}: {lasting(late_s)} of data are missing across the restart"
                verdict = Admission(text=text, gap_s=late_s)
        if dropped and verdict.gap_s > 0:
            text = f"{dropped} blocks ({lasting(verdict.gap_s)} of data) were not evaluated: the monitor cannot keep up"
            verdict = replace(verdict, text=f"{self.machine.title}: {text}")
        self._data_path.judged(verdict, block.start_ns)
        return self._count(verdict)

    def _count(self, verdict: Admission) -> Admission:
        self._accepted += verdict.accepted
        if not verdict.continuous:
            self._quality = counted(self._quality, verdict)
        return verdict

    def _evaluate(self, end_ns: int) -> Report:
        """Evaluate the window as it is after a completed hop; a defect is a reason why it cannot be."""
        self._fault = ""
        skipped = self._skips(end_ns) and self._window.filled == 1
        try:
            report = self._evaluated(end_ns, skipped=skipped)
        except Exception as error:
            self._failed(error, end_ns)
            state = self._state(HealthState.NOT_EVALUABLE)
            report = Report(**self._window_now(end_ns, end_ns, state), reason=self._fault)
        if skipped:
            report, count = report.model_copy(update={"skipped": True}), self._quality.skipped_windows + 1
            self._quality = self._quality.model_copy(update={"skipped_windows": count})
        self._latest = report
        self._alarms.suppress(None, end_ns)
        return report

    def _evaluated(self, end_ns: int, *, skipped: bool) -> Report:
        self._data_path.hop(end_ns, skipped=skipped)
        self._data_path.conflict(self._senders.conflict, end_ns)
        missing = self._missing.found(self._window.first_ns, end_ns)
        self._levels.take(self._window, implicated(missing))
        statistics, self.window = self._window.statistics(), self._window.again()
        there = statistics or self._window.statistics(len(self._window.hops))  # while it fills
        stood = "" if there is None else self._standstill.found(there)
        if statistics is None:
            if missing and there is not None:  # it ends no other fault: those are looked for in whole windows
                self._data_path.sensors(missing, there, standing=True)
            self._levels.tell(self._alarms, end_ns, faulty=implicated(missing), standing=bool(stood))
            return Report(**self._window_now(end_ns, end_ns, self._state(HealthState.WARMING)), sensors=missing)
        findings = sensor_findings(statistics, self._sensors, self.machine.sensors, missing, standing=bool(stood))
        usable = self._evaluator.usable(statistics, self._plan, findings)
        if usable is not None and usable is not statistics and not stood:
            findings = tuple(map(left_out, findings))
        start_ns, faulty = statistics.start_ns, implicated(findings)
        speed = None if "theta" in faulty else finite(statistics.speed_rad_s)
        self._alarms.suppress(None if speed is None else speed * _RPM, end_ns)
        self._data_path.sensors(findings, statistics, standing=bool(stood))
        self._evaluator.heard(findings)

        def unread(state: HealthState, reason: str) -> Report:
            """Of the levels and the sensors alone."""
            self._levels.tell(self._alarms, end_ns, faulty=faulty, standing=bool(stood))
            now = self._window_now(start_ns, end_ns, self._state(state))
            return Report(**now, speed_rad_s=speed, sensors=findings, reason=reason)

        if usable is None:
            return unread(HealthState.DATA_HEALTH, "; ".join(each.text for each in findings))
        if stood or skipped:
            return unread(HealthState.NOT_EVALUABLE, stood or _SKIPPED)
        try:
            evaluation = self._evaluator.evaluate(usable, (self._window, self._test))
        except EstimationError as error:
            return unread(HealthState.WATCHING if self.watching else HealthState.NOT_EVALUABLE, str(error))
        foreign = self._levels.foreign(self._window, statistics, named=bool(self._test.state.findings), faulty=faulty)
        evaluation = evaluation.named(self.machine.sensors, statistics, foreign.text)
        looks = {n: stretch_of(one, self._window.hops[-n].start_ns, end_ns) for n, one in evaluation.short.items()}
        whole = self._test.settings.window_hops
        looks[whole] = stretch_of(evaluation.deciding, start_ns, end_ns)
        verdict = self._test.update(looks, foreign=foreign.text != "", rivals=evaluation.rivals(foreign))
        unexplained, suspect = evaluation.deciding.unexplained, evaluation.deciding.suspect
        astride_s = self._test.astride_s if evaluation.alone and not foreign.text else 0.0
        explains = self._alarms.found(verdict, self._test.unexplained, suspect, end_ns, astride_s, hidden=foreign.hides)
        self._levels.tell(self._alarms, end_ns, faulty=faulty, explained=explains)
        reason = evaluation.reason(told=bool(verdict.current))
        if evaluation.shapes:
            changed, evidence = evaluation.unlike_healthy, Evidence(start_ns=start_ns, end_ns=end_ns)
            self._alarms.update_state(SHAPE, changed != "", end_ns, changed, evidence=evidence)
        look, length_s = looks[whole].complete(), self.machine.window.length_s
        calm = evaluation.calm(outside=verdict.outside_model, without=usable is not statistics)
        if not self._plan.states and self._levels.reference is not None:
            calm, reason = HealthState.UNCHANGED, ""
        return Report(
            **self._window_now(start_ns, end_ns, self._state(calm)),
            **evaluation.read,
            misfit_z=evaluation.deciding.misfit_z,
            suspect=suspect if verdict.outside_model or foreign.hides else "",
            verdict=verdict,
            sensors=findings,
            detectable=() if unexplained else detectable_changes(look, self._test.thresholds(whole), length_s),
            reason=reason,
            shapes=evaluation.shapes,
        )

    def _window_now(self, start_ns: int, end_ns: int, state: HealthState) -> dict[str, Any]:
        """What every report on a window begins with."""
        little = state in {HealthState.UNCHANGED, HealthState.WATCHING}  # is claimed: what would be seen has to be said
        return {
            **self.identity,
            "start_ns": start_ns,
            "end_ns": end_ns,
            "state": state,
            "filled": self._window.filled,
            "levels": self._levels.latest,
            "level_growth": growth_seen(self._levels.latest) if little else None,
        }

    def _state(self, otherwise: HealthState) -> HealthState:
        """A raised alarm outranks warming and not-evaluable: missing data clears nothing."""
        self._calm = otherwise
        severity = self._alarms.severity
        return otherwise if severity is None else HealthState[severity.name]
