"""The SQLite file of a history: whether it is still the one that was opened, what is done if not, and backups."""

import fcntl
import glob
import os
import sqlite3
import time
from contextlib import ExitStack, closing
from pathlib import Path
from urllib.parse import quote

from sqlalchemy import Connection
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from service.history.records import DamagedError, StoreError

_DAMAGE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_COMPANIONS = ("", "-wal", "-shm")
_HEADER = b"SQLite format 3\0"


class HistoryFile:
    """One file and what SQLite keeps beside it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = ""  # what SQLite found wrong with it while it was in use; set by the code that finds it
        self._opened: dict[str, tuple[int, int] | None] = {}

    def make(self) -> None:
        """Make the file, if there is none, and its folder.

        Raises
        ------
        StoreError
            If a file is there that never was a history: it begins with text, not with a header or zeros.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        _make(self.path)
        with self.path.open("rb") as file:
            header = file.read(len(_HEADER))
        if header.strip(b"\0") and not _HEADER.startswith(header) and header.isascii():
            raise StoreError(
                f"{self.path} is not a history (SQLite), and is left as it is: expected a new file, or a history"
            )

    def opened(self) -> None:
        """Take note of the file that is in use from now on."""
        self._opened = {end: _identity(self._beside(end)) for end in _COMPANIONS}
        self.damage = ""

    def astray(self) -> str:
        """Why what is written now would no longer be found at the path; empty if it would."""
        if not self._opened:
            return ""
        found = _identity(self.path)
        if found is None:
            return "the file was deleted"
        if found != self._opened[""]:
            return "another file was put in its place"
        return f"the file is damaged: {self.damage}" if self.damage else ""

    def rescue(self, source: Connection | None) -> bool:
        """Write the contents of a deleted file into a new one at its path; return whether that was possible.

        `source` was connected to it before it was deleted.
        """
        if source is None or _identity(self.path) is not None:
            return False
        copy = self._beside(".rescued")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)  # the whole folder may be gone
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
        """Rename the file and what SQLite keeps beside it, or only those that were opened; return the new name."""
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

    The system releases the lock when the process ends, however it ends.
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
    """Device and inode, which identify a file whatever its name; None if it cannot be reached."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _make(file: Path) -> None:
    """Make a file, if there is none, for its owner alone: it holds hashes of secrets."""
    os.close(os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))


def faults(file: Path) -> tuple[str, ...]:
    """What is wrong with a file; empty if it is a whole history. Takes seconds for each gigabyte.

    Raises StoreError if it cannot be opened.
    """
    try:
        with closing(_opened(file)) as connection:
            names = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if "alembic_version" not in names:
                return ("it contains no rotorwatch history",)
            found = tuple(text for (text,) in connection.execute("PRAGMA integrity_check"))
    except sqlite3.OperationalError as error:
        raise StoreError(f"{file}: {error}") from error
    except sqlite3.DatabaseError as error:
        return (str(error),)
    return () if found == ("ok",) else found


def back_up(file: Path, copy: Path) -> None:
    """Copy a history, also while a monitor writes it; the copy is whole or not there.

    Raises StoreError if the copy is there already, or cannot be made.
    """
    try:
        os.close(os.open(copy, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
    except OSError as error:
        raise StoreError(f"{copy}: {error.strerror or error}; expected a new file") from error
    try:
        with closing(_opened(file)) as source, closing(sqlite3.connect(copy)) as target:
            source.backup(target)
            target.execute("PRAGMA journal_mode = DELETE")  # so that the copy is one file, also when it is read
        if found := faults(copy):
            raise StoreError(f"{file}: {found[0]}")
    except BaseException as error:
        copy.unlink()
        if isinstance(error, sqlite3.Error):
            raise StoreError(f"{file}: cannot be copied to {copy}: {error}") from error
        raise


def restore(into: HistoryFile, backup: Path) -> Path | None:
    """Put a backup in the place of a history that no monitor writes; return where the former one is kept, if any was.

    Raises
    ------
    StoreError
        If a monitor runs, the backup is no whole history, or it cannot be copied.
    """
    file = into.path
    if found := faults(backup):
        raise StoreError(f"{backup}: {found[0]}")
    with ExitStack() as undo:
        for path in map(Path, glob.glob(f"{glob.escape(str(file))}.*.lock")):
            descriptor = lock_file(path)
            if descriptor is None:
                raise StoreError(f"{file}: a monitor writes it ({path.name} is locked): stop it first")
            undo.callback(os.close, descriptor)
        file.parent.mkdir(parents=True, exist_ok=True)  # on another computer there is none yet
        copy = file.with_name(f"{file.name}.restored")
        copy.unlink(missing_ok=True)
        back_up(backup, copy)
        was_there = file.exists()
        kept = into.set_aside("replaced")
        copy.rename(file)
    return kept if was_there else None


def _opened(file: Path) -> sqlite3.Connection:
    if not file.is_file():  # SQLite's own message says less
        raise StoreError(f"{file}: {'is a folder, expected a file' if file.is_dir() else 'no such file'}")
    try:
        return sqlite3.connect(f"file:{quote(str(file))}?mode=ro", uri=True)
    except sqlite3.Error as error:
        raise StoreError(f"{file}: {error}") from error
