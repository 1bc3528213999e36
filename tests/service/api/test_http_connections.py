"""Connections that keep the HTTP server waiting are closed and keep nobody out: a real monitor, real sockets."""

import os
import resource
import select
import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import httpx
import pytest
import trustme
from fastapi import FastAPI
from structlog.testing import capture_logs

from service.api.server import HttpServer, http_connections
from service.runtime.runtime import Runtime, running
from service.settings.access import AccessSettings, LimitSettings
from service.settings.service import HttpSettings
from service.terminal.logs import Limiter
from tests.service.access.test_access_tokens import files, trusting
from tests.service.rig.live import OPEN, endpoint, program, settings, until

HEAD = b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\n"
SHELVE = (
    b"POST /api/v1/machines/demo/lab/alarms/k_by/shelve HTTP/1.1\r\nhost: 127.0.0.1\r\n"
    b"content-type: application/json\r\ncontent-length: 500\r\n\r\n"
)
DESCRIPTION = b"GET /openapi.json HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n"
EVENTS = b"GET /api/v1/events HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n"


@contextmanager
def monitor(access: AccessSettings = OPEN, **http: float) -> Iterator[Runtime]:
    plan = settings(endpoint(), access=access, http=HttpSettings.model_validate({"port": 0, **http}))
    with running(plan) as runtime:
        yield runtime


@contextmanager
def connections(url: str, count: int, sends: bytes = b"") -> Iterator[list[socket.socket]]:
    """Open `count` connections that have sent something and wait."""
    place = httpx.URL(url)
    with ExitStack() as opened:
        found = []
        for _ in range(count):
            one = opened.enter_context(socket.create_connection((place.host, place.port or 0), timeout=180))
            one.sendall(sends)
            found.append(one)
        yield found


def stalled(url: str) -> socket.socket:
    """A connection of a client that has requested much and reads nothing."""
    place, one = httpx.URL(url), socket.socket()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    one.connect((place.host, place.port))
    one.sendall(DESCRIPTION * 40)
    return one


def over(connection: socket.socket) -> bool:
    """Whether the server has closed a connection; reads what has arrived."""
    try:
        while select.select([connection], [], [], 0)[0]:
            if not connection.recv(65536):
                return True
    except ConnectionError:
        return True
    return False


def healthy(url: str) -> bool:
    return httpx.get(f"{url}/healthz", trust_env=False, timeout=180.0).status_code == 200


def trickle(slow: Sequence[socket.socket]) -> bool:
    """Send one more byte on each open connection; return whether all are closed."""
    for one in slow:
        with suppress(OSError):
            one.send(b"x")
    return all(over(one) for one in slow)


def test_connections_with_endless_request_heads_are_closed() -> None:
    with monitor(head_timeout_s=0.5) as runtime, ExitStack() as opened:
        url = runtime.http_url
        silent = opened.enter_context(connections(url, 10))
        slow = [opened.enter_context(connections(url, 10, sends)) for sends in (b"GET / HT", HEAD, HEAD + b"x-slow: ")]
        until(lambda: all(map(over, silent)), "end of those who said nothing")
        until(lambda: all(map(trickle, slow)), "end of all half-open requests")
        assert healthy(url)


@pytest.mark.parametrize("access", [OPEN, AccessSettings()], ids=["awaited", "refused before"])
def test_connections_with_endless_request_bodies_are_closed(access: AccessSettings) -> None:
    with monitor(access, body_timeout_s=0.5) as runtime, connections(runtime.http_url, 20, SHELVE) as waiting:
        until(lambda: trickle(waiting), "end of all slow bodies")
        assert runtime.machines()[0].history.last_sequence == -1


def test_streams_and_regular_callers_stay_connected() -> None:
    """While others are closed, streams stay open, and so do clients that send requests now and then."""
    with (
        monitor(head_timeout_s=1, body_timeout_s=1, send_timeout_s=1) as runtime,
        connections(runtime.http_url, 3, EVENTS) as streams,
        httpx.Client(base_url=runtime.http_url, trust_env=False, timeout=180.0) as client,
    ):
        for _ in range(2):
            with connections(runtime.http_url, 5, HEAD) as waiting:
                until(lambda: client.get("/healthz").is_success and all(map(over, waiting)), "end of the half-open")
        assert not any(map(over, streams))


def test_a_client_that_does_not_read_its_response_is_cut_off() -> None:
    with (
        monitor(send_timeout_s=0.5) as runtime,
        stalled(runtime.http_url) as reader,
        stalled(runtime.http_url) as steady,
    ):
        taken = 0

        def cut_off() -> bool:
            nonlocal taken
            steady.setblocking(False)
            with suppress(BlockingIOError):
                taken += len(steady.recv(65536))
            # The socket reports an error once the connection was reset; nothing is read from it.
            return reader.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) != 0

        until(cut_off, "end of the reader that stopped")
        assert steady.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == 0
        assert taken


def test_half_open_requests_make_room_for_others() -> None:
    """Without waiting for their timeout: the oldest is closed when another connection comes."""
    with (
        monitor(connections_per_address=8, head_timeout_s=600) as runtime,
        connections(runtime.http_url, 60, HEAD) as waiting,
    ):
        assert healthy(runtime.http_url)
        until(lambda: sum(not over(one) for one in waiting) <= 8, "all but the latest to be ended")
        assert not over(waiting[-1])


def test_connections_beyond_the_limit_get_503() -> None:
    with monitor(connections=3) as runtime, connections(runtime.http_url, 3, EVENTS) as streams:
        for one in streams:
            assert one.recv(15) == b"HTTP/1.1 200 OK"
        with capture_logs() as lines:
            for _ in range(5):
                refused = httpx.get(f"{runtime.http_url}/healthz", trust_env=False, timeout=180.0)
                assert (refused.status_code, refused.headers["content-type"]) == (503, "application/problem+json")
                assert int(refused.headers["retry-after"]) >= 1
                assert refused.json()["status"] == 503
        assert len([line for line in lines if line["log_level"] == "warning"]) == 1
        streams[0].close()
        until(lambda: httpx.get(f"{runtime.http_url}/healthz", trust_env=False).status_code == 200, "room")
        assert not any(map(over, streams[1:]))


def test_stalled_readers_make_room_for_others() -> None:
    """Not at once, but long before their timeout."""
    with monitor(connections=3, send_timeout_s=3600) as runtime, ExitStack() as opened:
        for _ in range(3):
            opened.enter_context(stalled(runtime.http_url))
        until(lambda: httpx.get(f"{runtime.http_url}/healthz", trust_env=False).status_code == 200, "room")


def test_a_proxy_may_have_more_connections_than_others() -> None:
    access = AccessSettings(proxies=("127.0.0.0/24",), limits=LimitSettings())
    with (
        monitor(access, connections_per_address=2, head_timeout_s=600) as runtime,
        connections(runtime.http_url, 10, HEAD) as waiting,
    ):
        assert healthy(runtime.http_url)
        assert not any(map(over, waiting))


def test_endless_tls_handshakes_make_room_for_others(tmp_path: Path) -> None:
    authority = trustme.CA()
    access = AccessSettings(tls=files(tmp_path, authority))
    with (
        monitor(access, connections_per_address=8, head_timeout_s=0.5) as runtime,
        connections(runtime.http_url, 30) as waiting,
    ):
        url = f"{runtime.http_url}/healthz"
        assert httpx.get(url, verify=trusting(authority), trust_env=False, timeout=180.0).status_code == 200
        until(lambda: all(map(over, waiting)), "end of the handshakes")


def test_the_end_of_an_idle_connection_is_not_logged(tmp_path: Path) -> None:
    authority = trustme.CA()
    access = AccessSettings(tls=files(tmp_path, authority))
    with monitor(access, head_timeout_s=0.5) as runtime, capture_logs() as logs:
        with httpx.Client(verify=trusting(authority), trust_env=False, timeout=180.0) as client:
            assert client.get(f"{runtime.http_url}/healthz").status_code == 200
            pool = client._transport._pool  # type: ignore[attr-defined]  # a connection without requests
            (idle,) = pool.connections
            line = idle._connection._network_stream.get_extra_info("socket")
            until(lambda: bool(select.select([line], [], [], 0)[0]), "end of the idle connection")
        assert [one for one in logs if one["event"].startswith("connection ended")] == []
        with connections(runtime.http_url, 1) as waiting:
            until(lambda: all(map(over, waiting)), "end of the silent")
        assert [one["why"] for one in logs if one["event"].startswith("connection ended")] != []


def test_running_out_of_file_descriptors_is_logged_once(monkeypatch: pytest.MonkeyPatch) -> None:
    admit, asked = Limiter.admit, list[str]()

    def counted(limiter: Limiter, kind: str) -> int | None:
        asked.append(kind)
        return admit(limiter, kind)

    monkeypatch.setattr(Limiter, "admit", counted)
    app = FastAPI()
    app.get("/healthz")(lambda: True)
    server = HttpServer(HttpSettings(port=0), AccessSettings())
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as undo, capture_logs() as lines:
        undo.callback(server.stop)
        server.start(app)
        assert healthy(server.url)
        place = httpx.URL(server.url)
        late = [undo.enter_context(socket.socket()) for _ in range(20)]
        undo.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        lowest_free = os.dup(0)
        os.close(lowest_free)
        resource.setrlimit(resource.RLIMIT_NOFILE, (lowest_free, hard))
        for one in late:
            one.connect((place.host, place.port))
            one.sendall(HEAD + b"\r\n")
        until(lambda: asked.count("accept") >= 2, "attempts at accepting")
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for one in late:
            one.settimeout(180)
            assert one.recv(15) == b"HTTP/1.1 200 OK"
    assert len([line for line in lines if line["log_level"] == "error"]) == 1


@pytest.mark.parametrize(("soft", "expected"), [(1024, 300), (256, 85), (20_000, 300), (2, 1)])
def test_http_gets_only_part_of_the_file_descriptors(soft: int, expected: int) -> None:
    assert http_connections(HttpSettings(), soft) == expected


def test_the_monitor_raises_its_limit_of_open_files(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as undo:
        undo.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
        plan = ("--http-port", "0", "--listen", endpoint())
        started = undo.enter_context(program(tmp_path, "service", "run", *plan))
        text = httpx.get(f"{started.url()}/metrics", trust_env=False, timeout=180.0).text
    found = next(line for line in text.splitlines() if line.startswith("process_max_fds "))
    assert float(found.split()[1]) == min(hard, 65_536)
