"""Which scope each route of an application declares."""

from collections.abc import Callable
from typing import Any

from fastapi import FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute, RouteContext, iter_route_contexts

from service.access.requirement import Requirement
from service.access.scopes import Scope

PUBLIC_PATHS = frozenset(("/", "/healthz"))
"""Paths that anybody may GET: the page knows nothing until somebody has signed in there."""

PAGE_FILES = "/page/"
"""How paths begin that anybody may GET besides."""

PROBE_PATHS = frozenset(("/healthz", "/readyz"))
"""Paths by which others decide whether to restart the service; however many ask, they are answered."""


def declared_scopes(app: FastAPI, endpoint: Callable[..., Any] | None) -> frozenset[Scope]:
    """Scopes that whoever reaches `endpoint` must have; none if one of its routes declares none."""
    found: set[Scope] = set()
    for context in iter_route_contexts(app.routes):
        if context.endpoint is endpoint and endpoint is not None:
            declared = _required(context.dependant) if isinstance(context.original_route, APIRoute) else None
            if not declared:
                return frozenset()
            found |= declared
    return frozenset(found)


def unguarded_routes(app: FastAPI, gate: Callable[..., Any]) -> list[str]:
    """Routes before which `gate` does not stand: static files, sockets, mounted programs, or routes without it."""
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
