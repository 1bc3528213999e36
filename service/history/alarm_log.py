"""The logs of alarms, for those who have no right to write a machine's history."""

from sqlalchemy import select

from service.history.database import Database
from service.history.records import StoredEvent
from service.history.tables import alarm_events, machines

__all__ = ["EVENT", "AlarmLog", "committed_events"]

EVENT = [alarm_events.c[name] for name in StoredEvent.__dataclass_fields__]
_MOST = 10_000
_TIMEOUT_S = 5.0


class AlarmLog:
    """What monitors committed to their logs of alarms; for any thread."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def since(self, site: str, name: str, recorded_ns: int) -> tuple[StoredEvent, ...]:
        """The latest events of a machine, at most 10 000, in the order of their sequence.

        Parameters
        ----------
        site, name : str
            The machine; of one that has no history there are none.
        recorded_ns : int
            Only those recorded then or later.

        Raises
        ------
        StoreError
            If the database fails.
        """
        log = alarm_events.c
        query = select(*EVENT).join(machines, machines.c.machine_id == log.machine_id)
        query = query.where(machines.c.site == site, machines.c.name == name, log.recorded_ns >= recorded_ns)
        newest_first = self._database.rows(query.order_by(log.sequence.desc()).limit(_MOST))
        return tuple(StoredEvent(*row) for row in reversed(newest_first))


def committed_events(url: str, site: str, name: str, recorded_ns: int) -> tuple[StoredEvent, ...]:
    """`AlarmLog.since` of a history that another program writes, which is opened for the moment and left as it is.

    Raises
    ------
    StoreError
        If there is no such history, or it cannot be read.
    """
    database = Database(url, _TIMEOUT_S)
    database.start(read_only=True)
    try:
        return AlarmLog(database).since(site, name, recorded_ns)
    finally:
        database.stop()
