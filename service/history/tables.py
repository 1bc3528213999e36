"""The tables of the history; `migrations` makes them from the tables of older versions.

::

    machines --< alarm_events                      the log of alarms; triggers refuse to change it
             --< reports                           the newest, whole and compressed
             --< windows                           each with its readings in one value: see `windows.py`
             --< buckets                           readings of many windows, reduced, and kept longer
             --< series                            quantity and name for the numbers of series in both
             --< evidence                          pictures that are kept with alarms
             --- checkpoints --< checkpoint_parts  the state from which a monitor continues
    tokens    audit_log    webhook_cursors
"""

from typing import Any

import sqlalchemy as sa
from sqlalchemy import BigInteger, Double, Integer, LargeBinary, Text
from sqlalchemy.types import TypeEngine

from service.history.records import StoreError

REVISION = "0005"
"""The migration that ends with these tables."""
MIGRATING = (0x726F746F, 0)  # PostgreSQL's advisory lock; second numbers from 1 are machines

metadata = sa.MetaData(
    naming_convention={
        "pk": "%(table_name)s_pk",
        "fk": "%(table_name)s_%(column_0_name)s_fk",
        "uq": "%(table_name)s_%(column_0_N_name)s_unique",
        "ix": "%(table_name)s_%(column_0_N_name)s",
    }
)


def _filled(kind: type[TypeEngine[Any]], *names: str) -> tuple[sa.Column[Any], ...]:
    """Columns that are never empty."""
    return tuple(sa.Column(name, kind, nullable=False) for name in names)


def _machine_id() -> sa.Column[int]:
    return sa.Column("machine_id", Integer, sa.ForeignKey("machines.machine_id"), nullable=False)


machines = sa.Table(
    "machines",
    metadata,
    sa.Column("machine_id", Integer, primary_key=True),
    # Who may write: a monitor that finds another's mark in `owner` has been replaced.
    *_filled(Text, "site", "name", "owner"),
    # How many there have been; a step that is sent twice is recognised by its number.
    *_filled(BigInteger, "steps", "reports", "windows"),
    # The readings of windows up to this number are in buckets.
    sa.Column("bucketed", BigInteger, nullable=False, server_default=sa.text("0")),
    sa.UniqueConstraint("site", "name"),
)

alarm_events = sa.Table(
    "alarm_events",
    metadata,
    _machine_id(),
    *_filled(BigInteger, "sequence"),
    *_filled(Text, "id"),
    *_filled(BigInteger, "time_ns", "recorded_ns"),
    *_filled(Text, "kind", "alarm", "severity", "state"),
    *_filled(BigInteger, "occurrence"),
    *_filled(Text, "actor", "text"),
    sa.PrimaryKeyConstraint("machine_id", "sequence"),
    sa.UniqueConstraint("machine_id", "id"),
    sa.Index(None, "machine_id", "time_ns"),
)

reports = sa.Table(
    "reports",
    metadata,
    _machine_id(),
    *_filled(BigInteger, "number", "start_ns", "end_ns", "recorded_ns"),
    *_filled(Text, "state"),
    *_filled(Double, "filled"),
    *_filled(LargeBinary, "text"),
    sa.PrimaryKeyConstraint("machine_id", "number"),
    sa.Index(None, "machine_id", "end_ns"),
)

windows = sa.Table(
    "windows",
    metadata,
    _machine_id(),
    *_filled(BigInteger, "number", "end_ns", "recorded_ns"),
    *_filled(LargeBinary, "readings"),
    sa.PrimaryKeyConstraint("machine_id", "number"),
    sa.Index(None, "machine_id", "end_ns"),
)

series = sa.Table(
    "series",
    metadata,
    sa.Column("series_id", Integer, primary_key=True),
    _machine_id(),
    *_filled(Text, "quantity", "name"),
    # End of the latest window whose reading has been dropped, so that it is in buckets alone; -1 if there is none.
    sa.Column("dropped_ns", BigInteger, nullable=False, server_default=sa.text("-1")),
    sa.UniqueConstraint("machine_id", "quantity", "name"),
)

buckets = sa.Table(
    "buckets",
    metadata,
    _machine_id(),
    *_filled(BigInteger, "start_ns", "length_ns", "recorded_ns"),
    *_filled(LargeBinary, "readings"),
    sa.PrimaryKeyConstraint("machine_id", "start_ns", "length_ns"),
    sa.Index(None, "recorded_ns"),
)

evidence = sa.Table(
    "evidence",
    metadata,
    _machine_id(),
    *_filled(Text, "alarm"),
    *_filled(BigInteger, "occurrence", "recorded_ns"),
    *_filled(LargeBinary, "text"),
    sa.PrimaryKeyConstraint("machine_id", "alarm", "occurrence"),
    sa.Index(None, "machine_id", "recorded_ns"),
)

checkpoints = sa.Table(
    "checkpoints",
    metadata,
    sa.Column("machine_id", Integer, sa.ForeignKey("machines.machine_id"), primary_key=True, autoincrement=False),
    *_filled(Integer, "format"),
    sa.Column("bundle", Text, nullable=True),
    *_filled(Text, "machine_hash", "code_version"),
    *_filled(BigInteger, "end_ns", "recorded_ns"),
    *_filled(LargeBinary, "alarms", "state"),
)

# Large parts of a checkpoint, which stay the same for many hops.
checkpoint_parts = sa.Table(
    "checkpoint_parts",
    metadata,
    _machine_id(),
    *_filled(Text, "name"),
    *_filled(LargeBinary, "data"),
    sa.PrimaryKeyConstraint("machine_id", "name"),
    sqlite_with_rowid=False,
)

tokens = sa.Table(
    "tokens",
    metadata,
    sa.Column("token_id", Text, primary_key=True),
    *_filled(Text, "name", "scopes"),
    *_filled(LargeBinary, "secret_hash"),
    *_filled(BigInteger, "created_ns"),
    sa.Column("expires_ns", BigInteger, nullable=True),
    sa.Column("revoked_ns", BigInteger, nullable=True),
)

audit_log = sa.Table(
    "audit_log",
    metadata,
    sa.Column("number", BigInteger().with_variant(Integer, "sqlite"), primary_key=True),
    *_filled(BigInteger, "at_ns"),
    *_filled(Text, "actor", "address", "method", "path"),
    *_filled(Integer, "status"),
    *_filled(Text, "action", "machine", "alarm", "reason"),
)

webhook_cursors = sa.Table(
    "webhook_cursors",
    metadata,
    *_filled(Text, "name", "machine_key"),
    *_filled(BigInteger, "sequence"),
    sa.PrimaryKeyConstraint("name", "machine_key"),
)

_KEPT = ("alarm_events", "audit_log")
"""Append-only tables."""

_SQLITE_TRIGGERS = (
    *(
        f"CREATE TRIGGER {table}_no_{change.lower()} BEFORE {change} ON {table} "
        f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
        for table in _KEPT
        for change in ("UPDATE", "DELETE")
    ),
    # INSERT OR REPLACE removes the former row without a trigger of its own.
    "CREATE TRIGGER alarm_events_no_replace BEFORE INSERT ON alarm_events WHEN EXISTS (SELECT 1 FROM alarm_events "
    "WHERE machine_id = NEW.machine_id AND (sequence = NEW.sequence OR id = NEW.id)) "
    "BEGIN SELECT RAISE(ABORT, 'alarm_events is append-only'); END",
    "CREATE TRIGGER audit_log_no_replace BEFORE INSERT ON audit_log WHEN EXISTS (SELECT 1 FROM audit_log "
    "WHERE number = NEW.number) BEGIN SELECT RAISE(ABORT, 'audit_log is append-only'); END",
)


_POSTGRESQL_TRIGGERS = (
    "CREATE FUNCTION refuse_change() RETURNS trigger LANGUAGE plpgsql AS "
    "$$ BEGIN RAISE EXCEPTION '% is append-only', TG_TABLE_NAME; END $$",
    *(
        f"CREATE TRIGGER {table}_no_{name} BEFORE {change} ON {table} FOR EACH {each} EXECUTE FUNCTION refuse_change()"
        for table in _KEPT
        for name, change, each in (("change", "UPDATE OR DELETE", "ROW"), ("truncate", "TRUNCATE", "STATEMENT"))
    ),
)


def bring_up_to_date(connection: sa.Connection) -> None:
    """Make the tables in an empty database, or turn those of an older version into the present ones.

    Raises
    ------
    StoreError
        If the database belongs to a newer version, or to something else.
    """
    if _revisions(connection) == [REVISION]:
        return
    if connection.dialect.name == "postgresql":
        # Migrating may take minutes, and so may waiting for another's migration; in SQLite the transaction waits.
        connection.execute(sa.text("SET LOCAL statement_timeout = 0"))
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(*MIGRATING)))
    found = _revisions(connection)
    if found and found != [REVISION]:
        from service.history.migrations import migrate  # noqa: PLC0415  # Alembic takes long to import

        migrate(connection)
    elif not found and (others := sa.inspect(connection).get_table_names()):
        raise StoreError(
            f"the database holds a table {min(others)!r} not of the history: give the history a database of its own"
        )
    elif not found:
        metadata.create_all(connection, checkfirst=False)
        for statement in (
            *(_SQLITE_TRIGGERS if connection.dialect.name == "sqlite" else _POSTGRESQL_TRIGGERS),
            "CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL, "
            "CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num))",
            f"INSERT INTO alembic_version VALUES ('{REVISION}')",  # noqa: S608  # ours
        ):
            connection.execute(sa.text(statement))


def _revisions(connection: sa.Connection) -> list[str]:
    if not sa.inspect(connection).has_table("alembic_version"):
        return []
    return list(connection.scalars(sa.text("SELECT version_num FROM alembic_version")))
