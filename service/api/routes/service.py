"""What is said of the monitor itself over HTTP: metrics for Prometheus, and how webhooks stand."""

from fastapi import FastAPI, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CONTENT_TYPE_LATEST

from rotorwatch.records.monitor import WebhookList
from service.access.guard import Guard
from service.access.problems import problem_responses, responses
from service.api.views import ServiceView

_EXAMPLE = (
    "# HELP rotorwatch_blocks_accepted_total Blocks accepted\n"
    "# TYPE rotorwatch_blocks_accepted_total counter\n"
    'rotorwatch_blocks_accepted_total{machine="lab",site="demo"} 2051.0\n'
)


def add_service_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    """Add the routes."""

    @app.get(
        "/metrics",
        tags=["service"],
        dependencies=[guard.read],
        response_class=PlainTextResponse,
        responses={
            200: {"content": {"text/plain": {"schema": {"type": "string"}, "example": _EXAMPLE}}},
            **problem_responses(),
        },
    )
    def metrics() -> Response:
        """Numbers for Prometheus; a list of them is in the documentation."""
        return Response(service.metrics.text(), media_type=CONTENT_TYPE_LATEST)

    @app.get("/api/v1/webhooks", tags=["service"], dependencies=[guard.read], responses=responses(WebhookList))
    def webhooks() -> WebhookList:
        """Programs that are told of alarm events, and whether they take them."""
        return service.webhooks.statuses()
