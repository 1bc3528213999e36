"""Counts HTTP requests by route and answer."""

from collections import Counter
from collections.abc import Mapping

from starlette.types import ASGIApp, Message, Receive, Scope, Send

NO_ROUTE = "-"
"""Route of a request that was refused before its route was looked for, or that has none."""

_METHODS = frozenset(("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"))


class RequestCounts:
    """Requests that were answered; written by the server's event loop alone, read by any thread."""

    def __init__(self) -> None:
        self._answered: Counter[tuple[str, str, str]] = Counter()

    def count(self, method: str, route: str, status: int) -> None:
        """Count a request."""
        self._answered[method if method in _METHODS else "other", route, str(status)] += 1

    def answered(self) -> Mapping[tuple[str, str, str], int]:
        """Requests by method, route and status."""
        return dict(self._answered)

    def refused(self) -> Mapping[str, int]:
        """Requests that were refused: without a valid token, without the scope, for their origin, or too many."""
        refused = dict.fromkeys(("token", "scope", "origin", "rate"), 0)
        for (_, route, status), count in self.answered().items():
            # Scopes are checked once the route is known, the origin before that.
            reasons = {"401": "token", "403": "origin" if route == NO_ROUTE else "scope", "429": "rate"}
            if status in reasons:
                refused[reasons[status]] += count
        return refused


class RequestMeter:
    """Middleware around all others, which counts answers as they leave."""

    def __init__(self, app: ASGIApp, counts: RequestCounts) -> None:
        self._app = app
        self._counts = counts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        counted = False

        def count(status: int) -> None:
            nonlocal counted
            if not counted:
                counted = True
                route = getattr(scope.get("route"), "path", NO_ROUTE)
                self._counts.count(scope["method"], str(route), status)

        async def watched(message: Message) -> None:
            if message["type"] == "http.response.start":
                count(message["status"])
            await send(message)

        try:
            await self._app(scope, receive, watched)
        except BaseException:
            count(500)  # what the server answers then
            raise
