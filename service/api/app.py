"""The HTTP API of the service and its OpenAPI description; ``docs/api.md`` lists the routes."""

import threading
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Query, Request, Response
from fastapi.dependencies.models import Dependant
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, PlainTextResponse
from fastapi.routing import APIRoute, iter_route_contexts
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import AfterValidator, Field, WithJsonSchema

from models.machine import MachineFile, load_machine
from rotorwatch import __version__
from rotorwatch.records.example import example
from rotorwatch.records.health import Health
from rotorwatch.records.machines import DetectableChanges, MachineConfiguration, MachineDescription, MachineList
from rotorwatch.records.monitor import Alive, Readiness, SettingList, WebhookList
from service.access.guard import Guard
from service.access.problems import add_problems, problem_answer, problem_responses, responses, share_problems
from service.api.routes.events import add_event_routes
from service.api.routes.history import add_history_routes
from service.api.routes.operations import add_operation_routes
from service.api.routes.page import add_docs_routes, add_page_routes
from service.api.routes.recordings import add_recording_routes
from service.api.routes.replays import add_replay_routes
from service.api.routes.snapshots import add_plot_routes, add_snapshot_routes
from service.api.routes.tokens import add_session_routes, add_token_routes
from service.api.samples import SampleReader
from service.api.views import PLACE, InPath, ServiceView
from service.monitor.conversion import machine_description
from service.stream.monitored import Monitored, NoAnswerError

_DESCRIPTION = """Health of rotating machines: which parameter changed, by how much, how sure.

Every route listed here except `/healthz` needs a token with its scope. Errors are problem details (RFC 9457).
Times in ns count from 1970-01-01 UTC.
"""
_TAGS = {
    "machines": "Monitored machines and their state.",
    "alarms": "Alarms, and operators' actions on them.",
    "history": "Past alarms, reports and readings.",
    "snapshots": "Correlations, spectra, orbits and plots, of the newest data or of recordings.",
    "events": "Alarm events and changes of health as they happen.",
    "recordings": "Recorded streams.",
    "replays": "Recordings evaluated again or published again, apart from live data.",
    "service": "The monitor itself.",
}
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
    if not given or not request.scope["path"].startswith("/api/") or not isinstance(request.app, DescribedApp):
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


def create_app(service: ServiceView, guard: Guard) -> FastAPI:
    """Build the application, which answers from `service` in the server's worker threads."""
    app = DescribedApp(
        title="rotorwatch",
        version=__version__,
        description=_DESCRIPTION,
        openapi_tags=[{"name": name, "description": text} for name, text in _TAGS.items()],
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
