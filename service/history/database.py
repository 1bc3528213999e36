"""The database behind the history: its address, its connections, and what is done when one does not answer.

Callers use connections from the pool in their own threads, with `Database.reading` and `Database.writing`. One thread
watches them all and breaks off what takes too long.
"""

import importlib
import os
import select
import socket
import sqlite3
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from sqlalchemy import URL, Connection, Engine, Row, Select, create_engine, event, make_url, text
from sqlalchemy.exc import ArgumentError, DBAPIError, DisconnectionError, SQLAlchemyError
from sqlalchemy.pool import StaticPool

from service.history.file import HistoryFile, is_damage
from service.history.records import DamagedError, StoreError
from service.history.tables import bring_up_to_date

if TYPE_CHECKING:
    from sqlalchemy.dialects import postgresql, sqlite
    from sqlalchemy.sql.schema import Table

_BUSY_S = 0.02
_ANSWER_S = 60.0  # at least; a query over a long time may take a while
_FINISH_S = 2.0  # for queries that run when the history is closed
_JOIN_S = 10.0
_WATCH_S = 0.5
_IMMEDIATE = "rotorwatch_immediate"
_NEEDED = ("machines", "alarm_events", "checkpoints", "checkpoint_parts", "series", "tokens", "webhook_cursors")
"""Tables without which a monitor cannot go on; to check the others would take minutes."""
_POSTGRESQL = {"application_name": "rotorwatch", "client_encoding": "UTF8", "tcp_user_timeout": 25_000} | {
    "keepalives_idle": 10, "keepalives_interval": 5, "keepalives_count": 3
}  # fmt: skip
_SERVER_KEEPALIVES = {
    "tcp_keepalives_idle": 5, "tcp_keepalives_interval": 3, "tcp_keepalives_count": 3, "tcp_user_timeout": 15_000
}  # fmt: skip
_HIGHEST_PORT = 65535
_FORMS = "expected sqlite:////folder/file, sqlite:///:memory: or postgresql://user:password@host/database"


@dataclass(slots=True, eq=False)
class _Use:
    """One use of a connection: its deadline, and why it was broken off."""

    until_s: float
    driver: Any = None
    broken_off: str = ""


class Database:
    """Connections to one database, with URL and time limit of a `service.history.store.Store`; for any thread.

    Raises
    ------
    StoreError
        If the address is of no known form.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        self._url = checked_url(url)
        self.is_sqlite = self._url.get_backend_name() == "sqlite"
        self.in_memory = self.is_sqlite and self._url.database == ":memory:"
        self.file = HistoryFile(Path(self._url.database or "")) if self.is_sqlite and not self.in_memory else None
        self.shown = self._url.render_as_string(hide_password=True)  # the address without the password
        self.answer_s = max(_ANSWER_S, 10.0 * timeout_s)
        self.generation = 0  # goes up each time the history continues in another file than before
        self.news = ""  # what happened to the file then
        self.lost = ""  # the same if something of the history is not in the present file; empty if all of it is
        self._engine: Engine | None = None
        self._uses: set[_Use] = set()
        self._changed = threading.Condition()
        # SQLite has one writer at a time. In memory there is one connection in all, which readers share.
        self._one_writer = threading.Lock()

    def start(self, set_aside: bool = False, *, read_only: bool = False) -> None:
        """Connect, and bring the tables up to date.

        Parameters
        ----------
        set_aside : bool
            Whether a file that is damaged is renamed and a new one begun; otherwise it is an error.
        read_only : bool
            Neither make the file nor touch the tables: another program looks after the history.

        Raises
        ------
        StoreError
            If that fails; nothing is left running then.
        """
        if self._engine is not None:
            raise StoreError(f"{self.shown}: the history is open already")
        with self.plainly():
            self._engine = self._new_engine() if read_only else self._connect(set_aside)
            if read_only and self.file is not None:
                self.file.opened()
        threading.Thread(target=self._watch, name="history-watch", daemon=True).start()

    def stop(self) -> None:
        """Finish running queries, breaking off what takes too long, and disconnect; a second call does nothing."""
        with self._changed:
            engine, self._engine = self._engine, None
            if engine is None:
                return
            end_s = time.monotonic() + _FINISH_S
            for use in self._uses:
                use.until_s = min(use.until_s, end_s)
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._uses, _FINISH_S + _JOIN_S)
        engine.dispose()

    @property
    def is_open(self) -> bool:
        """Whether the history is open."""
        return self._engine is not None

    @property
    def engine(self) -> Engine:
        """The engine, while the history is open."""
        if self._engine is None:
            raise StoreError(f"{self.shown}: the history is closed")
        return self._engine

    def rows(self, query: Select[*tuple[Any, ...]]) -> Sequence[Row[*tuple[Any, ...]]]:
        """Everything that a query finds.

        Raises
        ------
        StoreError
            If the history is closed, or the database fails or does not answer.
        """
        with self.reading() as connection:
            return connection.execute(query).all()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that reads everything as of one point in time; raises as `rows` does."""
        with self.plainly(), self.alone() if self.in_memory else nullcontext(), self.using(self.answer_s) as connection:
            if not self.is_sqlite:
                connection.execution_options(isolation_level="REPEATABLE READ")
            yield connection

    @contextmanager
    def writing(self, limit_s: float | None = None) -> Iterator[Connection]:
        """A connection within a transaction, committed at the end; raises as `rows` does.

        Parameters
        ----------
        limit_s : float, optional
            How long the lock, and then the transaction, may take, if not as long as usual.
        """
        with self.plainly(), self.alone(limit_s), self.using(limit_s or self.answer_s) as connection:
            self.to_write(connection)
            with connection.begin():
                yield connection

    @contextmanager
    def using(self, limit_s: float, connection: Connection | None = None) -> Iterator[Connection]:
        """A watched connection: what takes longer than the limit, or too long when the history closes, is broken off.

        Parameters
        ----------
        connection : Connection, optional
            The one to watch; by default one from the pool.

        Raises
        ------
        StoreError
            If the history is closed.
        SQLAlchemyError, OSError
            If the database fails; TimeoutError if it was broken off.
        """
        use = _Use(time.monotonic() + limit_s)
        with self._changed:
            engine = self.engine
            self._uses.add(use)
        try:
            with engine.connect() if connection is None else nullcontext(connection) as used:
                use.driver = used.connection.driver_connection
                try:
                    yield used
                finally:
                    with self._changed:
                        use.driver = None  # not to be interrupted when somebody else has it
        except (SQLAlchemyError, OSError) as error:
            if use.broken_off:
                raise TimeoutError(use.broken_off) from error
            raise
        finally:
            with self._changed:
                self._uses.discard(use)
                if self._engine is None:
                    self._changed.notify_all()

    @contextmanager
    def alone(self, limit_s: float | None = None) -> Iterator[None]:
        """Keep other threads from writing to SQLite at the same time; does nothing in PostgreSQL."""
        if self.is_sqlite and not self._one_writer.acquire(timeout=limit_s or 2 * self.timeout_s):
            raise TimeoutError
        try:
            yield
        finally:
            if self.is_sqlite:
                self._one_writer.release()

    @contextmanager
    def plainly(self) -> Iterator[None]:
        """Raise what goes wrong with the database as `StoreError`."""
        try:
            yield
        except (SQLAlchemyError, OSError) as error:
            raise self.failure(error) from error

    def failure(self, error: BaseException) -> StoreError:
        """Put an error of the database into plain words."""
        if isinstance(error, StoreError):
            return error
        cause = error.orig if isinstance(error, DBAPIError) and error.orig is not None else error
        reason = " ".join(str(cause).split()) or type(cause).__name__
        if isinstance(error, TimeoutError):
            reason = str(error) or "no answer in time"
        elif isinstance(error, OSError) and error.strerror:
            reason = f"{error.strerror} ({error.filename})"
        password = self._url.password
        if password:
            reason = reason.replace(str(password), "***")
        return StoreError(f"{self.shown}: {reason}")

    def to_write(self, connection: Connection) -> None:
        """In SQLite, have transactions of a connection wait for the right to write when they begin."""
        connection.execution_options(**{_IMMEDIATE: True})

    def insert(self, table: "Table") -> "sqlite.Insert | postgresql.Insert":
        """Begin an INSERT that knows ON CONFLICT."""
        dialect = importlib.import_module(f"sqlalchemy.dialects.{'sqlite' if self.is_sqlite else 'postgresql'}")
        made: sqlite.Insert | postgresql.Insert = dialect.insert(table)
        return made

    def astray(self) -> str:
        """Why what is written now would no longer be found at the address; empty if it would."""
        why = "" if self.file is None else self.file.astray()
        return f"{self.shown}: {why}" if why else ""

    def found_damaged(self, error: Exception) -> bool:
        """Whether an error means that the file is damaged, and take note of it if so."""
        if self.file is None or not is_damage(error):
            return False
        self.file.damage = str(error.orig if isinstance(error, DBAPIError) else error)
        return True

    def begin_anew(self, why: str, source: Connection | None) -> None:
        """Continue in the file that is at the path now, or in a new one; `lost` says what is not in it.

        `why` is from `astray`. The contents of a deleted file are saved through `source`, a connection to it.

        Raises
        ------
        StoreError, SQLAlchemyError, OSError
            If that fails; readers still have the former file.
        """
        former, generation = self.engine, self.generation
        rescued = self.file is not None and self.file.rescue(source)
        if self.file is not None and not rescued and not self.file.damage:
            self.file.set_aside("deleted", only_opened=True)
        self._engine = self._connect(set_aside=True)
        former.dispose()
        if self.generation == generation:  # no damaged file was set aside
            self.generation += 1
            self.news = f"{why} while it was in use; " + (
                "its contents are in a new one" if rescued else "what was recorded before is not in it"
            )
            self.lost = "" if rescued else self.news

    def _connect(self, set_aside: bool) -> Engine:
        try:
            if self.file is not None and self.file.damage and set_aside:
                raise DamagedError(f"{self.shown}: the file is damaged: {self.file.damage}")
            return self._opened()
        except (DamagedError, DBAPIError) as error:
            if not set_aside or self.file is None or not is_damage(error):
                raise
            kept = self.file.set_aside("damaged")
            self.news = self.lost = f"{self.failure(error)}: it is kept as {kept}, and a new history is begun"
            self.generation += 1
            return self._opened()

    def _opened(self) -> Engine:
        if self.file is not None:
            self.file.make()
        engine = self._new_engine()
        try:
            # Without a limit: bringing the tables of a large history up to date may take minutes.
            with engine.connect() as connection:
                self.to_write(connection)
                with connection.begin():
                    self._bring_up_to_date(connection)
            if self.is_sqlite:  # the file keeps this setting, so only once it is known to be ours
                with closing(engine.raw_connection()) as raw, closing(raw.cursor()) as cursor:
                    end_s = time.monotonic() + self.timeout_s
                    while True:  # SQLite does not wait here for others who open the file at the same time
                        try:
                            cursor.execute("PRAGMA journal_mode = WAL")
                            break
                        except sqlite3.OperationalError as error:
                            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > end_s:
                                raise
                            time.sleep(_BUSY_S)
                    cursor.execute("PRAGMA schema_version")  # reading makes the log file
            if self.file is not None:
                self.file.opened()
        except BaseException:
            engine.dispose()
            raise
        return engine

    def _bring_up_to_date(self, connection: Connection) -> None:
        try:
            bring_up_to_date(connection)
        except StoreError as error:
            raise StoreError(f"{self.shown}: {error}") from error
        for table in _NEEDED if self.file is not None else ():
            found = connection.scalars(text(f"PRAGMA quick_check({table})")).all()
            if found != ["ok"]:
                raise DamagedError(f"{self.shown}: the file is damaged: table {table}: {found[0]}")

    def _new_engine(self) -> Engine:
        if not self.is_sqlite:
            return self._new_postgresql()
        url = self._url
        if self.file is not None:
            # A file that was deleted must not come back empty with the next reader.
            url = url.set(database=f"file:{quote(str(self.file.path))}", query={"mode": "rw", "uri": "true"})
        pool: dict[str, Any] = {"poolclass": StaticPool} if self.in_memory else {"pool_timeout": self.timeout_s}
        engine = create_engine(url, connect_args={"timeout": self.timeout_s, "check_same_thread": False}, **pool)
        event.listen(engine, "connect", _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine

    def _new_postgresql(self) -> Engine:
        try:
            engine = create_engine(
                self._url.set(drivername="postgresql+psycopg"),
                pool_timeout=self.timeout_s,
                connect_args=_POSTGRESQL | {"connect_timeout": max(2, round(self.timeout_s))},
            )
        except ImportError as error:
            raise StoreError(f"{self.shown}: PostgreSQL needs psycopg: pip install 'rotorwatch[postgres]'") from error

        @event.listens_for(engine, "connect")
        def limit(connection: Any, _record: object) -> None:
            encoding = connection.info.parameter_status("server_encoding")
            if encoding != "UTF8":  # a reason or a name that it cannot hold would stop all writing
                raise StoreError(
                    f"{self.shown}: the encoding of the database is {encoding}, expected UTF8 (createdb -E)"
                )
            # So that the server itself ends what `_break_off` has abandoned.
            connection.execute(f"SET statement_timeout = {round(1000 * self.answer_s)}")
            # So that it releases the locks of a computer that was lost; without effect on a Unix socket.
            for name, value in _SERVER_KEEPALIVES.items():
                connection.execute(f"SET {name} = {value}")
            connection.commit()

        @event.listens_for(engine, "checkout")
        def still_there(connection: Any, _record: object, _proxy: object) -> None:
            # Not a ping, which waits for a server that hangs: a connection that the server has closed can be read.
            line = select.poll()
            line.register(connection.fileno(), select.POLLIN)
            if line.poll(0):
                raise DisconnectionError

        return engine

    def _watch(self) -> None:
        with self._changed:
            while self._engine is not None or self._uses:
                for use in self._uses:
                    if use.driver is not None and use.until_s < time.monotonic():
                        use.broken_off = "the history was closed" if self._engine is None else "no answer in time"
                        with suppress(Exception):  # it may just have ended by itself
                            self._break_off(use.driver)
                self._changed.wait(_WATCH_S)

    def _break_off(self, driver: Any) -> None:
        if self.is_sqlite:
            driver.interrupt()
            return
        # Not a request to cancel, which a server that hangs ignores.
        with socket.socket(fileno=os.dup(driver.fileno())) as line:
            line.shutdown(socket.SHUT_RDWR)


def checked_url(url: str) -> URL:
    """Parse the URL of a database.

    Raises
    ------
    StoreError
        If it is of no known form; the message does not show its password.
    """
    try:
        made = make_url(url)
    except (ArgumentError, ValueError):
        # The text may hold a password, and so may the error: neither is shown.
        raise StoreError(f"the URL cannot be read; {_FORMS}") from None
    if made.drivername not in {"sqlite", "postgresql"}:
        raise StoreError(f"the URL begins with {made.drivername}; {_FORMS}")
    if not made.database or (made.drivername == "sqlite" and made.host):
        wanted = "file" if made.drivername == "sqlite" else "database"
        raise StoreError(f"the URL {made.render_as_string(hide_password=True)} names no {wanted}; {_FORMS}")
    if made.drivername == "sqlite" and made.query:
        raise StoreError(f"the URL has options ({', '.join(made.query)}), of which a file has none; {_FORMS}")
    if made.port is not None and not 0 < made.port <= _HIGHEST_PORT:
        raise StoreError(f"the port in the URL is {made.port}, expected 1 to {_HIGHEST_PORT}")
    return made


def _prepare_sqlite(connection: Any, _record: object) -> None:
    connection.isolation_level = None  # the transactions below, not those that the driver would begin
    # Small pages: each page that a step touches is written whole, and few hold more than one thing that it changes.
    # Pages that every step touches go from the log into the file only every few hundred steps.
    small = ("page_size = 512", "wal_autocheckpoint = 32000")
    for setting in (*small, "synchronous = FULL", "foreign_keys = ON"):
        connection.execute(f"PRAGMA {setting}")


def _begin_sqlite(connection: Connection) -> None:
    immediate = connection.get_execution_options().get(_IMMEDIATE, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")
