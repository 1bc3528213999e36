"""Around the whole application: identifies callers, limits bodies, writes the audit log, and sets safe headers.

Written against ASGI itself, so that event streams pass through piece by piece.
"""

from collections.abc import Awaitable, Callable
from http import HTTPStatus

from fastapi import Request, Response
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Send
from starlette.types import Scope as AsgiScope

from service.access.audit import AuditNote, AuditTrail, Visit
from service.access.credentials import SAFE_METHODS, address_of, challenges, network_of
from service.access.problems import problem_answer
from service.access.scopes import Caller
from service.terminal.logs import Limiter, logger

CALLER = "access_caller"
"""Attribute of ``request.state`` in which the middleware leaves the caller."""

VISIT = "access_visit"
"""Attribute of ``request.state`` that keeps the request's `Visit`."""

_TOO_LARGE = 413
_LONGEST_NUMBER = 18
_REFUSED = (401, 403, 429)
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
}
_log = logger(part="access")


class AccessMiddleware:
    """Lets requests in, or answers them with the problem; `admit` gives the caller, or raises `HTTPException`."""

    def __init__(
        self, app: ASGIApp, *, admit: Callable[[Request], Awaitable[Caller]], trail: AuditTrail, body_bytes: int
    ) -> None:
        self._app = app
        self._admit = admit
        self._trail = trail
        self._body_bytes = body_bytes
        self._limiter = Limiter()

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] == "http":
            await self._serve(scope, receive, send)
        elif scope["type"] == "websocket":  # no route of this service is one
            await send({"type": "websocket.close", "code": 1008})
        else:
            await self._app(scope, receive, send)

    async def _serve(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        request = Request(scope, receive)
        visit = self._trail.visit(address_of(request), request.method, scope["path"])
        received = 0
        answered = False

        async def measured() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._body_bytes:  # a body that is sent in chunks states no length beforehand
                raise self._too_large()
            return message

        async def watched(message: Message) -> None:
            nonlocal answered
            if message["type"] == "http.response.start":
                if received > self._body_bytes and message["status"] != _TOO_LARGE:
                    return  # an answer that others gave to the body as it was cut off
                answered = True
                # Before the answer, so that whoever gets it finds it in the log.
                await self._record(visit, message["status"], request)
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            if answered:
                await send(message)

        async def refuse(refusal: HTTPException) -> None:
            request.state.audit = AuditNote(reason=refusal.detail)
            await _refusal(request, refusal)(scope, receive, watched)

        try:
            caller = await self._admitted(request, visit)
        except HTTPException as refusal:
            await refuse(refusal)
            return
        setattr(request.state, CALLER, caller)
        setattr(request.state, VISIT, visit)
        await self._app(scope, measured, watched)
        if not answered and received > self._body_bytes:
            await refuse(self._too_large())

    async def _admitted(self, request: Request, visit: Visit) -> Caller:
        caller = await self._admit(request)
        visit.actor = caller.name
        length = request.headers.get("content-length", "0")
        if length.isdecimal() and (len(length) > _LONGEST_NUMBER or int(length) > self._body_bytes):
            raise self._too_large()
        return caller

    def _too_large(self) -> HTTPException:
        return HTTPException(_TOO_LARGE, f"the request body is too large, expected at most {self._body_bytes} bytes")

    async def _record(self, visit: Visit, status: int, request: Request) -> None:
        note = getattr(request.state, "audit", None)
        if not isinstance(note, AuditNote):
            note = AuditNote()
        refused = status in _REFUSED or not hasattr(request.state, CALLER)
        if refused and not visit.started:
            told = {"status": status, "address": visit.address, "actor": visit.actor, "method": visit.method}
            self._limiter.say(f"refused {status}", _log.warning, "request refused", **told)
            left_out = self._trail.admits_refusal(network_of(visit.address))
            if left_out is None:
                return
            if left_out:
                more = f"{left_out} refused requests before this one are not in this log"
                note = AuditNote(note.action, note.machine, note.alarm, "; ".join(filter(None, (note.reason, more))))
        elif visit.method in SAFE_METHODS:
            return
        await run_in_threadpool(self._trail.finish, visit, status, note)


def _refusal(request: Request, refusal: HTTPException) -> Response:
    answer = problem_answer(request, refusal.status_code, refusal.detail)
    answer.headers.update(refusal.headers or {})
    if refusal.status_code == HTTPStatus.UNAUTHORIZED:
        for challenge in challenges(request):
            answer.headers.append("WWW-Authenticate", challenge)
    return answer
