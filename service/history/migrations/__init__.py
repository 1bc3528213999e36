"""How tables of an older version become the present ones; `migrate` runs the migrations that a database lacks."""

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection

from service.history.records import StoreError

FOLDER = Path(__file__).parent


def migrate(connection: Connection) -> None:
    """Run the migrations that are missing, in the transaction of the connection.

    Raises StoreError if the tables are of a newer version, or of one before 0.1.0.
    """
    config = Config()
    config.set_main_option("script_location", str(FOLDER).replace("%", "%%"))
    config.attributes["connection"] = connection
    known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
    found = set(MigrationContext.configure(connection).get_current_heads())
    if not found <= known:
        raise StoreError(
            f"the database is of revision {', '.join(sorted(found - known))}, which this version of rotorwatch does "
            "not know: another version has written it"
        )
    command.upgrade(config, "head")
