"""Who asked for what, for ever."""

from sqlalchemy import insert, select

from service.history.database import Database
from service.history.errors import StoreError
from service.history.records import AuditEntry
from service.history.tables import audit_log

__all__ = ["AuditLog"]

_COLUMNS = [audit_log.c[name] for name in AuditEntry.__dataclass_fields__]


class AuditLog:
    """The log of requests that change something, or were refused; for any thread.

    Both methods raise `StoreError` if the database fails.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def append(self, entry: AuditEntry) -> int:
        """Write an entry and return its number; the number in the entry is not looked at."""
        values = {name: _storable(getattr(entry, name)) for name in AuditEntry.__dataclass_fields__ if name != "number"}
        with self._database.writing() as connection:
            made = connection.execute(insert(audit_log).values(values).returning(audit_log.c.number))
            number: int = made.scalar_one()
        return number

    def entries(
        self, before: int | None = None, limit: int = 100, *, machine: str | None = None, actor: str | None = None
    ) -> tuple[AuditEntry, ...]:
        """Entries, newest first.

        Parameters
        ----------
        before : int, optional
            Only entries with a smaller number: the last number of the page before.
        limit : int
            At most this many, 1 or more.
        machine, actor : str, optional
            Only entries about this ``site/name``, by this actor.
        """
        if limit < 1:
            raise StoreError(f"audit log: {limit} entries were asked for, expected 1 or more")
        query = select(*_COLUMNS).order_by(audit_log.c.number.desc()).limit(limit)
        if before is not None:
            query = query.where(audit_log.c.number < before)
        if machine is not None:
            query = query.where(audit_log.c.machine == machine)
        if actor is not None:
            query = query.where(audit_log.c.actor == actor)
        return tuple(AuditEntry(*row) for row in self._database.rows(query))


def _storable(value: str | int) -> str | int:
    """A value without what a stranger can put into a request and no database takes."""
    return value if isinstance(value, int) else value.replace("\0", "\\0").encode("utf-8", "backslashreplace").decode()
