"""How far each webhook has been served."""

from sqlalchemy import select

from service.history.database import Database
from service.history.tables import webhook_cursors

__all__ = ["WebhookCursors"]


class WebhookCursors:
    """The alarm event that each webhook is to have next of each machine; for any thread.

    Both methods raise `StoreError` if the database fails.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def get(self, name: str, machine_key: str) -> int:
        """Sequence of the event that is to be delivered next; -1 if none was ever set."""
        column = webhook_cursors.c
        query = select(column.sequence).where(column.name == name, column.machine_key == machine_key)
        return next((sequence for (sequence,) in self._database.rows(query)), -1)

    def set(self, name: str, machine_key: str, sequence: int) -> None:
        """Note the sequence of the event that is to be delivered next."""
        made = self._database.insert(webhook_cursors).values(name=name, machine_key=machine_key, sequence=sequence)
        made = made.on_conflict_do_update(index_elements=["name", "machine_key"], set_={"sequence": sequence})
        with self._database.writing() as connection:
            connection.execute(made)
