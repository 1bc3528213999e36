"""The tables of version 0.1.0, which `service.history.tables` makes: the starting point of later migrations."""

revision = "0004"
down_revision: str | None = None


def upgrade() -> None:
    """Nothing: a database that has no revision is empty, and gets the present tables at once."""
