"""Server-sent events of all machines: alarm events, and changes of health."""

from collections.abc import Mapping
from typing import Annotated, Literal

from fastapi import FastAPI, Header, HTTPException, Query
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from models.errors import RotorwatchError
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.example import example
from rotorwatch.records.health import Health
from service.access.guard import Guard
from service.access.problems import problem_responses
from service.access.scopes import Caller
from service.api.views import ServiceView, found_machine
from service.delivery.event_feed import CURSOR_PATTERN, Cursor, CursorError, cursor_text, parsed_cursor
from service.history.machine import MachineStore

_LONGEST = 20_000
_FORM = {"pattern": CURSOR_PATTERN}  # for the description only; the check in `_cursor` has a clearer message

_Machines = Annotated[
    list[str],
    Query(alias="machine", max_length=1000, description="only of this machine, as site/machine; may be repeated"),
]
_LastEventId = Annotated[
    str | None,
    Header(
        alias="Last-Event-ID",
        max_length=_LONGEST,
        json_schema_extra=_FORM,
        description="`id` of the last event received; the stream continues after it",
    ),
]
_LastEventIdArgument = Annotated[
    str | None,
    Query(
        max_length=_LONGEST,
        json_schema_extra=_FORM,
        description="the same for clients that cannot send the header; if both are given, the header counts",
    ),
]
_From = Annotated[
    Literal["now", "beginning"], Query(alias="from", description="where to begin if no last event is given")
]
_Detail = Annotated[
    Literal["whole", "overview"],
    Query(description="send health in full, or as event `overview` only what an overview of many machines needs"),
]
_InFull = Annotated[
    list[str],
    Query(max_length=64, description="with `overview`, this machine in full, as site/machine; may be repeated"),
]


def add_event_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    """Add the route."""
    event = AlarmCloudEvent.model_validate(example(AlarmCloudEvent))
    stream = (
        "retry: 2000\nid: demo/lab=-1\nevent: start\ndata: {}\n\n"
        f"id: demo/lab=0\nevent: alarm\ndata: {event.model_dump_json()}\n\n"
    )

    @app.get(
        "/api/v1/events",
        tags=["events"],
        response_class=StreamingResponse,
        responses={
            200: {"content": {"text/event-stream": {"schema": {"type": "string"}, "example": stream}}},
            **problem_responses(404, 409, 422),
        },
    )
    async def events(
        caller: Annotated[Caller, guard.stream],
        machine: _Machines = [],  # noqa: B006  # never changed
        last_event_id: _LastEventIdArgument = None,
        header: _LastEventId = None,
        from_: _From = "now",
        detail: _Detail = "whole",
        in_full: _InFull = [],  # noqa: B006
    ) -> StreamingResponse:
        """Alarm events from the history, each once and in the order of its machine's log, and changes of health."""
        if service.feed.closed:
            raise HTTPException(503, "the service is being stopped")
        there = {one.machine.title: one.history for one in service.machines()}
        if unknown := [place for place in machine if place not in there]:
            raise HTTPException(404, f"no machine {unknown[0][:129]}; there are: {', '.join(there)}")
        logs = {place: log for place, log in there.items() if place in machine or not machine}
        cursor = _cursor(logs, (header or "", last_event_id or ""), from_)

        async def admitted() -> bool:
            try:
                return await run_in_threadpool(guard.still_valid, caller)
            except RotorwatchError:  # the database fails: meanwhile only health can be sent
                return True

        def health(place: str) -> Health:
            return found_machine(service, *place.split("/")).health()

        return StreamingResponse(
            service.feed.follow(logs, cursor, admitted, health, None if detail == "whole" else frozenset(in_full)),
            media_type="text/event-stream",
            headers={"X-Accel-Buffering": "no"},
        )


def _cursor(logs: Mapping[str, MachineStore], texts: tuple[str, ...], begin: str) -> Cursor:
    """Where to begin in each log: after the first cursor in `texts`; a machine missing from it is sent from the start.

    All non-empty texts must be valid cursors, but only the first counts.
    """
    try:
        given = [parsed_cursor(text) for text in texts if text]
    except CursorError as error:
        raise HTTPException(422, f"Last-Event-ID: {error}") from error
    if not given:
        return {place: log.last_sequence if begin == "now" else -1 for place, log in logs.items()}
    heard = given[0]
    for place, log in logs.items():
        if heard.get(place, -1) > log.last_sequence:
            raise HTTPException(
                409,
                f"Last-Event-ID: {cursor_text({place: heard[place]})}, but the log of {place} ends at "
                f"{log.last_sequence}: it is another one than you followed",
            )
    return {place: heard.get(place, -1) for place in logs}
