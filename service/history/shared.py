"""What belongs to no single machine: tokens, audit log, cursors of webhooks; and alarms and reports to read."""

from dataclasses import asdict
from typing import Any

from sqlalchemy import func, insert, select, update

from rotorwatch.records.history import AuditRecord
from service.history.claim import unpack
from service.history.database import Database
from service.history.records import StoredEvent, StoreError, TokenRecord
from service.history.tables import alarm_events, audit_log, machines, reports, tokens, webhook_cursors

EVENT = [alarm_events.c[name] for name in StoredEvent.__dataclass_fields__]
_MOST = 10_000
_TIMEOUT_S = 5.0


def alarms_since(database: Database, site: str, name: str, recorded_ns: int) -> tuple[StoredEvent, ...]:
    """The latest events committed to a machine's log since a time of recording, at most 10 000, in order.

    Raises
    ------
    StoreError
        If the database fails.
    """
    log = alarm_events.c
    query = select(*EVENT).join(machines, machines.c.machine_id == log.machine_id)
    query = query.where(machines.c.site == site, machines.c.name == name, log.recorded_ns >= recorded_ns)
    newest_first = database.rows(query.order_by(log.sequence.desc()).limit(_MOST))
    return tuple(StoredEvent(*row) for row in reversed(newest_first))


def committed_events(url: str, site: str, name: str, recorded_ns: int) -> tuple[StoredEvent, ...]:
    """`alarms_since` of a history that another program writes: it is opened read-only and closed again.

    Raises
    ------
    StoreError
        If there is no such history, or it cannot be read.
    """
    database = Database(url, _TIMEOUT_S)
    database.start(read_only=True)
    try:
        return alarms_since(database, site, name, recorded_ns)
    finally:
        database.stop()


class ReportLog:
    """Committed reports of one machine; for any thread. Both methods raise `StoreError`."""

    def __init__(self, database: Database, site: str, name: str) -> None:
        self._database = database
        self._own = (machines.c.machine_id == reports.c.machine_id, machines.c.site == site, machines.c.name == name)

    def span_ns(self) -> tuple[int, int] | None:
        """When the oldest and the newest window end; None if there are no reports."""
        query = select(func.min(reports.c.end_ns), func.max(reports.c.end_ns)).where(*self._own)
        ((first, last),) = self._database.rows(query)
        return None if first is None else (first, last)

    def texts(self, since_ns: int, until_ns: int, most: int) -> list[str]:
        """Reports of windows with since_ns ≤ end_ns < until_ns, oldest first; every n-th of more than `most`."""
        where = (*self._own, reports.c.end_ns >= since_ns, reports.c.end_ns < until_ns)
        ((count,),) = self._database.rows(select(func.count()).select_from(reports).where(*where))
        every = -(-count // most) or 1
        query = select(reports.c.text).where(*where, reports.c.number % every == 0).order_by(reports.c.number)
        return [unpack(text) for (text,) in self._database.rows(query)]


_ENTRY = [audit_log.c[name] for name in AuditRecord.model_fields]


class AuditLog:
    """The log of requests that change something, or were refused; for any thread.

    Both methods raise `StoreError` if the database fails.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def append(self, at_ns: int, status: int, **texts: str) -> int:
        """Write an entry and return its number; `texts` are all other fields of an `AuditRecord`."""
        # With those characters escaped that a request may hold but no database takes.
        storable = {
            name: text.replace("\0", "\\0").encode("utf-8", "backslashreplace").decode() for name, text in texts.items()
        }
        entry = insert(audit_log).values(at_ns=at_ns, status=status, **storable)
        with self._database.writing() as connection:
            number: int = connection.execute(entry.returning(audit_log.c.number)).scalar_one()
        return number

    def entries(
        self, before: int | None = None, limit: int = 100, *, machine: str | None = None, actor: str | None = None
    ) -> tuple[AuditRecord, ...]:
        """Entries, newest first: at most `limit` before this number, which is the last one of the page before.

        Only those about this ``site/name``, and by this actor, if given.
        """
        query = select(*_ENTRY).order_by(audit_log.c.number.desc()).limit(limit)
        if before is not None:
            query = query.where(audit_log.c.number < before)
        for column, value in ((audit_log.c.machine, machine), (audit_log.c.actor, actor)):
            query = query if value is None else query.where(column == value)
        return tuple(AuditRecord.model_validate(dict(row._mapping)) for row in self._database.rows(query))


_TOKEN = [tokens.c[name] for name in TokenRecord.__dataclass_fields__]


class TokenStore:
    """Every token there is or was; for any thread. All methods raise `StoreError` if the database fails."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, record: TokenRecord) -> None:
        """Keep a new token; raises `StoreError` too if there is one with this identifier."""
        values = asdict(record) | {"scopes": " ".join(record.scopes)}
        with self._database.writing() as connection:
            there = select(tokens.c.token_id).where(tokens.c.token_id == record.token_id)
            if connection.scalar(there) is not None:
                raise StoreError(f"token {record.token_id}: there is one with this identifier already")
            connection.execute(insert(tokens).values(values))

    def find(self, token_id: str) -> TokenRecord | None:
        """One token, revoked and expired ones included."""
        rows = self._database.rows(select(*_TOKEN).where(tokens.c.token_id == token_id))
        return _record(*rows[0]) if rows else None

    def all(self) -> tuple[TokenRecord, ...]:
        """Every token, oldest first."""
        query = select(*_TOKEN).order_by(tokens.c.created_ns, tokens.c.token_id)
        return tuple(_record(*row) for row in self._database.rows(query))

    def revoke(self, token_id: str, at_ns: int) -> bool:
        """Revoke a token; False if there is none, or it is revoked already."""
        chosen = (tokens.c.token_id == token_id, tokens.c.revoked_ns.is_(None))
        with self._database.writing() as connection:
            return connection.execute(update(tokens).where(*chosen).values(revoked_ns=at_ns)).rowcount > 0


def _record(token_id: str, name: str, scopes: str, *rest: Any) -> TokenRecord:
    return TokenRecord(token_id, name, tuple(scopes.split()), *rest)


class WebhookCursors:
    """Which alarm event of each machine each webhook is to get next; for any thread.

    Both methods raise `StoreError` if the database fails.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def get(self, name: str, machine_key: str) -> int:
        """Sequence of the event that is to be delivered next; -1 if none was ever set."""
        column = webhook_cursors.c
        query = select(column.sequence).where(column.name == name, column.machine_key == machine_key)
        return next((sequence for (sequence,) in self._database.rows(query)), -1)

    def set(self, name: str, machine_key: str, sequence: int) -> None:
        """Note the sequence of the event that is to be delivered next."""
        made = self._database.insert(webhook_cursors).values(name=name, machine_key=machine_key, sequence=sequence)
        made = made.on_conflict_do_update(index_elements=["name", "machine_key"], set_={"sequence": sequence})
        with self._database.writing() as connection:
            connection.execute(made)
