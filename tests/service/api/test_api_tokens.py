"""Tokens over HTTP: what is shown of them, who may grant which scopes, and what the audit log holds."""

import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from rotorwatch.records.monitor import TokenCreated, TokenEntry, TokenList
from service.access.scopes import Scope
from service.settings.access import AccessSettings
from tests.service.rig.guarded import Guarded, guarded, problem
from tests.sure import sure

READ, OPERATE, CONFIGURE = Scope
TOKENS = "/api/v1/tokens"
DAY_NS = 86_400 * 10**9


def create(client: httpx.Client, name: str = "control room", **wish: Any) -> TokenCreated:
    answer = client.post(TOKENS, json={"name": name, "scopes": ["read"], **wish})
    assert answer.status_code == 201, answer.text
    assert answer.headers["cache-control"] == "no-store"
    return TokenCreated.model_validate_json(answer.content)


def listed(client: httpx.Client) -> dict[str, TokenEntry]:
    found = TokenList.model_validate_json(client.get(TOKENS).raise_for_status().content)
    assert found.needed
    return {one.name: one for one in found.tokens}


def test_a_token_is_created_used_and_revoked(monitor: Guarded, capfd: pytest.CaptureFixture[str]) -> None:
    with monitor.client(monitor.token(*Scope, name="chief")) as chief:
        before_ns = time.time_ns()
        made = create(chief, days=90)
        told = made.token
        assert made.text.startswith(f"rw_{told.token_id}_")
        assert (told.name, told.scopes, told.state, told.last_used_ns) == ("control room", ("read",), "valid", None)
        assert told.expires_ns == told.created_ns + 90 * DAY_NS
        assert listed(chief)["control room"] == told
        with monitor.client(made.text) as user:
            assert user.get("/health").json()["name"] == "control room"
            problem(user.get(TOKENS), 403)
            problem(user.post(TOKENS, json={"name": "x", "scopes": ["read"]}), 403)
            used_ns = sure(listed(chief)["control room"].last_used_ns)
            assert before_ns < used_ns <= time.time_ns()

            assert "already valid" in problem(chief.post(TOKENS, json={"name": told.name, "scopes": ["read"]}), 409)
            gone = TokenEntry.model_validate_json(chief.delete(f"{TOKENS}/{told.token_id}").raise_for_status().content)
            assert gone.state == "revoked"
            problem(user.get("/health"), 401)
        again = chief.delete(f"{TOKENS}/{told.token_id}").raise_for_status().json()
        assert again["revoked_ns"] == gone.revoked_ns
        assert create(chief).token.token_id != told.token_id  # the name is free again
        for text in ("000000000000", made.text):  # a secret given as an id is not repeated
            assert made.text not in problem(chief.delete(f"{TOKENS}/{text}"), 404)

    secret = made.text.rpartition("_")[2]
    written = [(one.action, one.status, one.reason) for one in monitor.entries() if one.path.startswith(TOKENS)]
    assert ("create-token", 201, f"{told.token_id}, control room, read") in written
    assert ("revoke-token", 200, f"{told.token_id}, control room") in written
    assert ("started", 0, "") in written
    assert secret not in repr(monitor.entries())
    logged = "".join(capfd.readouterr())
    assert "request refused" in logged
    assert secret not in logged
    assert secret not in repr(monitor.store.tokens.all())


def test_a_token_cannot_create_one_with_scopes_that_it_lacks(monitor: Guarded) -> None:
    with monitor.client(monitor.token(READ, CONFIGURE, name="clerk")) as clerk:
        for scopes in (["operate"], ["read", "operate", "configure"]):
            told = problem(clerk.post(TOKENS, json={"name": "more", "scopes": scopes}), 403)
            assert told == "clerk does not have the scope operate, and so cannot give it to a token"
        assert set(listed(clerk)) == {"clerk"}
        assert create(clerk, "less", scopes=["configure", "read", "read"]).token.scopes == ("read", "configure")
    refused = [one for one in monitor.entries() if one.status == 403]
    assert [one.action for one in refused] == ["create-token"] * 2
    assert "more, operate" in refused[0].reason


def test_a_token_cannot_create_one_that_is_valid_for_longer(monitor: Guarded) -> None:
    with monitor.client(monitor.token(*Scope, name="guest", days=30)) as guest:
        for days in (31, None):
            wish = {"name": "heir", "scopes": ["read"], "days": days}
            assert "valid for longer" in problem(guest.post(TOKENS, json=wish), 403)
        assert create(guest, "heir", days=29).token.expires_ns


@pytest.mark.parametrize(
    ("wish", "said"),
    [
        ({"name": " x"}, "name is ' x'"), ({"name": "anonymous"}, "is not a valid name of a token's user"),
        ({"name": "rw_000000000000_" + 43 * "0"}, "is not a valid name of a token's user"),
        ({"name": "a\nb"}, "name is"), ({"scopes": []}, "scopes: "), ({"scopes": ["admin"]}, "scopes"),
        ({"days": 0}, "days: "), ({"days": 3651}, "days: "), ({"secret": "x"}, "secret: "),
    ],
)  # fmt: skip
def test_invalid_token_requests_are_refused(monitor: Guarded, wish: dict[str, Any], said: str) -> None:
    with monitor.client(monitor.token(*Scope, name="chief")) as chief:
        told = problem(chief.post(TOKENS, json={"name": "x", "scopes": ["read"], **wish}), 422)
        assert said in told
        assert 43 * "0" not in told
        assert set(listed(chief)) == {"chief"}
    assert 43 * "0" not in repr(monitor.entries())


def test_the_token_list_says_whether_tokens_are_needed(tmp_path: Path) -> None:
    settings = AccessSettings.model_validate({"open_on_loopback": True})
    with guarded(tmp_path, settings) as monitor, monitor.client() as client:
        create(client, scopes=["read", "operate", "configure"])
        assert client.get(TOKENS).json()["needed"] is False
