"""Callers over HTTP and their rights: tokens, and a browser's sign-in (with a token in a cookie) and sign-out.

``rotorwatch token`` manages tokens in a terminal.
"""

import threading
import time
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Path, Request, Response

from models.errors import MachineFileError
from rotorwatch.records.example import example
from rotorwatch.records.monitor import CallerRights, TokenCreated, TokenEntry, TokenList, TokenRequest
from service.access.audit import AuditNote
from service.access.credentials import COOKIE, presented_text
from service.access.guard import Guard
from service.access.problems import responses, shown_body
from service.access.scopes import NOBODY, Caller, Scope
from service.access.tokens import NameTakenError, check_name_is_free, masked, new_token, token_state
from service.api.routes.replays import NothingToSay
from service.history.records import TokenRecord

_PLACE = "/api/v1/tokens"
_ID = Annotated[str, Path(description="public part of the token", examples=["3fK09aZqT1xB"])]


def add_token_routes(app: FastAPI, guard: Guard) -> None:
    """Add the routes."""
    one_at_a_time = threading.Lock()  # so that two simultaneous requests cannot take the same name

    @app.get(_PLACE, tags=["service"], dependencies=[guard.configure], responses=responses(TokenList))
    def tokens() -> TokenList:
        """Every token ever created, without its secret, and whether tokens are needed."""
        found = tuple(_entry(guard, record) for record in guard.tokens.all())
        return TokenList(needed=not guard.access.open_on_loopback, tokens=found)

    @app.post(
        _PLACE,
        status_code=201,
        tags=["service"],
        responses=responses(TokenCreated, 400, 409, 413, 415, 422, status_code=201),
    )
    def create_token(
        request: Request,
        caller: Annotated[Caller, guard.configure],
        wish: Annotated[TokenRequest, shown_body("for the control room", example(TokenRequest))],
    ) -> TokenCreated:
        """Create a token; only this answer shows its text, because only a hash of it is kept."""
        scopes = frozenset(Scope(one) for one in wish.scopes)
        said = f"{wish.name}, {' '.join(one for one in Scope if one in scopes)}"
        request.state.audit = AuditNote("create-token", reason=said)
        if beyond := [str(one) for one in Scope if one in scopes - caller.scopes]:
            text = f"{caller.name} does not have the scope {', '.join(beyond)}, and so cannot give it to a token"
            request.state.audit = AuditNote("create-token", reason=f"{said}: {text}")
            raise HTTPException(403, text)
        now_ns = time.time_ns()
        try:
            record, secret = new_token(wish.name, scopes, now_ns=now_ns, days=wish.days)
            if _outlasts(record, guard.tokens.find(caller.token_id)):
                text = f"{caller.name} expires, and so cannot give a token that is valid for longer; give it fewer days"
                request.state.audit = AuditNote("create-token", reason=f"{said}: {text}")
                raise HTTPException(403, text)
            with one_at_a_time:
                check_name_is_free(wish.name, guard.tokens.all(), now_ns)
                guard.tokens.add(record)
        except NameTakenError as error:
            raise HTTPException(409, str(error)) from error
        except MachineFileError as error:
            raise HTTPException(422, str(error)) from error
        request.state.audit = AuditNote("create-token", reason=f"{record.token_id}, {said}")
        return TokenCreated(token=_entry(guard, record), text=secret)

    @app.delete(
        f"{_PLACE}/{{token_id}}", tags=["service"], dependencies=[guard.configure], responses=responses(TokenEntry, 404)
    )
    def revoke_token(request: Request, token_id: _ID) -> TokenEntry:
        """Revoke a token: it is refused from the next request on; a token revoked before stays as it is."""
        request.state.audit = AuditNote("revoke-token", reason=token_id)
        guard.tokens.revoke(token_id, time.time_ns())
        record = guard.tokens.find(token_id)
        if record is None:
            raise HTTPException(404, f"no token {masked(token_id)[:80]}; expected the 12 characters after rw_")
        request.state.audit = AuditNote("revoke-token", reason=f"{record.token_id}, {record.name}")
        return _entry(guard, record)


def _outlasts(made: TokenRecord, own: TokenRecord | None) -> bool:
    """Whether a new token is valid for longer than the token of its creator."""
    if own is None or own.expires_ns is None:
        return False
    return made.expires_ns is None or made.expires_ns > own.expires_ns


def _entry(guard: Guard, record: TokenRecord) -> TokenEntry:
    return TokenEntry(
        token_id=record.token_id,
        name=record.name,
        scopes=tuple(scope.value for scope in Scope if scope in record.scopes),
        state=token_state(record, time.time_ns()),
        created_ns=record.created_ns,
        expires_ns=record.expires_ns,
        revoked_ns=record.revoked_ns,
        last_used_ns=guard.last_used_ns.get(record.token_id),
    )


def add_session_routes(app: FastAPI, guard: Guard) -> None:
    """Add the routes."""
    common: dict[str, Any] = {"tags": ["service"]}

    @app.get("/api/v1/caller", responses=responses(CallerRights), **common)
    def caller(request: Request, caller: Annotated[Caller, guard.read]) -> CallerRights:
        """Name and scopes of the caller; a token given as a password has only the scope read."""
        looks = "authorization" in request.headers and presented_text(request.headers, "POST") is None
        return _rights(caller.name, frozenset({Scope.READ}) if looks else caller.scopes)

    @app.post("/api/v1/session", responses=responses(CallerRights, 400, 413, 415, 422), **common)
    def sign_in(
        request: Request, answer: Response, caller: Annotated[Caller, guard.read], order: NothingToSay
    ) -> CallerRights:
        """Let a browser keep the token of this request until it is closed or signs out."""
        _ = order
        token = presented_text(request.headers, request.method)
        if token:
            answer.set_cookie(COOKIE, token, secure=request.url.scheme == "https", httponly=True, samesite="strict")
        return _rights(caller.name, caller.scopes)

    @app.delete("/api/v1/session", dependencies=[guard.read], responses=responses(CallerRights), **common)
    def sign_out(answer: Response) -> CallerRights:
        """Let a browser forget the token, which stays valid."""
        answer.delete_cookie(COOKIE, httponly=True, samesite="strict")
        return _rights(NOBODY, frozenset())


def _rights(name: str, scopes: frozenset[Scope]) -> CallerRights:
    return CallerRights(name=name, scopes=tuple(scope.value for scope in Scope if scope in scopes))
