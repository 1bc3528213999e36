"""Errors of the HTTP API as problem details (RFC 9457), and how OpenAPI tells of them."""

from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint

from service.logs import logger
from service.schemas import Problem, example

__all__ = ["add_problems", "problem_answer", "problem_responses", "responses"]

_PROBLEM = "application/problem+json"
_log = logger(part="api")


def responses(model: type[BaseModel], *problems: int, status_code: int = 200) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries: an example of the answer, and the problems a request may meet."""
    shown_answer = {"content": {"application/json": {"example": example(model)}}}
    found: dict[int | str, dict[str, Any]] = {status_code: shown_answer, **problem_responses(*problems)}
    return found


def problem_responses(*problems: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries of the problems a request may meet."""
    found: dict[int | str, dict[str, Any]] = {}
    for status in (*problems, 500):
        phrase = HTTPStatus(status).phrase
        shown = {**example(Problem), "title": phrase, "status": status}
        found[status] = {
            "description": phrase,
            "content": {_PROBLEM: {"schema": Problem.model_json_schema(), "example": shown}},
        }
    return found


def problem_answer(request: Request, status: int, detail: str, more: dict[str, Any] | None = None) -> JSONResponse:
    """Answer with a problem; `more` are fields beyond those of RFC 9457."""
    problem = Problem(title=HTTPStatus(status).phrase, status=status, detail=detail, instance=request.url.path)
    return JSONResponse({**problem.model_dump(), **(more or {})}, status, media_type=_PROBLEM)


def add_problems(app: FastAPI) -> None:
    """Answer every error with problem details."""

    async def on_http(request: Request, error: Exception) -> JSONResponse:
        if not isinstance(error, StarletteHTTPException):
            raise error
        response = problem_answer(request, error.status_code, str(error.detail))
        response.headers.update(error.headers or {})
        return response

    async def on_invalid(request: Request, error: Exception) -> JSONResponse:
        if not isinstance(error, RequestValidationError):
            raise error
        faults = [{"field": str(fault["loc"][-1]), "message": str(fault["msg"])} for fault in error.errors()]
        detail = "; ".join(f"{fault['field']}: {fault['message']}" for fault in faults)
        return problem_answer(request, 422, detail, {"errors": faults})

    async def guard(request: Request, call_next: RequestResponseEndpoint) -> Response:
        # A handler for Exception would let it through to the server after answering, which then drops the connection.
        try:
            return await call_next(request)
        except Exception:
            # Nothing narrower: refusals and invalid requests were answered further in, what arrives here is an error
            # in any code behind any path. Each must be a 500 in problem details that tells nothing of the inside.
            _log.exception("request failed", path=request.url.path)
            return problem_answer(request, 500, "an error inside the service; its log says more")

    handlers: dict[type[Exception], Callable[[Request, Exception], Awaitable[JSONResponse]]] = {
        StarletteHTTPException: on_http,
        RequestValidationError: on_invalid,
    }
    for kind, handler in handlers.items():
        app.add_exception_handler(kind, handler)
    app.add_middleware(BaseHTTPMiddleware, dispatch=guard)
