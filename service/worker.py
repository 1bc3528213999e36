"""One machine's thread: takes blocks out of the inbox, steps the monitor, hands on what comes out."""

import threading
import time
from collections.abc import Callable
from typing import Protocol

from models.commissioning.installed import Installed
from service import conversion
from service.config import HistorySettings, QueueSettings
from service.conversion import Identity
from service.descriptor import descriptor_mismatch
from service.history import History
from service.inbox import Inbox, RawBlock
from service.logs import Limiter, logger
from service.monitor import MachineHealth, MachineMonitor, MonitorReport
from service.schemas import (
    AlarmCloudEvent,
    AlarmStates,
    DetectableChanges,
    Health,
    MachineDescription,
    Report,
    StreamStatus,
)

__all__ = ["MachineWorker", "Outlet"]


class Outlet(Protocol):
    """Where a worker publishes; `service.transport.MachineLink` is one."""

    def publish_report(self, text: str) -> None:
        """Publish a window report."""

    def publish_alarm_event(self, text: str) -> None:
        """Publish an alarm event."""

    def publish_alarm_state(self, text: str) -> None:
        """Publish the alarms as they are now."""


class MachineWorker:
    """Monitors one machine in a thread of its own.

    The monitor belongs to the thread. What others may see is an immutable snapshot that the thread replaces after every
    block, and the history, which has its own lock.

    Parameters
    ----------
    installed : Installed
        The machine file, and what was trained and commissioned for it.
    queue : QueueSettings
    history : HistorySettings
    clock : callable
        Monotonic seconds; says how old the latest data are, nothing else.
    """

    def __init__(
        self,
        installed: Installed,
        queue: QueueSettings,
        history: HistorySettings,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.machine = machine = installed.machine
        self.inbox = Inbox(queue.blocks, queue.when_full)
        self.history = History(history.reports, history.alarm_events)
        self.identity = Identity(
            site=machine.site,
            machine=machine.name,
            bundle=installed.identity,
            machine_hash=conversion.machine_hash(machine),
        )
        self.errors = 0
        self.last_error = ""
        self._clock = clock
        self._log = logger(machine=f"{machine.site}/{machine.name}")
        self._limiter = Limiter(clock)
        self._monitor = MachineMonitor(installed)
        self._snapshot: MachineHealth = self._monitor.health()
        self._begin_s = clock()
        self._latest_data_s: float | None = None
        self._missed = 0
        self._publisher_alive = False
        self._mismatch: tuple[str, ...] = ()
        self._outlet: Outlet | None = None
        self._published_alarms: tuple[tuple[str, str, str], ...] = ()
        self._dropped_logged = 0
        self._thread = threading.Thread(target=self._run, name=f"monitor {machine.site}/{machine.name}", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def start(self, outlet: Outlet) -> None:
        """Start the thread; it publishes to `outlet`."""
        self._outlet = outlet
        self._begin_s = self._clock()
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
        if alive != self._publisher_alive:
            self._log.info("publisher is there" if alive else "publisher is gone")
        self._publisher_alive = alive
        if not alive:
            self._mismatch = ()

    def descriptor(self, announced: bytes) -> None:
        """Compare an announced channel descriptor with the machine file."""
        mismatch = descriptor_mismatch(announced, self.machine)
        if mismatch and mismatch != self._mismatch:
            self._log.warning("the publisher's channel descriptor differs from the machine file", differences=mismatch)
        self._mismatch = mismatch

    def health(self) -> Health:
        """Where the machine stands now."""
        now_s = self._clock()
        latest_s = self._latest_data_s
        silent_s = now_s - (self._begin_s if latest_s is None else latest_s)
        limit_s = self.machine.ingest.no_data_after_s
        reason = ""
        if silent_s > limit_s:
            since = "since the monitor started" if latest_s is None else f"for more than {limit_s:g} s"
            reason = f"no usable block {since}"
        return conversion.health(
            self.identity,
            self._snapshot,
            StreamStatus(
                publisher_alive=self._publisher_alive,
                data_age_s=None if latest_s is None else round(max(0.0, now_s - latest_s), 3),
                descriptor_mismatch=self._mismatch,
            ),
            no_data_reason=reason,
            queue_dropped_blocks=self.inbox.dropped,
            link_missed_blocks=self._missed,
            worker_errors=self.errors,
            last_worker_error=self.last_error,
        )

    def alarms(self, *, include_normal: bool = False) -> AlarmStates:
        """Return the alarms as they are now."""
        return conversion.alarm_states(self.identity, self._snapshot.alarms, include_normal=include_normal)

    def detectable(self, change: float | None) -> DetectableChanges:
        """Return what would be found on the machine as it runs now."""
        return conversion.detectable_changes(self.identity, self.machine, self._snapshot, change)

    def description(self) -> MachineDescription:
        """Identity, stream, keys, and the present state."""
        return conversion.machine_description(self.identity, self.machine, self.health().state)

    def reports(self, since_ns: int | None, until_ns: int | None, limit: int) -> tuple[Report, ...]:
        """Window reports with since_ns ≤ end_ns < until_ns, newest first."""
        found = self.history.reports(since_ns, until_ns, limit)
        return tuple(conversion.report(self.identity, window) for window in found)

    def alarm_events(self, since_ns: int | None, until_ns: int | None, limit: int) -> tuple[AlarmCloudEvent, ...]:
        """Alarm events with since_ns ≤ time_ns < until_ns, newest first."""
        found = self.history.alarm_events(since_ns, until_ns, limit)
        return tuple(conversion.alarm_cloud_event(self.identity, event) for event in found)

    def _run(self) -> None:
        while (block := self.inbox.get()) is not None:
            try:
                self._take(block)
            except Exception as error:  # one bad block must not end the monitoring of the machine
                self.errors += 1
                self.last_error = f"{type(error).__name__}: {error}"
                if (withheld := self._limiter.admit("error")) is not None:
                    self._log.exception("a block was lost to an error in the monitor", withheld=withheld)

    def _take(self, block: RawBlock) -> None:
        report = self._monitor.step_payload(block.payload, block.attachment, block.encoding)
        self._snapshot = self._monitor.health()
        self.history.add(report.windows, report.events)
        self._explain(report)
        if report.verdict.accepted:
            self._latest_data_s = self._clock()
        self._publish(report)

    def _publish(self, report: MonitorReport) -> None:
        outlet = self._outlet
        if outlet is None or not report.windows:
            return
        for window in report.windows:
            outlet.publish_report(conversion.report(self.identity, window).model_dump_json())
        for event in report.events:
            outlet.publish_alarm_event(conversion.alarm_cloud_event(self.identity, event).model_dump_json())
        # The latest change of each alarm is in every report; here only what an operator would call news.
        now = tuple((alarm.parameter, alarm.state.value, alarm.severity.value) for alarm in self._snapshot.alarms)
        if now != self._published_alarms:
            self._published_alarms = now
            outlet.publish_alarm_state(self.alarms().model_dump_json())

    def _explain(self, report: MonitorReport) -> None:
        verdict = report.verdict
        if verdict.reason is not None:
            self._warn(f"refused {verdict.reason}", "block refused", reason=verdict.reason.value, why=verdict.text)
        elif verdict.text:
            self._warn("gap", "the stream was interrupted", why=verdict.text)
        dropped = self.inbox.dropped
        if dropped > self._dropped_logged:
            self._warn("dropped", "cannot keep up, blocks dropped", count=dropped - self._dropped_logged)
            self._dropped_logged = dropped
        for event in report.events:
            self._log.warning("alarm", kind=event.kind, text=event.text, time_ns=event.time_ns)

    def _warn(self, kind: str, text: str, **details: object) -> None:
        withheld = self._limiter.admit(kind)
        if withheld is not None:
            self._log.warning(text, **details, **({"withheld": withheld} if withheld else {}))
