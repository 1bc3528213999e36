"""Dependency that a route's caller has a scope, as OpenAPI shows it; and which scopes each route declares."""

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Request, Security
from fastapi.dependencies.models import Dependant
from fastapi.openapi.models import HTTPBase, HTTPBearer
from fastapi.routing import APIRoute, RouteContext, iter_route_contexts
from fastapi.security.base import SecurityBase
from starlette.exceptions import HTTPException

from service.access.audit import AuditNote
from service.access.credentials import BEARER, NEEDED
from service.access.scopes import Caller, Scope

PUBLIC_PATHS = frozenset(("/", "/healthz"))
"""Paths that anybody may GET: the page knows nothing until somebody has signed in there."""

PAGE_FILES = "/page/"
"""Beginning of further paths that anybody may GET."""

PROBE_PATHS = frozenset(("/healthz", "/readyz"))
"""Paths by which others decide whether to restart the service; however many ask, they are answered."""

CALLER = "access_caller"
"""Attribute of ``request.state`` in which the middleware leaves the caller."""


class Requirement:
    """Gives the caller of a route, if that has a scope."""

    def __init__(self, scope: Scope) -> None:
        self.scope = scope

    def __call__(self, request: Request) -> Caller:
        """Return the caller.

        Raises
        ------
        HTTPException
            401 without a caller, 403 if the scope is missing.
        """
        caller = getattr(request.state, CALLER, None)
        if not isinstance(caller, Caller):  # the request did not pass the middleware
            raise HTTPException(401, NEEDED, {"WWW-Authenticate": BEARER})
        if self.scope not in caller.scopes:
            granted = ", ".join(scope for scope in Scope if scope in caller.scopes)
            text = f"this needs the scope {self.scope}; {caller.name} has {granted or 'none'}"
            request.state.audit = AuditNote(reason=text)
            raise HTTPException(403, text)
        return caller


class _Shown(SecurityBase):
    """A way to present a token as OpenAPI shows it; the middleware checks the token."""

    def __init__(self, model: HTTPBase, scheme_name: str) -> None:
        self.model = model
        self.scheme_name = scheme_name

    async def __call__(self) -> None:
        """Nothing is left to do."""


_BEARER = _Shown(HTTPBearer(bearerFormat="rw_<id>_<secret>", description="token of rotorwatch token create"), "token")
_BASIC = _Shown(
    HTTPBase(scheme="basic", description="for browsers, GET only: any user name, and the token as password"), "browser"
)


def requires(scope: Scope, *, in_browsers: bool = False) -> Any:
    """Dependency that gives a `Caller` with a scope; with `in_browsers`, OpenAPI offers the token as password too."""
    requirement = Requirement(scope)

    def with_token(
        caller: Annotated[Caller, Depends(requirement)],
        _token: Annotated[None, Security(_BEARER, scopes=[scope.value])],
    ) -> Caller:
        return caller

    def with_token_or_password(
        caller: Annotated[Caller, Depends(requirement)],
        _token: Annotated[None, Security(_BEARER, scopes=[scope.value])],
        _password: Annotated[None, Security(_BASIC, scopes=[scope.value])],
    ) -> Caller:
        return caller

    return Depends(with_token_or_password if in_browsers else with_token)


def declared_scopes(app: FastAPI, endpoint: Callable[..., Any] | None) -> frozenset[Scope]:
    """Scopes that a caller of `endpoint` must have; none if one of its routes declares none."""
    found: set[Scope] = set()
    for context in iter_route_contexts(app.routes):
        if context.endpoint is endpoint and endpoint is not None:
            declared = _required(context.dependant) if isinstance(context.original_route, APIRoute) else None
            if not declared:
                return frozenset()
            found |= declared
    return frozenset(found)


def unguarded_routes(app: FastAPI, gate: Callable[..., Any]) -> list[str]:
    """Routes that are not behind `gate`: static files, sockets, mounted programs, or routes without it."""
    return sorted(
        _title(context)
        for context in iter_route_contexts(app.routes)
        if not isinstance(context.original_route, APIRoute)
        or not any(inner.call == gate for inner in context.dependant.dependencies)
    )


def _required(dependant: Dependant) -> set[Scope]:
    found = {dependant.call.scope} if isinstance(dependant.call, Requirement) else set()
    return found.union(*(_required(inner) for inner in dependant.dependencies))


def _title(context: RouteContext) -> str:
    methods = "|".join(sorted(context.methods or ())) or type(context.original_route).__name__
    return f"{methods} {context.path or '?'}"
