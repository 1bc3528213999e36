"""A real PostgreSQL for the tests, in a temporary folder, reached over a socket in it.

`database_url` is for tests that run on both databases; one server is started for all of them.
"""

import atexit
import functools
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

import pytest

__all__ = ["KINDS", "USER", "PostgresServer", "database_url", "missing", "postgres_server"]

USER = "rotorwatch"
KINDS = ("sqlite", "postgresql")
_INSTALLED = Path("/usr/lib/postgresql")


@dataclass(slots=True)
class PostgresServer:
    """A server and how to stop and start it."""

    folder: Path
    account: str | None

    def url(self, database: str) -> str:
        """Address of a database."""
        return f"postgresql://{USER}@/{database}?host={self.folder}"

    def new_database(self, name: str) -> str:
        """Make an empty database and return its address."""
        self.run("createdb", "-h", str(self.folder), "-U", USER, name)
        return self.url(name)

    def start(self) -> None:
        """Start it and wait until it answers."""
        options = f"-c listen_addresses='' -k {self.folder} -c max_connections=40 -c shared_buffers=16MB"
        log = str(self.folder / "log")
        self.run("pg_ctl", "-D", str(self.folder / "data"), "-l", log, "-w", "-o", options, "start")

    def stop(self) -> None:
        """Stop it at once, connected programs or not, as a crash would."""
        self.run("pg_ctl", "-D", str(self.folder / "data"), "-m", "immediate", "-w", "stop")

    def run(self, program: str, *arguments: str) -> None:
        """Run one of PostgreSQL's programs."""
        done = subprocess.run(
            [str(_program(program)), *arguments],
            user=self.account,
            cwd=self.folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if program != "pg_ctl" else subprocess.DEVNULL,
            stderr=subprocess.STDOUT if program != "pg_ctl" else subprocess.DEVNULL,
            env={"PATH": os.environ["PATH"], "LC_ALL": "C"},
            check=False,
            timeout=120,
        )
        assert done.returncode == 0, f"{program} {arguments}: {done.stdout!r}"


def missing() -> str:
    """Why no server can be started; empty if one can."""
    try:
        import psycopg  # noqa: PLC0415  # an extra
    except ImportError:
        return "psycopg is not installed"
    _ = psycopg
    for program in ("initdb", "pg_ctl", "createdb", "postgres"):
        if _program(program) is None:
            return f"PostgreSQL is not installed: no {program} on the PATH or below {_INSTALLED}"
    if os.geteuid() == 0 and _account() is None:
        return "PostgreSQL does not run as root, and there is no user postgres"
    return ""


@contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """A running server; it and its folder are gone when the block is left."""
    # Not below pytest's own folder: the path of a socket may have hundred letters, and another user must get there.
    with tempfile.TemporaryDirectory(prefix="pg-") as name:
        folder = Path(name)
        account = _account() if os.geteuid() == 0 else None
        if account is not None:
            shutil.chown(folder, account)
        server = PostgresServer(folder, account)
        server.run("initdb", "-D", str(folder / "data"), "-U", USER, "-A", "trust", "-E", "UTF8", "--no-sync")
        server.start()
        try:
            yield server
        finally:
            server.stop()


def database_url(kind: str, folder: Path) -> str:
    """Address of an empty database of one of `KINDS`; skips the test, with the reason, if there is no server."""
    if kind == "sqlite":
        return f"sqlite:///{folder / 'history.sqlite'}"
    if missing():
        pytest.skip(missing())
    return _shared_server().new_database(f"history_{uuid.uuid4().hex}")


@functools.cache
def _shared_server() -> PostgresServer:
    stack = ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(postgres_server())


def _account() -> str | None:
    try:
        return pwd.getpwnam("postgres").pw_name
    except KeyError:
        return None


def _program(name: str) -> Path | None:
    found = shutil.which(name)
    if found is not None:
        return Path(found)
    places = sorted(
        _INSTALLED.glob(f"*/bin/{name}"), key=lambda path: int(path.parts[-3]) if path.parts[-3].isdigit() else 0
    )
    return places[-1] if places else None
