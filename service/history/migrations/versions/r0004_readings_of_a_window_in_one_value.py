"""The readings of a window are one value, and so are its buckets; none are kept open."""

from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
import sqlalchemy as sa
import structlog
from alembic import op

from service.history.windows import BUCKET, READING, add_up, packed

revision = "0004"
down_revision = "0003"

_PORTION = 20_000
_log = structlog.get_logger("rotorwatch", part="history")


def upgrade() -> None:
    """Pack window by window, which takes a minute or two for each million windows of eleven readings."""
    op.execute("ALTER TABLE machines RENAME COLUMN evaluations TO windows")
    op.add_column("machines", sa.Column("bucketed", sa.BigInteger(), nullable=False, server_default=sa.text("0")))
    _convert(
        _table("windows", ("number", "end_ns", "recorded_ns"), ("machine_id", "number")),
        "SELECT e.machine_id, e.number, e.end_ns, e.recorded_ns, r.series_id, r.value, r.standard_error "
        "FROM evaluations e JOIN readings r ON r.machine_id = e.machine_id AND r.number = e.number "
        "ORDER BY e.machine_id, e.number, r.series_id",
        READING,
    )
    op.create_index("windows_machine_id_end_ns", "windows", ["machine_id", "end_ns"])
    op.drop_table("readings")
    op.drop_table("evaluations")
    newest = "SELECT MAX(number) FROM windows WHERE windows.machine_id = machines.machine_id"
    op.execute(f"UPDATE machines SET bucketed = COALESCE(({newest}), 0)")  # noqa: S608  # ours
    op.drop_index("buckets_recorded_ns", "buckets")
    op.rename_table("buckets", "closed_buckets")
    if op.get_bind().dialect.name == "postgresql":
        op.execute("ALTER INDEX buckets_pk RENAME TO closed_buckets_pk")
    _convert(
        _table("buckets", ("start_ns", "length_ns", "recorded_ns"), ("machine_id", "start_ns", "length_ns")),
        "SELECT s.machine_id, b.start_ns, b.length_ns, b.recorded_ns, b.series_id, b.count, b.minimum, b.maximum, "
        "b.total, b.errors, b.errors_total "
        "FROM (SELECT * FROM closed_buckets UNION ALL SELECT * FROM open_buckets) b "
        "JOIN series s ON s.series_id = b.series_id ORDER BY s.machine_id, b.start_ns, b.length_ns, b.series_id",
        BUCKET,
    )
    op.create_index("buckets_recorded_ns", "buckets", ["recorded_ns"])
    op.drop_table("closed_buckets")
    op.drop_table("open_buckets")


def _table(name: str, numbers: tuple[str, ...], key: tuple[str, ...]) -> sa.Table:
    return op.create_table(
        name,
        sa.Column("machine_id", sa.Integer(), nullable=False),
        *(sa.Column(each, sa.BigInteger(), nullable=False) for each in numbers),
        sa.Column("readings", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint(*key, name=f"{name}_pk"),
        sa.ForeignKeyConstraint(["machine_id"], ["machines.machine_id"], name=f"{name}_machine_id_fk"),
    )


def _convert(table: sa.Table, query: str, kind: np.dtype[np.void]) -> None:
    """Make rows of the table of what a query finds: three columns that are its key, when it was recorded, records."""
    names = [column.name for column in table.columns]
    found = op.get_bind().execute(sa.text(query).execution_options(yield_per=_PORTION))
    made, total = list[dict[str, Any]](), 0
    for key, group in groupby(found, key=itemgetter(0, 1, 2)):
        rows = list(group)
        records = np.array([row[4:] for row in rows], kind)  # NULL becomes NaN
        if kind is BUCKET:  # of one that was open there may be a closed one
            _, records = add_up(records, np.zeros(len(records), np.int64))
        values = (*key, max(row[3] for row in rows), packed(records))
        made.append(dict(zip(names, values, strict=True)))
        if len(made) == _PORTION:
            total += len(made)
            _log.info("the history is brought up to date", table=table.name, rows=total)
            op.bulk_insert(table, made)
            made = []
    op.bulk_insert(table, made)
