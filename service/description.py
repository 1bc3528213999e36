"""The application's description of itself (OpenAPI), with whole examples."""

from typing import Any

from fastapi import FastAPI
from fastapi.routing import iter_route_contexts

__all__ = ["DescribedApp"]


class DescribedApp(FastAPI):
    """An application whose examples keep their nulls, which FastAPI leaves out wherever they are."""

    def openapi(self) -> dict[str, Any]:
        """Return the description; made once."""
        if self.openapi_schema is not None:
            return self.openapi_schema
        description = super().openapi()
        for context in iter_route_contexts(self.routes):
            routes = description["paths"].get(context.path_format, {})
            for method in context.methods or ():
                described = routes.get(method.lower())
                if described is not None:
                    _restore(described["responses"], context.responses)
        return description


def _restore(described: dict[str, Any], declared: dict[int | str, dict[str, Any]]) -> None:
    for status, answer in declared.items():
        for kind, part in answer.get("content", {}).items():
            if "example" in part:
                described[str(status)]["content"][kind]["example"] = part["example"]
