"""The data path of one machine: block in, report out. Read this first.

::

    payload -> Arrivals -> Gate -> SlidingWindow -> WindowEvaluator -> SequentialTest -> AlarmBook -> MonitorReport
               (order)   (ingest)  (correlations)     (residuals)     (what changed)     (alarms)

`MachineMonitor` knows no network, clock or thread: all times are the data's own. Live running and replay are two ways
of feeding it, and the same blocks give the same reports. Its state can be saved between two blocks and restored in
another monitor, which continues as if nothing had happened.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace

import numpy as np

from models.arrivals import Arrivals, Senders
from models.checkpoint import checked, prefixed, texts, unprefixed
from models.commissioning.commissioned import Installed
from models.diagnosis.sensors.missing import MissingNumbers, completed
from models.diagnosis.verdict.sequential_state import SequentialState
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import CheckpointError, WireError
from models.ingest import Admission, Gate, Reason, lasting
from models.signals.block import NewestBlocks, SampleBlock
from models.signals.wire import decode_block
from rotorwatch.records.health import HealthState, Quality, Report
from service.monitor.alarms.alarm import AlarmEvent, OperatorAction
from service.monitor.alarms.book import AlarmBook
from service.monitor.alarms.data_path import DataPathAlarms
from service.monitor.reporting import WindowReporter
from service.monitor.reports import MachineHealth, MonitorReport, MonitorState, counted, divided, joined


class MachineMonitor:
    """Monitors one machine.

    Parameters
    ----------
    skips : callable
        Takes the end of a hop, ns, and returns whether its window is to be skipped: live, because the computer cannot
        keep up; in a replay, because the live monitor skipped it.
    remembered : bool
        Whether `state` will be called; preparing for it takes time with every hop.

    Attributes
    ----------
    used : bool
        Whether the block used last is that of the latest message, rather than one that had waited for it.
    end_ns : int or None
        End of the newest data; None before the first.
    """

    def __init__(
        self, installed: Installed, skips: Callable[[int], bool] = lambda _: False, *, remembered: bool = True
    ) -> None:
        self.machine = machine = installed.machine
        self._skips = skips
        self.alarms = AlarmBook(machine.alarms, by_angle="theta" in machine.descriptor.states)
        self._data_path = DataPathAlarms(self.alarms, machine)
        self._reporter = reporter = WindowReporter(installed, self.alarms, self._data_path, remembered=remembered)
        self.identity, self.watching = reporter.identity, reporter.watching
        self._window, self._levels, self._test = reporter.samples, reporter.levels, reporter.test
        self._senders, self._arrivals = Senders(), Arrivals(machine.ingest.reorder_blocks)
        self._due: deque[SampleBlock] = deque()
        self._done: list[MonitorReport] = []
        self._gate, self._missing = Gate(machine, partial=True), MissingNumbers(machine.sensors)
        self._parts = (
            ("gate", self._gate), ("evaluator", reporter.evaluator), ("standstill", reporter.standstill),
            ("data_path", self._data_path), ("missing", self._missing),
        )  # fmt: skip
        self._quality, self._accepted, self._refused = Quality(), 0, False
        self._latest: Report | None = None
        self.end_ns: int | None = None
        self._reached_ns: int | None = None
        self._kept_is_valid = True
        self._not_recalled = self._dropped = 0
        self._held_messages: list[tuple[bytes, bytes, str]] = []
        self._drops: dict[tuple[int, int], int] = {}
        self._fault = ""
        self._defect: Exception | None = None
        self._newest = NewestBlocks(20_000)
        self._used: SampleBlock | None = None
        self.used, self.could_use, self.begin = False, self._gate.could_use, self._gate.begin

    def step_payload(
        self, payload: bytes, attachment: bytes, encoding: str, dropped_before: int = 0
    ) -> tuple[MonitorReport, ...]:
        """Decode a message of the stream (`models.signals.wire`), and `step` every block that is in order now.

        `dropped_before` are messages before this one that were dropped because this computer could not keep up. Returns
        one report per block that was taken: none while a block waits for an earlier one, several when that has come.
        Undecodable bytes are a refusal like any other.
        """
        self._dropped += dropped_before
        self.used = False
        try:
            block = decode_block(payload, attachment, encoding)
        except WireError as error:
            return (MonitorReport(self._count(Admission(Reason.MALFORMED, f"{self.machine.title}: {error}"))),)
        if (misshapen := self._gate.form(block)) is not None:  # before its run and number are used
            self._data_path.judged(misshapen, block.start_ns)
            return (MonitorReport(self._count(misshapen)),)
        if self._window.lacks or self._gate.had(block):  # `had`: sent again after a restart, neither new nor a mistake
            if self._gate.knows(block):
                self._recall(block)
            else:  # a new block may have overtaken a known one
                self._held_messages.append((payload, attachment, encoding))
            return self._step_held()
        if self._disputed(block):
            text = f"block {block.sequence} of run {block.run} arrived in two versions; neither is used"
            verdict = Admission(Reason.CONFLICT, f"{self.machine.title}: {text}")
            return (MonitorReport(self._count(verdict), events=self.alarms.take()),)
        if self._dropped:
            self._drops[block.run, block.sequence], self._dropped = self._dropped, 0
        self._due.extend(self._arrivals.take(block))
        done, self.used = self._step_due(), self._used is block
        return done

    def recall(self, payload: bytes, attachment: bytes, encoding: str) -> bool:
        """Take a recorded message to refill the window of a restored monitor, and for nothing else.

        Returns whether it is the newest block that the monitor has had: blocks recorded after it are new.
        """
        try:
            block = decode_block(payload, attachment, encoding)
        except WireError:
            return False
        return self._gate.form(block) is None and self._gate.knows(block) and self._recall(block)

    def _recall(self, block: SampleBlock) -> bool:
        newest = self._gate.is_newest(block)
        self._window.recall(completed(block).samples, block.start_ns, newest=newest)
        return newest

    @property
    def recalled(self) -> str:
        """What is missing of a window that was to be refilled after a restart, in words; empty if nothing is."""
        if self._window.lacks:
            return "there is no window until its samples are received again"
        lost = self._not_recalled
        return f"{lost} hops of the window were not received again, and it is filling anew" if lost else ""

    def _step_held(self) -> tuple[MonitorReport, ...]:
        """Step the new blocks held while the window is refilled, once it is complete or too many blocks are held."""
        if self._window.lacks and len(self._held_messages) <= self.machine.ingest.reorder_blocks:
            return ()
        self._not_recalled += self._window.give_up()
        held, self._held_messages = self._held_messages, []
        return tuple(report for one in held for report in self.step_payload(*one))

    def flush(self) -> tuple[MonitorReport, ...]:
        """Take the blocks that wait for earlier ones, which will not come any more."""
        self._not_recalled += self._window.give_up()
        self._done += self._step_held()
        self._due.extend(self._arrivals.flush())
        return self._step_due()

    def _disputed(self, block: SampleBlock) -> bool:
        """Whether a block contradicts one received before; also raise the alarm on conflicting publishers."""
        disputed = self._senders.take(block)
        if disputed and not self._arrivals.withdraw(block.run, block.sequence):
            self._window.gap()  # the other version may be in the unfinished hop
        if conflict := self._senders.conflict:
            self._data_path.conflict(conflict, block.end_ns if self.end_ns is None else self.end_ns, at_once=True)
        return disputed

    def _step_due(self) -> tuple[MonitorReport, ...]:
        """Step the blocks that are due; if one raises an error, the others are left for the next call."""
        while self._due:
            self._done.append(self.step(self._due.popleft(), formed=True))
        done, self._done = tuple(self._done), []
        return done

    def step(self, block: SampleBlock, *, formed: bool = False) -> MonitorReport:
        """Take one block: gate (`formed`: see `Gate.judge`), window, evaluation, alarms.

        Refused blocks, gaps and defects of the monitor are stated in the report, never raised.
        """
        dropped = self._drops.pop((block.run, block.sequence), 0)
        verdict = self._admission_of(block, dropped, formed=formed)
        if not verdict.accepted:
            self._dropped += dropped
            return MonitorReport(verdict)
        self._used, block = block, self._missing.take(block)
        windows: list[Report] = []
        try:
            windows.extend(map(self._evaluate, self._feed_window(block, verdict, dropped)))  # each before the next hop
        except Exception as error:  # whatever it is, the machine must not look healthy because of it
            self._window.gap()
            self._note_defect(error, block.end_ns)
        fault, self._defect = self._defect, None
        return MonitorReport(verdict, tuple(windows), self.alarms.take(), len(block.samples) / block.rate_hz, fault)

    def _feed_window(self, block: SampleBlock, verdict: Admission, dropped: int) -> Iterable[int]:
        """Feed an accepted block to the window; return the ends of hops it completes, each to be evaluated in turn."""
        self._not_recalled += self._window.give_up()
        joined = verdict.continuous and not verdict.new_snapshot
        if not joined:
            self._window.gap()
        self._newest.add(self._used or block, continuous=joined and not verdict.clock_step_s)
        if verdict.clock_step_s:
            self._window.clear()
            self._kept_is_valid = False  # parts are named by the ends of hops, which may now recur
            self._test.clear()
            self.alarms.clock_stepped(block.start_ns, round(verdict.clock_step_s * 1e9))
        elif self.end_ns is None and self._reached_ns is not None:
            # Until now shelving ran on the time of day; from now on it runs on the time of the data.
            self.alarms.clock_stepped(block.start_ns, block.start_ns - self._reached_ns)
        self.alarms.passed(block.start_ns)
        self._fault = self._data_path.accepted(verdict, block.start_ns, dropped) or self._fault
        self.end_ns = block.end_ns
        return self._window.feed(block.samples, block.start_ns)

    def fault(self, what: str, time_ns: int) -> tuple[AlarmEvent, ...]:
        """Raise the alarm on the monitor itself, at a data time; it clears once windows are evaluated again."""
        self._data_path.fault(what, time_ns)
        return self.alarms.take()

    def _note_defect(self, error: Exception, time_ns: int) -> None:
        """Note a defect of the monitor: the machine is not evaluable until a window is evaluated again."""
        self._defect = error
        self._fault = f"a defect in the monitor, not in the machine: {type(error).__name__}: {error}"
        self._data_path.fault(self._fault, time_ns)

    def passed(self, time_ns: int) -> tuple[AlarmEvent, ...]:
        """Take note of time that has passed, with data or without; `time_ns` estimates the data time reached by now."""
        self._reached_ns = time_ns
        self.alarms.passed(time_ns)
        self._data_path.passed(time_ns, self.end_ns)
        return self.alarms.take()

    @property
    def window(self) -> Callable[[], WindowStatistics] | None:
        """Function that computes the statistics of the latest report's window; None if that was not full."""
        return self._reporter.window

    @property
    def first_windows(self) -> str:
        """How far the first windows, if levels are compared with them, have come, in words; else empty."""
        return self._levels.first_windows

    @property
    def blocks_to_hop(self) -> int:
        """How many more blocks as long as the latest one complete the next hop, at least one; little changes before."""
        return 1 if self._used is None else max(1, -(-self._window.lacking // self._used.samples.shape[0]))

    @property
    def blocks(self) -> tuple[SampleBlock, ...]:
        """The newest blocks without a gap between them, about 20 000 samples at most."""
        return self._newest.blocks

    def operate(self, operation: OperatorAction, time_ns: int) -> tuple[AlarmEvent, ...]:
        """Do what an operator asks for, see `AlarmBook.operate`."""
        self._reached_ns = time_ns
        self.alarms.operate(operation, time_ns)
        return self.alarms.take()

    def state(self, kept: Collection[str] = (), *, whole: bool = False) -> MonitorState:
        """The state to restore from, without parts named in `kept`; with `whole` including the window, megabytes."""
        arrays = {
            **prefixed("window", self._window.checkpoint(whole=whole)),
            **prefixed("test", self._test.state.checkpoint()),
            **prefixed("levels", self._levels.checkpoint()),
            **{key: one for name, part in self._parts for key, one in prefixed(name, part.checkpoint()).items()},
            "calm": np.array([self._reporter.calm.value]),
            "end_ns": np.array([] if self.end_ns is None else [self.end_ns], dtype=np.int64),
        }
        state, new, names = divided(arrays, self._test.state.hops(), kept if self._kept_is_valid else ())
        self._kept_is_valid = True
        return MonitorState(self.alarms.checkpoint(), state, new, names, self.end_ns)

    def restore(
        self, state: bytes, parts: Collection[bytes] = (), latest: Report | None = None, *, levels_alone: bool = False
    ) -> None:
        """Continue from the state of a monitor of the same machine, files and version; alarms are restored separately.

        `latest` is its latest report, shown until the next one. With `levels_alone` files and version may differ: only
        the levels of the first windows are restored.

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
        self._test.state, self._latest = test, latest
        self.end_ns, self._reporter.calm = end_ns, HealthState(*calm)
        self._arrivals.resume(self._gate.courses)

    def restore_alarms(self, alarms: str, next_sequence: int | None = None, end_ns: int | None = None) -> None:
        """Continue with the alarms of another monitor, see `AlarmBook.restore`.

        `end_ns` is the end of its newest data, on the alarms' clock, if nothing else of it was restored.
        """
        self.alarms.restore(alarms, next_sequence)
        self.end_ns = end_ns if self.end_ns is None else self.end_ns

    def health(self) -> MachineHealth:
        """State of the machine now."""
        calm = HealthState.NOT_EVALUABLE if self._fault else self._reporter.calm
        return MachineHealth(
            self._reporter.state(calm),  # what operators did counts at once
            self._window.filled,
            self._latest,
            self.alarms.alarms,
            self._quality.model_copy(update={"accepted_blocks": self._accepted}),
            self.alarms.next_sequence - 1,
            self._fault or ("" if self._latest is None else self._latest.reason),
            self.end_ns,
            self._refused,
        )

    def _admission_of(self, block: SampleBlock, dropped: int, *, formed: bool) -> Admission:
        """Judge a block by the gate and, if it is the first one after a restart, by the time of the data before."""
        anew = not self._gate.courses
        verdict = self._gate.judge(block, formed=formed)
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
        self._refused = not verdict.accepted
        if not verdict.continuous:
            self._quality = counted(self._quality, verdict)
        return verdict

    def _evaluate(self, end_ns: int) -> Report:
        """Evaluate the window after a completed hop; after a defect, report it as not evaluable for that reason."""
        self._fault = ""
        skipped = self._skips(end_ns) and self._window.filled == 1
        try:
            self._data_path.hop(end_ns, skipped=skipped)
            self._data_path.conflict(self._senders.conflict, end_ns)
            missing = self._missing.found(self._window.first_ns, end_ns)
            report = self._reporter.report(end_ns, missing, skipped=skipped)
        except Exception as error:
            self._note_defect(error, end_ns)
            report = self._reporter.unread(end_ns, end_ns, HealthState.NOT_EVALUABLE, reason=self._fault)
        if skipped:
            report, count = report.model_copy(update={"skipped": True}), self._quality.skipped_windows + 1
            self._quality = self._quality.model_copy(update={"skipped_windows": count})
        self._latest = report
        self.alarms.suppress(None, end_ns)
        return report
