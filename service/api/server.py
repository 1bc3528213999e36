"""The HTTP server, which runs in its own thread."""

import asyncio
import errno
import resource
import socket
import threading

import uvicorn
from fastapi import FastAPI

from models.errors import RotorwatchError
from service.access.tls import server_arguments
from service.api.connections import HttpConnections
from service.settings.access import AccessSettings
from service.settings.service import HttpSettings
from service.terminal.logs import logger

_JOIN_S = 10.0
_LAST_ANSWERS_S = 5
_SHARE = 3
_log = logger(part="http")


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
        self._socket = self._connections.listener(listening)
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        self.url = f"{'http' if access.tls is None else 'https'}://{host}:{self._socket.getsockname()[1]}"
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None

    @property
    def exhausted(self) -> int:
        """Number of failures to accept a connection because no file was left."""
        return self._connections.exhausted

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
