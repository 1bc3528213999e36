"""Checks who may call which route, and that every route declares it.

::

    middleware   token, rate, origin, body size ------------> 401, 403, 413, 429, 503   (no token for public paths)
    gate         scopes of the route, body type, audit log -> 403, 415, 503             (before the route's own code)
    route        dependencies=[guard.read], or caller: Annotated[Caller, guard.operate]

A route that declares no scope is refused by the gate. How an application is guarded::

    guard = Guard(store.tokens, store.audit, settings.access, settings.http.host)
    app = FastAPI(dependencies=[guard.gate], openapi_url=None, docs_url=None, redoc_url=None)
    ...                                     # routes
    guard.protect(app)                      # after all of them
"""

import functools
import hmac
import math
import secrets
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Request, Security
from fastapi.dependencies.models import Dependant
from fastapi.openapi.models import HTTPBase, HTTPBearer
from fastapi.responses import JSONResponse, Response
from fastapi.routing import APIRoute, RouteContext, iter_route_contexts
from fastapi.security.base import SecurityBase
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from models.errors import RotorwatchError
from service.access.audit import AuditNote, AuditTrail, Visit
from service.access.credentials import (
    BEARER,
    NEEDED,
    SAFE_METHODS,
    address_of,
    check_body_type,
    check_origin,
    kept_text,
    key_of,
    network_of,
    presented_text,
    unauthenticated,
)
from service.access.middleware import CALLER, VISIT, AccessMiddleware
from service.access.rates import MovingWindow, StreamSeats
from service.access.scopes import ANONYMOUS, NOBODY, Caller, Scope
from service.access.tokens import PresentedToken, parse_token, token_is_valid, token_state
from service.history.records import TokenRecord
from service.history.shared import AuditLog, TokenStore
from service.settings.access import AccessSettings
from service.terminal.logs import Limiter, logger

PUBLIC_PATHS = frozenset(("/", "/healthz"))
"""Paths that anybody may GET: the page knows nothing until somebody has signed in there."""

PAGE_FILES = "/page/"
"""Beginning of further paths that anybody may GET."""

PROBE_PATHS = frozenset(("/healthz", "/readyz"))
"""Paths by which others decide whether to restart the service; however many ask, they are answered."""

_log = logger(part="access")
_KNOWN_TOKENS = 1_000
_WITHOUT_DATABASE_S = 900.0


class AccessError(RotorwatchError):
    """An application cannot be guarded the way it is built."""


@dataclass(frozen=True)
class Requirement:
    """Gives the caller of a route, if that has a scope."""

    scope: Scope

    def __call__(self, request: Request) -> Caller:
        """Return the caller; HTTPException 401 without one, 403 if the scope is missing."""
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


class Guard:
    """Guards an application.

    Parameters
    ----------
    tokens : TokenStore
        Looked up at every request, so that a token that is revoked is refused at the next one.
    host : str
        Address that is listened on; it counts as a name of the service.

    Attributes
    ----------
    read, operate, configure
        Dependencies that give a `Caller` with the scope.
    stream
        Dependency of an event stream that needs ``read``: holds one of the caller's streams until its end.
    gate
        Dependency of the application as a whole.
    last_used_ns
        When each token that was used since the start was used last, by its public part.
    """

    def __init__(
        self,
        tokens: TokenStore,
        audit: AuditLog,
        access: AccessSettings,
        host: str,
        *,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        limits = access.limits
        self.access = access
        self.trail = AuditTrail(audit, limits.refusals_recorded_per_minute, monotonic=monotonic)
        self.seats = StreamSeats(limits.streams_per_caller, limits.streams)
        self.read: Any = requires(Scope.READ, in_browsers=True)
        self.operate: Any = requires(Scope.OPERATE)
        self.configure: Any = requires(Scope.CONFIGURE)
        self.gate: Any = Depends(self.pass_gate)
        self.tokens = tokens
        self.last_used_ns: dict[str, int] = {}
        self._host = host.lower()
        self._requests = MovingWindow(limits.requests_per_minute, clock=monotonic)
        self._failures = MovingWindow(limits.failures_per_minute, clock=monotonic)
        self._secret = secrets.token_bytes(32)
        self._monotonic = monotonic
        self._limiter = Limiter(monotonic)
        self._known: OrderedDict[bytes, tuple[TokenRecord, float]] = OrderedDict()  # valid ones, and when looked up

        async def stream(caller: Annotated[Caller, self.read]) -> AsyncIterator[Caller]:
            with self.seats.seat(key_of(caller)):
                yield caller

        self.stream: Any = Depends(stream)

    def protect(self, app: FastAPI) -> None:
        """Put the middleware around an application that has all its routes, and serve its ``/openapi.json``.

        Raises
        ------
        AccessError
            If a route is not behind the gate.
        """

        @app.get("/openapi.json", include_in_schema=False, dependencies=[self.read])
        def description() -> Response:
            return Response(written(), media_type="application/json")

        @functools.cache
        def written() -> bytes:
            return bytes(JSONResponse(app.openapi()).body)

        if outside := self._unguarded_routes(app):
            raise AccessError(
                f"{outside}: the gate does not stand before this; build the application with "
                "FastAPI(dependencies=[guard.gate], openapi_url=None, docs_url=None, redoc_url=None), and add nothing "
                "but its own routes"
            )
        app.add_middleware(
            AccessMiddleware, admit=self.admit, trail=self.trail, body_bytes=self.access.limits.body_bytes
        )

    async def admit(self, request: Request) -> Caller:
        """Identify the caller; HTTPException 401, 403, 429 or 503 for the token, rate or origin of a request."""
        address = address_of(request)
        if outside := self._unguarded_routes(request.app):  # one that was added since `protect`
            raise HTTPException(403, f"{outside}: declares no scope, so nothing is served")
        if _is_public(request):
            caller: Caller | None = Caller(NOBODY, address=address)
        elif self.access.open_on_loopback:
            caller = Caller(ANONYMOUS, frozenset(Scope), address)
        else:
            caller = await self._authenticated(request, address)
        key = network_of(address) if caller is None else key_of(caller)
        is_probe = request.scope["path"] in PROBE_PATHS and request.method in SAFE_METHODS
        if not is_probe and (wait_s := self._requests.hit(key)):
            raise _too_many(f"more than {self.access.limits.requests_per_minute} requests in a minute", wait_s)
        if caller is None:
            raise HTTPException(401, unauthenticated(request))
        check_origin(request, self.access, self._host)
        return caller

    def pass_gate(self, request: Request) -> None:
        """Refuse what the caller, or anybody, may not do; write into the audit log what is about to be done.

        Raises
        ------
        HTTPException
            403 if the scope is missing or the route declares none, 415 if a body is not sent as JSON, 503 if the audit
            log cannot be written.
        """
        if _is_public(request):
            return
        needed = declared_scopes(request.app, request.scope.get("endpoint"))
        if not needed:
            raise HTTPException(403, "this route declares no scope, so nobody may call it")
        for scope in sorted(needed):
            Requirement(scope)(request)
        if request.method in SAFE_METHODS:
            return
        check_body_type(request)
        visit: Visit = getattr(request.state, VISIT)
        try:
            self.trail.start(visit)
        except RotorwatchError as error:
            raise HTTPException(503, f"nothing was done, because the audit log cannot be written: {error}") from error

    def _unguarded_routes(self, app: FastAPI) -> str:
        """Routes that are not behind the gate: static files, sockets, mounted programs, or routes without it."""
        outside = sorted(
            _title(context)
            for context in iter_route_contexts(app.routes)
            if not isinstance(context.original_route, APIRoute)
            or not any(inner.call == self.pass_gate for inner in context.dependant.dependencies)
        )
        return ", ".join(outside)

    def still_valid(self, caller: Caller) -> bool:
        """Whether a caller's token still holds, for streams that stay open for long; may wait for a database."""
        if not caller.token_id:
            return True
        record = self.tokens.find(caller.token_id)
        return record is not None and token_state(record, time.time_ns()) == "valid"

    async def _authenticated(self, request: Request, address: str) -> Caller | None:
        """Return the owner of the token that is presented; None if none is presented or it is not valid."""
        text = presented_text(request.headers, request.method)
        # Only a digest of what was presented is kept, from which nobody can recover it.
        given = kept_text(request.headers) or "\n".join(request.headers.getlist("authorization"))
        if not given:
            return None
        presented = None if text is None else parse_token(text)
        identity = hmac.digest(self._secret, given.encode(), "sha256").hex()
        if wait_s := self._failures.wait(identity):
            raise _too_many("too many attempts with this wrong token", wait_s)
        record = None if presented is None else await self._looked_up(presented, request.method)
        valid = token_is_valid(record, presented, time.time_ns())
        if record is None or presented is None or not valid:
            if presented is not None:
                self._known.pop(presented.secret_hash, None)
            self._failures.hit(identity)
            # Only after the look-up, so that nobody is locked out by others who try out tokens from the same address.
            if wait_s := self._failures.hit(network_of(address)):
                raise _too_many("too many attempts with a wrong token from this address", wait_s)
            return None
        self.last_used_ns[record.token_id] = time.time_ns()
        granted = frozenset(scope for scope in Scope if scope.value in record.scopes)
        return Caller(record.name, granted, address, record.token_id)

    async def _looked_up(self, presented: PresentedToken, method: str) -> TokenRecord | None:
        now_s = self._monotonic()
        known = self._known.get(presented.secret_hash)
        try:
            record = await run_in_threadpool(self.tokens.find, presented.token_id)
        except RotorwatchError as error:
            # Just when the database fails, operators want to look at their machines.
            if known is not None and method in SAFE_METHODS and now_s - known[1] <= _WITHOUT_DATABASE_S:
                return known[0]
            # The caller is not known and must not learn where the database is, which the error says: log it.
            self._limiter.say("look-up", _log.error, "tokens cannot be looked up", why=str(error))
            raise HTTPException(
                503, "tokens cannot be looked up in the history: nothing was done; the log says why"
            ) from error
        if record is not None and token_is_valid(record, presented, time.time_ns()):
            self._known[presented.secret_hash] = record, now_s
            self._known.move_to_end(presented.secret_hash)
            if len(self._known) > _KNOWN_TOKENS:
                self._known.popitem(last=False)
        return record


def _is_public(request: Request) -> bool:
    path = request.scope["path"]
    return request.method in SAFE_METHODS and (path in PUBLIC_PATHS or path.startswith(PAGE_FILES))


def _too_many(detail: str, wait_s: float) -> HTTPException:
    seconds = math.ceil(wait_s)
    return HTTPException(429, f"{detail}; try again in {seconds} s", {"Retry-After": str(seconds)})


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


def _required(dependant: Dependant) -> set[Scope]:
    found = {dependant.call.scope} if isinstance(dependant.call, Requirement) else set()
    return found.union(*(_required(inner) for inner in dependant.dependencies))


def _title(context: RouteContext) -> str:
    methods = "|".join(sorted(context.methods or ())) or type(context.original_route).__name__
    return f"{methods} {context.path or '?'}"
