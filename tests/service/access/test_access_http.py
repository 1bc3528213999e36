"""Who is let in over HTTP, by token or signed in with a browser, and who is refused: a real server, a real store."""

import base64
import hmac
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI, WebSocket

from service.access.credentials import COOKIE
from service.access.guard import AccessError
from service.access.scopes import Scope
from service.settings.access import AccessSettings, LimitSettings
from tests.service.rig.guarded import JSON, Guarded, application, basic, guarded, problem, served

READ, OPERATE, CONFIGURE = Scope
DAY_NS = 86_400 * 10**9
ASKED = 'Bearer realm="rotorwatch"'
SESSION = "/api/v1/session"
BODY = {"reason": "known"}


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
    assert {answer.headers["www-authenticate"] for answer in answers} == {f'{ASKED}, error="invalid_token"'}
    assert len(texts) == 1
    with monitor.client() as client:
        without = client.get("/health")
        in_no_form = client.get("/health", headers={"authorization": f"Token {good}"})
    details = {problem(answer, 401) for answer in (refused, without, in_no_form)}
    assert len(details) == 3  # none, not a bearer token, and an unknown one
    assert "error" not in without.headers["www-authenticate"]
    with monitor.client(good) as client:
        assert client.get("/health").json()["name"] == "ops"


def test_a_token_is_accepted_only_in_its_header(monitor: Guarded) -> None:
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


def test_browsers_can_send_the_token_as_a_password(monitor: Guarded) -> None:
    token = monitor.token(READ)
    with monitor.client() as client:
        for given in ({}, basic("rw_000000000000_" + 43 * "0")):
            asked = client.get("/docs", headers={"accept": "text/html,*/*"} | given)
            assert asked.status_code == 401
            bearer, in_browsers = asked.headers.get_list("www-authenticate")  # Chromium reads one challenge a line
            assert bearer == ASKED + (', error="invalid_token"' if given else "")
            assert in_browsers == 'Basic realm="rotorwatch", charset="UTF-8"'
        assert client.get("/docs", headers=basic(token)).status_code == 200
        assert client.get("/docs", headers=basic(token, "")).status_code == 200
        for wrong in ("Basic", "Basic ===", "Basic eA==", f"Basic {base64.b64encode(b'x:' + bytes([255])).decode()}"):
            problem(client.get("/docs", headers={"authorization": wrong}), 401)


def test_a_route_without_a_scope_or_added_too_late_is_refused_to_everybody(monitor: Guarded) -> None:
    @monitor.app.get("/late")
    def late() -> str:
        return "late"

    with monitor.client(monitor.token(*Scope)) as client:
        for answer in (client.get("/forgotten"), client.post("/forgotten", headers=JSON)):
            assert "declares no scope" in problem(answer, 403)
        problem(client.get("/late"), 403)
        monitor.app.mount("/static", FastAPI())
        assert "/static" in problem(client.get("/health"), 403)
    assert not monitor.done


def test_an_app_with_a_route_that_bypasses_the_gate_is_not_protected(monitor: Guarded) -> None:
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


def test_without_the_middleware_the_gate_refuses_every_request(monitor: Guarded) -> None:
    app = application(monitor.guard, monitor.done)
    with served(app) as url, httpx.Client(base_url=url, trust_env=False, timeout=180.0) as client:
        headers = {"authorization": f"Bearer {monitor.token(*Scope)}"}
        assert client.get("/health", headers=headers).status_code == 401
        assert client.post("/alarms/e/shelve", json={"reason": "r"}, headers=headers).status_code == 401
    assert not monitor.done


def test_unknown_tokens_are_compared_in_constant_time(monitor: Guarded, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_responses_carry_security_headers(monitor: Guarded) -> None:
    with monitor.client(monitor.token(READ)) as client:
        for path in ("/docs", "/health", "/nowhere", "/healthz", "/openapi.json"):
            headers = client.get(path).headers
            assert (headers["x-content-type-options"], headers["cache-control"]) == ("nosniff", "no-store")
            assert headers["content-security-policy"].startswith("default-src 'none'; base-uri 'none';")
            assert "server" not in headers


def test_cross_site_requests_and_forms_change_nothing_even_with_a_token(monitor: Guarded) -> None:
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
        for headers in ({"content-type": "text/plain"}, {"content-type": "application/x-www-form-urlencoded"}, {}):
            problem(client.post("/alarms/e/shelve", content=b'{"reason": "r"}', headers=headers), 415)
    assert not monitor.done


def test_requests_of_the_services_own_origins_are_accepted(tmp_path: Path) -> None:
    with guarded(tmp_path, AccessSettings(hosts=("plant.example", "[2001:db8::1]:8443"))) as monitor:
        ours: tuple[dict[str, str], ...] = (
            {"origin": monitor.url, "sec-fetch-site": "same-origin"},
            {"origin": "https://plant.example"},
            {"origin": "https://[2001:db8::1]:8443"},
            {},
        )
        with monitor.client(monitor.token(*Scope)) as client:
            for headers in ours:
                assert client.delete("/machine", headers=headers).status_code == 200
            problem(client.delete("/machine", headers={"origin": "https://plant.example:8443"}), 403)


def test_open_on_loopback_every_caller_is_anonymous_and_audited(tmp_path: Path) -> None:
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


@pytest.mark.parametrize(("proxies", "address"), [((), "127.0.0.1"), (("127.0.0.1",), "10.1.2.3")])
def test_only_a_configured_proxy_names_the_caller(tmp_path: Path, proxies: tuple[str, ...], address: str) -> None:
    with guarded(tmp_path, AccessSettings(proxies=proxies)) as monitor, monitor.client(monitor.token(READ)) as client:
        assert client.get("/health", headers={"x-forwarded-for": "10.1.2.3"}).json()["address"] == address


def signed_in(monitor: Guarded, client: httpx.Client, token: str) -> httpx.Response:
    return client.post(SESSION, json={}, headers={"authorization": f"Bearer {token}", "origin": monitor.url})


def test_a_session_reads_and_operates_until_signing_out(monitor: Guarded) -> None:
    token = monitor.token(READ, OPERATE)
    with monitor.client() as client:
        answer = signed_in(monitor, client, token)
        assert answer.json() == {"name": "ops", "scopes": ["read", "operate"]}
        attributes = {one.strip().lower() for one in answer.headers["set-cookie"].split(";")[1:]}
        assert {"httponly", "samesite=strict", "path=/"} <= attributes
        assert not any(one.startswith(("max-age", "expires", "domain")) for one in attributes)
        assert client.get("/health").json()["name"] == "ops"
        assert client.post("/alarms/k_by/shelve", json=BODY, headers={"origin": monitor.url}).json() == "shelved"
        assert client.delete(SESSION, headers={"origin": monitor.url}).json() == {"name": "", "scopes": []}
        assert COOKIE not in client.cookies
        problem(client.get("/health"), 401)
    assert monitor.done == ["shelve k_by ops"]
    logged = {(entry.method, entry.actor) for entry in monitor.entries() if entry.path == SESSION}
    assert logged == {("POST", "ops"), ("DELETE", "ops")}


def test_the_cookie_changes_nothing_without_the_services_own_origin(monitor: Guarded) -> None:
    token = monitor.token(READ, OPERATE)
    with monitor.client() as client:
        signed_in(monitor, client, token)
        here, elsewhere = {"origin": monitor.url}, {"origin": "https://elsewhere.example"}
        for headers in ({}, elsewhere, {"origin": "null"}, here | {"sec-fetch-site": "cross-site"}):
            assert problem(client.post("/alarms/k_by/shelve", json=BODY, headers=headers), 403)
            assert problem(client.delete(SESSION, headers=headers), 403)
        assert client.get("/health", headers=elsewhere).status_code == 200  # they cannot read the response
        problem(client.post("/alarms/k_by/shelve", content=b"reason=known", headers=here), 415)
    assert not monitor.done


def test_a_wrong_token_sets_no_cookie_and_a_revoked_one_ends_the_session(monitor: Guarded) -> None:
    record, token = monitor.issue(READ)
    with monitor.client() as client:
        problem(signed_in(monitor, client, token[:-1]), 401)
        problem(client.post(SESSION, json={}), 401)
        assert not client.cookies
        signed_in(monitor, client, token)
        monitor.store.tokens.revoke(record.token_id, 1)
        assert "no longer signed in" in problem(client.get("/health"), 401)
        # A token in the header takes precedence over the cookie.
        other = monitor.token(READ, name="other")
        assert client.get("/health", headers={"authorization": f"Bearer {other}"}).json()["name"] == "other"


def test_wrong_cookies_count_as_failed_attempts(tmp_path: Path) -> None:
    with (
        guarded(tmp_path, AccessSettings(limits=LimitSettings(failures_per_minute=2))) as monitor,
        monitor.client() as client,
    ):
        client.cookies.set(COOKIE, "rw_nothing")
        assert [client.get("/health").status_code for _ in range(4)] == [401, 401, 429, 429]


def test_no_cookie_is_set_where_no_token_is_needed(tmp_path: Path) -> None:
    with guarded(tmp_path, AccessSettings(open_on_loopback=True)) as monitor, monitor.client() as client:
        assert client.post(SESSION, json={}).json()["name"] == "anonymous"
        assert not client.cookies
