"""Everything the history began with."""

import sqlalchemy as sa
from alembic import op

from service.history.tables import KEPT, SQLITE_TRIGGERS

revision = "0001"
down_revision: str | None = None


def upgrade() -> None:
    """Create all tables, and the triggers that keep the log of alarms and the audit log as they were written."""
    _machines()
    _windows()
    _checkpoints()
    _access()
    if op.get_bind().dialect.name == "sqlite":
        for trigger in SQLITE_TRIGGERS:
            op.execute(trigger)
    else:
        _triggers_of_postgresql()


def _big(name: str, nullable: bool = False) -> sa.Column[int]:
    return sa.Column(name, sa.BigInteger(), nullable=nullable)


def _text(name: str, nullable: bool = False) -> sa.Column[str]:
    return sa.Column(name, sa.Text(), nullable=nullable)


def _double(name: str, nullable: bool = False) -> sa.Column[float]:
    return sa.Column(name, sa.Double(), nullable=nullable)


def _bytes(name: str) -> sa.Column[bytes]:
    return sa.Column(name, sa.LargeBinary(), nullable=False)


def _of_machine(table: str) -> tuple[sa.Column[int], sa.ForeignKeyConstraint]:
    return (
        sa.Column("machine_id", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["machine_id"], ["machines.machine_id"], name=f"{table}_machine_id_fk"),
    )


def _machines() -> None:
    op.create_table(
        "machines",
        sa.Column("machine_id", sa.Integer(), nullable=False),
        _text("site"),
        _text("name"),
        _text("owner"),
        _big("steps"),
        _big("reports"),
        _big("evaluations"),
        sa.PrimaryKeyConstraint("machine_id", name="machines_pk"),
        sa.UniqueConstraint("site", "name", name="machines_site_name_unique"),
    )
    op.create_table(
        "alarm_events",
        *_of_machine("alarm_events"),
        _big("sequence"),
        _text("id"),
        _big("time_ns"),
        _big("recorded_ns"),
        _text("kind"),
        _text("alarm"),
        _text("severity"),
        _text("state"),
        _big("occurrence"),
        _text("actor"),
        _text("text"),
        sa.PrimaryKeyConstraint("machine_id", "sequence", name="alarm_events_pk"),
        sa.UniqueConstraint("machine_id", "id", name="alarm_events_machine_id_id_unique"),
    )
    op.create_index("alarm_events_machine_id_time_ns", "alarm_events", ["machine_id", "time_ns"])


def _windows() -> None:
    op.create_table(
        "reports",
        *_of_machine("reports"),
        _big("number"),
        _big("start_ns"),
        _big("end_ns"),
        _big("recorded_ns"),
        _text("state"),
        _double("filled"),
        _bytes("text"),
        sa.PrimaryKeyConstraint("machine_id", "number", name="reports_pk"),
    )
    op.create_table(
        "evaluations",
        *_of_machine("evaluations"),
        _big("number"),
        _big("end_ns"),
        _big("recorded_ns"),
        sa.PrimaryKeyConstraint("machine_id", "number", name="evaluations_pk"),
        sqlite_with_rowid=False,
    )
    for table in ("reports", "evaluations"):
        op.create_index(f"{table}_machine_id_end_ns", table, ["machine_id", "end_ns"])
        op.create_index(f"{table}_recorded_ns", table, ["recorded_ns"])
    op.create_table(
        "series",
        sa.Column("series_id", sa.Integer(), nullable=False),
        *_of_machine("series"),
        _text("quantity"),
        _text("name"),
        sa.PrimaryKeyConstraint("series_id", name="series_pk"),
        sa.UniqueConstraint("machine_id", "quantity", "name", name="series_machine_id_quantity_name_unique"),
    )
    op.create_table(
        "readings",
        sa.Column("machine_id", sa.Integer(), nullable=False),
        _big("number"),
        sa.Column("series_id", sa.Integer(), nullable=False),
        _double("value"),
        _double("standard_error", nullable=True),
        sa.PrimaryKeyConstraint("machine_id", "number", "series_id", name="readings_pk"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "buckets",
        sa.Column("series_id", sa.Integer(), nullable=False),
        _big("start_ns"),
        _big("length_ns"),
        _big("recorded_ns"),
        _big("count"),
        _double("minimum"),
        _double("maximum"),
        _double("total"),
        _big("errors"),
        _double("errors_total"),
        sa.PrimaryKeyConstraint("series_id", "start_ns", "length_ns", name="buckets_pk"),
        sa.ForeignKeyConstraint(["series_id"], ["series.series_id"], name="buckets_series_id_fk"),
        sqlite_with_rowid=False,
    )
    op.create_index("buckets_recorded_ns", "buckets", ["recorded_ns"])


def _checkpoints() -> None:
    op.create_table(
        "checkpoints",
        *_of_machine("checkpoints"),
        sa.Column("format", sa.Integer(), nullable=False),
        _text("bundle", nullable=True),
        _text("machine_hash"),
        _text("code_version"),
        _big("end_ns"),
        _big("recorded_ns"),
        _text("alarms"),
        _bytes("state"),
        sa.PrimaryKeyConstraint("machine_id", name="checkpoints_pk"),
    )
    op.create_table(
        "checkpoint_hops",
        *_of_machine("checkpoint_hops"),
        _big("end_ns"),
        _bytes("moments"),
        sa.PrimaryKeyConstraint("machine_id", "end_ns", name="checkpoint_hops_pk"),
    )


def _access() -> None:
    op.create_table(
        "tokens",
        _text("token_id"),
        _text("name"),
        _text("scopes"),
        _bytes("secret_hash"),
        _big("created_ns"),
        _big("expires_ns", nullable=True),
        _big("revoked_ns", nullable=True),
        sa.PrimaryKeyConstraint("token_id", name="tokens_pk"),
    )
    op.create_table(
        "audit_log",
        sa.Column("number", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        _big("at_ns"),
        *(_text(name) for name in ("actor", "address", "method", "path")),
        sa.Column("status", sa.Integer(), nullable=False),
        *(_text(name) for name in ("action", "machine", "alarm", "reason")),
        sa.PrimaryKeyConstraint("number", name="audit_log_pk"),
    )
    op.create_table(
        "webhook_cursors",
        _text("name"),
        _text("machine_key"),
        _big("sequence"),
        sa.PrimaryKeyConstraint("name", "machine_key", name="webhook_cursors_pk"),
    )


def _triggers_of_postgresql() -> None:
    op.execute(
        "CREATE FUNCTION refuse_change() RETURNS trigger LANGUAGE plpgsql AS "
        "$$ BEGIN RAISE EXCEPTION '% is append-only', TG_TABLE_NAME; END $$"
    )
    for table in KEPT:
        op.execute(
            f"CREATE TRIGGER {table}_no_change BEFORE UPDATE OR DELETE ON {table} "
            "FOR EACH ROW EXECUTE FUNCTION refuse_change()"
        )
        op.execute(
            f"CREATE TRIGGER {table}_no_truncate BEFORE TRUNCATE ON {table} "
            "FOR EACH STATEMENT EXECUTE FUNCTION refuse_change()"
        )
