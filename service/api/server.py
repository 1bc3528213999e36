"""The HTTP server, in its own thread; how many connections it holds, and how long each may keep it waiting.

uvicorn limits neither (docs/decisions/0022-http-connections.md). Connections are counted when they are accepted, so
that those whose TLS handshake never ends count too, and are checked a few times per second::

    handshake --> head --> body --> answering --> head ...
       '------------'--------'---------------------'      in these phases the server waits for the client, up to
                                                          a time limit; if there is no more room, the connection
                                                          with the longest wait is ended

All that concerns connections runs in the event loop of the server.
"""

import asyncio
import errno
import fcntl
import ipaddress
import resource
import socket
import struct
import sys
import termios
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, cast

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

from models.errors import RotorwatchError
from rotorwatch.records.monitor import Problem
from service.access.credentials import network_of
from service.access.tls import server_arguments
from service.settings.access import AccessSettings
from service.settings.service import HttpSettings
from service.terminal.logs import Limiter, logger

_JOIN_S = 10.0
_LAST_ANSWERS_S = 5
_SHARE = 3
_LOOK_S = 0.2
_MINUTE_S = 60.0
_MOMENTS_S = 5.0
"""A client that acknowledges nothing of its answer for longer is ended when there is no more room."""
_OUT_OF_RESOURCES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_BUSY = Problem(
    title="Service Unavailable",
    status=503,
    detail="you have as many connections open as this service allows, and all are in use; try again in 5 s",
    instance="",
).model_dump_json()
_REFUSAL = (
    "HTTP/1.1 503 Service Unavailable\r\ncontent-type: application/problem+json\r\nretry-after: 5\r\n"
    f"connection: close\r\ncontent-length: {len(_BUSY)}\r\n\r\n{_BUSY}"
).encode()
_BYTES_ACKED = 120
"""Offset of ``tcpi_bytes_acked`` in ``struct tcp_info`` (linux/tcp.h), since Linux 4.1."""

_RESET_ON_CLOSE = struct.pack("ii", 1, 0)
_log = logger(part="http")

_Doing = Literal["handshake", "head", "body", "answering"]


@dataclass(slots=True, eq=False)
class _Connection:
    """A connection, its current phase, and the times of its latest progress."""

    accepted: socket.socket
    address: str
    network: str
    since_s: float
    taken_s: float
    doing: _Doing = "handshake"
    request: RequestResponseCycle | None = None
    unsent: int = 0
    taken: int = 0
    ended: bool = False
    protocol: H11Protocol | None = None

    def look(self, now_s: float) -> None:
        """Update the phase, and whether the client has taken any of the answer."""
        request: RequestResponseCycle | None = None
        doing: _Doing = "handshake"
        unsent = taken = 0
        if self.protocol is not None:
            request = cast("RequestResponseCycle | None", self.protocol.cycle)  # None before the first request
            taken, queued = _taken_and_queued(self.accepted)
            unsent = self.protocol.transport.get_write_buffer_size() + queued
            if self.protocol.conn.their_state is h11.SEND_BODY:
                doing = "body"
            elif (request is None or request.response_complete) and not unsent:
                doing = "head"
            else:
                doing = "answering"
        if doing != self.doing or request is not self.request:
            self.doing, self.request, self.since_s = doing, request, now_s
        if not unsent or unsent < self.unsent or taken != self.taken:
            self.taken_s = now_s
        self.unsent, self.taken = unsent, taken

    @property
    def idle(self) -> bool:
        """Whether the latest request is answered and the next has not begun, which is normal.

        Over TLS such a connection outlives uvicorn's own limit, waiting for the client to close the TLS session.
        """
        protocol = self.protocol
        answered = self.doing == "head" and self.request is not None
        return answered and protocol is not None and not protocol.conn.trailing_data[0]

    def waited_for(self, now_s: float) -> float | None:
        """Time since which the server has waited for the client; None if it does not, or only for `_MOMENTS_S`."""
        if self.doing != "answering":
            return self.since_s
        return self.taken_s if now_s - self.taken_s > _MOMENTS_S else None

    def end(self) -> None:
        """End the connection at once and drop unsent data, which the system might otherwise keep indefinitely."""
        self.ended = True
        with suppress(OSError):
            self.accepted.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_ON_CLOSE)
        if self.protocol is not None:
            self.protocol.transport.abort()
            return
        with suppress(OSError):  # the client has already closed it
            self.accepted.shutdown(socket.SHUT_RDWR)


class HttpConnections:
    """All connections of one server.

    Parameters
    ----------
    proxies : sequence of str
        Addresses and networks without a limit per address; only the limit of all connections applies to them.
    plain : bool
        Whether connections are plain HTTP, so that a refusal can be sent as such.
    """

    def __init__(self, settings: HttpSettings, most: int, proxies: Sequence[str], *, plain: bool = True) -> None:
        self._most = most
        self._per_address = settings.connections_per_address
        self._longest_s = {
            "handshake": settings.head_timeout_s,
            "head": settings.head_timeout_s,
            "body": settings.body_timeout_s,
        }
        self._send_s = settings.send_timeout_s
        self._proxies = [ipaddress.ip_network(proxy) for proxy in proxies]
        self._plain = plain
        self._limiter = Limiter(quiet_s=_MINUTE_S)
        self._looked_s = time.monotonic()
        self._open: dict[Any, _Connection] = {}

    def protocol(self) -> type[asyncio.Protocol]:
        """Class of the protocol for ``uvicorn.Config``."""
        connections = self

        class Protocol(H11Protocol):
            """Reports when a connection is ready for requests."""

            def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
                super().connection_made(transport)
                connections.made(transport.get_extra_info("peername"), self)

        return Protocol

    def watch(self, loop: asyncio.AbstractEventLoop) -> None:
        """Start checking all connections a few times per second; accept errors are logged once a minute."""
        self._looked_s = time.monotonic()
        loop.set_exception_handler(self._on_error)
        loop.call_later(_LOOK_S, self._look, loop)

    def made(self, address: Any, protocol: H11Protocol) -> None:
        """Note that a connection has completed its handshake."""
        if found := self._open.get(address):
            found.protocol = protocol
            found.look(time.monotonic())
            if found.ended:
                found.end()

    def admit(self, accepted: socket.socket, address: Any) -> bool:
        """Count a new connection, and return whether there was room for it without closing another.

        If there is no room, the connection for which the server has waited longest is ended; if it waits for none, the
        new one is refused.
        """
        now_s = time.monotonic()
        present = self._present()
        network = network_of(address[0])
        mine = [one for one in present if one.network == network]
        crowd: Sequence[_Connection] = ()
        if len(mine) >= self._per_address and not self._is_proxy(address[0]):
            crowd = mine
        elif len(present) >= self._most:
            crowd = present
        for one in crowd:
            one.look(now_s)
        waiting = {one: since_s for one in crowd if (since_s := one.waited_for(now_s)) is not None}
        if crowd and not waiting:
            self._say("refused", address[0], "all connections are in use")
            if self._plain:
                with suppress(OSError):
                    accepted.setblocking(False)
                    accepted.send(_REFUSAL)
            accepted.close()
            return False
        self._open[address] = _Connection(accepted, address[0], network, now_s, now_s)
        if waiting:
            longest = min(waiting, key=waiting.__getitem__)
            self._say("ended", longest.address, f"another one arrived; this one was kept waiting for: {longest.doing}")
            longest.end()
        return not crowd

    def _present(self) -> list[_Connection]:
        self._open = {address: one for address, one in self._open.items() if one.accepted.fileno() >= 0}
        return [one for one in self._open.values() if not one.ended]

    def _look(self, loop: asyncio.AbstractEventLoop) -> None:
        loop.call_later(_LOOK_S, self._look, loop)
        now_s = time.monotonic()
        # Delay of the event loop itself, on a busy computer, does not count as waiting for the client.
        late_s = max(0.0, now_s - self._looked_s - _LOOK_S)
        self._looked_s = now_s
        for one in self._present():
            one.since_s = min(now_s, one.since_s + late_s)
            one.taken_s = min(now_s, one.taken_s + late_s)
            one.look(now_s)
            if now_s - one.since_s > self._longest_s.get(one.doing, float("inf")):
                if not one.idle:
                    self._say(
                        "ended", one.address, f"the {one.doing} took longer than {self._longest_s[one.doing]:g} s"
                    )
                one.end()
            elif now_s - one.taken_s > self._send_s:
                self._say("ended", one.address, f"the client took nothing of the answer for {self._send_s:g} s")
                one.end()

    def _say(self, what: str, address: str, why: str) -> None:
        text = f"connection {what}; logged at most once a minute"
        self._limiter.say(what, _log.warning, text, address=address, why=why)

    def _is_proxy(self, address: str) -> bool:
        return any(ipaddress.ip_address(address.partition("%")[0]) in network for network in self._proxies)

    def _on_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if not isinstance(error, OSError) or error.errno not in _OUT_OF_RESOURCES:
            loop.default_exception_handler(context)
            return
        text = "no connection can be accepted; logged at most once a minute"
        self._limiter.say("accept", _log.error, text, why=error.strerror)


class _Listener(socket.socket):
    """Takes over a listening socket and counts the connections that it accepts."""

    def __init__(self, listening: socket.socket, connections: HttpConnections) -> None:
        super().__init__(fileno=listening.detach())
        self._connections = connections
        self._pause = False

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection for which there is room.

        asyncio accepts thousands of waiting connections in one go, until BlockingIOError. It is raised early if the
        event loop must first close connections, or if asyncio must wait a second because no file was left.
        """
        if self._pause:
            self._pause = False
            raise BlockingIOError
        try:
            accepted, address = super().accept()
        except OSError as error:
            self._pause = error.errno in _OUT_OF_RESOURCES
            raise
        self._pause = not self._connections.admit(accepted, address)
        if accepted.fileno() < 0:
            self._pause = False
            raise BlockingIOError
        return accepted, address


def _taken_and_queued(connection: socket.socket) -> tuple[int, int]:
    """Bytes that the client has acknowledged, and those queued in the system; zeros if the system is not Linux.

    The system buffers megabytes, so our own buffer may not change for long although the client reads.
    """
    if sys.platform != "linux":
        return 0, 0
    (taken,) = struct.unpack_from("Q", connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256), _BYTES_ACKED)
    (queued,) = struct.unpack("i", fcntl.ioctl(connection.fileno(), termios.TIOCOUTQ, bytes(4)))
    return taken, queued


class HttpError(RotorwatchError):
    """The HTTP API cannot be served; the message names the address."""


class HttpServer:
    """Serves an application; the constructor binds the address.

    Raises
    ------
    HttpError
        If the address cannot be listened on.
    MachineFileError
        If certificate or key cannot be used.
    """

    def __init__(self, settings: HttpSettings, access: AccessSettings) -> None:
        self._arguments = server_arguments(access)
        most = http_connections(settings, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        if most < settings.connections:
            _log.warning(
                "fewer connections than the settings allow: the process may not open enough files (ulimit -n)",
                connections=most,
                settings=settings.connections,
            )
        self._connections = HttpConnections(settings, most, access.proxies, plain=access.tls is None)
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        try:
            listening = socket.create_server((settings.host, settings.port), family=family)
        except OSError as error:
            raise HttpError(f"HTTP cannot listen on {settings.host} port {settings.port}: {_why(error)}") from error
        # Without TCP_NODELAY, the end of every answer waits for the client's acknowledgement, 40 ms.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = _Listener(listening, self._connections)
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        self.url = f"{'http' if access.tls is None else 'https'}://{host}:{self._socket.getsockname()[1]}"
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None

    def start(self, app: FastAPI) -> None:
        """Serve the API."""
        config = uvicorn.Config(
            app,
            loop="asyncio",
            http=self._connections.protocol(),
            ws="none",
            log_config=None,
            access_log=False,
            lifespan="off",
            timeout_graceful_shutdown=_LAST_ANSWERS_S,  # for clients that have stopped reading
            **self._arguments,
        )
        server = self._server = _Server(config, self._connections)
        self._thread = threading.Thread(target=server.run, kwargs={"sockets": [self._socket]}, name="http", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Finish present requests and free the address."""
        if self._server is not None and self._thread is not None:
            self._server.should_exit = True
            if self._thread.is_alive():  # otherwise starting it failed, and that error must be reported
                self._thread.join(_JOIN_S)
        self._socket.close()


class _Server(uvicorn.Server):
    """A uvicorn server whose connections are watched."""

    def __init__(self, config: uvicorn.Config, connections: HttpConnections) -> None:
        super().__init__(config)
        self._connections = connections

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        self._connections.watch(asyncio.get_running_loop())
        await super().startup(sockets)


def http_connections(settings: HttpSettings, files: int) -> int:
    """Most connections of a process that may open `files` files.

    At most a third of them: a connection may need another file, as a download does, and the last third is for the
    history, Zenoh and recordings.
    """
    return max(1, min(settings.connections, files // _SHARE))


def _why(error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "the port is in use: is another program listening there? --http-port 0 takes a free one"
    return (error.strerror or str(error)).partition(" (while")[0]
