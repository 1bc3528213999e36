"""One machine's thread: takes blocks out of the inbox, steps the monitor, passes on its reports and events.

The results of a block and the monitor's state after it are committed to the history in one step; only then is anything
published.
"""

import math
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial

from models.commissioning.commissioned import Installed
from models.descriptor import descriptor_mismatch
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import SampleBlock
from models.signals.keys import Topic
from models.signals.recording import RecordedMessage
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Health, Report, StreamStatus
from rotorwatch.records.machines import DetectableChanges
from service.analysis.snapshots.machine import LatestData, MachineSnapshots
from service.history.machine import MachineStore
from service.history.records import StoredEvent, StoredReport
from service.monitor import conversion
from service.monitor.alarms.alarm import AlarmEvent, NotInTime, OperatorAction
from service.monitor.alarms.book import NO_ALARMS
from service.monitor.conversion import alarm_cloud_event, alarm_entries, alarm_log_page
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import MachineHealth, MonitorReport, Tally, identity_of
from service.recordings.recorder import MachineRecorder
from service.settings.service import QueueSettings
from service.stream.checkpoints import StepWriter, recorded_after, recorded_since_ns, restored
from service.stream.inbox import Inbox, RawBlock
from service.stream.liveness import COMPUTER, Clocks, DataClock, Pulse
from service.stream.monitored import MachineStatus
from service.stream.shedding import LoadShedding, in_turn
from service.terminal.logs import Limiter, logger

_OPERATION_S = 10.0
_LONGEST_UNSEEN_S = 0.5  # longest time until other threads see what a block changed, if more blocks wait
_LATEST = 100
_LONGEST_ERROR = 500


class MachineWorker:
    """Monitors one machine in a thread of its own.

    The monitor belongs to the thread. Other threads see an immutable snapshot, which the thread replaces with every
    report or event and after the last waiting block, and the history, which has its own lock.

    Parameters
    ----------
    installed : Installed
        The machine file, and what was trained and commissioned for it.
    history : MachineStore
        Where everything is kept; an earlier run in it is continued.
    clocks : Clocks
        Say how old the latest data are and when things were recorded, nothing else.
    on_events : callable
        Called after alarm events were committed.
    recorded : callable
        Takes a time of this computer and returns the messages of the stream that were recorded since then, before this
        program was started.
    """

    def __init__(
        self,
        installed: Installed,
        queue: QueueSettings,
        history: MachineStore,
        clocks: Clocks = COMPUTER,
        on_events: Callable[[], None] = lambda: None,
        recorded: Callable[[int], Iterable[RecordedMessage]] = lambda _: (),
    ) -> None:
        self.machine = machine = installed.machine
        self.inbox = Inbox(
            queue.blocks,
            queue.when_full,
            round(queue.mb * 1e6),
            lambda one, known: self._monitor.could_use(one.payload, one.attachment, one.encoding, size_alone=known),
        )
        self.history = history
        self.identity = identity_of(installed)
        self.snapshots = MachineSnapshots(installed, self.identity)
        self._make_latest: Callable[[], LatestData] = LatestData
        self.errors = 0
        self.last_error = ""
        self.recorder: MachineRecorder | None = None
        self.tally = Tally()
        self._clocks = clocks
        self._on_events = on_events
        self._recorded = recorded
        self._recorded_since_ns: int | None = None
        self._log = logger(machine=machine.title)
        self._limiter = Limiter(clocks.monotonic_s)
        self.steps = StepWriter(history, self.identity)
        self._unpublished: tuple[StoredEvent, ...] = ()
        self._unevaluated_s = 0.0
        self._time = DataClock(clocks, machine.ingest.no_data_after_s)
        self._shedding: LoadShedding | None = None
        self._monitor, self.restart = self._restored(installed)
        self._sheds = queue.when_full == "drop" and not self._monitor.watching
        self._snapshot: MachineHealth = self._monitor.health()
        self.told = self._monitor.alarms.next_sequence  # first alarm event that `health` does not show yet
        self._seen_s = -math.inf  # when the snapshot was last replaced
        self._missed = self._dropped_logged = 0
        self._publisher_alive = self._replay_announced = False
        self._mismatch: tuple[str, ...] = ()
        self._outlet: Callable[[Topic, str], None] | None = None
        self._published_alarms: tuple[tuple[str, int, bool, bool], ...] = ()
        self._pulse = Pulse(self.inbox.call, self._tick)
        self._thread = threading.Thread(target=self._run, name=f"monitor {machine.title}", daemon=True)

    def _restored(self, installed: Installed) -> tuple[MachineMonitor, str]:
        """A monitor that continues from the history if there is a checkpoint, and what was restored, in a sentence."""
        last, checkpoint = self.history.last_sequence, self.history.restore()
        if checkpoint is None:
            monitor = MachineMonitor(installed, self._skips)
            monitor.restore_alarms(NO_ALARMS, last + 1)
            return monitor, ""
        report = next((one for _, one in self.history.reports(limit=1)), None)
        build = partial(MachineMonitor, installed, self._skips)
        monitor, text = restored(build, self.identity, checkpoint, last + 1, report)
        self.steps.kept = tuple(name for name, _ in checkpoint.parts)
        self.history.go_on_from(monitor.alarms.next_sequence - 1)
        self._time.slept(checkpoint.head.recorded_ns)
        # They were committed but perhaps not published; subscribers leave out those that they had by their id.
        latest = self.history.events(after=last - _LATEST, limit=_LATEST)
        self._unpublished = tuple(one for one in latest if one.recorded_ns >= checkpoint.head.recorded_ns)
        self._log.info("restart", what=text)
        self._recorded_since_ns = recorded_since_ns(checkpoint.head)
        return monitor, text

    @property
    def trouble(self) -> str:
        """Why the machine is not monitored as it should be although data come in; empty if it is."""
        refused = self.steps.refused
        reasons = [] if refused is None else [f"the history refuses what happens: {refused}"]
        if self.history.claim.trouble:
            reasons.append(f"the history does not accept what happens: {self.history.claim.trouble}")
        if self._unevaluated_s > 2 * self.machine.hop_data_s and not self._time.silent:
            why = self._snapshot.reason
            reasons.append(f"{self._unevaluated_s:.0f} s of data have come in and no window was evaluated: {why}")
        return "; ".join(reasons)

    def start(self, outlet: Callable[[Topic, str], None]) -> None:
        """Start the thread; it publishes to `outlet`."""
        self._outlet = outlet
        self._time.begin()
        self.tick()  # before any block, for the data time reached so far
        for event in self._unpublished:
            outlet("alarm_event", event.text)
        self._thread.start()

    def stop(self) -> None:
        """Stop after the present block."""
        self.inbox.close()
        if self._thread.is_alive():
            self._thread.join()

    def missed(self, count: int) -> None:
        """Take note of messages lost on the way."""
        self._missed += count
        self._warn("missed", "messages were lost on the way", count=count)

    def publisher(self, alive: bool) -> None:
        """Take note of a publisher that came or went."""
        if alive != self._publisher_alive and (withheld := self._limiter.admit(f"publisher {alive}")) is not None:
            self._log.info("publisher is there" if alive else "publisher is gone", withheld=withheld)
        self._publisher_alive = alive
        if not alive:
            self._mismatch = ()

    def replay(self, announced: bool) -> None:
        """Take note of a replay on the machine's own keys that begins or ends; its blocks do not arrive here."""
        self._replay_announced = announced
        if announced:
            self._warn("replay", "a replay is announced on this machine's own keys; only its own blocks count")

    def descriptor(self, announced: bytes) -> None:
        """Compare an announced channel descriptor with the machine file."""
        mismatch = descriptor_mismatch(announced, self.machine)
        if mismatch and mismatch != self._mismatch:
            self._warn("descriptor", "the publisher's channel descriptor differs from the file", differences=mismatch)
        self._mismatch = mismatch

    def health(self) -> Health:
        """State of the machine now."""
        snapshot, silent = self._snapshot, self._time.silent
        return conversion.health(
            self.identity,
            snapshot,
            StreamStatus(
                publisher_alive=self._publisher_alive,
                data_age_s=self._time.age_s,
                silent=silent,
                silent_since_ns=snapshot.end_ns if silent else None,
                replay_announced=self._replay_announced,
                descriptor_mismatch=self._mismatch,
            ),
            queue_dropped_blocks=self.inbox.dropped,
            unread_messages=self.inbox.unread,
            link_missed_blocks=self._missed,
            worker_errors=self.errors,
            last_worker_error=self.last_error,
            restart="; ".join(each for each in (self.restart, self._monitor.recalled) if each),
        )

    def status(self) -> MachineStatus:
        """State of the monitoring itself."""
        return MachineStatus(
            alive=self._thread.is_alive(),
            errors=self.errors,
            last_error=self.last_error,
            trouble=self.trouble,
            busy_s=round(self._pulse.busy_s, 1),
            queue_blocks=len(self.inbox),
            history_waiting=self.history.claim.steps,
            restart=self.restart,
            tally=replace(self.tally),
            recorder=None if self.recorder is None else self.recorder.status(),
        )

    def alarms(self, *, include_normal: bool = False) -> AlarmStates:
        """Return the alarms as they are now."""
        snapshot = self._snapshot
        alarms = alarm_entries(snapshot.alarms, include_normal=include_normal)
        return AlarmStates(**self.identity, alarms=alarms, sequence=snapshot.sequence)

    def alarm_log(self, after: int, limit: int) -> str:
        """Alarm events after a sequence number, -1 for the beginning, as JSON of an `AlarmLogPage`; from any thread.

        Raises
        ------
        StoreError
            If the database fails.
        """
        latest = self.history.last_sequence
        events = self.history.events(after=after, limit=limit)
        return alarm_log_page(self.identity, [event.text for event in events], latest)

    def detectable(self, change: float | None) -> DetectableChanges:
        """Return what would be found on the machine as it runs now."""
        return conversion.detectable_changes(self.identity, self.machine, self._snapshot, change)

    def operate(self, operation: OperatorAction) -> tuple[AlarmCloudEvent, ...]:
        """Do what an operator asks for, on the machine's thread, and say what happened.

        Raises as `AlarmBook.operate`, and `NotInTime` if the thread does not answer.
        """
        done: Future[tuple[AlarmCloudEvent, ...]] = Future()

        def work() -> None:
            if not done.set_running_or_notify_cancel():
                return
            try:
                events = self._monitor.operate(operation, self._time.next_ns(self._monitor.end_ns))
                self._conclude((), events)
                done.set_result(tuple(alarm_cloud_event(self.identity, event) for event in events))
            except Exception as error:  # raised for the caller; the thread goes on
                done.set_exception(error)

        if not self.inbox.call(work):
            raise NotInTime(f"{self.machine.title}: the monitor is being stopped")
        try:
            return done.result(_OPERATION_S)
        except TimeoutError as error:
            then = "nothing was done" if done.cancel() else "look at the alarm before trying again"
            raise NotInTime(f"{self.machine.title}: busy for {_OPERATION_S:g} s; {then}") from error

    def tick(self) -> None:
        """Let the machine's thread notice that time passes, with data or without; called every now and then."""
        self._pulse.beat()

    def _data_now_ns(self) -> int:
        return self._time.now_ns(self._monitor.end_ns)

    def _tick(self) -> None:
        self._time.tick()
        if news := self.steps.begun_anew():
            self._conclude((), self._monitor.fault(news, self._data_now_ns()), always=True)
        if len(self.inbox):
            return  # time passes with the blocks that wait
        if self._monitor.end_ns is not None:
            if self._time.given_up:
                self._conclude_reports(self._monitor.flush())
            elif self._time.stands:
                return
        self._conclude((), self._monitor.passed(self._data_now_ns()))

    def _skips(self, _: int) -> bool:
        shedding, to_hop = self._shedding, self._monitor.blocks_to_hop
        return shedding is not None and shedding.skips(self.inbox.behind, to_hop, self._clocks.monotonic_s())

    def _run(self) -> None:
        try:
            if self._recorded_since_ns is not None:
                # Refill the window from the recording, and take what was recorded after the latest committed step.
                for message in recorded_after(self._monitor, self._recorded(self._recorded_since_ns)):
                    self._take(RawBlock(message.payload, message.attachment, message.encoding))
                    self._time.slept(message.log_time_ns)
                self._snapshot = self._monitor.health()
                self._time.wake()
        except Exception as error:  # a defect that it brings to light must not end the monitoring of the machine
            self._note_error(error)
        self._monitor.begin()
        self._shedding = LoadShedding() if self._sheds else None  # only now: recorded windows are never skipped
        while (item := self.inbox.get(self._monitor.blocks_to_hop)) is not None:
            try:
                if isinstance(item, RawBlock):
                    self._take(item)
                else:
                    item()
            except Exception as error:  # one bad block must not end the monitoring of the machine
                self._note_error(error)
                self._raise_fault(f"{type(error).__name__}: {error}")
        # An orderly end saves the state up to the last block, so that a restart needs no publisher's cache.
        self._conclude((), (), whole=True)

    def _note_error(self, error: Exception) -> None:
        self.errors += 1
        self.last_error = f"{type(error).__name__}: {error}"[:_LONGEST_ERROR]
        if (withheld := self._limiter.admit("error")) is not None:
            self._log.error("something was lost to an error in the monitor", withheld=withheld, exc_info=error)

    def _raise_fault(self, what: str) -> None:
        """Raise the alarm on the monitor itself, once."""
        try:
            events = self._monitor.fault(what, self._data_now_ns())
            if events:
                self._conclude((), events)
        except Exception as error:  # can only be counted and logged
            self._note_error(error)

    def _take(self, block: RawBlock) -> None:
        with in_turn(completes_hop=self._monitor.blocks_to_hop == 1):
            begin_s = self._clocks.monotonic_s()
            reports = self._monitor.step_payload(block.payload, block.attachment, block.encoding, block.dropped_before)
            self.tally.step_s += self._clocks.monotonic_s() - begin_s
        self.tally.blocks += 1
        if self._monitor.used:
            self.inbox.follow(block)
        self._conclude_reports(reports)

    def _conclude_reports(self, reports: Sequence[MonitorReport]) -> None:
        """Conclude all reports on one message in one step: the monitor's state is that after the last block."""
        for report in reports:
            self._log_admission(report)
            if report.verdict.accepted:
                self._time.came(continuous=report.verdict.continuous)
                self.tally.data_s += report.data_s
            if report.fault is not None:
                self._note_error(report.fault)
            evaluated = any(not one.skipped for one in report.windows) and report.fault is None
            self._unevaluated_s = 0.0 if evaluated else self._unevaluated_s + report.data_s
        self._conclude(
            tuple(window for report in reports for window in report.windows),
            tuple(event for report in reports for event in report.events),
        )

    def _conclude(
        self, windows: tuple[Report, ...], events: tuple[AlarmEvent, ...], *, always: bool = False, whole: bool = False
    ) -> None:
        """Commit windows and events, then replace the snapshot and publish."""
        events += self._monitor.alarms.take()  # left behind by a defect
        now_s, news = self._clocks.monotonic_s(), bool(windows or events or always or whole)
        if not news and len(self.inbox) and now_s - self._seen_s < _LONGEST_UNSEEN_S:
            return
        self._seen_s = now_s
        self.steps.owed += events
        snapshot = self._monitor.health()
        try:
            reports, told = self._commit(windows, whole=whole) if news else ((), ())
        finally:
            self._snapshot = snapshot
            self._make_latest = partial(held_now, self._monitor.window, snapshot, self._monitor.blocks)
        texts = tuple(one.text for one in told if one.sequence >= self.told)
        for event in events:
            self._log.warning("alarm", kind=event.kind.value, text=event.text, time_ns=event.time_ns)
        if texts:
            self.told = told[-1].sequence + 1
            self._on_events()
        try:
            self._publish([one.text for one in reports], texts)
        except Exception as error:  # the network's, of whatever kind; subscribers query events that they lack
            self._note_error(error)
        if self.steps.refused is not None:
            self._raise_fault(f"the history refuses what happens: {self.steps.refused}")

    def _commit(
        self, windows: tuple[Report, ...], *, whole: bool
    ) -> tuple[tuple[StoredReport, ...], tuple[StoredEvent, ...]]:
        """Commit windows, events and the monitor's state; return reports and events as they are to be published."""
        begin_s = self._clocks.monotonic_s()
        reports, told, written = self.steps.commit(self._monitor, windows, self._clocks.utc_ns(), whole=whole)
        if self.steps.refused is not None:
            self._note_error(self.steps.refused)
        elif not written:
            self._warn("history", "the history cannot be written; events wait in memory and are published")
        self.tally.windows += sum(not one.skipped for one in windows)
        self.tally.commit_s += self._clocks.monotonic_s() - begin_s
        return reports, told

    @property
    def latest(self) -> LatestData:
        """Latest data of the monitor, for snapshots; the window is computed when somebody looks at it."""
        return self._make_latest()

    def _publish(self, reports: Iterable[str], events: Iterable[str]) -> None:
        outlet = self._outlet
        if outlet is None:
            return
        for text in reports:
            outlet("report", text)
        for text in events:
            outlet("alarm_event", text)
        # Changes of parameters are in every report; alarm states are published only if a state or a delay has changed.
        now = tuple(
            (one.name, one.version, one.beyond_ns is None, one.small_ns is None) for one in self._snapshot.alarms
        )
        if now != self._published_alarms:
            self._published_alarms = now
            outlet("alarm_state", self.alarms().model_dump_json())

    def _log_admission(self, report: MonitorReport) -> None:
        verdict = report.verdict
        if verdict.reason is not None:
            self._warn(f"refused {verdict.reason}", "block refused", reason=verdict.reason.value, why=verdict.text)
        elif verdict.text:
            self._warn("gap", "the stream was interrupted", why=verdict.text)
        dropped = self.inbox.dropped
        if dropped > self._dropped_logged:
            self._warn("dropped", "cannot keep up, blocks dropped", count=dropped - self._dropped_logged)
            self._dropped_logged = dropped

    def _warn(self, kind: str, text: str, **details: object) -> None:
        self._limiter.say(kind, self._log.warning, text, **details)


def held_now(
    window: Callable[[], WindowStatistics] | None, health: MachineHealth, blocks: tuple[SampleBlock, ...]
) -> LatestData:
    """Latest data of a running monitor, for snapshots."""
    latest = health.latest
    return LatestData(
        window=None if window is None else window(),
        filled=health.filled,
        sensors=() if latest is None else latest.sensors,
        parameters=() if latest is None else latest.parameters,
        why_not="" if latest is None else latest.reason,
        blocks=blocks,
    )
