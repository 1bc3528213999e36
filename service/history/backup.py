"""Check, back up and restore a history that is one SQLite file."""

import glob
import os
import sqlite3
from contextlib import ExitStack, closing
from pathlib import Path
from urllib.parse import quote

from service.history.errors import StoreError
from service.history.file import HistoryFile, lock_file

__all__ = ["back_up", "faults", "restore"]


def faults(file: Path) -> tuple[str, ...]:
    """What is wrong with a file; empty if it is a whole history. Takes seconds for each gigabyte.

    Raises
    ------
    StoreError
        If it cannot be opened.
    """
    try:
        with closing(_opened(file)) as connection:
            names = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if "alembic_version" not in names:
                return ("it holds no history of rotorwatch",)
            found = tuple(text for (text,) in connection.execute("PRAGMA integrity_check"))
    except sqlite3.OperationalError as error:
        raise StoreError(f"{file}: {error}") from error
    except sqlite3.DatabaseError as error:
        return (str(error),)
    return () if found == ("ok",) else found


def back_up(file: Path, copy: Path) -> None:
    """Copy a history, also while a monitor writes it; the copy is whole or not there.

    Raises
    ------
    StoreError
        If the copy is there already, or cannot be made.
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
        copy = file.with_name(f"{file.name}.restored")
        copy.unlink(missing_ok=True)
        back_up(backup, copy)
        was_there = file.exists()
        kept = into.set_aside("replaced")
        copy.rename(file)
    return kept if was_there else None


def _opened(file: Path) -> sqlite3.Connection:
    try:
        return sqlite3.connect(f"file:{quote(str(file))}?mode=ro", uri=True)
    except sqlite3.Error as error:
        raise StoreError(f"{file}: {error}") from error
