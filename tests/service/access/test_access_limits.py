"""Limits on a caller's requests, and what the audit log holds of them: a real server, a real store."""

import asyncio
import logging
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import httpx
import pytest
from fastapi import FastAPI, Request, Response
from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint
from structlog.testing import capture_logs

from service.access.audit import STARTED, AuditTrail
from service.access.guard import Guard
from service.access.scopes import Scope
from service.history.records import Retention
from service.history.store import Store
from service.settings.access import AccessSettings, LimitSettings
from tests.service.rig.guarded import JSON, Guarded, application, basic, guarded, problem
from tests.service.rig.postgres import executed

READ, OPERATE, CONFIGURE = Scope


def test_large_bodies_are_refused_while_they_are_read(tmp_path: Path) -> None:
    with (
        guarded(tmp_path, AccessSettings(limits=LimitSettings(body_bytes=10_000))) as monitor,
        monitor.client(monitor.token(READ, OPERATE)) as client,
    ):
        sent = 0

        def pieces(count: int) -> Iterator[bytes]:
            nonlocal sent
            yield b'{"reason": "'
            for _ in range(count):
                sent += 1
                yield b"x" * 1000
            yield b'"}'

        assert client.post("/large", content=b"x" * 10_000, headers=JSON).json() == 10_000
        assert "10000 bytes" in problem(client.post("/large", content=b"x" * 10_001, headers=JSON), 413)
        assert client.post("/alarms/e/shelve", content=pieces(5), headers=JSON).status_code == 200
        for path in ("/alarms/e/shelve", "/large"):
            assert "10000 bytes" in problem(client.post(path, content=pieces(50), headers=JSON), 413)
        assert monitor.done == ["shelve e ops"]
        assert [entry.status for entry in monitor.entries() if entry.status][-2:] == [413, 413]


def test_a_middleware_does_not_change_the_413_for_a_large_body(tmp_path: Path) -> None:
    """Behind a middleware of this kind the route turns the refusal into a bad request."""

    async def passed_on(request: Request, call_next: RequestResponseEndpoint) -> Response:
        return await call_next(request)

    def build(guard: Guard, done: list[str]) -> FastAPI:
        app = application(guard, done)
        app.add_middleware(BaseHTTPMiddleware, dispatch=passed_on)
        return app

    limits = LimitSettings(body_bytes=1000)
    with guarded(tmp_path, AccessSettings(limits=limits), build) as monitor:
        with monitor.client(monitor.token(READ, OPERATE)) as client:
            body = iter([b"x" * 600, b"x" * 600])
            problem(client.post("/alarms/e/shelve", content=body, headers=JSON), 413)
        assert not monitor.done


def test_a_body_that_never_ends_is_cut_off(tmp_path: Path) -> None:
    """The refusal comes before the sender has finished, however much it announces."""
    with guarded(tmp_path, AccessSettings(limits=LimitSettings(body_bytes=1000))) as monitor:
        url, token = httpx.URL(monitor.url), monitor.token(OPERATE)
        for length in ("content-length: 99999999999999999999", "transfer-encoding: chunked"):
            with socket.create_connection((url.host, url.port or 0), timeout=180) as raw:
                head = f"POST /large HTTP/1.1\r\nhost: {url.host}\r\nauthorization: Bearer {token}\r\n"
                raw.sendall(f"{head}content-type: application/json\r\n{length}\r\n\r\n".encode())
                if "chunked" in length:
                    raw.sendall(b"800\r\n" + b"x" * 0x800 + b"\r\n")
                assert raw.recv(100).startswith(b"HTTP/1.1 413")


def test_requests_per_minute_are_limited_for_each_caller(tmp_path: Path) -> None:
    with guarded(tmp_path, AccessSettings(limits=LimitSettings(requests_per_minute=5))) as monitor:
        one, other = monitor.client(monitor.token(READ)), monitor.client(monitor.token(READ))
        with one, other, monitor.client() as nobody:
            assert [one.get("/health").status_code for _ in range(5)] == [200] * 5
            monitor.clock.now_s += 20.5
            refused = one.get("/health")
            assert "requests" in problem(refused, 429)
            assert refused.headers["retry-after"] == "40"
            assert other.get("/health").status_code == 200
            assert [nobody.get("/health").status_code for _ in range(6)] == [401] * 5 + [429]
            monitor.clock.now_s += 40.0
            assert one.get("/health").status_code == 200


def test_guessing_tokens_is_limited_and_does_not_load_the_database(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with guarded(tmp_path, AccessSettings(limits=LimitSettings(failures_per_minute=3))) as monitor:
        wrong, find = monitor.token(READ)[:-3] + "000", Mock(wraps=monitor.store.tokens.find)
        monkeypatch.setattr(monitor.store.tokens, "find", find)
        with monitor.client(wrong) as stranger:
            assert [stranger.get("/health").status_code for _ in range(5)] == [401] * 3 + [429] * 2
            assert find.call_count == 3
            assert stranger.get("/health").headers["retry-after"] == "60"
            monitor.clock.now_s += 60.0
            assert stranger.get("/health").status_code == 401
        # Nor with a different token each time.
        assert [_asked(monitor, f"{wrong[:-3]}{number:03}") for number in range(1, 5)] == [401] * 2 + [429] * 2


def test_wrong_tokens_from_the_same_address_lock_no_valid_token_out(tmp_path: Path) -> None:
    """Behind a proxy that the settings do not name, all callers have the same address."""
    with guarded(tmp_path, AccessSettings(limits=LimitSettings(failures_per_minute=3))) as monitor:
        in_use, fresh, old = monitor.token(READ), monitor.token(READ), monitor.token(READ)
        assert _asked(monitor, in_use) == 200
        tried = [_asked(monitor, f"{old[:-3]}{number:03}") for number in range(20)]
        assert tried == [401] * 3 + [429] * 17
        assert [_asked(monitor, token) for token in (in_use, fresh, old)] == [200] * 3


def test_health_and_readiness_probes_are_not_rate_limited(tmp_path: Path) -> None:
    limits = LimitSettings(requests_per_minute=3, failures_per_minute=3)
    with (
        guarded(tmp_path, AccessSettings(limits=limits)) as monitor,
        monitor.client(monitor.token(READ)) as client,
        monitor.client() as nobody,
    ):
        for _ in range(5):
            client.get("/health")
            nobody.get("/health")
        assert [client.get("/health").status_code, nobody.get("/health").status_code] == [429, 429]
        assert {nobody.get("/healthz").status_code for _ in range(10)} == {200}
        assert {client.get("/readyz").status_code for _ in range(10)} == {200}
        assert {nobody.get("/readyz").status_code for _ in range(10)} == {401}


def _asked(monitor: Guarded, token: str) -> int:
    with monitor.client(token) as client:
        return client.get("/health").status_code


def test_actions_are_audited_before_and_after(monitor: Guarded) -> None:
    token = monitor.token(READ, OPERATE, name="control room")
    with monitor.client(token) as client:
        client.get("/health")
        assert client.post("/alarms/k_by/shelve?token=q", json={"reason": "bolt is being replaced"}).status_code == 200
        assert client.post("/alarms/k_by/shelve", json={"wrong": 1}).status_code == 422
        assert client.post("/broken", headers=JSON).status_code == 500
        assert client.post("/nowhere", headers=JSON).status_code == 404
    entries = monitor.entries()
    assert [(entry.status, entry.action) for entry in entries] == [
        (0, STARTED), (200, "shelve"), (0, STARTED), (422, ""), (0, STARTED), (500, ""), (404, "")
    ]  # fmt: skip
    before, after = entries[:2]
    assert before.at_ns == after.at_ns
    assert (after.actor, after.address, after.method) == ("control room", "127.0.0.1", "POST")
    assert (after.path, after.machine, after.alarm) == ("/alarms/k_by/shelve", "demo/lab", "k_by")
    assert after.reason == "bolt is being replaced"
    assert len({entry.at_ns for entry in entries}) == 4
    assert monitor.done == ["shelve k_by control room"]


def test_audit_times_follow_a_clock_that_is_set_back_by_days(monkeypatch: pytest.MonkeyPatch) -> None:
    day_ns = 86_400 * 10**9
    times = iter([5 * day_ns, 5 * day_ns, 5 * day_ns - 1, day_ns, day_ns])
    trail = AuditTrail(Store("sqlite:///:memory:", Retention()).audit, 5)
    monkeypatch.setattr("service.access.audit.time", SimpleNamespace(time_ns=lambda: next(times)))
    at_ns = [trail.visit("127.0.0.1", "POST", "/").at_ns for _ in range(5)]
    assert at_ns == [5 * day_ns, 5 * day_ns + 1, 5 * day_ns + 2, day_ns, day_ns + 1]


def audit_fails(folder: Path, when: str = "") -> None:
    then = "BEGIN SELECT RAISE(ABORT, 'the disk is full'); END"
    executed(f"sqlite:///{folder / 'history.sqlite'}", f"CREATE TRIGGER full BEFORE INSERT ON audit_log {when} {then}")


def test_an_action_that_cannot_be_audited_is_not_done(monitor: Guarded, tmp_path: Path) -> None:
    token = monitor.token(*Scope)
    with monitor.client(token) as client:
        assert client.get("/health").status_code == 200
        audit_fails(tmp_path)
        for answer in (client.delete("/machine"), client.post("/alarms/e/shelve", json={"reason": "r"})):
            assert "nothing was done" in problem(answer, 503)
        assert client.get("/health").status_code == 200
    assert not monitor.done


def test_an_outcome_that_cannot_be_audited_is_logged(monitor: Guarded, tmp_path: Path) -> None:
    audit_fails(tmp_path, "WHEN NEW.status > 0")
    with monitor.client(monitor.token(*Scope)) as client, capture_logs() as lines:
        assert client.delete("/machine").status_code == 200
    assert monitor.done == ["remove"]
    assert [entry.action for entry in monitor.entries()] == [STARTED]
    assert any("outcome is missing" in line["event"] and line["status"] == 200 for line in lines)


def test_without_the_database_known_tokens_can_still_read_for_a_time(monitor: Guarded) -> None:
    known, fresh = monitor.token(*Scope), monitor.token(READ)
    with monitor.client(known) as client, monitor.client(fresh) as late:
        assert client.get("/health").status_code == 200
        monitor.store.close()
        assert client.get("/health").status_code == 200
        refused = problem(client.delete("/machine"), 503)
        assert "looked up" in refused
        assert "sqlite" not in refused
        problem(late.get("/health"), 503)
        monitor.clock.now_s += 901.0
        problem(client.get("/health"), 503)
    assert not monitor.done


def test_refusals_do_not_flood_the_audit_log(tmp_path: Path) -> None:
    limits = LimitSettings(refusals_recorded_per_minute=4, failures_per_minute=10)
    with guarded(tmp_path, AccessSettings(limits=limits)) as monitor:
        with monitor.client("wrong") as client, monitor.client() as nobody:
            for _ in range(30):
                client.get("/health")
                nobody.post("/large", content=b"x")
                nobody.delete("/machine", headers={"origin": "http://evil.example"})
            assert [entry.status for entry in monitor.entries()] == [401] * 4
            monitor.clock.now_s += 61.0
            client.get("/health")
            assert monitor.entries()[-1].reason.endswith("86 refused requests before this one are not in this log")
        # Actions with a valid token are recorded all the same.
        with monitor.client(monitor.token(*Scope)) as client:
            assert client.delete("/machine").status_code == 200
        assert [entry.status for entry in monitor.entries()][-2:] == [0, 200]


def test_no_secret_is_written_anywhere(monitor: Guarded, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    good, wrong = monitor.token(*Scope), monitor.token(READ)[:-3] + "000"
    bodies: list[str] = []
    with capture_logs() as lines:
        for token in (good, wrong):
            with monitor.client(token) as client:
                for answer in (
                    client.get("/health"),
                    client.get(f"/{token}", params={"token": token}),
                    client.post(f"/alarms/{token}/shelve", json={"reason": f"use {token}"}),
                    client.post("/broken", headers=JSON),
                    client.delete("/machine", headers={"origin": f"http://{token}"}),
                    client.get("/health", headers={"authorization": f"Bearer {token} {token}"}),
                    client.get("/docs", headers=basic(token)),
                ):
                    bodies.append(str(answer.headers))
    # The client logs what it sends, and the server's own log of requests is off in the service.
    others = ("httpx", "httpcore", "uvicorn.access")
    logged = [one.getMessage() for one in caplog.records if not one.name.startswith(others)]
    written = "\n".join([repr(lines), *logged, *bodies, *map(repr, monitor.entries())])
    secrets = [token.rpartition("_")[2] for token in (good, wrong)]
    assert "rw_" in written
    for secret in secrets:
        assert secret not in written
    stored = b"".join(path.read_bytes() for path in tmp_path.glob("history.sqlite*"))
    assert secrets[0].encode() not in stored


def test_audited_paths_are_printable_and_bounded(monitor: Guarded) -> None:
    with monitor.client() as client:
        client.get("/%00%1b[31mred%0d%0aline%ff/" + "x" * 2000)
    (entry,) = monitor.entries()
    assert entry.path.isprintable()
    assert len(entry.path) == 500
    assert re.match(r"/..\[31mred..line./x", entry.path)


def test_a_websocket_is_refused(monitor: Guarded) -> None:
    async def receive() -> dict[str, str]:
        return {"type": "websocket.connect"}

    sent: list[object] = []

    async def run() -> None:
        async def send(message: object) -> None:
            sent.append(message)

        scope: dict[str, object] = {
            "type": "websocket", "path": "/health", "headers": [], "query_string": b"", "client": None,
        }  # fmt: skip
        await monitor.app(scope, receive, send)

    asyncio.run(run())
    assert sent == [{"type": "websocket.close", "code": 1008}]
