"""What one machine writes into the history and reads from it."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import zstandard
from sqlalchemy import Connection, delete, func, select
from sqlalchemy.sql.base import ReadOnlyColumnCollection
from sqlalchemy.sql.elements import ColumnElement

from rotorwatch.records.history import Reading
from service.history.claim import Claim, pack, unpack
from service.history.database import Database
from service.history.records import (
    Checkpoint,
    CheckpointHead,
    Step,
    StoredBucket,
    StoredEvent,
    StoredReport,
    StoreError,
)
from service.history.shared import EVENT, ReportLog
from service.history.tables import alarm_events, checkpoint_parts, checkpoints, evidence, reports, series, windows
from service.history.windows import READING, trend, unpacked
from service.history.writer import Writer

_AT_ONCE = 1000  # windows
_MOST_EVIDENCE = 500  # occurrences of a machine's alarms
_HEAD = [checkpoints.c[name] for name in CheckpointHead.__dataclass_fields__]


class MachineStore:
    """The history of one machine, with the sole right to write it; from `Store.machine`.

    `commit` is for the machine's own thread, everything else for any. All methods that read raise `StoreError` if the
    database fails; they see what is committed.
    """

    def __init__(self, database: Database, writer: Writer, claim: Claim, now_ns: Callable[[], int]) -> None:
        self.title = claim.title
        self.report_log = ReportLog(database, claim.site, claim.name)
        self.database = database
        self._writer = writer
        self.claim = claim
        self._now_ns = now_ns
        log = alarm_events.c
        latest = select(func.max(log.sequence)).where(log.machine_id == claim.machine_id)
        # Sequence of the latest alarm event that was committed, or waits to be; -1 if there is none.
        self.last_sequence: int = next((last for (last,) in database.rows(latest) if last is not None), -1)

    def go_on_from(self, sequence: int) -> None:
        """Number the next alarm event after this one, even if the log of a file that was begun anew has fewer."""
        self.last_sequence = max(self.last_sequence, sequence)

    def commit(self, step: Step) -> bool:
        """Write the results of one block, whole or not at all, in order.

        Parameters
        ----------
        step : Step
            Alarm events go on from `last_sequence` without a gap. One whose sequence is there already is left out if
            its id is the same.

        Returns
        -------
        bool
            True if it is in the database, for good. False if the database fails: the step waits in memory and is
            written before all later ones, which is tried every second. Meanwhile `Writer.trouble` says why. What waits
            is bounded: the oldest reports and readings are dropped first; alarm events are never dropped.

        Raises
        ------
        StoreError
            If the step is refused, and thus not written at all: a value that no database takes, a gap in the sequence,
            an alarm event whose sequence or id is in the history with another id or sequence, or another monitor that
            has taken over the machine.
        """
        before = self.last_sequence
        last = self._follow(step.events)
        recorded_ns = self._now_ns()
        packed = pack(self.title, step, recorded_ns)
        self.last_sequence = last
        try:
            return self._writer.submit(self.claim, step, packed, recorded_ns)
        except StoreError:
            self.last_sequence = before
            raise

    def restore(self) -> Checkpoint | None:
        """State of the monitor after the last committed step, or None if there is none."""
        parts, machine_id = checkpoint_parts.c, self.claim.machine_id
        with self.database.reading() as connection:
            head = connection.execute(select(*_HEAD).where(checkpoints.c.machine_id == machine_id)).one_or_none()
            if head is None:
                return None
            query = select(parts.name, parts.data).where(parts.machine_id == machine_id).order_by(parts.name)
            rows = connection.execute(query).all()
        with suppress(StoreError):  # if they are damaged, restoring the alarms fails and says so
            alarms = ""
            alarms = unpack(head.alarms)
        kept = CheckpointHead(**head._asdict() | {"alarms": alarms})
        return Checkpoint(kept, tuple((row.name, row.data) for row in rows))

    def evidence(self, alarm: str, occurrence: int | None = None) -> str | None:
        """Evidence of an occurrence of an alarm, or of its latest one; None if nothing was kept."""
        kept = evidence.c
        query = select(kept.text).where(kept.machine_id == self.claim.machine_id, kept.alarm == alarm)
        if occurrence is not None:
            query = query.where(kept.occurrence == occurrence)
        rows = self.database.rows(query.order_by(kept.occurrence.desc()).limit(1))
        return zstandard.decompress(rows[0].text).decode() if rows else None

    def keep_evidence(self, alarm: str, occurrence: int, text: str) -> None:
        """Keep the evidence of an occurrence of an alarm, replacing what was kept; beyond 500, the oldest go."""
        kept, own = evidence.c, evidence.c.machine_id == self.claim.machine_id
        values = {"recorded_ns": self._now_ns(), "text": zstandard.compress(text.encode())}
        key = {"machine_id": self.claim.machine_id, "alarm": alarm, "occurrence": occurrence}
        made = self.database.insert(evidence).values(**key, **values)
        made = made.on_conflict_do_update(index_elements=list(key), set_=values)
        newest = select(kept.recorded_ns).where(own).order_by(kept.recorded_ns.desc()).limit(1).offset(_MOST_EVIDENCE)
        with self.database.writing() as connection:
            connection.execute(made)
            connection.execute(delete(evidence).where(own, kept.recorded_ns <= newest.scalar_subquery()))

    def events(  # noqa: PLR0913  # each narrows the query
        self,
        *,
        after: int | None = None,
        before: int | None = None,
        since_ns: int | None = None,
        until_ns: int | None = None,
        alarm: str | None = None,
        kind: str | None = None,
        severity: str | None = None,
        limit: int = 100,
        newest_first: bool = False,
    ) -> tuple[StoredEvent, ...]:
        """Alarm events with after < sequence < before and since_ns ≤ time_ns < until_ns, in order, at most `limit`."""
        log = alarm_events.c
        query = select(*EVENT).where(
            log.machine_id == self.claim.machine_id,
            *_between(log.time_ns, since_ns, until_ns),
            *(
                column == value
                for column, value in ((log.alarm, alarm), (log.kind, kind), (log.severity, severity))
                if value is not None
            ),
            *([] if after is None else [log.sequence > after]),
            *_between(log.sequence, None, before),
        )
        query = query.order_by(log.sequence.desc() if newest_first else log.sequence).limit(limit)
        return tuple(StoredEvent(*row) for row in self.database.rows(query))

    def reports(
        self, *, since_ns: int | None = None, until_ns: int | None = None, before: int | None = None, limit: int = 100
    ) -> tuple[tuple[int, StoredReport], ...]:
        """Reports with their numbers, the latest to arrive first, of windows with since_ns ≤ end_ns < until_ns.

        At most `limit` with a number less than `before`, which is the last number of the page before.
        """
        report = reports.c
        query = select(report.number, report.start_ns, report.end_ns, report.state, report.filled, report.text)
        with self.database.reading() as connection:
            chosen = self._windows(connection, report, since_ns, until_ns)
            query = query.where(*chosen, *_between(report.number, None, before)).order_by(report.number.desc())
            rows = connection.execute(query.limit(limit)).all()
        return tuple((row.number, StoredReport(*row[1:-1], unpack(row.text))) for row in rows)

    def readings(
        self,
        *,
        quantity: str,
        name: str,
        since_ns: int | None = None,
        until_ns: int | None = None,
        after: int | None = None,
        limit: int = 1000,
    ) -> tuple[Reading, ...]:
        """Single readings in the order of arrival, oldest first, of windows with since_ns ≤ end_ns < until_ns.

        At most `limit` with a number greater than `after`, which is the last number of the page before.
        """
        window, of, found = windows.c, series.c, list[Reading]()
        named = (of.machine_id == self.claim.machine_id, of.quantity == quantity, of.name == name)
        query = select(window.number, window.end_ns, window.readings).order_by(window.number)
        query = query.execution_options(yield_per=min(limit, _AT_ONCE))
        with self.database.reading() as connection:
            series_id = connection.scalar(select(of.series_id).where(*named))
            chosen = self._windows(connection, window, since_ns, until_ns)
            chosen += [] if after is None else [window.number > after]
            with connection.execute(query.where(*chosen)) as windows_found:
                for rows in windows_found.partitions():
                    places, readings = unpacked([row.readings for row in rows], READING)
                    own = readings["series_id"] == series_id
                    for place, (_, value, error) in zip(places[own].tolist(), readings[own].tolist(), strict=True):
                        number, end_ns, _ = rows[place]
                        known = None if math.isnan(error) else error
                        found.append(Reading(number=number, end_ns=end_ns, value=value, standard_error=known))
                    if len(found) >= limit or series_id is None:
                        break
        return tuple(found[:limit])

    def names_of(self, quantity: str) -> frozenset[str]:
        """All names that were ever read as this quantity, also with an earlier machine file."""
        of = series.c
        query = select(of.name).where(of.machine_id == self.claim.machine_id, of.quantity == quantity)
        return frozenset(name for (name,) in self.database.rows(query))

    def downsampled(
        self,
        *,
        quantity: str,
        names: Sequence[str] | None = None,
        since_ns: int | None = None,
        until_ns: int | None = None,
        points: int = 300,
    ) -> tuple[StoredBucket, ...]:
        """Readings reduced to at most `points` buckets of equal length for each name, by name and time.

        Parameters
        ----------
        names : sequence of str, optional
            Names to reduce; all if left out.
        since_ns, until_ns : int, optional
            Windows with since_ns ≤ end_ns < until_ns; all if left out. Buckets begin with the first of them. Stored
            buckets are taken for more than 20 000 windows, for more than 2000 if `points` asks for at least half the
            length of a stored bucket, and where readings have been dropped. Buckets are then multiples of stored ones
            in length and begin where a stored one would, so the first may begin before `since_ns`. Where readings have
            been dropped, and only there, a stored bucket counts as a whole if it begins within the time.
        points : int
            At most this many buckets for each name; those without a reading are left out.
        """
        with self.database.reading() as connection:
            of = connection, self.claim.machine_id, self._writer.bucket_ns
            return trend(*of, quantity, names, since_ns, until_ns, points)

    def latest(self, quantity: str, name: str, *, span_ns: int, points: int) -> tuple[StoredBucket, ...]:
        """Readings of one name in the last `span_ns` up to the newest window, reduced like those of `downsampled`."""
        window = windows.c
        newest = select(window.end_ns).where(window.machine_id == self.claim.machine_id)
        with self.database.reading() as connection:
            end_ns = connection.scalar(newest.order_by(window.end_ns.desc()).limit(1))
            of = connection, self.claim.machine_id, self._writer.bucket_ns
            since_ns = max(0, (end_ns or 0) - span_ns)
            return trend(*of, quantity, [name], since_ns, None, points)

    def _follow(self, events: Sequence[StoredEvent]) -> int:
        """The last sequence after these events; raises `StoreError` at a gap or a repeated id."""
        last = self.last_sequence
        for event in events:
            if event.sequence > last + 1:
                raise StoreError(f"{self.title}: alarm event {event.sequence} comes after {last}, expected {last + 1}")
            last = max(last, event.sequence)
        identifiers = [event.id for event in events]
        if len(set(identifiers)) < len(identifiers):
            raise StoreError(f"{self.title}: two alarm events of one step have the same id: {identifiers}")
        return last

    def _windows(
        self,
        connection: Connection,
        column: ReadOnlyColumnCollection[str, Any],
        since_ns: int | None,
        until_ns: int | None,
    ) -> list[ColumnElement[bool]]:
        """Conditions on windows; if time is asked for, on their numbers too, along which pages are read."""
        chosen = [column.machine_id == self.claim.machine_id, *_between(column.end_ns, since_ns, until_ns)]
        if since_ns is None and until_ns is None:
            return chosen
        bounds = connection.execute(select(func.min(column.number), func.max(column.number)).where(*chosen)).one()
        return [*chosen, column.number.between(*bounds)]


def _between(column: ColumnElement[int], first: int | None, end: int | None) -> list[ColumnElement[bool]]:
    since = [] if first is None else [column >= first]
    return since if end is None else [*since, column < end]
