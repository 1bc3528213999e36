"""Less is written with every hop: no moments of the window, and buckets that are being filled beside each other."""

import sqlalchemy as sa
import zstandard
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Parts of a checkpoint in place of hops; one of before is still gone on from, with a window that fills anew."""
    for table in ("reports", "evaluations"):
        op.drop_index(f"{table}_recorded_ns", table)
    _checkpoints()
    op.drop_table("checkpoint_hops")
    op.create_table(
        "checkpoint_parts",
        sa.Column("machine_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["machine_id"], ["machines.machine_id"], name="checkpoint_parts_machine_id_fk"),
        sa.PrimaryKeyConstraint("machine_id", "name", name="checkpoint_parts_pk"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "open_buckets",
        sa.Column("series_id", sa.Integer(), nullable=False),
        *(
            sa.Column(name, sa.BigInteger(), nullable=False)
            for name in ("start_ns", "length_ns", "recorded_ns", "count")
        ),
        *(sa.Column(name, sa.Double(), nullable=False) for name in ("minimum", "maximum", "total")),
        sa.Column("errors", sa.BigInteger(), nullable=False),
        sa.Column("errors_total", sa.Double(), nullable=False),
        sa.PrimaryKeyConstraint("series_id", name="open_buckets_pk"),
        sa.ForeignKeyConstraint(["series_id"], ["series.series_id"], name="open_buckets_series_id_fk"),
        sqlite_with_rowid=False,
    )


def _checkpoints() -> None:
    """Compress the alarms."""
    kept = op.get_bind().execute(sa.text("SELECT * FROM checkpoints")).mappings().all()
    op.drop_table("checkpoints")
    made = op.create_table(
        "checkpoints",
        sa.Column("machine_id", sa.Integer(), nullable=False),
        sa.Column("format", sa.Integer(), nullable=False),
        sa.Column("bundle", sa.Text(), nullable=True),
        *(sa.Column(name, sa.Text(), nullable=False) for name in ("machine_hash", "code_version")),
        *(sa.Column(name, sa.BigInteger(), nullable=False) for name in ("end_ns", "recorded_ns")),
        *(sa.Column(name, sa.LargeBinary(), nullable=False) for name in ("alarms", "state")),
        sa.PrimaryKeyConstraint("machine_id", name="checkpoints_pk"),
        sa.ForeignKeyConstraint(["machine_id"], ["machines.machine_id"], name="checkpoints_machine_id_fk"),
    )
    rows = [dict(row) | {"alarms": zstandard.compress(row["alarms"].encode())} for row in kept]
    if rows:
        op.bulk_insert(made, rows)
