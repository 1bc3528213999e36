"""The database behind the history: address, connections, transactions, and the one event loop that uses them."""

import asyncio
import os
import sqlite3
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import CancelledError
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext
from pathlib import Path
from typing import Any, ParamSpec, TypeVar
from urllib.parse import quote

from sqlalchemy import URL, Connection, event, make_url, text
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine, create_async_engine
from sqlalchemy.sql.schema import Table

from service.store.errors import DamagedError, StoreError
from service.store.schema import migrate

__all__ = ["Database"]

_P = ParamSpec("_P")
_T = TypeVar("_T")

_ANSWER_S = 60.0  # at least; a query over a long time may take a while
_JOIN_S = 10.0
_FINISH_S = 2.0  # for what others have asked for when the history is closed
_IMMEDIATE = "rotorwatch_immediate"
_DAMAGE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_NEEDED = ("machines", "alarm_events", "checkpoints", "checkpoint_hops", "series", "tokens", "webhook_cursors")
"""Tables without which a monitor cannot go on; to look through the others would take minutes."""
_COMPANIONS = ("", "-wal", "-shm")
_FORMS = "expected sqlite:////folder/file, sqlite:///:memory: or postgresql://user:password@host/database"


class Database:
    """Connections to one database, used in one thread of its own.

    Parameters
    ----------
    url : str
        ``sqlite:////folder/file``, ``sqlite:///:memory:`` or ``postgresql://user:password@host/database``.
    timeout_s : float
        How long to wait for a connection, for a lock that another program holds, or for one transaction, in seconds.

    Attributes
    ----------
    generation : int
        Goes up each time the history is gone on with in another file than before.
    news : str
        What happened to the file then.
    lost : str
        The same, where something of the history is not in the present file; empty if all of it is.
    damage : str
        What SQLite found wrong with the file while it was in use; whoever finds it sets it.

    Raises
    ------
    StoreError
        If the address is of no known form.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        self._url = _checked(url)
        self.is_sqlite = self._url.get_backend_name() == "sqlite"
        self.in_memory = self.is_sqlite and self._url.database in {None, "", ":memory:"}
        self.file = None if not self.is_sqlite or self.in_memory else Path(self._url.database or "")
        self.shown = self._url.render_as_string(hide_password=True)
        self._asking = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._engine: AsyncEngine | None = None
        self._identity: tuple[int, int] | None = None
        self._companions: dict[str, tuple[int, int] | None] = {}
        self.generation = 0
        self.news = self.lost = self.damage = ""
        # SQLite has one writer at a time. In memory there is one connection in all, which readers share.
        self._one_writer = asyncio.Lock()

    def start(self, set_aside: bool = False, *, read_only: bool = False) -> None:
        """Start the thread, connect, and bring the tables up to date.

        Parameters
        ----------
        set_aside : bool
            Whether a file that is damaged is renamed and a new one begun; otherwise it is an error.
        read_only : bool
            Neither make the file nor touch the tables, to look into a history that another program writes.

        Raises
        ------
        StoreError
            If that fails; nothing is left running then.
        """
        if self._loop is not None:
            raise StoreError(f"{self.shown}: the history is open already")
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="history", daemon=True)
        self._thread.start()
        try:
            if read_only:
                self._engine = self._make_engine()
                return
            # Without a limit: bringing the tables of a large history up to date may take minutes.
            asyncio.run_coroutine_threadsafe(self._guarded(None, self._connect, set_aside), self._loop).result()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Answer everybody who has asked, close all connections and end the thread; a second time is nothing.

        Raises
        ------
        StoreError
            If the connections cannot be closed.
        """
        with self._asking:
            loop, self._loop = self._loop, None
        if loop is None or self._thread is None:
            return
        try:
            limit_s = _FINISH_S + max(_ANSWER_S, 10.0 * self.timeout_s)
            asyncio.run_coroutine_threadsafe(self._guarded(limit_s, self._finish), loop).result()
        finally:
            loop.call_soon_threadsafe(loop.stop)
            self._thread.join(_JOIN_S)
            if not self._thread.is_alive():
                loop.close()

    def call(self, function: Callable[_P, Awaitable[_T]], *args: _P.args, **kwargs: _P.kwargs) -> _T:
        """Run a coroutine function in the history's loop and wait for it; for any thread but the history's own.

        Raises
        ------
        StoreError
            If the history is closed, or the database fails or does not answer.
        """
        limit_s = max(_ANSWER_S, 10.0 * self.timeout_s)
        with self._asking:  # after this nobody stops the loop without answering
            if self._loop is None:
                raise StoreError(f"{self.shown}: the history is closed")
            asked = asyncio.run_coroutine_threadsafe(self._guarded(limit_s, function, *args, **kwargs), self._loop)
        try:
            return asked.result()
        except CancelledError as error:
            raise StoreError(f"{self.shown}: the history was closed") from error

    async def _finish(self) -> None:
        """End what is going on, cancelling what takes too long, and disconnect."""
        others = asyncio.all_tasks() - {asyncio.current_task()}
        if others:
            _, late = await asyncio.wait(others, timeout=_FINISH_S)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)
        await self._disconnect()

    async def _guarded(
        self, limit_s: float | None, function: Callable[_P, Awaitable[_T]], *args: _P.args, **kwargs: _P.kwargs
    ) -> _T:
        try:
            async with asyncio.timeout(limit_s):
                return await function(*args, **kwargs)
        except (SQLAlchemyError, OSError, TimeoutError) as error:
            raise self.failure(error) from error

    def failure(self, error: BaseException) -> StoreError:
        """Put an error of the database into plain words."""
        if isinstance(error, StoreError):
            return error
        if isinstance(error, TimeoutError):
            reason = "no answer in time"
        else:
            cause = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
            reason = " ".join(str(cause).split()) or type(cause).__name__
        password = self._url.password
        if password:
            reason = reason.replace(str(password), "***")
        return StoreError(f"{self.shown}: {reason}")

    @property
    def is_open(self) -> bool:
        """Whether the thread runs."""
        return self._loop is not None

    @property
    def engine(self) -> AsyncEngine:
        """The engine, while the history is open."""
        if self._engine is None:
            raise StoreError(f"{self.shown}: the history is closed")
        return self._engine

    @asynccontextmanager
    async def reading(self) -> AsyncIterator[AsyncConnection]:
        """A connection to read with, all of it at one point in time in SQLite."""
        async with self._one_writer if self.in_memory else nullcontext(), self.engine.connect() as connection:
            yield connection

    @asynccontextmanager
    async def writing(self, repeatable: bool = False) -> AsyncIterator[AsyncConnection]:
        """A connection within a transaction, committed at the end.

        Parameters
        ----------
        repeatable : bool
            Whether all statements must see the same, which they do in SQLite anyhow.
        """
        async with self.alone(), self.writers.connect() as connection:
            if repeatable and not self.is_sqlite:
                await connection.execution_options(isolation_level="REPEATABLE READ")
            async with connection.begin():
                yield connection

    @property
    def writers(self) -> AsyncEngine:
        """The engine for connections that write: in SQLite their transactions wait for their turn at the beginning."""
        return self.engine.execution_options(**{_IMMEDIATE: True})

    def alone(self) -> AbstractAsyncContextManager[None]:
        """What keeps others of this process from writing to SQLite at the same time; nothing in PostgreSQL."""
        return self._one_writer if self.is_sqlite else nullcontext()

    def insert(self, table: Table) -> "sqlite.Insert | postgresql.Insert":
        """Begin an INSERT that knows ON CONFLICT."""
        return sqlite.insert(table) if self.is_sqlite else postgresql.insert(table)

    def astray(self) -> str:
        """Why what is written would not be found at the address any more; empty if it would."""
        if self.file is None or self._identity is None:
            return ""
        found = _identity(self.file)
        if found is None:
            return f"{self.shown}: the file was deleted"
        if found != self._identity:
            return f"{self.shown}: another file was put in its place"
        return f"{self.shown}: the file is damaged: {self.damage}" if self.damage else ""

    def found_damaged(self, error: Exception) -> bool:
        """Whether an error means that the file is damaged, and take note of it if so."""
        if self.file is None or not _is_damage(error):
            return False
        self.damage = str(error.orig if isinstance(error, DBAPIError) else error)
        return True

    async def rescue(self, source: AsyncConnection | None) -> bool:
        """Write what a deleted file holds, which is still open, into a new one at its path; say whether that is done.

        Parameters
        ----------
        source : AsyncConnection or None
            Opened before the file was deleted.
        """
        if self.file is None or source is None or _identity(self.file) is not None:
            return False
        copy = self.file.with_name(f"{self.file.name}.rescued")
        try:
            driver = (await source.get_raw_connection()).driver_connection
            copy.unlink(missing_ok=True)
            _make_file(copy)
            target = sqlite3.connect(copy, check_same_thread=False)
            try:
                await driver.backup(target)  # type: ignore[union-attr]  # aiosqlite's, as it is SQLite
            finally:
                target.close()
            self.set_aside("deleted")
            copy.rename(self.file)
        except (SQLAlchemyError, sqlite3.Error, OSError):
            copy.unlink(missing_ok=True)
            return False
        return True

    async def reconnect(self, why: str, rescued: bool) -> None:
        """Go on in the file that is at the path now, or in a new one.

        Parameters
        ----------
        why : str
            From `astray`.
        rescued : bool
            Whether all that was in the former file is in it.

        Raises
        ------
        StoreError, SQLAlchemyError, OSError
            If that fails; readers have the former file still.
        """
        if not rescued and not self.damage:
            self.set_aside("deleted", only_own=True)
        former, generation = self._engine, self.generation
        try:
            await self._connect(set_aside=True)
        except BaseException:
            failed, self._engine = self._engine, former
            if failed is not None and failed is not former:
                await failed.dispose()
            raise
        if former is not None:
            await former.dispose()
        if self.generation == generation:  # not set aside
            self.generation += 1
            self.news = f"{why} while it was in use; " + (
                "all that it held is in a new one" if rescued else "what was recorded before is not in it"
            )
            self.lost = "" if rescued else self.news

    async def _connect(self, set_aside: bool) -> None:
        try:
            if self.damage and set_aside:
                raise DamagedError(f"{self.shown}: the file is damaged: {self.damage}")
            await self._open()
        except (DamagedError, DBAPIError) as error:
            if not set_aside or self.file is None or not _is_damage(error):
                raise
            await self._disconnect()
            kept = self.set_aside("damaged")
            self.news = self.lost = f"{self.failure(error)}: it is kept as {kept}, and the history begins anew"
            self.generation += 1
            await self._open()
        self.damage = ""

    async def _open(self) -> None:
        if self.file is not None:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            _make_file(self.file)
        self._engine = self._make_engine()
        async with self.writers.connect() as connection, connection.begin():
            try:
                await connection.run_sync(migrate)
            except StoreError as error:
                raise StoreError(f"{self.shown}: {error}") from error
            for table in _NEEDED if self.file is not None else ():
                found = (await connection.execute(text(f"PRAGMA quick_check({table})"))).scalars().all()
                if found != ["ok"]:
                    raise DamagedError(f"{self.shown}: the file is damaged: table {table}: {found[0]}")
        if self.file is not None:
            self._identity = _identity(self.file)
            self._companions = {end: _identity(self._beside(end)) for end in _COMPANIONS}

    def _beside(self, end: str) -> Path:
        return Path(f"{self.file}{end}")

    def set_aside(self, why: str, *, only_own: bool = False) -> Path:
        """Rename the file and what SQLite keeps beside it; return the new name."""
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        kept = self._beside(f".{why}-{stamp}")
        for end in _COMPANIONS:
            there = self._beside(end)
            if (found := _identity(there)) is not None and (not only_own or found == self._companions.get(end)):
                there.rename(kept.with_name(kept.name + end))
        return kept

    async def _disconnect(self) -> None:
        engine, self._engine = self._engine, None
        if engine is not None:
            await engine.dispose()

    def _make_engine(self) -> AsyncEngine:
        if self.is_sqlite:
            url = self._url.set(drivername="sqlite+aiosqlite")
            if self.file is not None:
                # A file that was deleted must not come back empty with the next reader.
                url = url.set(database=f"file:{quote(str(self.file))}", query={"mode": "rw", "uri": "true"})
            engine = create_async_engine(url, connect_args={"timeout": self.timeout_s})
            event.listen(engine.sync_engine, "connect", _prepare_sqlite)
            event.listen(engine.sync_engine, "begin", _begin_sqlite)
            return engine
        try:
            return create_async_engine(
                self._url.set(drivername="postgresql+psycopg"),
                pool_pre_ping=True,
                pool_timeout=self.timeout_s,
                connect_args={
                    "connect_timeout": max(2, round(self.timeout_s)),
                    "application_name": "rotorwatch",
                    "keepalives_idle": 10,
                    "keepalives_interval": 5,
                    "keepalives_count": 3,
                },
            )
        except ImportError as error:
            raise StoreError(f"{self.shown}: PostgreSQL needs psycopg: pip install 'rotorwatch[postgres]'") from error


def _identity(file: Path) -> tuple[int, int] | None:
    """What a file is known by, whatever its name; None if there is none."""
    try:
        found = file.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def _make_file(file: Path) -> None:
    """Make a file, if there is none, for its owner alone: it holds hashes of secrets."""
    os.close(os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))


def _is_damage(error: Exception) -> bool:
    code = getattr(error.orig if isinstance(error, DBAPIError) else error, "sqlite_errorcode", None)
    return isinstance(error, DamagedError) or (isinstance(code, int) and code & 0xFF in _DAMAGE)


def _checked(url: str) -> URL:
    try:
        made = make_url(url)
    except (ArgumentError, ValueError):
        # The text may hold a password, and so may the error: neither is shown.
        raise StoreError(f"history: the URL cannot be read; {_FORMS}") from None
    if made.drivername not in {"sqlite", "postgresql"}:
        raise StoreError(f"history: the URL begins with {made.drivername}; {_FORMS}")
    if made.drivername == "postgresql" and not made.database:
        raise StoreError(f"history: the URL {made.render_as_string(hide_password=True)} names no database; {_FORMS}")
    return made


def _prepare_sqlite(connection: Any, record: object) -> None:
    _ = record
    connection.isolation_level = None  # the transactions below, not those that the driver would begin
    cursor = connection.cursor()
    # A compressed report is somewhat longer than half of SQLite's usual page, of which the rest would stay empty.
    for setting in ("page_size = 8192", "journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
        cursor.execute(f"PRAGMA {setting}")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    immediate = connection.get_execution_options().get(_IMMEDIATE, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")
