"""The HTTP API of the service; ``docs/api.md`` lists the routes."""

from typing import Annotated, Any

from fastapi import Depends, FastAPI, Query, Request, Response
from fastapi.responses import JSONResponse, PlainTextResponse
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import AfterValidator, Field, WithJsonSchema

from models.machine import MachineFile, load_machine
from rotorwatch import __version__
from rotorwatch.records.example import example
from rotorwatch.records.health import Health
from rotorwatch.records.machines import DetectableChanges, MachineConfiguration, MachineDescription, MachineList
from rotorwatch.records.monitor import Alive, Readiness, SettingList, WebhookList
from service.access.guard import Guard
from service.access.problems import add_problems, problem_answer, problem_responses, responses
from service.api.description import DescribedApp, only_known_arguments
from service.api.routes.events import add_event_routes
from service.api.routes.history import add_history_routes
from service.api.routes.operations import add_operation_routes
from service.api.routes.page import add_docs_routes, add_page_routes
from service.api.routes.plots import add_plot_routes
from service.api.routes.recordings import add_recording_routes
from service.api.routes.replays import add_replay_routes
from service.api.routes.snapshots import add_snapshot_routes
from service.api.routes.tokens import add_session_routes, add_token_routes
from service.api.samples import SampleReader
from service.api.views import PLACE, InPath, ServiceView
from service.monitor.conversion import machine_description
from service.stream.monitored import Monitored, NoAnswerError

_DESCRIPTION = """Health of rotating machines: which parameter changed, by how much, how sure.

Every route listed here except `/healthz` needs a token with its scope. Errors are problem details (RFC 9457).
Times in ns count from 1970-01-01 UTC.
"""
_TAGS = [
    {"name": "machines", "description": "Monitored machines and their state."},
    {"name": "alarms", "description": "Alarms, and operators' actions on them."},
    {"name": "history", "description": "Past alarms, reports and readings."},
    {
        "name": "snapshots",
        "description": "Correlations, spectra, orbits and plots, of the newest data or of recordings.",
    },
    {"name": "events", "description": "Alarm events and changes of health as they happen."},
    {"name": "recordings", "description": "Recorded streams."},
    {"name": "replays", "description": "Recordings evaluated again or published again, apart from live data."},
    {"name": "service", "description": "The monitor itself."},
]
_SMALLEST_CHANGE = 1e-6
_METRICS = (
    "# HELP rotorwatch_blocks_accepted_total Blocks accepted\n"
    "# TYPE rotorwatch_blocks_accepted_total counter\n"
    'rotorwatch_blocks_accepted_total{machine="lab",site="demo"} 2051.0\n'
)


def _sizeable(change: float) -> float:
    if abs(change) < _SMALLEST_CHANGE:
        raise ValueError(f"{change:g} is not a change that could be found, expected at least 0.000001 up or down")
    return change


_Sizeable = Annotated[
    float,
    Field(gt=-1, le=10, allow_inf_nan=False),
    AfterValidator(_sizeable),
    WithJsonSchema(
        {
            "type": "number",
            "exclusiveMinimum": -1,
            "maximum": 10,
            "not": {"exclusiveMinimum": -_SMALLEST_CHANGE, "exclusiveMaximum": _SMALLEST_CHANGE},
        }
    ),
]
_Change = Annotated[_Sizeable | None, Query(description="relative change to be found, -0.05 for a loss of 5 %")]


def create_app(service: ServiceView, guard: Guard) -> FastAPI:
    """Build the application, which answers from `service` in the server's worker threads."""
    app = DescribedApp(
        title="rotorwatch",
        version=__version__,
        description=_DESCRIPTION,
        openapi_tags=_TAGS,
        dependencies=[guard.gate, Depends(only_known_arguments)],
        openapi_url=None,  # the guard serves it
        docs_url=None,  # the default pages load scripts from the internet; those of `add_docs_routes` do not
        redoc_url=None,
    )
    app.state.service = service
    add_problems(app)

    @app.exception_handler(NoAnswerError)
    async def not_monitored(request: Request, error: Exception) -> JSONResponse:
        return problem_answer(request, 503, str(error))

    _add_machine_routes(app, service, guard)
    add_history_routes(app, service, guard)
    add_operation_routes(app, service, guard)
    reader = SampleReader(service)
    add_snapshot_routes(app, reader, guard)
    add_plot_routes(app, reader, guard)
    add_event_routes(app, service, guard)
    add_recording_routes(app, service.catalogue, guard, lambda: [one.machine.title for one in service.machines()])
    add_replay_routes(app, service.replays, guard)
    _add_service_routes(app, service, guard)
    add_session_routes(app, guard)
    add_token_routes(app, guard)
    _add_readiness_routes(app, service, guard)
    add_docs_routes(app, guard)
    add_page_routes(app)
    guard.protect(app)
    return app


def _description(view: Monitored) -> MachineDescription:
    return machine_description(view.identity, view.machine, view.health().state)


def _add_machine_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    common: dict[str, Any] = {"tags": ["machines"], "dependencies": [guard.read]}
    lab = {**example(MachineConfiguration), "file": load_machine("lab").model_dump(mode="json")}

    @app.get("/api/v1/machines", responses=responses(MachineList), **common)
    def machines() -> MachineList:
        """Every monitored machine with its state."""
        return MachineList(machines=tuple(_description(machine) for machine in service.machines()))

    @app.get(PLACE, responses=responses(MachineDescription, 404, 422), **common)
    def machine(view: InPath) -> MachineDescription:
        """One machine: stream, channels, keys, state."""
        return _description(view)

    @app.get(f"{PLACE}/configuration", responses=responses(MachineConfiguration, 404, 422, shown=lab), **common)
    def configuration(view: InPath) -> MachineConfiguration:
        """The machine file in use, with defaults filled in, and the identity of its bundle."""
        return MachineConfiguration(
            **view.identity, file=MachineFile.model_validate(view.machine.model_dump()).model_dump(mode="json")
        )

    @app.get(f"{PLACE}/health", responses=responses(Health, 404, 422), **common)
    def health(view: InPath) -> Health:
        """Current health of a machine: state, report of the latest window, alarms, quality of the data."""
        return view.health()

    @app.get(f"{PLACE}/detectable", responses=responses(DetectableChanges, 404, 422), **common)
    def detectable(view: InPath, change: _Change = None) -> DetectableChanges:
        """Smallest changes that one window would show as the machine runs now, and data needed for a requested one."""
        return view.detectable(change)


def _add_service_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    @app.get(
        "/metrics",
        tags=["service"],
        dependencies=[guard.read],
        response_class=PlainTextResponse,
        responses={
            200: {"content": {"text/plain": {"schema": {"type": "string"}, "example": _METRICS}}},
            **problem_responses(),
        },
    )
    def metrics() -> Response:
        """Metrics for Prometheus, which the documentation lists."""
        return Response(service.metrics.text(), media_type=CONTENT_TYPE_LATEST)

    @app.get("/api/v1/webhooks", tags=["service"], dependencies=[guard.read], responses=responses(WebhookList))
    def webhooks() -> WebhookList:
        """Programs that receive alarm events (webhooks), and the state of delivery."""
        return service.webhooks.statuses()

    @app.get("/api/v1/settings", tags=["service"], dependencies=[guard.configure], responses=responses(SettingList))
    def settings() -> SettingList:
        """Settings of the monitor in use, without those that may hold a secret."""
        return SettingList(settings=service.settings.shown)


def _add_readiness_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    @app.get("/healthz", tags=["service"], responses=responses(Alive, guarded=False))
    def healthz() -> Alive:
        """Whether the process answers."""
        return Alive(alive=True)

    @app.get(
        "/readyz", tags=["service"], dependencies=[guard.read], responses=responses(Readiness), response_model=Readiness
    )
    def readyz(request: Request) -> Readiness | JSONResponse:
        """Whether the service can do its work, and if not, why; machines without data do not make it unready."""
        readiness = service.readiness()
        if readiness.ready:
            return readiness
        return problem_answer(request, 503, "; ".join(readiness.reasons), readiness.model_dump(mode="json"))
