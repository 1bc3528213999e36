"""Where Alembic starts; the connection comes from `service.history.migrations`, inside a transaction."""

from alembic import context

if __name__ == "env_py":  # the name under which Alembic runs this file
    context.configure(connection=context.config.attributes["connection"])
    context.run_migrations()
