"""What is said of the monitor itself over HTTP: metrics for Prometheus, and how webhooks stand."""

from typing import Protocol

from fastapi import FastAPI, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CONTENT_TYPE_LATEST

from rotorwatch.records.monitor import WebhookList
from service.access.guard import Guard
from service.access.problems import problem_responses, responses
from service.delivery.webhooks.webhooks import Webhooks

_EXAMPLE = (
    "# HELP rotorwatch_blocks_accepted_total Blocks accepted\n"
    "# TYPE rotorwatch_blocks_accepted_total counter\n"
    'rotorwatch_blocks_accepted_total{machine="lab",site="demo"} 2051.0\n'
)


class MetricsText(Protocol):
    """Writes down the metrics; `service.delivery.metrics.collector.Metrics` is one."""

    def text(self) -> bytes:
        """Everything in the text format of Prometheus."""


class MeasuredView(Protocol):
    """What these routes need to know about the service; `service.runtime.Runtime` is one."""

    @property
    def metrics(self) -> MetricsText:
        """The metrics."""

    @property
    def webhooks(self) -> Webhooks:
        """Who is told of alarm events."""


def add_service_routes(app: FastAPI, service: MeasuredView, guard: Guard) -> None:
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
