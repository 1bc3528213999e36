"""Where shards run: in processes of this computer, or elsewhere behind the same interface.

::

    sensors --> Zenoh router in this process --> shard 1: its machines' threads --> history <-- this process
                    (no Python on the way)   '-> shard 2: its machines' threads -->    '
    this process <-- a Zenoh session within a folder of its own --> shards: standings, questions
"""

import multiprocessing
import signal
import tempfile
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Protocol

from models.errors import RotorwatchError
from models.signals.link import LinkSettings
from service.runtime.shard import run_shard
from service.settings.service import ServiceSettings
from service.stream.transport import Link, relay_items


class ShardProcess(Protocol):
    """A process that runs `service.runtime.shard.run_shard`; for one thread at a time."""

    def begin_again(self) -> None:
        """Start it again, after it has ended or could not begin; raises `RotorwatchError`."""

    def said(self, wait_s: float) -> str | None:
        """Its next message; None if none comes in this time. Raises `EOFError` if none will ever come."""

    def ended(self, wait_s: float) -> str:
        """How it has ended within this time; empty if it is at work."""

    def ask_to_stop(self) -> None:
        """Ask it to end in order."""

    def end(self, patience_s: float) -> None:
        """Wait for its end, and kill it after this time."""


class Placement(Protocol):
    """Gives processes to shards."""

    @property
    def session_open(self) -> bool:
        """Whether streams can pass, if they come through this process."""

    def connect(self, undo: ExitStack) -> Link:
        """Listen where streams and shards come in; returns the session that the shards connect to."""

    def process(self, number: int, settings: ServiceSettings) -> ShardProcess:
        """Start a process for a shard; raises `RotorwatchError` if it cannot."""


class OneComputer:
    """Processes of this computer; streams come in through this one, which with `waits` slows down sources."""

    def __init__(self, link: LinkSettings, *, waits: bool) -> None:
        self._link, self._waits = link, waits
        self._inner = LinkSettings()
        self._router: Link | None = None

    @property
    def session_open(self) -> bool:
        """As `Placement.session_open`."""
        return self._router is None or self._router.is_open

    def connect(self, undo: ExitStack) -> Link:
        """As `Placement.connect`; raises `LinkError`."""
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="rotorwatch-")))  # of mode 700
        streams, inner = (f"unixsock-stream/{folder / name}" for name in ("streams", "inner"))
        if self._link.listen:
            relay = dict(self._link) | {"mode": "router", "listen": (*self._link.listen, streams)}
            self._router = Link(LinkSettings(**relay), more=relay_items(waits=self._waits))
            undo.callback(self._router.close)
            alone = {"mode": "client", "listen": (), "connect": (streams,), "tls": None, "user": None}
            self._link = self._link.model_copy(update=alone | {"password_file": None, "password_variable": None})
        self._inner = LinkSettings(mode="client", connect=(inner,))
        link = Link(LinkSettings(mode="router", listen=(inner,)))
        undo.callback(link.close)
        return link

    def process(self, number: int, settings: ServiceSettings) -> ShardProcess:
        """As `Placement.process`."""
        _ = number
        return _Spawned(settings.model_copy(update={"link": self._link}), self._inner)


class _Spawned:
    """A process started by this one, which ends with it."""

    def __init__(self, settings: ServiceSettings, inner: LinkSettings) -> None:
        self._arguments = (settings, inner)
        self._begin()

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    def begin_again(self) -> None:
        self.end(0.0)
        self._begin()

    def _begin(self) -> None:
        # Not a fork: locks that threads of this process hold would never be released in the copy.
        context = multiprocessing.get_context("spawn")
        try:
            ours, theirs = context.Pipe()
            with theirs:
                process = context.Process(target=_run, args=(*self._arguments, theirs))
                try:
                    process.start()
                except OSError:
                    ours.close()
                    raise
        except OSError as error:
            raise RotorwatchError(f"the system does not allow another process: {error.strerror or error}") from error
        self._connection, self._process = ours, process

    def said(self, wait_s: float) -> str | None:
        try:
            return self._connection.recv_bytes().decode() if self._connection.poll(wait_s) else None
        except OSError as error:
            raise EOFError from error

    def ended(self, wait_s: float) -> str:
        self._process.join(wait_s)
        return "" if self._process.exitcode is None else f"ended (exit {self._process.exitcode})"

    def ask_to_stop(self) -> None:
        with suppress(OSError):
            self._connection.send_bytes(b"")

    def end(self, patience_s: float) -> None:
        self._process.join(patience_s)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._connection.close()


def _run(settings: ServiceSettings, inner: LinkSettings, connection: Connection) -> None:
    # Signals are for the process that started this one and decides when it ends.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    run_shard(settings, inner, connection)
