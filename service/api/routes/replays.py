"""Replays over HTTP: start, watch, control and stop them, and read their results."""

import asyncio
import re
import secrets
import time
from collections.abc import AsyncIterator, Callable, Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, FastAPI, HTTPException, Query
from fastapi.responses import StreamingResponse

from models.commissioning.commissioned import FILE as COMMISSIONED
from models.commissioning.commissioned import Installed
from models.errors import MachineFileError, RotorwatchError
from models.machine import load_machine_file
from models.mistakes import changed, form
from models.signals.keys import MachineKeys
from models.signals.link import LinkSettings, is_loopback
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.example import example
from rotorwatch.records.fields import Record
from rotorwatch.records.health import Report
from rotorwatch.records.replays import (
    TOML_NAME,
    ReplayAlarmList,
    ReplayJob,
    ReplayList,
    ReplayReportList,
    ReplayRequest,
    ReplaySeek,
)
from service.access.guard import Guard
from service.access.problems import problem_responses, responses, shown_body
from service.api.routes.recordings import found_recording
from service.recordings.catalogue import Catalogue
from service.recordings.replay.jobs import REPLAYS, JobPlan, ReplayJobError, ReplayJobs, RunningJob, TooManyReplaysError
from service.recordings.replay.offline import check_sent, choose_machine, is_shipped_bundle, is_shipped_machine
from service.settings.service import MachineEntry, ServiceSettings

_PLACE = "/api/v1/replays"
form(TOML_NAME, "a file name that ends in .toml")
_JOB = f"{_PLACE}/{{replay_id}}"
_END = re.compile(r'"end_ns":(\d+)')
_SAME_NS = 1000
"""Tolerance for times from JavaScript, whose numbers resolve present times to 256 ns."""
_LOOK_S = 0.25
_QUIET_S = 15.0
_UNSPECIFIED = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}  # noqa: S104  # addresses to connect to; nothing listens on them


class NoOrder(Record):
    """An empty object; sending it as JSON shows that the request is not from another site's page."""


class ReplayRequests:
    """Turns requests for replays of recordings in the index (if any) into jobs."""

    def __init__(self, settings: ServiceSettings, index: Catalogue | None) -> None:
        self._settings = settings
        self._index = index
        plan = settings.replay
        folder = None if index is None else index.directory / REPLAYS
        self.jobs = ReplayJobs(folder, limit=plan.jobs, nice=plan.nice, kept=plan.kept)

    @property
    def enabled(self) -> bool:
        """Whether replays may be started."""
        wish = self._settings.replay.enabled
        return is_loopback(self._settings.http.host) if wish is None else wish

    def start(self, request: ReplayRequest) -> ReplayJob:
        """Start a replay; HTTPException if the request is invalid or cannot be fulfilled."""
        recordings = [found_recording(self._index, name) for name in request.recordings]
        for recording in recordings:
            if not recording.complete or recording.problem:
                raise HTTPException(
                    409, f"{recording.id} cannot be replayed: {recording.problem or 'it is incomplete'}"
                )
        machines = sorted({f"{recording.site}/{recording.machine}" for recording in recordings})
        if len(machines) != 1:
            raise HTTPException(422, f"recordings: of several machines ({', '.join(machines)}), expected one")
        if request.from_ns is not None and request.to_ns is not None and request.from_ns >= request.to_ns:
            raise HTTPException(422, f"to_ns: {request.to_ns} is not later than from_ns, {request.from_ns}")
        offline = request.mode == "offline"
        link = self._settings.link
        if not offline and (link.grants or link.tls or link.user or link.passwords_file):  # it could not connect
            raise HTTPException(
                409,
                "mode: a paced replay needs a network without grants, passwords and certificates; expected "
                "offline, or rotorwatch replay on a separate network",
            )
        sent = request.machine_file is not None
        machine = self._machine(request, machines[0]) if offline and not sent else None
        bundle = self._beside_sent(request, machines[0])
        _check_changes(request, machine)
        job = ReplayJob(
            id=(job_id := secrets.token_hex(6)),
            state="running",
            mode=request.mode,
            recordings=request.recordings,
            machine="@".join(filter(None, (request.machine_file_name, request.bundle))) if sent else machine,
            machine_file_sent=sent,
            changes=request.changes,
            from_ns=request.from_ns,
            to_ns=request.to_ns,
            pace=None if offline else request.pace,
            prefix="" if offline else f"replay/{job_id}",
            started_ns=time.time_ns(),
            progress=None,
            summary=None,
            error="",
        )
        arguments = [str(recording.path.resolve()) for recording in recordings]
        arguments += ["--key", machines[0]]
        for option, time_ns in (("--from", request.from_ns), ("--to", request.to_ns)):
            arguments += [] if time_ns is None else [option, f"{time_ns}ns"]
        if offline:
            arguments += ["--offline", *(["--machine", machine] if machine else [])]
            arguments += [f"--set={line}" for line in request.changes]
        else:
            arguments += ["--pace", f"{request.pace:g}", "--prefix", job.prefix]
            arguments += [part for end in _endpoints(link) for part in ("--connect", end)]
        try:
            return self.jobs.start(JobPlan(job, tuple(arguments), request.machine_file or "", bundle))
        except TooManyReplaysError as error:
            raise HTTPException(429, str(error)) from error
        except ReplayJobError as error:
            raise HTTPException(503, str(error)) from error

    def found(self, replay_id: str) -> RunningJob:
        """One replay; raises HTTPException 404 if there is none."""
        found = self.jobs.find(replay_id)
        if found is None:
            kept = self._settings.replay.kept
            raise HTTPException(404, f"no replay {replay_id}; the latest {kept} are kept, until the service stops")
        return found

    def _machine(self, request: ReplayRequest, recorded: str) -> str | None:
        """Machine as FILE or FILE@BUNDLE; None if it is to be chosen by the recorded name."""
        monitored = self._monitored
        name, bundle = request.machine, request.bundle
        if name is None:
            if bundle is not None:
                raise HTTPException(422, "bundle: needs machine or machine_file beside it")
            entry = monitored.get(recorded)
            return None if entry is None else _spec(entry.file, entry.bundle)
        if bundle is not None and not is_shipped_bundle(bundle):
            raise HTTPException(422, f"bundle: {bundle!r} is not the name of shipped networks")
        if is_shipped_machine(name):
            return _spec(name, bundle)
        if name in monitored:
            return _spec(monitored[name].file, bundle or monitored[name].bundle)
        raise HTTPException(
            422, f"machine: {name!r} is neither shipped nor monitored; monitored are {', '.join(monitored)}"
        )

    def _beside_sent(self, request: ReplayRequest, recorded: str) -> str | None:
        """Bundle for a machine file sent with the request: shipped networks by name, or the commissioned bundle."""
        if request.machine_file is None:
            return None
        if request.mode != "offline":
            raise HTTPException(422, "machine_file: nothing is evaluated in a paced replay")
        if request.machine is not None:
            raise HTTPException(422, "machine_file: is given beside machine, expected one of them")
        try:
            check_sent(request.machine_file, "\n".join(request.changes), recorded)
        except MachineFileError as error:
            raise HTTPException(422, str(error)) from error
        if request.bundle is not None:
            if not is_shipped_bundle(request.bundle):
                raise HTTPException(422, f"bundle: {request.bundle!r} is not the name of shipped networks")
            return request.bundle
        entry = self._monitored.get(recorded)
        bundle = None if entry is None or entry.bundle is None else Path(entry.bundle)
        return None if bundle is None or not (bundle / COMMISSIONED).is_file() else str(bundle.resolve())

    @cached_property
    def _monitored(self) -> dict[str, MachineEntry]:
        return {entry.load().title: entry for entry in self._settings.machines}


def installed_for(replay: RunningJob) -> Installed:
    """Machine file and bundle of an offline replay; HTTPException 404 if they cannot be read any more."""
    job = replay.view
    keys = MachineKeys(*job.recordings[0].split("/")[:2])
    try:
        return choose_machine(keys, replay.machine_file or job.machine, "\n".join(job.changes))
    except RotorwatchError as error:  # its text has the file's path, which must not be shown over HTTP
        raise HTTPException(404, f"what replay {job.id} was evaluated with can no longer be read") from error


def replayed_report(replay: RunningJob, end_ns: int) -> Report | None:
    """Report of an offline replay on the window that ends at `end_ns`, which may be rounded to a microsecond."""
    for message in _messages(replay, "/report"):
        end = _END.search(message)
        if end is not None and abs(int(end[1]) - end_ns) < _SAME_NS:
            return Report.model_validate_json(message)
    return None


def _check_changes(request: ReplayRequest, machine: str | None) -> None:
    """Check changes before the replay starts; if only the recording names the machine, the replay checks them fully."""
    if request.changes and request.mode != "offline":
        raise HTTPException(422, "changes: nothing is evaluated in a paced replay")
    changes = "\n".join(request.changes)
    try:
        if request.changes and machine is not None:
            load_machine_file(machine.partition("@")[0], changes)
        else:
            changed({}, changes)
    except MachineFileError as error:
        # The path of the file must not be shown over HTTP.
        raise HTTPException(422, re.sub(r"(?m)^[^:\n]*\.toml: ", "changes: ", str(error))) from error


def add_replay_routes(app: FastAPI, desk: ReplayRequests, guard: Guard) -> None:
    """Add the routes."""
    _add_reading_routes(app, desk, guard)
    _add_changing_routes(app, desk, guard)


NothingToSay = Annotated[NoOrder, shown_body("nothing to say", {})]
_Offset = Annotated[int, Query(ge=0, description="leave out this many, the oldest")]
_Every = Annotated[int, Query(ge=1, le=100_000, description="of the rest, only every n-th, for a plot")]
_Limit = Annotated[int, Query(ge=1, le=1000, description="at most this many")]


def _add_reading_routes(app: FastAPI, desk: ReplayRequests, guard: Guard) -> None:
    common: dict[str, Any] = {"tags": ["replays"], "dependencies": [guard.read]}

    @app.get(_PLACE, responses=responses(ReplayList), **common)
    def replays() -> ReplayList:
        """Replays since the service started, the latest first."""
        return ReplayList(replays=desk.jobs.jobs())

    @app.get(_JOB, responses=responses(ReplayJob, 404, 422), **common)
    def replay(replay_id: str) -> ReplayJob:
        """Progress of a replay, and at the end its results."""
        return desk.found(replay_id).view

    @app.get(f"{_JOB}/reports", responses=responses(ReplayReportList, 404, 422), **common)
    def replay_reports(replay_id: str, offset: _Offset = 0, limit: _Limit = 100, every: _Every = 1) -> ReplayReportList:
        """Window reports of an offline replay; they are not in the history of the live machine."""
        found, following = _results(desk, replay_id, "/report", offset, limit, every)
        return ReplayReportList(reports=tuple(Report.model_validate_json(one) for one in found), next_offset=following)

    @app.get(f"{_JOB}/alarms", responses=responses(ReplayAlarmList, 404, 422), **common)
    def replay_alarms(replay_id: str, offset: _Offset = 0, limit: _Limit = 100) -> ReplayAlarmList:
        """Alarm events of an offline replay; they are not sent to anybody else."""
        found, following = _results(desk, replay_id, "/alarm/event", offset, limit)
        events = tuple(AlarmCloudEvent.model_validate_json(one) for one in found)
        return ReplayAlarmList(events=events, next_offset=following)

    @app.get(
        f"{_JOB}/events",
        tags=["replays"],
        dependencies=[guard.stream],
        response_class=StreamingResponse,
        responses={200: {"content": {"text/event-stream": {}}}, **problem_responses(404, 422)},
    )
    def replay_events(replay_id: str) -> StreamingResponse:
        """Progress as server-sent events until the end: `progress`, then `end`, each with the replay as data."""
        desk.found(replay_id)
        return StreamingResponse(
            _events(lambda: desk.found(replay_id).view),
            media_type="text/event-stream",
            headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
        )


def _add_changing_routes(app: FastAPI, desk: ReplayRequests, guard: Guard) -> None:
    def enabled() -> None:
        if not desk.enabled:
            raise HTTPException(403, "replays over HTTP are disabled in the settings ([replay] enabled)")

    common: dict[str, Any] = {"tags": ["replays"], "dependencies": [guard.operate, Depends(enabled)]}
    problems = (400, 404, 413, 415, 422)

    @app.post(_PLACE, status_code=201, responses=responses(ReplayJob, *problems, 409, status_code=201), **common)
    def start_replay(
        request: Annotated[ReplayRequest, shown_body("an hour of yesterday", example(ReplayRequest))],
    ) -> ReplayJob:
        """Start a replay, in a process of its own."""
        return desk.start(request)

    @app.delete(_JOB, responses=responses(ReplayJob, 404, 422), **common)
    def stop_replay(replay_id: str) -> ReplayJob:
        """Stop a replay; its results so far are kept."""
        found = desk.found(replay_id)
        found.end()
        return found.view

    @app.post(f"{_JOB}/pause", responses=responses(ReplayJob, *problems, 409), **common)
    def pause_replay(replay_id: str, order: NothingToSay) -> ReplayJob:
        """Pause a paced replay."""
        _ = order
        return _order(desk, replay_id, "pause")

    @app.post(f"{_JOB}/resume", responses=responses(ReplayJob, *problems, 409), **common)
    def resume_replay(replay_id: str, order: NothingToSay) -> ReplayJob:
        """Resume a paused replay."""
        _ = order
        return _order(desk, replay_id, "resume")

    @app.post(f"{_JOB}/seek", responses=responses(ReplayJob, *problems, 409), **common)
    def seek_in_replay(
        replay_id: str, place: Annotated[ReplaySeek, shown_body("to a time", example(ReplaySeek))]
    ) -> ReplayJob:
        """Continue a paced replay from another position; a monitor ignores data that it has already received."""
        return _order(desk, replay_id, f"seek {place.to_ns if place.by_s is None else f'{place.by_s:+f}'}")


def _order(desk: ReplayRequests, replay_id: str, order: str) -> ReplayJob:
    found = desk.found(replay_id)
    if found.view.mode != "paced":
        raise HTTPException(409, "an offline replay has no pace: only paced replays can be paused or moved")
    if not found.running:
        raise HTTPException(409, f"the replay has ended: {found.view.state}")
    found.order(order)
    return found.view


def _results(
    desk: ReplayRequests, replay_id: str, topic: str, offset: int, limit: int, every: int = 1
) -> tuple[list[str], int | None]:
    """Messages of one topic, and the offset of the next page, or None at the end."""
    job = desk.found(replay_id)
    if job.view.mode != "offline":
        raise HTTPException(404, "a paced replay only publishes: ask the monitor in its namespace what it found")
    chosen = islice(enumerate(_messages(job, topic)), offset, None, every)
    found = [message for _, message in islice(chosen, limit)]
    return found, next((number for number, _ in chosen), None)


def _messages(job: RunningJob, topic: str) -> Iterator[str]:
    if not job.results.exists():
        return
    with job.results.open(encoding="utf-8") as lines:
        for line in lines:
            if not line.endswith("\n"):  # still being written
                return
            head, _, message = line.partition('", "message": ')  # format of `result_lines`
            if head.endswith(topic):
                yield message.rstrip("\n")[:-1]


async def _events(look: Callable[[], ReplayJob]) -> AsyncIterator[str]:
    said: ReplayJob | None = None
    quiet_s = 0.0
    while True:
        try:
            job = look()
        except HTTPException:  # its results were removed to make room
            return
        ended = job.state not in ("running", "paused")
        if job != said:
            yield f"event: {'end' if ended else 'progress'}\ndata: {job.model_dump_json()}\n\n"
            said, quiet_s = job, 0.0
        elif quiet_s >= _QUIET_S:
            yield ": still there\n\n"
            quiet_s = 0.0
        if ended:
            return
        await asyncio.sleep(_LOOK_S)
        quiet_s += _LOOK_S


def _spec(file: str, bundle: str | None) -> str:
    """Value for ``--machine``, with absolute paths."""
    file = str(Path(file).resolve()) if file.endswith(".toml") else file
    return file if bundle is None else f"{file}@{Path(bundle).resolve() if Path(bundle).is_dir() else bundle}"


def _endpoints(link: LinkSettings) -> tuple[str, ...]:
    """Endpoints at which a client on this computer reaches the service's network."""
    found = []
    for end in link.listen:
        for unspecified, here in _UNSPECIFIED.items():
            end = end.replace(f"/{unspecified}:", f"/{here}:")  # noqa: PLW2901  # the same endpoint via loopback
        found.append(end)
    return tuple(found[:1]) or link.connect
