"""Who is let in over HTTP and who is refused: a real server, a real store."""

import asyncio
import base64
import hmac
import logging
import re
import socket
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI, Request, Response, WebSocket
from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint
from structlog.testing import capture_logs

from service.access.audit import STARTED
from service.access.guard import AccessError, Guard
from service.access.routes import undeclared_routes
from service.access.scopes import Caller, Scope
from service.access_settings import AccessSettings, LimitSettings
from tests.service.guarded import JSON, Guarded, application, guarded, served
from tests.service.live import until

READ, OPERATE, CONFIGURE = Scope
DAY_NS = 86_400 * 10**9
#: Every route of the small application with the scopes that it needs.
ROUTES = {
    ("GET", "/"): {READ},
    ("GET", "/health"): {READ},
    ("GET", "/alarms"): {READ},
    ("GET", "/openapi.json"): {READ},
    ("POST", "/alarms/k_by/shelve"): {READ, OPERATE},
    ("POST", "/broken"): {OPERATE},
    ("POST", "/large"): {OPERATE},
    ("DELETE", "/machine"): {CONFIGURE},
}


@pytest.fixture
def monitor(tmp_path: Path) -> Iterator[Guarded]:
    with guarded(tmp_path) as running:
        yield running


def basic(token: str, user: str = "x") -> dict[str, str]:
    return {"authorization": "Basic " + base64.b64encode(f"{user}:{token}".encode()).decode()}


def send(client: httpx.Client, method: str, path: str) -> httpx.Response:
    body = None if method in {"GET", "DELETE"} else {"reason": "known"}
    return client.request(method, path, json=body)


def problem(answer: httpx.Response, status: int) -> str:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    found = answer.json()
    assert found["status"] == status
    return str(found["detail"])


def test_every_route_but_healthz_refuses_whoever_has_no_token(monitor: Guarded) -> None:
    with monitor.client() as client:
        assert client.get("/healthz").json() is True
        for method, path in [*ROUTES, ("GET", "/forgotten"), ("GET", "/nowhere"), ("PATCH", "/health")]:
            answer = send(client, method, path)
            problem(answer, 401)
            assert answer.headers["www-authenticate"] == "Bearer"
        problem(client.post("/healthz", json={}), 401)
    assert not monitor.done


def test_every_route_refuses_whoever_lacks_a_scope_and_no_scope_includes_another(monitor: Guarded) -> None:
    for scopes in ({READ}, {OPERATE}, {CONFIGURE}, {READ, OPERATE}):
        token = monitor.token(*scopes)
        monitor.clock.now_s += 61.0
        with monitor.client(token) as client:
            for (method, path), needed in ROUTES.items():
                answer = send(client, method, path)
                if needed <= scopes:
                    assert answer.status_code == (500 if path == "/broken" else 200)
                else:
                    detail = problem(answer, 403)
                    assert "needs the scope" in detail


def test_a_wrong_expired_or_revoked_token_gets_the_same_answer(monitor: Guarded) -> None:
    record, good = monitor.issue(*Scope)
    expired = monitor.token(READ, days=1, now_ns=record.created_ns - 2 * DAY_NS)
    revoked_record, revoked = monitor.issue(READ)
    with monitor.client(revoked) as client:
        assert client.get("/health").status_code == 200
        monitor.store.tokens.revoke(revoked_record.token_id, 1)
        refused = client.get("/health")
    answers = [refused]
    last = "0" if good[-1] != "0" else "1"
    for token in (expired, good[:-1] + last, "rw_" + "0" * 12 + good[15:], good[:-1], good + "0", "ä", "x" * 5000):
        with monitor.client() as client:
            answers.append(client.get("/health", headers={b"authorization": f"Bearer {token}".encode()}))
    texts = {answer.text for answer in answers}
    assert {answer.status_code for answer in answers} == {401}
    assert {answer.headers["www-authenticate"] for answer in answers} == {"Bearer"}
    assert len(texts) == 1
    with monitor.client(good) as client:
        assert client.get("/health").json()["name"] == "ops"


def test_a_token_counts_only_in_its_header(monitor: Guarded) -> None:
    token = monitor.token(*Scope)
    header = f"Bearer {token}"
    with monitor.client() as client:
        for answer in (
            client.get("/health", params={"token": token, "access_token": token}),
            client.get("/health", headers={"cookie": f"token={token}; authorization={token}"}),
            client.get("/health", headers=[("authorization", header)] * 2),
            client.get("/health", headers={"authorization": f"Token {token}"}),
            client.post("/large", json={}, headers=basic(token)),
        ):
            problem(answer, 401)
        assert client.get("/health", headers={"authorization": header}).status_code == 200
    assert not monitor.done
    assert all(token not in str(entry) for entry in monitor.entries())


def test_browsers_give_the_token_as_password(monitor: Guarded) -> None:
    token = monitor.token(READ)
    with monitor.client() as client:
        asked = client.get("/", headers={"accept": "text/html,*/*"})
        assert asked.status_code == 401
        assert asked.headers["www-authenticate"].startswith("Bearer, Basic realm=")
        assert client.get("/", headers=basic(token)).status_code == 200
        assert client.get("/", headers=basic(token, "")).status_code == 200
        for wrong in ("Basic", "Basic ===", "Basic eA==", f"Basic {base64.b64encode(b'x:' + bytes([255])).decode()}"):
            problem(client.get("/", headers={"authorization": wrong}), 401)


def test_a_route_that_declares_nothing_is_refused_to_everybody(monitor: Guarded) -> None:
    with monitor.client(monitor.token(*Scope)) as client:
        assert "declares no scope" in problem(client.get("/forgotten"), 403)
        assert "declares no scope" in problem(client.post("/forgotten", headers=JSON), 403)
    assert not monitor.done
    assert undeclared_routes(monitor.app) == ["GET /forgotten", "POST /forgotten"]


def test_a_route_that_is_added_too_late_is_refused_as_well(monitor: Guarded) -> None:
    @monitor.app.get("/late")
    def late() -> str:
        return "late"

    with monitor.client(monitor.token(*Scope)) as client:
        problem(client.get("/late"), 403)
        monitor.app.mount("/static", FastAPI())
        assert "/static" in problem(client.get("/health"), 403)


def test_what_the_gate_does_not_stand_before_cannot_be_protected(monitor: Guarded) -> None:
    def without_gate(app: FastAPI) -> None:
        @app.get("/x", dependencies=[monitor.guard.read])
        def route() -> str:
            return "x"

    def socketed(app: FastAPI) -> None:
        @app.websocket("/ws")
        async def route(socket: WebSocket) -> None:
            await socket.accept()

    gate = monitor.guard.gate
    apps = {
        "/x": FastAPI(openapi_url=None),
        "/ws": FastAPI(dependencies=[gate], openapi_url=None),
        "/docs": FastAPI(dependencies=[gate]),
    }
    without_gate(apps["/x"])
    socketed(apps["/ws"])
    for path, app in apps.items():
        with pytest.raises(AccessError, match=path):
            monitor.guard.protect(app)


def test_without_the_middleware_nobody_gets_past_the_gate(monitor: Guarded) -> None:
    app = application(monitor.guard, monitor.done)
    with served(app) as url, httpx.Client(base_url=url, trust_env=False) as client:
        headers = {"authorization": f"Bearer {monitor.token(*Scope)}"}
        assert client.get("/health", headers=headers).status_code == 401
        assert client.post("/alarms/e/shelve", json={"reason": "r"}, headers=headers).status_code == 401
    assert not monitor.done


def test_secrets_are_compared_in_constant_time_even_if_there_is_no_such_token(
    monitor: Guarded, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared: list[tuple[int, int]] = []
    original = hmac.compare_digest

    def watched(one: bytes, other: bytes) -> bool:
        compared.append((len(one), len(other)))
        return original(one, other)

    monkeypatch.setattr("service.access.tokens.hmac.compare_digest", watched)
    good = monitor.token(READ)
    for token, status in ((good, 200), ("rw_" + "0" * 12 + good[15:], 401)):
        compared.clear()
        with monitor.client(token) as client:
            assert client.get("/health").status_code == status
        assert compared
        assert set(compared) == {(32, 32)}


def test_openapi_tells_of_tokens_and_scopes(monitor: Guarded) -> None:
    with monitor.client(monitor.token(READ)) as client:
        described = client.get("/openapi.json").json()
    schemes = described["components"]["securitySchemes"]
    assert schemes["token"]["scheme"] == "bearer"
    assert schemes["browser"]["scheme"] == "basic"
    assert described["paths"]["/health"]["get"]["security"] == [{"token": ["read"]}, {"browser": ["read"]}]
    assert {"token": ["configure"]} in described["paths"]["/machine"]["delete"]["security"]
    assert "security" not in described["paths"]["/healthz"]["get"]


def test_answers_carry_safe_headers(monitor: Guarded) -> None:
    with monitor.client(monitor.token(READ)) as client:
        for path in ("/", "/health", "/nowhere", "/healthz", "/openapi.json"):
            headers = client.get(path).headers
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["cache-control"] == "no-store"
            assert headers["content-security-policy"].startswith("default-src 'none'; style-src 'unsafe-inline';")
            assert "server" not in headers


# What may come from elsewhere


def test_another_page_changes_nothing_even_with_a_token(monitor: Guarded) -> None:
    with monitor.client(monitor.token(*Scope)) as client:
        for headers in (
            {"origin": "http://evil.example"},
            {"origin": "null"},
            {"origin": "http://["},
            {"origin": "http://127.0.0.1:1"},
            {"sec-fetch-site": "cross-site"},
            {"sec-fetch-site": "same-site"},
        ):
            assert "may not do this" in problem(client.delete("/machine", headers=headers), 403)
            assert client.get("/health", headers=headers).status_code == 200
    assert not monitor.done


def test_our_own_page_may(tmp_path: Path) -> None:
    with guarded(tmp_path, AccessSettings(hosts=("plant.example",))) as monitor:
        ours: tuple[dict[str, str], ...] = (
            {"origin": monitor.url, "sec-fetch-site": "same-origin"},
            {"origin": "https://plant.example"},
            {},
        )
        with monitor.client(monitor.token(*Scope)) as client:
            for headers in ours:
                assert client.delete("/machine", headers=headers).status_code == 200
            problem(client.delete("/machine", headers={"origin": "https://plant.example:8443"}), 403)


def test_a_form_cannot_be_sent(monitor: Guarded) -> None:
    with monitor.client(monitor.token(*Scope)) as client:
        for headers in ({"content-type": "text/plain"}, {"content-type": "application/x-www-form-urlencoded"}, {}):
            problem(client.post("/alarms/e/shelve", content=b'{"reason": "r"}', headers=headers), 415)
    assert not monitor.done


def test_open_on_loopback_everybody_is_anonymous_and_written_down(tmp_path: Path) -> None:
    with guarded(tmp_path, AccessSettings(open_on_loopback=True, hosts=("Plant.example",))) as monitor:
        with monitor.client() as client:
            assert client.get("/health").json() == {"name": "anonymous", "address": "127.0.0.1"}
            assert client.delete("/machine").status_code == 200
            for token in ("wrong", monitor.token(READ)):
                assert client.get("/health", headers={"authorization": f"Bearer {token}"}).status_code == 200
            assert client.get("/health", headers={"authorization": "Basic ==="}).status_code == 200
            port = httpx.URL(monitor.url).port
            for host in ("localhost", f"localhost:{port}", "127.0.0.1", "[::1]:8080", "plant.example"):
                assert client.get("/health", headers={"host": host}).status_code == 200
            for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", "[::1", ""):
                assert "host" in problem(client.get("/health", headers={"host": host}), 403)
                problem(client.delete("/machine", headers={"host": host}), 403)
            assert "proxy" in problem(client.get("/health", headers={"x-forwarded-for": "10.0.0.1"}), 403)
            problem(client.delete("/machine", headers={"origin": "http://evil.example"}), 403)
            problem(client.get("/forgotten"), 403)
        assert monitor.done == ["remove"]
        kept = [(entry.actor, entry.method, entry.status) for entry in monitor.entries() if entry.method == "DELETE"]
        assert kept[:2] == [("anonymous", "DELETE", 0), ("anonymous", "DELETE", 200)]


def test_a_caller_cannot_choose_its_address(monitor: Guarded) -> None:
    with monitor.client(monitor.token(READ)) as client:
        assert client.get("/health", headers={"x-forwarded-for": "10.1.2.3"}).json()["address"] == "127.0.0.1"


def test_a_named_proxy_says_who_calls(tmp_path: Path) -> None:
    with (
        guarded(tmp_path, AccessSettings(proxies=("127.0.0.1",))) as monitor,
        monitor.client(monitor.token(READ)) as client,
    ):
        assert client.get("/health", headers={"x-forwarded-for": "10.1.2.3"}).json()["address"] == "10.1.2.3"


# How much


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


def test_what_others_make_of_a_body_that_was_cut_off_is_not_sent(tmp_path: Path) -> None:
    """Between a middleware of this kind and the route the refusal turns into a bad request."""

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
    """Answered before the sender is through, however much it says it will send."""
    with guarded(tmp_path, AccessSettings(limits=LimitSettings(body_bytes=1000))) as monitor:
        url, token = httpx.URL(monitor.url), monitor.token(OPERATE)
        for length in ("content-length: 99999999999999999999", "transfer-encoding: chunked"):
            with socket.create_connection((url.host, url.port or 0), timeout=20) as raw:
                head = f"POST /large HTTP/1.1\r\nhost: {url.host}\r\nauthorization: Bearer {token}\r\n"
                raw.sendall(f"{head}content-type: application/json\r\n{length}\r\n\r\n".encode())
                if "chunked" in length:
                    raw.sendall(b"800\r\n" + b"x" * 0x800 + b"\r\n")
                assert raw.recv(100).startswith(b"HTTP/1.1 413")


def test_so_many_requests_a_minute_of_a_caller(tmp_path: Path) -> None:
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
            assert nobody.get("/healthz").status_code == 429
            monitor.clock.now_s += 40.0
            assert one.get("/health").status_code == 200


def test_tokens_cannot_be_tried_out(tmp_path: Path) -> None:
    with guarded(tmp_path, AccessSettings(limits=LimitSettings(failures_per_minute=3))) as monitor:
        in_use, fresh, wrong = monitor.token(READ), monitor.token(READ), monitor.token(READ)[:-3] + "000"
        with monitor.client(in_use) as client, monitor.client(wrong) as stranger, monitor.client(fresh) as late:
            assert client.get("/health").status_code == 200
            assert [stranger.get("/health").status_code for _ in range(5)] == [401] * 3 + [429] * 2
            assert stranger.get("/health").headers["retry-after"] == "60"
            # Not even the right one tells anything, unless it was in use before.
            assert late.get("/health").status_code == 429
            assert client.get("/health").status_code == 200
            monitor.clock.now_s += 60.0
            assert late.get("/health").status_code == 200
            assert stranger.get("/health").status_code == 401


def test_so_many_streams(tmp_path: Path) -> None:
    limits = LimitSettings(streams_per_caller=2, streams=3)
    with guarded(tmp_path, AccessSettings(limits=limits)) as monitor:
        seats = monitor.guard.seats
        one, other = monitor.client(monitor.token(READ)), monitor.client(monitor.token(READ))
        with one, other:
            with one.stream("GET", "/events") as first, one.stream("GET", "/events"):
                # Piece by piece, not at the end, of which there is none.
                pieces = first.iter_text()
                assert "data: 0" in next(pieces)
                refused = one.get("/events")
                assert "event streams of yours" in problem(refused, 429)
                assert int(refused.headers["retry-after"]) >= 1
                with other.stream("GET", "/events") as third:
                    assert third.status_code == 200
                    assert "which is the most this service has" in problem(other.get("/events"), 429)
            until(lambda: seats.taken == 0, "streams that were left give their seats back")
            with one.stream("GET", "/events") as again:
                assert again.status_code == 200


# What is written down


def test_what_is_done_is_written_down_before_and_after(monitor: Guarded) -> None:
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


def test_nothing_is_done_that_cannot_be_written_down(monitor: Guarded, tmp_path: Path) -> None:
    token = monitor.token(*Scope)
    with monitor.client(token) as client:
        assert client.get("/health").status_code == 200
        with sqlite3.connect(tmp_path / "history.sqlite") as database:
            database.execute(
                "CREATE TRIGGER full BEFORE INSERT ON audit_log BEGIN SELECT RAISE(ABORT, 'the disk is full'); END"
            )
        database.close()
        for answer in (client.delete("/machine"), client.post("/alarms/e/shelve", json={"reason": "r"})):
            assert "nothing was done" in problem(answer, 503)
        assert client.get("/health").status_code == 200
    assert not monitor.done


def test_an_outcome_that_cannot_be_written_is_in_the_log_at_least(monitor: Guarded, tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "history.sqlite") as database:
        database.execute(
            "CREATE TRIGGER full BEFORE INSERT ON audit_log WHEN NEW.status > 0 "
            "BEGIN SELECT RAISE(ABORT, 'the disk is full'); END"
        )
    database.close()
    with monitor.client(monitor.token(*Scope)) as client, capture_logs() as lines:
        assert client.delete("/machine").status_code == 200
    assert monitor.done == ["remove"]
    assert [entry.action for entry in monitor.entries()] == [STARTED]
    assert any("outcome is missing" in line["event"] and line["status"] == 200 for line in lines)


def test_without_the_database_those_who_were_there_may_look_on(monitor: Guarded) -> None:
    known, fresh = monitor.token(*Scope), monitor.token(READ)
    with monitor.client(known) as client, monitor.client(fresh) as late:
        assert client.get("/health").status_code == 200
        monitor.store.close()
        assert client.get("/health").status_code == 200
        assert "looked up" in problem(client.delete("/machine"), 503)
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
        # What a token's owner does is written down all the same.
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
                    client.get("/", headers=basic(token)),
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


def test_what_strangers_send_does_not_spoil_the_log(monitor: Guarded) -> None:
    with monitor.client() as client:
        client.get("/%00%1b[31mred%0d%0aline%ff/" + "x" * 2000)
    (entry,) = monitor.entries()
    assert entry.path.isprintable()
    assert len(entry.path) == 500
    assert re.match(r"/..\[31mred..line./x", entry.path)


def test_a_stream_can_ask_whether_its_token_still_holds(monitor: Guarded) -> None:
    record, token = monitor.issue(READ)
    with monitor.client(token) as client:
        assert client.get("/health").status_code == 200
    caller = Caller("ops", frozenset((READ,)), "127.0.0.1", record.token_id)
    assert monitor.guard.still_valid(caller)
    monitor.store.tokens.revoke(record.token_id, 1)
    assert not monitor.guard.still_valid(caller)
    assert not monitor.guard.still_valid(Caller("x", frozenset(), "", "unknown"))
    assert monitor.guard.still_valid(Caller("anonymous"))


def test_a_websocket_is_refused(monitor: Guarded) -> None:
    async def receive() -> dict[str, str]:
        return {"type": "websocket.connect"}

    sent: list[object] = []

    async def run() -> None:
        async def send(message: object) -> None:
            sent.append(message)

        scope: dict[str, object] = {
            "type": "websocket",
            "path": "/health",
            "headers": [],
            "query_string": b"",
            "client": None,
        }
        await monitor.app(scope, receive, send)

    asyncio.run(run())
    assert sent == [{"type": "websocket.close", "code": 1008}]
