"""The right to write one machine, and its steps on their way into the database.

::

    commit --> waiting (all steps since, as one) --> attempt (numbered, as it is, until the database has it)

While the database fails, what waits is bounded: the oldest reports and readings are dropped first, only the newest
checkpoint is kept, and alarm events are never dropped.
"""

import math
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import zstandard

from service.history.records import CheckpointHead, Step, StoredEvent, StoredReading, StoredReport, StoreError

_LARGEST = 2**63
# Nearly as small as level 15 (2.09 kB instead of 2.00), in a fifth of its time.
_HOW = zstandard.ZstdCompressionParameters(
    window_log=17, chain_log=17, hash_log=16, search_log=4, min_match=6, strategy=zstandard.STRATEGY_BTLAZY2
)
# Never change it: every report that was ever written is read with it, also those from before it existed.
_LIKE_REPORTS = zstandard.ZstdCompressionDict(
    Path(__file__).with_name("reports.dictionary").read_bytes(), dict_type=zstandard.DICT_TYPE_RAWCONTENT
)
_LIKE_REPORTS.precompute_compress(compression_params=_HOW)  # once: for every report it would double the time


class PackedReport(NamedTuple):
    """A report, when it was recorded, and its text compressed."""

    recorded_ns: int
    report: StoredReport
    text: bytes


@dataclass(slots=True)
class StepBundle:
    """Steps of one machine combined into one: in order, written whole or not at all."""

    reports: deque[PackedReport] = field(default_factory=deque)
    readings: deque[tuple[int, tuple[StoredReading, ...]]] = field(default_factory=deque)
    events: list[StoredEvent] = field(default_factory=list)
    head: CheckpointHead | None = None
    new_parts: dict[str, bytes] = field(default_factory=dict)
    keep: frozenset[str] = frozenset()
    steps: int = 0
    heard: list[Future[bool]] = field(default_factory=list)

    def settle(self, error: StoreError | None, written: bool) -> None:
        """Give the result to the callers that wait for it."""
        for future in self.heard:
            if error is None:
                future.set_result(written)
            else:
                future.set_exception(error)
        self.heard.clear()


@dataclass(slots=True, eq=False)
class Claim:
    """The right to write one machine, and what it has to write.

    What waits, the attempt included, is changed only while the writer's lock is held.
    """

    site: str
    name: str
    most_reports: int  # reports that wait while the database fails, and steps whose readings do
    machine_id: int = 0
    owner: str = ""  # mark of this monitor in the database
    written: int = 0  # number of the latest attempt that is known to be in the database
    locked: bool = True  # whether the lock in PostgreSQL is held, as far as is known
    lost: StoreError | None = None  # why this monitor must not write the machine any more
    trouble: str = ""  # why the database does not take what waits although it works; empty if it does
    retry_s: float = 0.0  # when that is tried again, by the monotonic clock
    generation: int = 0  # goes up when the history continues in another file, which may lack what was written before
    waiting: StepBundle = field(default_factory=StepBundle)
    attempt: StepBundle = field(default_factory=StepBundle)
    dropped_reports: int = 0
    dropped_readings: int = 0

    @property
    def title(self) -> str:
        """``site/name``."""
        return f"{self.site}/{self.name}"

    @property
    def steps(self) -> int:
        """Steps that are not in the database yet."""
        return self.attempt.steps + self.waiting.steps

    def contents(self) -> str:
        """What is not in the database, in words; with what was dropped to make room."""
        bundles = (self.attempt, self.waiting)
        numbers = [event.sequence for bundle in bundles for event in bundle.events]
        n_reports = sum(len(bundle.reports) for bundle in bundles) + self.dropped_reports
        n_readings = sum(len(step) for bundle in bundles for _, step in bundle.readings) + self.dropped_readings
        events = f"alarm events {min(numbers)} to {max(numbers)}" if numbers else "alarm events: none"
        return f"the state to go on from, reports: {n_reports}, readings: {n_readings}, {events}"

    def add(self, step: Step, recorded_ns: int, reports: Iterable[PackedReport]) -> None:
        """Append a step to what waits."""
        waiting = self.waiting
        waiting.steps += 1
        waiting.events.extend(step.events)
        waiting.reports.extend(reports)
        if step.readings:
            waiting.readings.append((recorded_ns, step.readings))
        if step.checkpoint is not None:
            new = dict(step.checkpoint.new_parts)
            waiting.head = step.checkpoint.head
            waiting.keep = frozenset(step.checkpoint.keep) | new.keys()
            waiting.new_parts = {name: part for name, part in waiting.new_parts.items() if name in waiting.keep} | new
        while len(waiting.reports) > self.most_reports:
            waiting.reports.popleft()
            self.dropped_reports += 1
        while len(waiting.readings) > self.most_reports:
            self.dropped_readings += len(waiting.readings.popleft()[1])

    def take(self) -> bool:
        """Keep an earlier attempt unchanged, or else attempt all that waits; return whether there is anything."""
        if not self.attempt.steps:
            self.attempt, self.waiting = self.waiting, StepBundle()
        return self.attempt.steps > 0

    def put_off(self) -> None:
        """Tell callers that wait that their steps are not written yet."""
        for bundle in (self.attempt, self.waiting):
            bundle.settle(None, written=False)


def pack(machine: str, step: Step, recorded_ns: int) -> tuple[PackedReport, ...]:
    """Check that both databases can take the step as it is, and compress its reports.

    Raises
    ------
    StoreError
        Naming the machine, the field and the value, if they cannot.
    """
    for report in step.reports:
        _check(machine, "report", report)
    for reading in step.readings:
        _check(machine, f"reading of {reading.quantity} {reading.name}", reading)
    for event in step.events:
        _check(machine, f"alarm event {event.sequence}", event)
    if step.checkpoint is not None:
        _check(machine, "checkpoint", step.checkpoint.head)
    compressor = zstandard.ZstdCompressor(dict_data=_LIKE_REPORTS, compression_params=_HOW)
    return tuple(PackedReport(recorded_ns, each, compressor.compress(each.text.encode())) for each in step.reports)


def unpack(text: bytes) -> str:
    """Undo the compression of a report's text; raises `StoreError` if the bytes are damaged."""
    try:
        return zstandard.ZstdDecompressor(dict_data=_LIKE_REPORTS).decompress(text).decode()
    except (zstandard.ZstdError, UnicodeDecodeError) as error:
        raise StoreError(f"history: the text of a report is damaged: {error}") from error


def _check(machine: str, of: str, record: StoredReport | StoredReading | StoredEvent | CheckpointHead) -> None:
    for name in record.__slots__:  # there are a hundred readings in a step
        value = getattr(record, name)
        if isinstance(value, float):
            if math.isnan(value):
                raise StoreError(f"{machine}: {of}: {name} is nan, expected a number")
        elif isinstance(value, int):
            if not 0 <= value < _LARGEST:
                raise StoreError(f"{machine}: {of}: {name} is {value}, expected 0 or more and less than 2^63")
        elif isinstance(value, str):
            try:
                value.encode()
            except UnicodeEncodeError as error:
                raise StoreError(f"{machine}: {of}: {value!r} is not valid text: {error.reason}") from error
            if "\0" in value:
                raise StoreError(f"{machine}: {of}: {value!r} holds a NUL character, which no text may")
