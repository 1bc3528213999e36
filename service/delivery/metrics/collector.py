"""All metrics, when somebody asks for them.

Nothing is counted for them while blocks are processed: what the monitor keeps anyway is read when somebody asks.
"""

import platform
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Protocol

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.process_collector import ProcessCollector

from rotorwatch import __version__
from rotorwatch.records.monitor import Readiness, WebhookList
from service.delivery.metrics.machine import Observed, machine_families
from service.delivery.metrics.requests import RequestCounts
from service.delivery.webhooks.webhooks import Webhooks
from service.history.records import StoreError
from service.stream.monitored import Monitored

_PAGE = 1000
_WEBHOOK_STATES = ("working", "failing", "disabled")


class MeasuredService(Protocol):
    """What metrics are read from; `service.runtime.runtime.Runtime` is one."""

    def machines(self) -> Sequence[Monitored]:
        """Every monitored machine."""

    def readiness(self) -> Readiness:
        """Whether the service can do its work."""

    webhooks: Webhooks


class Metrics:
    """The metrics of a service."""

    def __init__(self, service: MeasuredService, requests: RequestCounts) -> None:
        self._service = service
        self._requests = requests
        self._events: dict[str, tuple[int, Counter[str]]] = {}  # latest event counted, and numbers of events by kind
        self._one_at_a_time = threading.Lock()
        self._registry = CollectorRegistry()
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def watch(self, machine: Monitored) -> None:
        """Count the alarm events of a machine from now on."""
        self._events[machine.machine.title] = machine.history.last_sequence(), Counter()

    def text(self) -> bytes:
        """Everything in the text format of Prometheus; for any thread."""
        with self._one_at_a_time:
            return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """Every metric, as the library expects them."""
        readiness = self._service.readiness()
        observed = [Observed(one, one.health(), one.status(), self._counted(one)) for one in self._service.machines()]
        yield from machine_families(observed)
        yield from _service_families(readiness)
        yield from _webhook_families(self._service.webhooks.statuses())
        yield from self._http_families()

    def _counted(self, machine: Monitored) -> Counter[str]:
        """Count the events that have come since the last time; while the history cannot be read, nothing is added."""
        after, kinds = self._events[machine.machine.title]
        with suppress(StoreError):
            while after < machine.history.last_sequence():
                page = machine.history.events(after=after, limit=_PAGE)
                if not page:
                    break
                kinds.update(event.kind for event in page)
                after = page[-1].sequence
        self._events[machine.machine.title] = after, kinds
        return kinds

    def _http_families(self) -> Iterator[Metric]:
        answered = CounterMetricFamily(
            "rotorwatch_http_requests_total", "HTTP requests answered", labels=("method", "route", "status")
        )
        for labels, count in sorted(self._requests.answered().items()):
            answered.add_metric(labels, count)
        yield answered
        refused = CounterMetricFamily(
            "rotorwatch_http_refused_requests_total", "HTTP requests refused, by reason", labels=("reason",)
        )
        for reason, count in self._requests.refused().items():
            refused.add_metric((reason,), count)
        yield refused


def _service_families(readiness: Readiness) -> Iterator[Metric]:
    build = InfoMetricFamily("rotorwatch_build", "Version of the monitor")
    build.add_metric((), {"version": __version__, "python": platform.python_version()})
    yield build
    yield GaugeMetricFamily("rotorwatch_ready", "1 if /readyz says so", value=readiness.ready)
    yield GaugeMetricFamily("rotorwatch_session_open", "1 if the Zenoh session is open", value=readiness.session_open)
    yield GaugeMetricFamily(
        "rotorwatch_history_failing", "1 if the history cannot be written", value=bool(readiness.history_trouble)
    )


def _webhook_families(webhooks: WebhookList) -> Iterator[Metric]:
    labels = ("webhook",)
    state = GaugeMetricFamily(
        "rotorwatch_webhook_state", "1 for the state the webhook is in, 0 for others", labels=("webhook", "state")
    )
    pending = GaugeMetricFamily(
        "rotorwatch_webhook_pending_events", "Alarm events after the last one delivered", labels=labels
    )
    delivered = CounterMetricFamily("rotorwatch_webhook_delivered_events_total", "Events delivered", labels=labels)
    failed = CounterMetricFamily("rotorwatch_webhook_failed_attempts_total", "Attempts that failed", labels=labels)
    latest = GaugeMetricFamily(
        "rotorwatch_webhook_delivery_timestamp_seconds", "When an event was last delivered", labels=labels
    )
    for webhook in webhooks.webhooks:
        for each in _WEBHOOK_STATES:
            state.add_metric((webhook.name, each), each == webhook.state)
        pending.add_metric((webhook.name,), webhook.pending)
        delivered.add_metric((webhook.name,), webhook.delivered)
        failed.add_metric((webhook.name,), webhook.failed_attempts)
        if webhook.last_delivered_ns is not None:
            latest.add_metric((webhook.name,), webhook.last_delivered_ns / 1e9)
    yield from (state, pending, delivered, failed, latest)
