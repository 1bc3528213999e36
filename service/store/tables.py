"""The tables of the history, as the code sees them; `migrations` makes and changes them.

::

    machines --< alarm_events                      the log of alarms; triggers refuse to change it
             --< reports                           the newest, whole and compressed
             --< evaluations --< readings >-- series    a window's numbers: one row for the window, one for each number
                                 buckets >-- series     the same reduced, filled as they come, and kept longer
             --- checkpoints --< checkpoint_hops   where a monitor goes on from
    tokens    audit_log    webhook_cursors
"""

from sqlalchemy import (
    BigInteger,
    Column,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    PrimaryKeyConstraint,
    Table,
    Text,
    UniqueConstraint,
    text,
)

__all__ = [
    "alarm_events",
    "audit_log",
    "buckets",
    "checkpoint_hops",
    "checkpoints",
    "evaluations",
    "machines",
    "metadata",
    "readings",
    "reports",
    "series",
    "tokens",
    "webhook_cursors",
]

metadata = MetaData(
    naming_convention={
        "pk": "%(table_name)s_pk",
        "fk": "%(table_name)s_%(column_0_name)s_fk",
        "uq": "%(table_name)s_%(column_0_N_name)s_unique",
        "ix": "%(table_name)s_%(column_0_N_name)s",
    }
)


def _machine_id() -> Column[int]:
    return Column("machine_id", Integer, ForeignKey("machines.machine_id"), nullable=False)


machines = Table(
    "machines",
    metadata,
    Column("machine_id", Integer, primary_key=True),
    Column("site", Text, nullable=False),
    Column("name", Text, nullable=False),
    # Who may write: a monitor that finds another's mark here has been replaced.
    Column("owner", Text, nullable=False),
    # How many there have been; a step that is sent twice is known by its number.
    Column("steps", BigInteger, nullable=False),
    Column("reports", BigInteger, nullable=False),
    Column("evaluations", BigInteger, nullable=False),
    UniqueConstraint("site", "name"),
)

alarm_events = Table(
    "alarm_events",
    metadata,
    _machine_id(),
    Column("sequence", BigInteger, nullable=False),
    Column("id", Text, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("recorded_ns", BigInteger, nullable=False),
    Column("kind", Text, nullable=False),
    Column("alarm", Text, nullable=False),
    Column("severity", Text, nullable=False),
    Column("state", Text, nullable=False),
    Column("occurrence", BigInteger, nullable=False),
    Column("actor", Text, nullable=False),
    Column("text", Text, nullable=False),
    PrimaryKeyConstraint("machine_id", "sequence"),
    UniqueConstraint("machine_id", "id"),
    Index(None, "machine_id", "time_ns"),
)

reports = Table(
    "reports",
    metadata,
    _machine_id(),
    Column("number", BigInteger, nullable=False),
    Column("start_ns", BigInteger, nullable=False),
    Column("end_ns", BigInteger, nullable=False),
    Column("recorded_ns", BigInteger, nullable=False),
    Column("state", Text, nullable=False),
    Column("filled", Double, nullable=False),
    Column("text", LargeBinary, nullable=False),
    PrimaryKeyConstraint("machine_id", "number"),
    Index(None, "machine_id", "end_ns"),
    Index(None, "recorded_ns"),
)

evaluations = Table(
    "evaluations",
    metadata,
    _machine_id(),
    Column("number", BigInteger, nullable=False),
    Column("end_ns", BigInteger, nullable=False),
    Column("recorded_ns", BigInteger, nullable=False),
    PrimaryKeyConstraint("machine_id", "number"),
    Index(None, "machine_id", "end_ns"),
    Index(None, "recorded_ns"),
    sqlite_with_rowid=False,
)

series = Table(
    "series",
    metadata,
    Column("series_id", Integer, primary_key=True),
    _machine_id(),
    Column("quantity", Text, nullable=False),
    Column("name", Text, nullable=False),
    # End of the latest window whose reading has been dropped, so that only buckets know of it; -1 if there is none.
    Column("dropped_ns", BigInteger, nullable=False, server_default=text("-1")),
    UniqueConstraint("machine_id", "quantity", "name"),
)

# The greatest number of rows by far: nothing but the numbers, in the order in which they come.
readings = Table(
    "readings",
    metadata,
    Column("machine_id", Integer, nullable=False),
    Column("number", BigInteger, nullable=False),
    Column("series_id", Integer, nullable=False),
    Column("value", Double, nullable=False),
    Column("standard_error", Double, nullable=True),
    PrimaryKeyConstraint("machine_id", "number", "series_id"),
    sqlite_with_rowid=False,
)

buckets = Table(
    "buckets",
    metadata,
    Column("series_id", Integer, ForeignKey("series.series_id"), nullable=False),
    Column("start_ns", BigInteger, nullable=False),
    Column("length_ns", BigInteger, nullable=False),
    Column("recorded_ns", BigInteger, nullable=False),
    Column("count", BigInteger, nullable=False),
    Column("minimum", Double, nullable=False),
    Column("maximum", Double, nullable=False),
    Column("total", Double, nullable=False),
    Column("errors", BigInteger, nullable=False),
    Column("errors_total", Double, nullable=False),
    PrimaryKeyConstraint("series_id", "start_ns", "length_ns"),
    Index(None, "recorded_ns"),
    sqlite_with_rowid=False,
)

checkpoints = Table(
    "checkpoints",
    metadata,
    Column("machine_id", Integer, ForeignKey("machines.machine_id"), primary_key=True, autoincrement=False),
    Column("format", Integer, nullable=False),
    Column("bundle", Text, nullable=True),
    Column("machine_hash", Text, nullable=False),
    Column("code_version", Text, nullable=False),
    Column("end_ns", BigInteger, nullable=False),
    Column("recorded_ns", BigInteger, nullable=False),
    Column("alarms", Text, nullable=False),
    Column("state", LargeBinary, nullable=False),
)

checkpoint_hops = Table(
    "checkpoint_hops",
    metadata,
    _machine_id(),
    Column("end_ns", BigInteger, nullable=False),
    Column("moments", LargeBinary, nullable=False),
    PrimaryKeyConstraint("machine_id", "end_ns"),
)

tokens = Table(
    "tokens",
    metadata,
    Column("token_id", Text, primary_key=True),
    Column("name", Text, nullable=False),
    Column("scopes", Text, nullable=False),
    Column("secret_hash", LargeBinary, nullable=False),
    Column("created_ns", BigInteger, nullable=False),
    Column("expires_ns", BigInteger, nullable=True),
    Column("revoked_ns", BigInteger, nullable=True),
)

audit_log = Table(
    "audit_log",
    metadata,
    Column("number", BigInteger().with_variant(Integer, "sqlite"), primary_key=True),
    Column("at_ns", BigInteger, nullable=False),
    Column("actor", Text, nullable=False),
    Column("address", Text, nullable=False),
    Column("method", Text, nullable=False),
    Column("path", Text, nullable=False),
    Column("status", Integer, nullable=False),
    Column("action", Text, nullable=False),
    Column("machine", Text, nullable=False),
    Column("alarm", Text, nullable=False),
    Column("reason", Text, nullable=False),
)

webhook_cursors = Table(
    "webhook_cursors",
    metadata,
    Column("name", Text, nullable=False),
    Column("machine_key", Text, nullable=False),
    Column("sequence", BigInteger, nullable=False),
    PrimaryKeyConstraint("name", "machine_key"),
)
