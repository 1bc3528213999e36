"""What a monitor writes into the history with every hop, and how it is restored from there."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace

from pydantic import ValidationError

from models.errors import CheckpointError
from models.signals.recording import RecordedMessage
from rotorwatch import __version__
from rotorwatch.records.fields import finite
from rotorwatch.records.health import MEASURES, Report
from service.history.machine import MachineStore
from service.history.records import (
    Checkpoint,
    CheckpointHead,
    CheckpointStep,
    Step,
    StoredEvent,
    StoredReading,
    StoredReport,
    StoreError,
)
from service.monitor.alarms.alarm import Alarm, AlarmEvent
from service.monitor.alarms.book import NO_ALARMS
from service.monitor.conversion import alarm_cloud_event, rfc3339
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import Identity, MonitorState

FORMAT = 11
"""Goes up when the form of a monitor's state changes."""
_LOOK_BACK_NS, _LATE_NS = 300 * 10**9, 3600 * 10**9


def stored_report(window: Report) -> StoredReport:
    """A window report as it is published."""
    return StoredReport(window.start_ns, window.end_ns, window.state.value, window.filled, window.model_dump_json())


def stored_readings(windows: Iterable[Report]) -> tuple[StoredReading, ...]:
    """Parameters, residuals of the equations and the measures of each window, as points in time."""
    found = []
    for window in windows:
        points: list[tuple[str, str, float | None, float | None]] = [
            (name, name, getattr(window, field), None) for name, (field, _) in MEASURES.items()
        ]
        points += [("parameter", one.name, one.relative_change, one.standard_error) for one in window.parameters]
        points += [("equation", one.equation, one.msd, None) for one in window.equations]
        points += [
            ("level", f"{level.channel}:{name}", value, None)
            for level in window.levels
            for name, value in level.values().items()
        ]
        found += [
            StoredReading(window.end_ns, quantity, name, value, finite(error))
            for quantity, name, value, error in points
            if finite(value) is not None and value is not None
        ]
    return tuple(found)


def stored_event(identity: Identity, event: AlarmEvent, recorded_ns: int) -> StoredEvent:
    """An alarm event as it is published."""
    said = alarm_cloud_event(identity, event)
    return StoredEvent(
        sequence=event.sequence,
        id=said.id,
        time_ns=event.time_ns,
        recorded_ns=recorded_ns,
        kind=event.kind.value,
        alarm=event.alarm.name,
        severity=event.alarm.severity.value,
        state=event.alarm.state.value,
        occurrence=event.alarm.occurrence,
        actor=event.actor,
        text=said.model_dump_json(),
    )


class StepWriter:
    """Commits reports and events of one machine's monitor, and its state after them, in one step.

    Alarm events come first: whatever else cannot be converted, saved or written, they go into the log and out to
    operators. Events that the log refuses are tried again with the next step: it takes none that follows a missing one.
    """

    def __init__(self, history: MachineStore, identity: Identity) -> None:
        self._history = history
        self._identity = identity
        self.owed: tuple[AlarmEvent, ...] = ()  # events that go into the next step
        self.kept: tuple[str, ...] = ()  # parts of the state that are in the history already
        self._generation = 0
        # Why the latest step is not in the history as a whole; None if it is, or waits to be.
        self.refused: Exception | None = None

    def begun_anew(self) -> str:
        """Why everything has to be written to the history again; empty if it need not be."""
        return "" if self._generation == self._history.claim.generation else self._history.database.news

    def commit(
        self, monitor: MachineMonitor, windows: tuple[Report, ...], recorded_ns: int, *, whole: bool = False
    ) -> tuple[tuple[StoredReport, ...], tuple[StoredEvent, ...], bool]:
        """Commit windows, the events that are owed, and the state of the monitor; raises nothing.

        With `whole` the state includes the window, which then need not be refilled. Returns reports and events as they
        are to be published, and whether all of it is in the database now.
        """
        self.refused = None
        if (generation := self._history.claim.generation) != self._generation:
            self.kept, self._generation = (), generation
        reports: tuple[StoredReport, ...] = ()
        told = tuple(self._to_publish(event, recorded_ns) for event in self.owed)
        try:
            reports = tuple(stored_report(window) for window in windows)
            state = monitor.state(self.kept, whole=whole)
            checkpoint = checkpoint_step(self._identity, state, recorded_ns)
            written = self._history.commit(Step(reports, stored_readings(windows), told, checkpoint))
        except Exception as error:  # whatever it is, no alarm may be lost to it
            self.refused, self.kept = error, ()
            # The events alone; a restart then continues from an older state, with the log's own numbers.
            with suppress(StoreError):  # said already
                if told:
                    self._history.commit(Step(events=told))
                self.owed = ()
            return reports, told, False
        self.kept, self.owed = state.parts, ()
        return reports, told, written

    def _to_publish(self, event: AlarmEvent, recorded_ns: int) -> StoredEvent:
        """An event as it is published; one that cannot be converted is published without its details."""
        try:
            return stored_event(self._identity, event, recorded_ns)
        except Exception as error:
            self.refused = error
            was = event.alarm
            bare = Alarm(was.name, was.state, was.present, was.severity, was.since_ns, was.raised_ns, was.occurrence)
            return stored_event(self._identity, replace(event, alarm=bare), recorded_ns)


def checkpoint_step(identity: Identity, state: MonitorState, recorded_ns: int) -> CheckpointStep:
    """Convert the state of a monitor for the history."""
    head = CheckpointHead(
        format=FORMAT,
        bundle=identity["bundle"],
        machine_hash=identity["machine_hash"],
        code_version=__version__,
        end_ns=state.end_ns or 0,
        recorded_ns=recorded_ns,
        alarms=state.alarms,
        state=state.state,
    )
    return CheckpointStep(head, state.new_parts, state.parts)


def restored(
    build: Callable[[], MachineMonitor],
    identity: Identity,
    checkpoint: Checkpoint,
    next_sequence: int,
    latest: StoredReport | None = None,
) -> tuple[MachineMonitor, str]:
    """Build a monitor that continues from a checkpoint, as far as that fits; say in a sentence what was restored.

    Alarms are restored whatever else differs, with the log's number of the next event. First windows are restored if
    sensors and settings of levels are the same; windows and tests only if the files and the program are.
    """
    head, monitor = checkpoint.head, build()
    at = rfc3339(head.end_ns) if head.end_ns else "the beginning, before any data"
    pairs = {
        "form of what is remembered": (head.format, FORMAT),
        "machine file": (head.machine_hash, identity["machine_hash"]),
        "bundle": (head.bundle, identity["bundle"]),
        "program version": (head.code_version, __version__),
    }
    differs = [f"{what} was {then}, is {now}" for what, (then, now) in pairs.items() if then != now]
    if not differs:
        report = None
        with suppress(ValidationError):  # of another form, written by an earlier state of the same version
            report = None if latest is None else Report.model_validate_json(latest.text)
        try:
            monitor.restore(head.state, tuple(data for _, data in checkpoint.parts), report)
        except CheckpointError as error:
            monitor, differs = build(), [f"what is remembered does not fit this state of the program ({error})"]
    try:
        monitor.restore_alarms(head.alarms, next_sequence, head.end_ns or None)
    except CheckpointError as error:
        monitor.restore_alarms(NO_ALARMS, next_sequence)
        return monitor, f"all alarms start afresh: {error}"
    if differs:
        try:  # a machine that has become louder since its first windows must not be taken for a healthy one
            monitor.restore(head.state, tuple(data for _, data in checkpoint.parts), levels_alone=True)
        except CheckpointError as error:
            differs = [*differs, f"where first windows are the reference of levels, they are taken again ({error})"]
        return monitor, f"alarms are as they were at {at}; the window is filling anew: {'; '.join(differs)}"
    return monitor, f"resumed at {at}"


def recorded_since_ns(head: CheckpointHead) -> int:
    """Time of this computer from which on recordings hold all that the window was made of."""
    late_ns = head.recorded_ns - head.end_ns  # long after the latest data, or by another clock
    return head.recorded_ns - _LOOK_BACK_NS - (late_ns if 0 < late_ns < _LATE_NS else 0)


def recorded_after(monitor: MachineMonitor, recorded: Iterable[RecordedMessage]) -> Iterator[RecordedMessage]:
    """Messages recorded after the newest block that the monitor has had; earlier ones refill its window."""
    newest = False
    for message in recorded:
        if newest:
            yield message
        else:
            newest = monitor.recall(message.payload, message.attachment, message.encoding)
