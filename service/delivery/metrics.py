"""Metrics of the monitor for Prometheus.

Nothing but requests is counted for them: what the monitor keeps anyway is read when somebody asks.
"""

import platform
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, Literal, Protocol, TypeVar

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric, SummaryMetricFamily
from prometheus_client.process_collector import ProcessCollector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rotorwatch import __version__
from rotorwatch.records.alarms import AlarmState, EventKind, Severity
from rotorwatch.records.health import Health, HealthState
from rotorwatch.records.monitor import Readiness, WebhookStatus
from service.delivery.webhooks.dispatcher import Webhooks
from service.history.records import StoreError
from service.recordings.recorder import RecorderStatus
from service.stream.monitored import MachineStatus, Monitored

_PAGE = 1000
_WEBHOOK_STATES = ("working", "failing", "disabled")
_PLACE = ("site", "machine")
_RECORDER_STATES = ("off", "idle", "recording", "failing")
NO_ROUTE = "-"
"""Route of a request that was refused before its route was looked for, or that has none."""

_METHODS = frozenset(("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"))


class RequestCounts:
    """Requests that were answered; written by the server's event loop alone, read by any thread."""

    def __init__(self) -> None:
        self._answered: Counter[tuple[str, str, str]] = Counter()

    def count(self, method: str, route: str, status: int) -> None:
        """Count a request."""
        self._answered[method if method in _METHODS else "other", route, str(status)] += 1

    def answered(self) -> Mapping[tuple[str, str, str], int]:
        """Requests by method, route and status."""
        return dict(self._answered)

    def refused(self) -> Mapping[str, int]:
        """Requests that were refused: without a valid token, without the scope, for their origin, or too many."""
        refused = dict.fromkeys(("token", "scope", "origin", "rate"), 0)
        for (_, route, status), count in self.answered().items():
            # Scopes are checked once the route is known, the origin before that.
            reasons = {"401": "token", "403": "origin" if route == NO_ROUTE else "scope", "429": "rate"}
            if status in reasons:
                refused[reasons[status]] += count
        return refused


class RequestMeter:
    """Middleware around all others, which counts answers as they leave."""

    def __init__(self, app: ASGIApp, counts: RequestCounts) -> None:
        self._app = app
        self._counts = counts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        counted = False

        def count(status: int) -> None:
            nonlocal counted
            if not counted:
                counted = True
                route = getattr(scope.get("route"), "path", NO_ROUTE)
                self._counts.count(scope["method"], str(route), status)

        async def watched(message: Message) -> None:
            if message["type"] == "http.response.start":
                count(message["status"])
            await send(message)

        try:
            await self._app(scope, receive, watched)
        except BaseException:
            count(500)  # what the server answers then
            raise


@dataclass(frozen=True, slots=True)
class Observed:
    """A machine at the moment of asking."""

    monitored: Monitored
    health: Health
    status: MachineStatus
    events: Mapping[str, int]  # alarm events since the start, by kind

    @property
    def place(self) -> tuple[str, str]:
        """Values of the labels ``site`` and ``machine``."""
        return self.monitored.machine.site, self.monitored.machine.name


_Values = Iterable[tuple[tuple[str, ...], float]]
_Of = TypeVar("_Of")


@dataclass(frozen=True, slots=True)
class _Family(Generic[_Of]):
    """One metric of every machine or webhook; `values` gives a number, or none, or one for each value of `labels`."""

    kind: Literal["gauge", "counter"]
    name: str
    text: str
    values: Callable[[_Of], _Values | float | None]
    labels: tuple[str, ...] = ()

    def metric(self, place: tuple[str, ...], subjects: Sequence[tuple[tuple[str, ...], _Of]]) -> Metric:
        """The metric, with the labels `place`, whose values stand beside each subject."""
        build = GaugeMetricFamily if self.kind == "gauge" else CounterMetricFamily
        family = build(f"rotorwatch_{self.name}", self.text, labels=(*place, *self.labels))
        for where, subject in subjects:
            if (found := self.values(subject)) is not None:
                for more, value in found if isinstance(found, Iterable) else [((), found)]:
                    family.add_metric((*where, *more), value)
        return family


def _recorded(number: Callable[[RecorderStatus], float]) -> Callable[[Observed], float | None]:
    return lambda machine: None if machine.status.recorder is None else number(machine.status.recorder)


def _state(machine: Observed) -> _Values:
    return (((state.value,), float(machine.health.state is state)) for state in HealthState)


def _lag_s(machine: Observed) -> float:
    """Length of the blocks that wait, by the mean length of accepted ones."""
    status, accepted = machine.status, machine.health.quality.accepted_blocks
    return status.queue_blocks * status.tally.data_s / max(1, accepted)


def _recorder_state(machine: Observed) -> _Values:
    now = "off" if machine.status.recorder is None else machine.status.recorder.state
    return (((state,), float(state == now)) for state in _RECORDER_STATES)


def _alarms(machine: Observed) -> _Values:
    there = [(alarm.state, alarm.severity) for alarm in machine.health.alarms]
    return (
        ((state.value, severity.value), float(there.count((state, severity))))
        for state in AlarmState
        if state is not AlarmState.NORMAL
        for severity in Severity
    )


def _levels(machine: Observed) -> _Values:
    report = machine.health.report
    return (
        ((one.channel, name, "mm/s" if name == "velocity" else one.unit), value)
        for one in (() if report is None else report.levels)
        for name, value in one.values().items()
    )


_FAMILIES: tuple[_Family[Observed], ...] = (
    _Family("gauge", "machine_state", "1 for the state of health the machine is in, 0 for others", _state, ("state",)),
    _Family("gauge", "publisher_alive", "1 if a publisher of the stream is there",
            lambda machine: machine.health.stream.publisher_alive),
    _Family("gauge", "stream_silent", "1 if no usable block has come for longer than a silence may last",
            lambda machine: machine.health.stream.silent),
    _Family("gauge", "data_age_seconds", "Time since the last accepted block was processed; missing before the first",
            lambda machine: machine.health.stream.data_age_s),
    _Family("counter", "blocks_accepted_total", "Blocks accepted",
            lambda machine: machine.health.quality.accepted_blocks),
    _Family("counter", "blocks_refused_total", "Blocks refused, by reason",
            lambda machine: (((why,), n) for why, n in machine.health.quality.refused_blocks.items()), ("reason",)),
    _Family("counter", "data_seconds_total", "Length of the data accepted",
            lambda machine: machine.status.tally.data_s),
    _Family("counter", "gaps_total", "Interruptions of the stream", lambda machine: machine.health.quality.gaps),
    _Family("counter", "missing_seconds_total", "Length of the data that the gaps cost",
            lambda machine: machine.health.quality.missing_s),
    _Family("gauge", "queue_blocks", "Blocks that have arrived and wait for evaluation",
            lambda machine: machine.status.queue_blocks),
    _Family("gauge", "lag_seconds", "Length of the data that have arrived and wait for evaluation", _lag_s),
    _Family("counter", "queue_dropped_blocks_total", "Blocks dropped because the monitor could not keep up",
            lambda machine: machine.health.quality.queue_dropped_blocks),
    _Family("counter", "link_missed_blocks_total", "Blocks lost on the way, as far as the link knows",
            lambda machine: machine.health.quality.link_missed_blocks),
    _Family("gauge", "window_filled_ratio", "Fraction of a full window that is there",
            lambda machine: machine.health.filled),
    _Family("counter", "windows_total", "Windows evaluated", lambda machine: machine.status.tally.windows),
    _Family("counter", "windows_skipped_total", "Windows not evaluated because the monitor could not keep up",
            lambda machine: machine.health.quality.skipped_windows),
    _Family("counter", "commit_seconds_total", "Time spent waiting for the history",
            lambda machine: machine.status.tally.commit_s),
    _Family("gauge", "history_waiting_steps", "Steps that are not in the history yet",
            lambda machine: machine.status.history_waiting),
    _Family("gauge", "worker_alive", "1 if the thread that evaluates the blocks runs",
            lambda machine: machine.status.alive),
    _Family("gauge", "worker_busy_seconds", "How long that thread has been at work on the same block",
            lambda machine: machine.status.busy_s),
    _Family("counter", "worker_errors_total", "Blocks lost to an error inside the monitor",
            lambda machine: machine.status.errors),
    _Family("gauge", "restored_at_start", "1 if the monitor resumed from where it stood before its latest start",
            lambda machine: machine.status.restart.startswith("resumed")),
    _Family("gauge", "level", "Vibration levels of the latest window, in the unit of the channel", _levels,
            ("channel", "measure", "unit")),
    _Family("gauge", "alarms", "Alarms that are not normal", _alarms, ("state", "severity")),
    _Family("counter", "alarm_events_total", "Alarm events in the history since the start, by kind",
            lambda machine: (((kind.value,), machine.events.get(kind.value, 0)) for kind in EventKind), ("kind",)),
    _Family("gauge", "alarm_sequence", "Number of the latest alarm event, -1 before the first; goes on across restarts",
            lambda machine: machine.monitored.history.last_sequence),
    _Family("gauge", "recorder_state", "1 for the state the recorder is in, 0 for others", _recorder_state, ("state",)),
    _Family("counter", "recorder_received_messages_total", "Messages that arrived at the recorder",
            _recorded(lambda recorder: recorder.received)),
    _Family("counter", "recorder_dropped_messages_total", "Messages the recorder threw away: its queue was full",
            _recorded(lambda recorder: recorder.dropped)),
    _Family("counter", "recorder_lost_messages_total", "Messages that could not be written, or vanished",
            _recorded(lambda recorder: recorder.lost)),
    _Family("counter", "recorder_failures_total", "Attempts at writing a recording that failed",
            _recorded(lambda recorder: recorder.failures)),
)  # fmt: skip
_WEBHOOK_FAMILIES: tuple[_Family[WebhookStatus], ...] = (
    _Family("gauge", "webhook_state", "1 for the state the webhook is in, 0 for others",
            lambda webhook: (((state,), float(state == webhook.state)) for state in _WEBHOOK_STATES), ("state",)),
    _Family("gauge", "webhook_pending_events", "Alarm events after the last one delivered",
            lambda webhook: webhook.pending),
    _Family("counter", "webhook_delivered_events_total", "Events delivered", lambda webhook: webhook.delivered),
    _Family("counter", "webhook_failed_attempts_total", "Attempts that failed",
            lambda webhook: webhook.failed_attempts),
    _Family("gauge", "webhook_delivery_timestamp_seconds", "When an event was last delivered",
            lambda webhook: None if webhook.last_delivered_ns is None else webhook.last_delivered_ns / 1e9),
)  # fmt: skip


def machine_families(machines: Sequence[Observed]) -> Iterator[Metric]:
    """All metrics of machines."""
    info = InfoMetricFamily("rotorwatch_machine", "What the monitor of the machine runs on", labels=_PLACE)
    steps = SummaryMetricFamily(
        "rotorwatch_step_seconds", "Time spent evaluating blocks: how many, and how long altogether", labels=_PLACE
    )
    for machine in machines:
        identity, tally = machine.monitored.identity, machine.status.tally
        info.add_metric(machine.place, {"bundle": identity["bundle"] or "", "machine_hash": identity["machine_hash"]})
        steps.add_metric(machine.place, tally.blocks, tally.step_s)
    yield info
    yield steps
    subjects = [(machine.place, machine) for machine in machines]
    yield from (family.metric(_PLACE, subjects) for family in _FAMILIES)


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
        self._events[machine.machine.title] = machine.history.last_sequence, Counter()

    def text(self) -> bytes:
        """Everything in the text format of Prometheus; for any thread."""
        with self._one_at_a_time:
            return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """Every metric, as the library expects them."""
        readiness = self._service.readiness()
        observed = [Observed(one, one.health(), one.status(), self._counted(one)) for one in self._service.machines()]
        yield from machine_families(observed)
        build = InfoMetricFamily("rotorwatch_build", "Version of the monitor")
        build.add_metric((), {"version": __version__, "python": platform.python_version()})
        yield build
        for name, text, value in (
            ("ready", "1 if /readyz says so", readiness.ready),
            ("session_open", "1 if the Zenoh session is open", readiness.session_open),
            ("history_failing", "1 if the history cannot be written", bool(readiness.history_trouble)),
        ):
            yield GaugeMetricFamily(f"rotorwatch_{name}", text, value=value)
        webhooks = [((one.name,), one) for one in self._service.webhooks.statuses().webhooks]
        yield from (family.metric(("webhook",), webhooks) for family in _WEBHOOK_FAMILIES)
        yield from self._http_families()

    def _counted(self, machine: Monitored) -> Counter[str]:
        """Count the events that have come since the last time; while the history cannot be read, nothing is added."""
        after, kinds = self._events[machine.machine.title]
        with suppress(StoreError):
            while after < machine.history.last_sequence:
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
