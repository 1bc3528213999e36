"""Signing in with a browser: the token in a cookie, and what is refused with it."""

from pathlib import Path

import httpx

from service.access.credentials import COOKIE
from service.access.scopes import Scope
from service.settings.access import AccessSettings
from tests.service.rig.guarded import Guarded, guarded, problem

READ, OPERATE, _ = Scope
SESSION = "/api/v1/session"
BODY = {"reason": "known"}


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
    settings = AccessSettings.model_validate({"limits": {"failures_per_minute": 2}})
    with guarded(tmp_path, settings) as monitor, monitor.client() as client:
        client.cookies.set(COOKIE, "rw_nothing")
        assert [client.get("/health").status_code for _ in range(4)] == [401, 401, 429, 429]


def test_no_cookie_is_set_where_no_token_is_needed(tmp_path: Path) -> None:
    settings = AccessSettings.model_validate({"open_on_loopback": True})
    with guarded(tmp_path, settings) as monitor, monitor.client() as client:
        assert client.post(SESSION, json={}).json()["name"] == "anonymous"
        assert not client.cookies
