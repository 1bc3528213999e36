"""The OpenAPI description of the application, with complete examples; refuses undeclared query arguments."""

import threading
from collections.abc import Mapping
from functools import cached_property
from typing import Any

from fastapi import FastAPI, Request
from fastapi.dependencies.models import Dependant
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute, iter_route_contexts

from service.access.problems import share_problems

_STRICT = "/api/"


class DescribedApp(FastAPI):
    """An application whose description is suitable for code generators.

    Operations have the names of their functions, problems are described once, and examples keep their nulls, which
    FastAPI would remove.
    """

    def __init__(self, **arguments: Any) -> None:
        super().__init__(generate_unique_id_function=lambda route: route.name, **arguments)
        self._describing = threading.Lock()

    @cached_property
    def arguments(self) -> Mapping[Any, frozenset[str]]:
        """Names of the query arguments that each endpoint takes."""
        return {
            context.endpoint: frozenset(_queried(context.dependant))
            for context in iter_route_contexts(self.routes)
            if isinstance(context.original_route, APIRoute)
        }

    def openapi(self) -> dict[str, Any]:
        """Return the description, built once under a lock, so that no thread sees it incomplete."""
        with self._describing:
            if self.openapi_schema is None:
                self.openapi_schema = self._described()
            return self.openapi_schema

    def _described(self) -> dict[str, Any]:
        description = super().openapi()
        for context in iter_route_contexts(self.routes):
            routes = description["paths"].get(context.path_format, {})
            for method in context.methods or ():
                described = routes.get(method.lower())
                if described is not None:
                    _restore(described["responses"], context.responses)
        share_problems(description)
        _simplify(description)
        return description


def only_known_arguments(request: Request) -> None:
    """Refuse a query argument that the route does not have: a misspelt one would otherwise be silently ignored.

    Raises
    ------
    RequestValidationError
        Naming the argument and those of the route.
    """
    given = request.query_params.keys()
    if not given or not request.scope["path"].startswith(_STRICT) or not isinstance(request.app, DescribedApp):
        return
    known = request.app.arguments.get(request.scope.get("endpoint"), frozenset())
    expected = f"expected one of {', '.join(sorted(known))}" if known else "expected none"
    faults = [
        {"loc": ("query", name[:64]), "msg": f"no argument of this route, {expected}"}
        for name in given
        if name not in known
    ]
    if faults:
        raise RequestValidationError(faults)


def _queried(dependant: Dependant) -> set[str]:
    """Names of the query arguments of a route, including those of its dependencies."""
    return {one.alias for one in dependant.query_params}.union(*map(_queried, dependant.dependencies))


def _restore(described: dict[str, Any], declared: dict[int | str, dict[str, Any]]) -> None:
    for status, answer in declared.items():
        for kind, part in answer.get("content", {}).items():
            if "example" in part:
                described[str(status)]["content"][kind]["example"] = part["example"]


def _simplify(schema: Any) -> None:
    """Make a schema smaller and suitable for code generators.

    Adds `items` to every tuple, for generators that do not know `prefixItems`, and removes titles that only repeat the
    name of a field, and null as a value of optional query arguments, which nobody can send.
    """
    if isinstance(schema, list):
        for one in schema:
            _simplify(one)
    elif isinstance(schema, dict):
        for one in schema.values():
            _simplify(one)
        properties, own = schema.get("properties"), schema.get("schema")
        for field in (*(properties.values() if isinstance(properties, dict) else ()), own):
            if isinstance(field, dict):
                field.pop("title", None)
        if isinstance(own, dict) and own.get("description") == schema.get("description"):  # that of a query argument
            own.pop("description", None)
        if isinstance(own, dict) and "in" in schema and isinstance(choice := own.get("anyOf"), list):
            own["anyOf"] = choice = [one for one in choice if one != {"type": "null"}]
            if len(choice) == 1:
                own.update(*own.pop("anyOf"))
        if isinstance(first := schema.get("prefixItems"), list):
            different = [one for number, one in enumerate(first) if one not in first[:number]]
            schema["items"] = different[0] if len(different) == 1 else {"anyOf": different}
