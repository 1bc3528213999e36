"""Where Alembic starts; the connection comes from `service.history.migrations`, inside a transaction."""

from alembic import context

from service.history.tables import metadata


def _migrate() -> None:
    context.configure(connection=context.config.attributes["connection"], target_metadata=metadata)
    with context.begin_transaction():
        context.run_migrations()


if __name__ == "env_py":  # the name under which Alembic runs this file
    _migrate()
