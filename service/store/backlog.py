"""Steps of one machine on their way into the database.

::

    commit --> waiting (all steps since, as one) --> attempt (numbered, as it is, until the database has it)

While the database fails, what waits is bounded: the oldest reports and readings are let go first, of checkpoints only
the newest state is needed, and alarm events are never dropped.
"""

import asyncio
import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import zstandard

from service.store.errors import StoreError
from service.store.records import CheckpointHead, Step, StoredEvent, StoredReading, StoredReport

__all__ = ["Backlog", "Bundle", "PackedReport", "pack", "unpack"]

_LARGEST = 2**63
_READINGS_PER_REPORT = 20


@dataclass(frozen=True, slots=True)
class PackedReport:
    """A report with its text compressed, and when it was recorded."""

    report: StoredReport
    recorded_ns: int
    text: bytes


@dataclass(slots=True)
class Bundle:
    """Steps of one machine as one step: in order, written whole or not at all."""

    reports: deque[PackedReport] = field(default_factory=deque)
    readings: deque[tuple[int, StoredReading]] = field(default_factory=deque)
    events: list[StoredEvent] = field(default_factory=list)
    head: CheckpointHead | None = None
    new_hops: dict[int, bytes] = field(default_factory=dict)
    keep: frozenset[int] = frozenset()
    steps: int = 0
    heard: list[asyncio.Future[bool]] = field(default_factory=list)

    def settle(self, error: StoreError | None, written: bool) -> None:
        """Tell those who wait what became of it."""
        for future in self.heard:
            if not future.done():
                if error is None:
                    future.set_result(written)
                else:
                    future.set_exception(error)
        self.heard.clear()


class Backlog:
    """What one machine has to write; used in the history's loop only.

    Parameters
    ----------
    most_reports : int
        Reports that wait while the database fails; of readings, twenty times as many.
    """

    def __init__(self, most_reports: int) -> None:
        self._most_reports = most_reports
        self.waiting = Bundle()
        self.attempt: Bundle | None = None
        self.dropped_reports = 0
        self.dropped_readings = 0

    @property
    def steps(self) -> int:
        """Steps that are not in the database yet."""
        return self.waiting.steps + (0 if self.attempt is None else self.attempt.steps)

    def contents(self) -> str:
        """What is not in the database, in words; with what was dropped to make room."""
        bundles = [bundle for bundle in (self.attempt, self.waiting) if bundle is not None]
        numbers = [event.sequence for bundle in bundles for event in bundle.events]
        n_reports = sum(len(bundle.reports) for bundle in bundles) + self.dropped_reports
        n_readings = sum(len(bundle.readings) for bundle in bundles) + self.dropped_readings
        events = f"alarm events {min(numbers)} to {max(numbers)}" if numbers else "alarm events: none"
        return f"the state to go on from, reports: {n_reports}, readings: {n_readings}, {events}"

    def add(self, step: Step, recorded_ns: int, reports: Iterable[PackedReport]) -> None:
        """Append a step to what waits."""
        waiting = self.waiting
        waiting.steps += 1
        waiting.events.extend(step.events)
        waiting.reports.extend(reports)
        waiting.readings.extend((recorded_ns, reading) for reading in step.readings)
        if step.checkpoint is not None:
            new_hops = dict(step.checkpoint.new_hops)
            waiting.head = step.checkpoint.head
            waiting.keep = frozenset(step.checkpoint.keep) | new_hops.keys()
            waiting.new_hops = {end: hop for end, hop in waiting.new_hops.items() if end in waiting.keep} | new_hops
        while len(waiting.reports) > self._most_reports:
            waiting.reports.popleft()
            self.dropped_reports += 1
        while len(waiting.readings) > self._most_reports * _READINGS_PER_REPORT:
            waiting.readings.popleft()
            self.dropped_readings += 1

    def take(self) -> Bundle | None:
        """What is to be written next: what was tried before, unchanged, or else everything that waits."""
        if self.attempt is None and self.waiting.steps:
            self.attempt, self.waiting = self.waiting, Bundle()
        return self.attempt

    def done(self) -> None:
        """Forget the attempt: it is written, or refused for good."""
        self.attempt = None


def pack(machine: str, step: Step, recorded_ns: int) -> tuple[PackedReport, ...]:
    """Check that both databases can take the step as it is, and compress its reports.

    Raises
    ------
    StoreError
        Naming the machine, the field and the value, if they cannot.
    """
    for report in step.reports:
        _times(machine, "report", start_ns=report.start_ns, end_ns=report.end_ns)
        _number(machine, "report", "filled", report.filled)
        _texts(machine, "report", report.state)
    for reading in step.readings:
        of = f"reading of {reading.quantity} {reading.name}"
        _times(machine, of, end_ns=reading.end_ns)
        _number(machine, of, "value", reading.value)
        _number(machine, of, "standard_error", 0.0 if reading.standard_error is None else reading.standard_error)
        _texts(machine, of, reading.quantity, reading.name)
    for event in step.events:
        of = f"alarm event {event.sequence}"
        _times(
            machine, of, time_ns=event.time_ns, recorded_ns=event.recorded_ns,
            sequence=event.sequence, occurrence=event.occurrence,
        )  # fmt: skip
        _texts(machine, of, event.id, event.kind, event.alarm, event.severity, event.state, event.actor, event.text)
    if step.checkpoint is not None:
        head = step.checkpoint.head
        _times(machine, "checkpoint", end_ns=head.end_ns, recorded_ns=head.recorded_ns)
        for end_ns, _ in step.checkpoint.new_hops:
            _times(machine, "hop of the checkpoint", end_ns=end_ns)
        _texts(machine, "checkpoint", head.bundle or "", head.machine_hash, head.code_version, head.alarms)
    compressor = zstandard.ZstdCompressor()
    return tuple(PackedReport(each, recorded_ns, compressor.compress(each.text.encode())) for each in step.reports)


def unpack(text: bytes) -> str:
    """Undo the compression of a report's text.

    Raises
    ------
    StoreError
        If the bytes are damaged.
    """
    try:
        return zstandard.ZstdDecompressor().decompress(text).decode()
    except (zstandard.ZstdError, UnicodeDecodeError) as error:
        raise StoreError(f"history: the text of a report is damaged: {error}") from error


def _times(machine: str, of: str, **values: int) -> None:
    for name, value in values.items():
        if not 0 <= value < _LARGEST:
            raise StoreError(f"{machine}: {of}: {name} is {value}, expected 0 or more and less than 2^63")


def _number(machine: str, of: str, name: str, value: float) -> None:
    if math.isnan(value):
        raise StoreError(f"{machine}: {of}: {name} is nan, expected a number")


def _texts(machine: str, of: str, *values: str) -> None:
    for value in values:
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise StoreError(f"{machine}: {of}: {value!r} is no valid text: {error.reason}") from error
        if "\0" in value:
            raise StoreError(f"{machine}: {of}: {value!r} holds a NUL character, which no text may")
