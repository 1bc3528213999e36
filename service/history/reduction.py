"""Drops what has been kept long enough."""

import threading
from collections.abc import Callable

import structlog
from sqlalchemy import Connection, Table, delete, func, select, update

from service.history.age import AgeClock
from service.history.database import Database
from service.history.records import Dropped, Retention, StoreError
from service.history.tables import buckets, machines, reports, series, windows
from service.history.windows import fill_buckets

_DAY_NS = 86_400 * 10**9
_EVERY_S = 300.0
_BATCH = 500  # rows or windows in one transaction: others write between two of them
_LOCK = (0x726F746F, -1)  # PostgreSQL: two monitors on one database take turns
_log = structlog.get_logger("rotorwatch", part="history")


class Reduction:
    """Keeps the history as long as `Retention` says, by the computer's time `now_ns`, see `AgeClock`."""

    def __init__(self, database: Database, retention: Retention, now_ns: Callable[[], int]) -> None:
        self._database = database
        self._retention = retention
        self._now_ns = now_ns
        self._turn = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="history-reduction", daemon=True)

    def start(self) -> None:
        """Begin to look every few minutes."""
        self._thread.start()

    def stop(self) -> None:
        """Stop looking, after the batch that is under way."""
        self._stopping.set()
        self._thread.join(self._database.answer_s)

    def run(self, now_ns: int) -> Dropped:
        """Drop what is too old at a time of the computer, readings once they are in buckets; runs every few minutes.

        Raises
        ------
        StoreError
            If the database fails.
        """
        kept = self._retention
        with self._turn:
            return Dropped(
                reports=self._repeat(reports, now_ns - round(kept.reports_days * _DAY_NS)),
                windows=self._repeat(windows, now_ns - round(kept.readings_days * _DAY_NS)),
                buckets=self._repeat(buckets, now_ns - round(max(kept.buckets_days, kept.readings_days) * _DAY_NS)),
            )

    def _run(self) -> None:
        age_ns = AgeClock(self._now_ns)
        while not self._stopping.wait(_EVERY_S):
            try:
                dropped = self.run(age_ns())
            except StoreError as error:
                _log.warning("the history could not be cleaned up", why=str(error))
                continue
            if dropped != Dropped():
                _log.debug("tidied", reports=dropped.reports, windows=dropped.windows, buckets=dropped.buckets)

    def _repeat(self, table: Table, until_ns: int) -> int:
        """Drop what a table holds from before a time, batch by batch, and count it."""
        total = 0
        while not self._stopping.is_set() and (dropped := self._batch(table, until_ns)):
            total += dropped
        return total

    def _batch(self, table: Table, until_ns: int) -> int:
        with self._database.writing() as connection:
            if not (self._database.is_sqlite or connection.scalar(select(func.pg_try_advisory_xact_lock(*_LOCK)))):
                return 0  # another monitor is at it
            if table is not buckets:
                numbers = connection.scalars(select(machines.c.machine_id).order_by(machines.c.machine_id)).all()
                most = max(1, _BATCH // max(1, len(numbers)))
                return sum(self._drop_first(connection, table, each, until_ns, most) for each in numbers)
            oldest = select(table.c.recorded_ns).where(table.c.recorded_ns < until_ns)
            oldest = oldest.order_by(table.c.recorded_ns).limit(_BATCH)
            boundary_ns = connection.scalar(select(func.max(oldest.subquery().c.recorded_ns)))
            return connection.execute(delete(table).where(table.c.recorded_ns <= (boundary_ns or -1))).rowcount

    def _drop_first(self, connection: Connection, table: Table, machine_id: int, until_ns: int, most: int) -> int:
        """Drop one machine's first rows, up to the last one among `most` that is too old; return how many.

        Numbers give the order of recording; times do not where the computer's clock was ahead. Rows with such times go
        with a later row that is too old.
        """
        row, last, now_ns = table.c, -1, self._now_ns()
        while True:
            query = select(row.number, row.recorded_ns).where(row.machine_id == machine_id, row.number > last)
            found = connection.execute(query.order_by(row.number).limit(most)).all()
            old = [number for number, recorded_ns in found if recorded_ns < until_ns]
            if old:
                break
            if len(found) < most or any(recorded_ns <= now_ns for _, recorded_ns in found):
                return 0
            last = found[-1].number
        chosen = (row.machine_id == machine_id, row.number <= old[-1])
        if table is windows:
            of = machines.c.machine_id == machine_id
            bucketed = connection.execute(select(machines.c.bucketed).where(of).with_for_update()).scalar_one()
            if bucketed < old[-1]:
                bucket_ns = self._retention.bucket_s * 10**9
                fill_buckets(self._database, connection, machine_id, bucketed, old[-1], bucket_ns)
                connection.execute(update(machines).where(of).values(bucketed=old[-1]))
            end_ns = connection.scalar(select(func.max(row.end_ns)).where(*chosen))
            behind = (series.c.machine_id == machine_id, series.c.dropped_ns < end_ns)
            connection.execute(update(series).where(*behind).values(dropped_ns=end_ns))
        return connection.execute(delete(table).where(*chosen)).rowcount
