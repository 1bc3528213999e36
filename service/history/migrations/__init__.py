"""How the tables of the history came about, step by step; `migrate` runs what a database does not have yet."""

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, inspect, text

from service.history.records import StoreError

MIGRATING = (0x726F746F, 0)  # PostgreSQL's advisory lock; second numbers from 1 are machines


def migrate(connection: Connection, revision: str = "head") -> None:
    """Run the migrations that are missing, up to a revision, in the transaction of the connection.

    Raises
    ------
    StoreError
        If the database belongs to a newer version, or to something else.
    """
    if connection.dialect.name == "postgresql":
        connection.execute(text("SET LOCAL statement_timeout = 0"))  # a large history may take minutes, another's too
        # One at a time; SQLite's transaction keeps the others out by itself.
        connection.execute(
            text("SELECT pg_advisory_xact_lock(:high, :low)"), {"high": MIGRATING[0], "low": MIGRATING[1]}
        )
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    config.attributes["connection"] = connection
    known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
    found = set(MigrationContext.configure(connection).get_current_heads())
    if not found <= known:
        raise StoreError(
            f"the database is of revision {', '.join(sorted(found - known))}, which this version of rotorwatch does "
            "not know: a newer one has written it"
        )
    if not found and "machines" in inspect(connection).get_table_names():
        raise StoreError(
            "the database holds a table 'machines' that is not ours: give the history a database of its own"
        )
    command.upgrade(config, revision)
