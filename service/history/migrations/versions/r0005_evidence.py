"""A table for the evidence of alarms."""

from alembic import op

from service.history.tables import evidence

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Add the table, which begins empty."""
    evidence.create(op.get_bind())
