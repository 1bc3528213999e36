"""How large a history is, and how far back it goes."""

from sqlalchemy import Column, Table, func, select, text

from rotorwatch.records.monitor import HistorySpan, HistoryStatus
from service.history.database import Database
from service.history.records import Retention
from service.history.tables import alarm_events, buckets, machines, reports, windows

_OLDEST: tuple[tuple[Table, Column[int]], ...] = (
    (alarm_events, alarm_events.c.time_ns),
    (reports, reports.c.end_ns),
    (windows, windows.c.end_ns),
    (buckets, buckets.c.start_ns),
)


class Holdings:
    """What a history holds; for any thread."""

    def __init__(self, database: Database, retention: Retention) -> None:
        self._database = database
        self._retention = retention

    def read(self) -> HistoryStatus:
        """Look.

        Raises
        ------
        StoreError
            If the database fails.
        """
        # One entry of an index each, however long the history is.
        oldest = [
            select(func.min(column)).where(table.c.machine_id == machines.c.machine_id).scalar_subquery()
            for table, column in _OLDEST
        ]
        query = select(machines.c.site, machines.c.name, *oldest).order_by(machines.c.site, machines.c.name)
        with self._database.reading() as connection:
            if self._database.is_sqlite:
                pages, size = (connection.scalar(text(f"PRAGMA {what}")) for what in ("page_count", "page_size"))
                size_bytes = pages * size
            else:
                size_bytes = connection.scalar(text("SELECT pg_database_size(current_database())"))
            rows = connection.execute(query).all()
        return HistoryStatus(
            database="in memory, until the monitor ends" if self._database.in_memory else self._database.shown,
            size_bytes=size_bytes,
            machines=tuple(
                HistorySpan(
                    site=site,
                    machine=name,
                    oldest_event_ns=event,
                    oldest_report_ns=report,
                    oldest_reading_ns=min((one for one in readings if one is not None), default=None),
                )
                for site, name, event, report, *readings in rows
            ),
            **self._retention.model_dump(exclude={"bucket_s"}),
        )
