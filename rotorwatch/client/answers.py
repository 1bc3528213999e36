"""Converts the service's answers to models, and problems to exceptions."""

from typing import TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from rotorwatch.client.errors import AccessRefused, ClientError, Conflict, NotFound, RequestRefused, Unavailable
from rotorwatch.records.monitor import Problem

M = TypeVar("M", bound=BaseModel)

_KINDS: dict[int, type[RequestRefused]] = {
    401: AccessRefused,
    403: AccessRefused,
    404: NotFound,
    409: Conflict,
    412: Conflict,
    429: Unavailable,
    502: Unavailable,  # a proxy's answer while the service restarts, like 504
    503: Unavailable,
    504: Unavailable,
}
_SHOWN = 200


def refusal(answer: httpx.Response) -> RequestRefused:
    """Convert an error answer, whose body has been read, to an exception with the problem's text."""
    try:
        detail = Problem.model_validate_json(answer.content).detail
    except ValidationError:  # not from the service, but from a proxy for example
        detail = answer.text.strip()[:_SHOWN] or answer.reason_phrase
    text = f"{answer.request.method} {answer.request.url.path}: {detail}"
    return _KINDS.get(answer.status_code, RequestRefused)(answer.status_code, text)


def understood(model: type[M], text: str | bytes, place: str) -> M:
    """Parse JSON as a model; ClientError if it does not match, as when service and client have different versions."""
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        fault = error.errors()[0]
        if fault["type"] == "json_invalid":
            raise ClientError(f"{place}: the answer is not JSON; is this the address of a monitor?") from error
        field = ".".join(str(part) for part in fault["loc"])
        raise ClientError(
            f"{place}: the data received do not match this version; do versions differ? {field}: {fault['msg']}"
        ) from error
