"""The history of all machines of one monitor, in one database.

::

    machines' threads --steps--> what waits, for each machine
                                    |  the Writer's thread: all that waits in one transaction
                                    v
    whoever asks, in its own thread --> SQLite or PostgreSQL <-- the Reduction's thread drops what is old

The way of a step: `MachineStore.commit` checks and packs it, `Writer.submit` adds it to what waits in the machine's
`Claim`, the Writer's thread takes what waits of all machines, `write_group` makes rows of it, and callers that wait
get the result.
"""

import time
from collections.abc import Callable
from functools import partial

from sqlalchemy import Column, Table, func, select, text

from rotorwatch.records.monitor import HistorySpan, HistoryStatus
from service.history.claim import Claim
from service.history.database import Database
from service.history.machine import MachineStore
from service.history.records import Retention, StoreError
from service.history.reduction import Reduction
from service.history.shared import AuditLog, TokenStore, WebhookCursors, alarms_since
from service.history.tables import alarm_events, buckets, machines, reports, windows
from service.history.writer import Writer

_PROBE_S = 3.0
_OLDEST: tuple[tuple[Table, Column[int]], ...] = (
    (alarm_events, alarm_events.c.time_ns),
    (reports, reports.c.end_ns),
    (windows, windows.c.end_ns),
    (buckets, buckets.c.start_ns),
)


class Store:
    """Alarms, reports, readings, checkpoints, tokens and audit log.

    Parameters
    ----------
    url : str
        ``sqlite:////folder/file``, ``sqlite:///:memory:`` or ``postgresql://user:password@host/database``.
    timeout_s : float
        How long to wait for a connection, or for a lock of another program, in seconds; a transaction may take twice
        as long. Then steps wait in memory.
    retry_s : float
        Time between attempts while the database fails, in seconds.
    waiting_reports : int
        Reports of one machine that wait in memory meanwhile, and steps whose readings do.
    shared : bool
        Other processes of this monitor write the same database, and one of them looks after it: nothing is made,
        reduced or begun anew here.

    Raises
    ------
    StoreError
        If the URL is of no known form.

    Examples
    --------
    >>> store = Store("sqlite:///:memory:", Retention())
    >>> store.open()
    >>> lab = store.machine("demo", "lab")
    >>> lab.last_sequence, lab.restore()
    (-1, None)
    >>> store.close()
    """

    def __init__(
        self,
        url: str,
        retention: Retention,
        *,
        timeout_s: float = 5.0,
        retry_s: float = 1.0,
        waiting_reports: int = 2000,
        now_ns: Callable[[], int] = time.time_ns,
        shared: bool = False,
    ) -> None:
        self.database = Database(url, timeout_s)
        self.writer = Writer(self.database, retry_s, waiting_reports, retention.bucket_s * 10**9, shared=shared)
        self._shared = shared
        self.reduction = Reduction(self.database, retention, now_ns)
        self._now_ns = now_ns
        self._retention = retention
        self.alarms_since = partial(alarms_since, self.database)
        self.tokens = TokenStore(self.database)
        self.audit = AuditLog(self.database)
        self.webhooks = WebhookCursors(self.database)

    def unreachable(self) -> str:
        """Why the database takes no transaction now, even if nothing has to be written; empty if it takes one."""
        if astray := self.database.astray():
            return astray
        try:
            with self.database.writing(_PROBE_S) as connection:
                connection.execute(text("SELECT 1"))
        except StoreError as error:
            return str(error)
        return ""

    def open(self, *, set_aside: bool = False) -> None:
        """Connect, and bring the tables up to date; a store is opened once.

        An SQLite file that is damaged is renamed and a new one begun, if it may be `set_aside`; `lost` says so. Raises
        StoreError if the database cannot be reached or used.
        """
        self.database.start(set_aside, read_only=self._shared)
        self.writer.start()
        if not self._shared:
            self.reduction.start()

    def close(self) -> None:
        """Write what waits, if the database takes it, release all machines and disconnect.

        Raises
        ------
        StoreError
            If the database does not take it, saying what is lost; everything is released all the same.
        """
        if not self.database.is_open:
            return
        try:
            if not self._shared:
                self.reduction.stop()
            self.writer.stop()
        finally:
            self.database.stop()

    def machine(self, site: str, name: str) -> MachineStore:
        """The history of a machine, which nobody else writes until this store is closed or its process ends.

        Raises StoreError if another monitor writes it, or the database fails.
        """
        return MachineStore(self.database, self.writer, self.writer.claim(site, name), self._now_ns)

    def reader(self, site: str, name: str) -> MachineStore:
        """The history of a machine that another process of this monitor writes, to be read.

        Raises StoreError if there is none, or the database fails.
        """
        query = select(machines.c.machine_id).where(machines.c.site == site, machines.c.name == name)
        found = self.database.rows(query)
        if not found:
            raise StoreError(f"{self.database.shown}: there is no history of {site}/{name}")
        claim = Claim(site, name, most_reports=0, machine_id=found[0][0])
        return MachineStore(self.database, self.writer, claim, self._now_ns)

    def status(self) -> HistoryStatus:
        """How large the history is, and how far back it goes. Raises StoreError if the database fails."""
        # One entry of an index each, however long the history is.
        oldest = [
            select(func.min(column)).where(table.c.machine_id == machines.c.machine_id).scalar_subquery()
            for table, column in _OLDEST
        ]
        query = select(machines.c.site, machines.c.name, *oldest).order_by(machines.c.site, machines.c.name)
        with self.database.reading() as connection:
            if self.database.is_sqlite:
                pages, size = (connection.scalar(text(f"PRAGMA {what}")) for what in ("page_count", "page_size"))
                size_bytes = pages * size
            else:
                size_bytes = connection.scalar(text("SELECT pg_database_size(current_database())"))
            rows = connection.execute(query).all()
        return HistoryStatus(
            database="in memory, until the monitor ends" if self.database.in_memory else self.database.shown,
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
