"""The SQLite file of a history: whether it is still the one that was opened, and what is done if not."""

import fcntl
import os
import sqlite3
import time
from contextlib import closing
from pathlib import Path

from sqlalchemy import Connection
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from service.history.errors import DamagedError

__all__ = ["HistoryFile", "is_damage", "lock_file"]

_DAMAGE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_COMPANIONS = ("", "-wal", "-shm")


class HistoryFile:
    """One file and what SQLite keeps beside it.

    Attributes
    ----------
    path : Path
    damage : str
        What SQLite found wrong with it while it was in use; whoever finds it sets it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = ""
        self._opened: dict[str, tuple[int, int] | None] = {}

    def make(self) -> None:
        """Make the file, if there is none, and its folder."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        _make(self.path)

    def opened(self) -> None:
        """Take note of the file that is in use from now on."""
        self._opened = {end: _identity(self._beside(end)) for end in _COMPANIONS}
        self.damage = ""

    def astray(self) -> str:
        """Why what is written would not be found at the path any more; empty if it would."""
        if not self._opened:
            return ""
        found = _identity(self.path)
        if found is None:
            return "the file was deleted"
        if found != self._opened[""]:
            return "another file was put in its place"
        return f"the file is damaged: {self.damage}" if self.damage else ""

    def rescue(self, source: Connection | None) -> bool:
        """Write what a deleted file holds into a new one at its path; say whether that is done.

        Parameters
        ----------
        source : Connection or None
            Opened before the file was deleted.
        """
        if source is None or _identity(self.path) is not None:
            return False
        copy = self._beside(".rescued")
        try:
            copy.unlink(missing_ok=True)
            _make(copy)
            with closing(sqlite3.connect(copy)) as target:
                source.connection.driver_connection.backup(target)  # type: ignore[union-attr]  # sqlite3's
            self.set_aside("deleted")
            copy.rename(self.path)
        except (SQLAlchemyError, sqlite3.Error, OSError):
            copy.unlink(missing_ok=True)
            return False
        return True

    def set_aside(self, why: str, *, only_opened: bool = False) -> Path:
        """Rename the file and what SQLite keeps beside it; return the new name.

        Parameters
        ----------
        why : str
            Part of the new name.
        only_opened : bool
            Leave what belongs to another file than was opened.
        """
        kept = self._beside(f".{why}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}")
        for end in _COMPANIONS:
            found = _identity(self._beside(end))
            if found is not None and (not only_opened or found == self._opened.get(end)):
                self._beside(end).rename(kept.with_name(kept.name + end))
        return kept

    def _beside(self, end: str) -> Path:
        return Path(f"{self.path}{end}")


def is_damage(error: BaseException) -> bool:
    """Whether an error means that the file is damaged."""
    code = getattr(error.orig if isinstance(error, DBAPIError) else error, "sqlite_errorcode", None)
    return isinstance(error, DamagedError) or (isinstance(code, int) and code & 0xFF in _DAMAGE)


def lock_file(path: Path) -> int | None:
    """Lock the file beside the database that stands for one machine; None if another has it.

    The system lets go of it when the process ends, however it ends.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _identity(file: Path) -> tuple[int, int] | None:
    """What a file is known by, whatever its name; None if there is none that can be reached."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _make(file: Path) -> None:
    """Make a file, if there is none, for its owner alone: it holds hashes of secrets."""
    os.close(os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
