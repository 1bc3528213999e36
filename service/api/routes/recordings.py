"""Recordings over HTTP: list, describe, download."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Query, Request
from fastapi.responses import FileResponse
from starlette.types import Message, Receive, Scope, Send

from models.errors import RecordingError
from models.signals.recording import summarize_recording
from rotorwatch.records.recordings import RecordingDetail, RecordingList
from service.access.guard import Guard
from service.access.problems import problem_answer, problem_responses, responses
from service.recordings.catalogue import Catalogue, Recording
from service.recordings.replay.source import DataSpan, RecordingSource

_PLACE = "/api/v1/recordings"
_NO_RANGE = {400: "Range: not understood, expected bytes=from-to", 416: "Range: the file is shorter than that"}
_NONE = "no recordings: the settings name no directory for them ([recording] directory)"


_Site = Annotated[str | None, Query(description="only of this site")]
_Machine = Annotated[str | None, Query(description="only of this machine, its name or site/machine")]
_SinceNs = Annotated[int | None, Query(ge=0, description="only those that reach this time, ns since 1970-01-01 UTC")]
_UntilNs = Annotated[int | None, Query(ge=0, description="only those that begin before this time")]
_Latest = Annotated[int | None, Query(ge=1, le=10_000, description="at most this many of each machine, the latest")]
_DataTimes = Annotated[
    bool, Query(description="also give the times of the data; for this, each recording must be opened the first time")
]


def add_recording_routes(
    app: FastAPI, index: Catalogue | None, guard: Guard, monitored: Callable[[], Sequence[str]]
) -> None:
    """Add the routes; without an index they answer with a problem that names the setting.

    `monitored` lists machines as site/machine that are known even if they have no recordings yet.
    """
    common: dict[str, Any] = {"tags": ["recordings"], "dependencies": [guard.read]}

    @app.get(_PLACE, responses=responses(RecordingList, 404, 422), **common)
    def recordings(
        site: _Site = None,
        machine: _Machine = None,
        since_ns: _SinceNs = None,
        until_ns: _UntilNs = None,
        latest: _Latest = None,
        data_times: _DataTimes = False,
    ) -> RecordingList:
        """Recordings, by site, machine and time."""
        asked = "" if machine is None else machine if site is None else f"{site}/{machine}"
        if machine is not None and site is None and "/" in machine:
            site, machine = machine.split("/", 1)
        listed = _present(index).recordings(site, machine)
        if machine is not None and not listed:
            there = monitored()
            if not any(one.endswith(f"/{machine}") if site is None else one == f"{site}/{machine}" for one in there):
                raise HTTPException(
                    404,
                    f"no machine {asked[:128]!r} has recordings, and of those monitored none has that name: "
                    f"{', '.join(there)}",
                )
        chosen = [
            one
            for one in listed
            if (since_ns is None or one.end_ns >= since_ns) and (until_ns is None or one.start_ns < until_ns)
        ]
        if latest is not None:
            places = groupby(chosen, attrgetter("site", "machine"))
            chosen = [one for _, group in places for one in list(group)[-latest:]]
        return RecordingList(recordings=tuple(map(_with_data_times, chosen) if data_times else chosen))

    @app.get(f"{_PLACE}/{{site}}/{{machine}}/{{name}}", responses=responses(RecordingDetail, 404, 422), **common)
    def recording(site: str, machine: str, name: str) -> RecordingDetail:
        """One recording, with the keys in it."""
        found = found_recording(index, f"{site}/{machine}/{name}")
        readable = found.complete and not found.problem
        keys = summarize_recording(found.path).messages if readable else {}
        return RecordingDetail.model_validate({**dict(_with_data_times(found)), "keys": keys})

    @app.get(
        f"{_PLACE}/{{site}}/{{machine}}/{{name}}/download",
        **common,
        response_class=FileResponse,
        responses={
            200: {"content": {"application/octet-stream": {}}},
            206: {"description": "The requested ranges", "content": {"application/octet-stream": {}}},
            **problem_responses(400, 404, 409, 416, 422),
        },
    )
    def download_recording(site: str, machine: str, name: str) -> FileResponse:
        """Download the file, or ranges of it."""
        found = found_recording(index, f"{site}/{machine}/{name}")
        if not found.complete:
            raise HTTPException(409, f"{found.id} is incomplete: it is being written, or was left by a crash")
        return _RecordingFile(found.path, media_type="application/octet-stream", filename=found.path.name)


def _with_data_times(recording: Recording) -> Recording:
    if not recording.messages or recording.problem:
        return recording
    span = _data_span(recording.path, recording.size_bytes)
    if span is None:
        return recording
    return recording.model_copy(update={"data_start_ns": span.start_ns, "data_end_ns": span.end_ns})


@lru_cache(maxsize=10_000)  # the size is part of the key, because a file may still grow
def _data_span(path: Path, _size_bytes: int) -> DataSpan | None:
    """Time span of the data in a file, cached while its size stays the same; None if the file is damaged or gone."""
    try:
        return RecordingSource([path]).span()
    except RecordingError:
        return None


class _RecordingFile(FileResponse):
    """A file or a range of it; an invalid range is answered with problem details."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        refused: int | None = None

        async def watched(message: Message) -> None:
            nonlocal refused
            if message["type"] == "http.response.start" and message["status"] in _NO_RANGE:
                refused = message["status"]
            if refused is None:
                await send(message)

        await super().__call__(scope, receive, watched)
        if refused is not None:
            await problem_answer(Request(scope), refused, _NO_RANGE[refused])(scope, receive, send)


def found_recording(index: Catalogue | None, recording_id: str) -> Recording:
    """Find a recording; HTTPException 404 if there is none, or no directory for recordings is set."""
    found = _present(index).find(recording_id)
    if found is None:
        raise HTTPException(404, f"no recording {recording_id}")
    return found


def _present(index: Catalogue | None) -> Catalogue:
    if index is None:
        raise HTTPException(404, _NONE)
    return index
