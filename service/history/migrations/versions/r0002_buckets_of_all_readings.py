"""Buckets hold every reading from the moment it comes, and not only those that have been dropped."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"

_LENGTH_NS = 600 * 10**9
_LARGEST = 1.7e308


def upgrade() -> None:
    """Note what has been dropped, and add the readings that are there to the buckets; minutes in a large history."""
    op.add_column("series", sa.Column("dropped_ns", sa.BigInteger(), nullable=False, server_default=sa.text("-1")))
    op.execute(
        "UPDATE series SET dropped_ns = COALESCE((SELECT MAX(start_ns + length_ns) - 1 FROM buckets "
        "WHERE buckets.series_id = series.series_id), -1)"
    )
    length_ns = op.get_bind().scalar(sa.text("SELECT MAX(length_ns) FROM buckets")) or _LENGTH_NS
    least, greatest = ("MIN", "MAX") if op.get_bind().dialect.name == "sqlite" else ("LEAST", "GREATEST")
    added = (
        "SELECT r.series_id, (e.end_ns / :length) * :length, CAST(:length AS BIGINT), MAX(e.recorded_ns), COUNT(*), "
        "MIN(r.value), MAX(r.value), SUM(r.value), COUNT(r.standard_error), COALESCE(SUM(r.standard_error), 0.0) "
        "FROM evaluations e JOIN readings r ON r.machine_id = e.machine_id AND r.number = e.number "
        "WHERE r.value BETWEEN :least AND :greatest AND COALESCE(r.standard_error, 0.0) BETWEEN :least AND :greatest "
        "GROUP BY 1, 2"
    )
    op.get_bind().execute(
        sa.text(
            "INSERT INTO buckets (series_id, start_ns, length_ns, recorded_ns, count, minimum, maximum, total, errors, "
            f"errors_total) {added} ON CONFLICT (series_id, start_ns, length_ns) DO UPDATE SET "
            f"recorded_ns = {greatest}(buckets.recorded_ns, excluded.recorded_ns), "
            "count = buckets.count + excluded.count, "
            f"minimum = {least}(buckets.minimum, excluded.minimum), "
            f"maximum = {greatest}(buckets.maximum, excluded.maximum), "
            "total = buckets.total + excluded.total, errors = buckets.errors + excluded.errors, "
            "errors_total = buckets.errors_total + excluded.errors_total"
        ),
        {"length": length_ns, "least": -_LARGEST, "greatest": _LARGEST},
    )
