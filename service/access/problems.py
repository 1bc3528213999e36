"""Errors of the HTTP API as problem details (RFC 9457), and their description in OpenAPI."""

from difflib import SequenceMatcher
from http import HTTPStatus
from typing import Any

from fastapi import Body, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import iter_route_contexts
from pydantic import BaseModel
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from models.mistakes import plainly
from rotorwatch.records.example import example
from rotorwatch.records.monitor import Problem
from service.access.tokens import masked
from service.history.records import StoreError
from service.terminal.logs import logger

_PROBLEM = "application/problem+json"
_ANYWHERE = (422, 429, 500)
_GUARDED = (401, 403, 503)
_BEGINNING = ["api", "v1"]
_LIKENESS = 0.6
_LONGEST_PATH = 128
_HEADERS: dict[int, dict[str, Any]] = {
    401: {"WWW-Authenticate": {"description": "how to authenticate", "schema": {"type": "string"}}},
    429: {"Retry-After": {"description": "seconds to wait", "schema": {"type": "integer"}}},
}
# As in RFC 9110; Python's own words for them depend on its version.
_TITLES = {413: "Content Too Large", 416: "Range Not Satisfiable", 422: "Unprocessable Content"}
_DETAILS = {
    400: "There was an error parsing the body",
    401: "an access token is needed; programs send it as header Authorization: Bearer rw_…",
    403: "this needs the scope operate; screen has read",
    409: "k_by is acknowledged (version 18), no longer as it was seen (version 17): look again",
    413: "the request body is too large, expected at most 1000000 bytes",
    415: "content type is text/plain, expected application/json",
    422: "limit: expected at most 1000 (found '5000')",
    428: "state how you saw the alarm: header If-Match with its ETag, or expected_state in the body",
    429: "more than 600 requests in a minute; try again in 3 s",
    500: "an error inside the service; its log says more",
    503: "demo/lab: busy for 10 s; nothing was done",
}
_log = logger(part="api")


def responses(
    model: type[BaseModel],
    *problems: int,
    status_code: int = 200,
    guarded: bool = True,
    shown: object = None,
    headers: dict[str, Any] | None = None,
) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries: an example of the answer, and the problems a request may meet.

    Parameters
    ----------
    *problems : int
        Statuses besides those that any request may meet.
    shown : object, optional
        Example, if not the one made of the examples of the model's fields.
    """
    answer: dict[str, Any] = {"content": {"application/json": {"example": example(model) if shown is None else shown}}}
    if headers is not None:
        answer["headers"] = headers
    return {status_code: answer, **problem_responses(*problems, guarded=guarded)}


def written(model: type[BaseModel], *problems: int) -> dict[str, Any]:
    """Arguments that let OpenAPI describe a route whose answer is JSON text before FastAPI sees it."""
    return {"responses": responses(model, *problems), "response_model": model}


def shown_body(summary: str, value: object) -> Any:
    """Body of a request, described in OpenAPI by an example."""
    return Body(openapi_examples={"example": {"summary": summary, "value": value}})


def problem_responses(*problems: int, guarded: bool = True) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries of the problems a request may meet, those that any request may meet included."""
    statuses = sorted({*problems, *_ANYWHERE, *(_GUARDED if guarded else ())})
    return {status: {"description": _title(status)} for status in statuses}


def share_problems(description: dict[str, Any]) -> None:
    """Describe each problem once, in the components of an OpenAPI description, and refer to it from its operations."""
    components = description["components"]
    components["schemas"]["Problem"] = Problem.model_json_schema()
    shared = components["responses"] = {}
    answers = (route["responses"] for routes in description["paths"].values() for route in routes.values())
    for found in answers:
        for status in [int(text) for text in found if int(text) >= HTTPStatus.BAD_REQUEST]:
            title = _title(status)
            name = title.replace(" ", "")
            found[str(status)] = {"$ref": f"#/components/responses/{name}"}
            shown = {**example(Problem), "title": title, "status": status}
            if status in _DETAILS:
                shown["detail"] = _DETAILS[status]
            content = {_PROBLEM: {"schema": {"$ref": "#/components/schemas/Problem"}, "example": shown}}
            headers = {"headers": _HEADERS[status]} if status in _HEADERS else {}
            shared[name] = {"description": title, "content": content, **headers}


def _title(status: int) -> str:
    return _TITLES.get(status, HTTPStatus(status).phrase)


def problem_answer(request: Request, status: int, detail: str, more: dict[str, Any] | None = None) -> JSONResponse:
    """Answer with a problem; `more` are fields beyond those of RFC 9457."""
    problem = Problem(title=_title(status), status=status, detail=detail, instance=request.url.path)
    return JSONResponse({**problem.model_dump(), **(more or {})}, status, media_type=_PROBLEM)


def add_problems(app: FastAPI) -> None:
    """Answer every error with problem details."""

    @app.exception_handler(StarletteHTTPException)
    async def on_http(request: Request, error: StarletteHTTPException) -> JSONResponse:
        detail, headers = str(error.detail), dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = ", ".join(_methods(request))
            detail = (
                f"{request.url.path[:_LONGEST_PATH]} takes {headers['Allow']}, not {request.method[:_LONGEST_PATH]}"
            )
        elif error.status_code == HTTPStatus.NOT_FOUND and "endpoint" not in request.scope:
            near = _nearest(request)
            detail = f"there is nothing at {request.url.path[:_LONGEST_PATH]}"
            detail += f"; did you mean {near}?" if near else "; all of it is listed in /docs and /openapi.json"
        response = problem_answer(request, error.status_code, detail)
        response.headers.update(headers)
        return response

    @app.exception_handler(RequestValidationError)
    async def on_invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        faults = [{"field": _field(fault["loc"]), "message": masked(plainly(fault))} for fault in error.errors()]
        detail = "; ".join(f"{fault['field']}: {fault['message']}" for fault in faults)
        return problem_answer(request, 422, detail, {"errors": faults})

    @app.exception_handler(StoreError)
    async def on_history(request: Request, error: StoreError) -> JSONResponse:
        return problem_answer(request, 503, f"the history cannot be used: {error}")

    app.add_middleware(_LastResort)


def _methods(request: Request) -> list[str]:
    """Methods of all routes at the path of a request that no route takes."""
    contexts = list(iter_route_contexts(request.app.routes))
    path = next(one.path_format for one in contexts if one.endpoint == request.scope["endpoint"])
    return sorted({method for one in contexts if one.path_format == path for method in one.methods or ()})


def _nearest(request: Request) -> str | None:
    """Path that was perhaps meant: with as many similar parts, ``/api/v1`` left out or not; None if there is none."""
    asked = request.url.path.strip("/").split("/")
    best, found = _LIKENESS, None
    for context in iter_route_contexts(request.app.routes):
        whole = (context.path_format or "").strip("/").split("/")
        for beginning in {0, len(_BEGINNING)} if whole[: len(_BEGINNING)] == _BEGINNING else {0}:
            if len(whole) - beginning != len(asked) or max(map(len, asked)) > _LONGEST_PATH:
                continue
            pairs = list(zip(whole[beginning:], asked, strict=True))
            like = min(1.0 if one[:1] == "{" else SequenceMatcher(None, one, other).ratio() for one, other in pairs)
            if like > best:
                parts = [other if one[:1] == "{" else one for one, other in pairs]
                best, found = like, "/" + "/".join(whole[:beginning] + parts)
    return found


def _field(place: tuple[str | int, ...]) -> str:
    """Innermost field name in the place of a fault, where numbers count the values of a field."""
    return next(part for part in reversed(place) if isinstance(part, str))


class _LastResort:
    """Answers requests that ended in an error that nobody handled.

    A handler for Exception would, after answering, pass the error on to the server, which then drops the connection.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun = False

        async def watched(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self._app(scope, receive, watched)
        except Exception:  # an error of any kind behind any path must be a 500 that reveals nothing of the inside
            request = Request(scope, receive)
            _log.exception("request failed", path=request.url.path)
            if begun:
                raise
            await problem_answer(request, 500, "an error inside the service; its log says more")(scope, receive, send)
