"""The HTTP API over what the service knows; ``docs/api.md`` lists the routes."""

from collections.abc import Sequence
from typing import Annotated, Protocol

from fastapi import FastAPI, HTTPException, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse
from pydantic import BaseModel, ConfigDict, Field

from service.access.guard import Guard
from service.page import front_page
from service.problems import add_problems, problem_answer, responses
from service.recordings_api import RecordingIndex, add_recording_routes
from service.replays_api import ReplayDesk, add_replay_routes
from service.schemas import (
    AlarmCloudEvent,
    AlarmStates,
    DetectableChanges,
    Health,
    MachineDescription,
    Readiness,
    Report,
)
from service.store.machine import MachineStore

__all__ = ["AlarmEventList", "Alive", "MachineList", "MachineView", "ReportList", "ServiceView", "create_app"]

_JSON = ConfigDict(extra="forbid", frozen=True)
_CURSOR = "pass it as until_ns to get what is older; null if nothing older is kept"


class MachineView(Protocol):
    """What the API needs to know about one machine."""

    def description(self) -> MachineDescription:
        """Identity, stream, keys, and the present state."""

    def health(self) -> Health:
        """Where the machine stands now."""

    def alarms(self, *, include_normal: bool = False) -> AlarmStates:
        """Return the alarms as they are now."""

    def detectable(self, change: float | None) -> DetectableChanges:
        """Return what would be found on the machine as it runs now."""

    @property
    def history(self) -> MachineStore:
        """What is kept of the machine."""


class ServiceView(Protocol):
    """What the API needs to know about the service."""

    def machines(self) -> Sequence[MachineView]:
        """Every monitored machine."""

    def machine(self, site: str, name: str) -> MachineView | None:
        """One machine, or None if it is not monitored."""

    def readiness(self) -> Readiness:
        """Whether the service can do its work."""

    @property
    def catalogue(self) -> RecordingIndex | None:
        """Recordings, or None if no directory for them is set."""

    @property
    def replays(self) -> ReplayDesk:
        """Where replays are started."""


class MachineList(BaseModel):
    """Every monitored machine."""

    model_config = _JSON

    machines: tuple[MachineDescription, ...] = Field(description="in the order of the settings")


class ReportList(BaseModel):
    """Window reports, newest first."""

    model_config = _JSON

    reports: tuple[Report, ...] = Field(description="newest first")
    next_until_ns: int | None = Field(description=_CURSOR, examples=[1767225805000000000])


class AlarmEventList(BaseModel):
    """Alarm events, newest first."""

    model_config = _JSON

    events: tuple[AlarmCloudEvent, ...] = Field(description="newest first")
    next_until_ns: int | None = Field(description=_CURSOR, examples=[1767225805000000000])


class Alive(BaseModel):
    """The process answers."""

    model_config = _JSON

    alive: bool = Field(description="always true", examples=[True])


_SinceNs = Annotated[int | None, Query(ge=0, description="from this time on, ns since 1970-01-01 UTC")]
_UntilNs = Annotated[int | None, Query(ge=0, description="before this time, ns since 1970-01-01 UTC")]
_Change = Annotated[
    float | None, Query(gt=-1, le=10, description="relative change to be found, -0.05 for a loss of 5 %")
]
_Limit = Annotated[int, Query(ge=1, le=1000, description="at most this many, the newest")]


def create_app(service: ServiceView, guard: Guard) -> FastAPI:
    """Build the application.

    Parameters
    ----------
    service : ServiceView
        Where the answers come from; called from the server's worker threads.
    guard : Guard
        Who may call what.
    """
    app = FastAPI(
        title="rotorwatch",
        description="Health of rotating machines: which parameter changed, by how much, how sure. "
        "Errors are problem details (RFC 9457).",
        dependencies=[guard.gate],
        openapi_url=None,  # the guard serves it
        docs_url=None,  # the usual pages load their scripts from elsewhere
        redoc_url=None,
    )
    add_problems(app)
    _add_machine_routes(app, service, guard)
    _add_history_routes(app, service, guard)
    add_recording_routes(app, service.catalogue, guard)
    add_replay_routes(app, service.replays, guard)
    _add_service_routes(app, service, guard)
    guard.protect(app)
    return app


def _add_machine_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    @app.get("/api/v1/machines", tags=["machines"], dependencies=[guard.read], responses=responses(MachineList))
    def machines() -> MachineList:
        """Every monitored machine with its state."""
        return MachineList(machines=tuple(machine.description() for machine in service.machines()))

    @app.get(
        "/api/v1/machines/{site}/{machine}",
        tags=["machines"],
        dependencies=[guard.read],
        responses=responses(MachineDescription, 404, 422),
    )
    def machine(site: str, machine: str) -> MachineDescription:
        """One machine: stream, channels, keys, state."""
        return _find(service, site, machine).description()

    @app.get(
        "/api/v1/machines/{site}/{machine}/health",
        tags=["machines"],
        dependencies=[guard.read],
        responses=responses(Health, 404, 422),
    )
    def health(site: str, machine: str) -> Health:
        """Where a machine stands: state, parameters with intervals, equations, alarms, quality of the data."""
        return _find(service, site, machine).health()

    @app.get(
        "/api/v1/machines/{site}/{machine}/alarms",
        tags=["machines"],
        dependencies=[guard.read],
        responses=responses(AlarmStates, 404, 422),
    )
    def alarms(
        site: str,
        machine: str,
        all_: Annotated[bool, Query(alias="all", description="normal ones as well")] = False,
    ) -> AlarmStates:
        """Alarms that are pending, active or clearing."""
        return _find(service, site, machine).alarms(include_normal=all_)

    @app.get(
        "/api/v1/machines/{site}/{machine}/detectable",
        tags=["machines"],
        dependencies=[guard.read],
        responses=responses(DetectableChanges, 404, 422),
    )
    def detectable(site: str, machine: str, change: _Change = None) -> DetectableChanges:
        """Smallest changes that would be found in a window as the machine runs now, and the data a wished one takes."""
        return _find(service, site, machine).detectable(change or None)


def _add_history_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    @app.get(
        "/api/v1/machines/{site}/{machine}/reports",
        tags=["history"],
        dependencies=[guard.read],
        responses=responses(ReportList, 404, 422),
    )
    def reports(
        site: str, machine: str, since_ns: _SinceNs = None, until_ns: _UntilNs = None, limit: _Limit = 100
    ) -> ReportList:
        """Window reports by the time of the window's end, newest first: the history of residuals."""
        history = _find(service, site, machine).history
        stored = history.reports(since_ns=since_ns, until_ns=until_ns, limit=limit)
        found = tuple(Report.model_validate_json(one.text) for _, one in stored)
        return ReportList(reports=found, next_until_ns=found[-1].end_ns if len(found) == limit else None)

    @app.get(
        "/api/v1/machines/{site}/{machine}/alarms/events",
        tags=["history"],
        dependencies=[guard.read],
        responses=responses(AlarmEventList, 404, 422),
    )
    def alarm_events(
        site: str, machine: str, since_ns: _SinceNs = None, until_ns: _UntilNs = None, limit: _Limit = 100
    ) -> AlarmEventList:
        """Raised, escalated and cleared alarms by their time, newest first, as CloudEvents."""
        history = _find(service, site, machine).history
        stored = history.events(since_ns=since_ns, until_ns=until_ns, limit=limit, newest_first=True)
        found = tuple(AlarmCloudEvent.model_validate_json(one.text) for one in stored)
        return AlarmEventList(events=found, next_until_ns=found[-1].data.time_ns if len(found) == limit else None)


def _add_service_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    @app.get("/healthz", tags=["service"], responses=responses(Alive))
    def healthz() -> Alive:
        """Whether the process answers."""
        return Alive(alive=True)

    @app.get(
        "/readyz",
        tags=["service"],
        dependencies=[guard.read],
        responses=responses(Readiness, 503),
        response_model=Readiness,
    )
    def readyz(request: Request) -> Readiness | JSONResponse:
        """Whether the session is open and every worker runs; a machine without data is listed, not counted."""
        readiness = service.readiness()
        if readiness.ready:
            return readiness
        return problem_answer(
            request, 503, "the session is closed or a worker has stopped", readiness.model_dump(mode="json")
        )

    @app.get("/", dependencies=[guard.read], include_in_schema=False, response_class=HTMLResponse)
    def page() -> str:
        """Serve a plain page for people."""
        return front_page(tuple(machine.health() for machine in service.machines()))


def _find(service: ServiceView, site: str, name: str) -> MachineView:
    machine = service.machine(site, name)
    if machine is None:
        known = ", ".join(f"{d.site}/{d.machine}" for d in (view.description() for view in service.machines()))
        raise HTTPException(404, f"no machine {site}/{name}; there are: {known}")
    return machine
