"""Who calls over HTTP and what that caller may do; how a browser signs in, with its token in a cookie, and out."""

from typing import Annotated, Any

from fastapi import FastAPI, Request, Response

from rotorwatch.records.monitor import CallerRights
from service.access.credentials import COOKIE, presented_text
from service.access.guard import Guard
from service.access.problems import responses
from service.access.scopes import NOBODY, Caller, Scope
from service.api.routes.replays import NothingToSay


def add_session_routes(app: FastAPI, guard: Guard) -> None:
    """Add the routes."""
    common: dict[str, Any] = {"tags": ["service"]}

    @app.get("/api/v1/caller", responses=responses(CallerRights), **common)
    def caller(request: Request, caller: Annotated[Caller, guard.read]) -> CallerRights:
        """Who calls, and which scopes that caller has; as a password a token lets its owner look and no more."""
        looks = "authorization" in request.headers and presented_text(request.headers, "POST") is None
        return _rights(caller.name, frozenset({Scope.READ}) if looks else caller.scopes)

    @app.post("/api/v1/session", responses=responses(CallerRights, 400, 413, 415, 422), **common)
    def sign_in(
        request: Request, answer: Response, caller: Annotated[Caller, guard.read], order: NothingToSay
    ) -> CallerRights:
        """Let a browser keep the token that this request is made with, until it is closed or signs out."""
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
