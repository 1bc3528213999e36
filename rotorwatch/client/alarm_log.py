"""Follows the alarm logs of machines over Zenoh: every event once, in order, from a given sequence number on."""

import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Literal

import zenoh
import zenoh.ext

from rotorwatch.client.answers import understood
from rotorwatch.client.errors import ClientError
from rotorwatch.client.log_order import LogOrder
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmLogPage, AlarmStates

_PREFIX = "rotorwatch"
_ANSWER_S = 5.0
_CACHED_EVENTS = 200
_PAGE = 500
_QUEUED = 10_000
_STOP_S = 0.25
_WAIT_FOR_MISSING_S = 0.1

_log = logging.getLogger("rotorwatch.client")


def follow_alarms(
    session: zenoh.Session,
    machines: Sequence[str],
    after: Mapping[str, int],
    on_event: Callable[[AlarmCloudEvent], None],
    *,
    stop: threading.Event | None = None,
    ask_every_s: float = 2.0,
) -> None:
    """Pass every alarm event of the given machines to `on_event`, once and in order, until `stop` is set.

    Events are passed on as they happen. Events missed while this program, the connection or the monitor was down are
    requested from the log; while no monitor answers, this function waits. A program that stores the sequence number of
    the last event and passes it as `after` gets the log without a gap and without a repetition.

    Parameters
    ----------
    session : zenoh.Session
        An open session with the monitors' network. It stays open; a lost connection is restored automatically.
    machines : sequence of str
        ``<site>/<machine>``, where ``*`` stands for any.
    after : mapping of str to int
        Sequence number of the last event already taken, by machine; machines not in it are followed from the
        beginning.
    on_event : callable
        Called in this thread with one event after the other. If it raises, this function ends with the same exception,
        and the event counts as not taken.
    stop : threading.Event, optional
        Set it to end; without it this function runs for ever.
    ask_every_s : float
        Interval at which each log is queried for missed events, in seconds.

    Raises
    ------
    LogReplaced
        If a log has been replaced: it ends before `after`, or the last event taken has changed.
    ClientError
        If a monitor sends something that this version does not understand.
    """
    _Follower(session, machines, after, on_event, stop or threading.Event(), ask_every_s).run()


@dataclass(frozen=True, slots=True)
class _Message:
    """A message about a machine's alarms."""

    place: str  # ``<site>/<machine>``
    kind: Literal["event", "state", "monitor"]  # an alarm event, the current alarms, or a monitor that has appeared
    text: bytes  # JSON; empty for a monitor


@dataclass(slots=True)
class _Follower:
    """Subscribes to the alarms of machines, and queries their monitors for what was missed.

    A lost connection is restored automatically, but messages published meanwhile are missed. Latest states and events
    cached by monitors are delivered at once, possibly out of order and repeatedly.
    """

    _session: zenoh.Session
    _machines: Sequence[str]
    _after: Mapping[str, int]
    _on_event: Callable[[AlarmCloudEvent], None]
    _stop: threading.Event
    _ask_every_s: float
    _heard: queue.Queue[_Message] = field(default_factory=lambda: queue.Queue(_QUEUED))
    _orders: dict[str, LogOrder] = field(default_factory=dict)
    _due_s: dict[str, float] = field(default_factory=dict)
    _silent: set[str] = field(default_factory=set)

    def run(self) -> None:
        with ExitStack() as undo:
            for place in self._machines:
                self._subscribe(f"{_PREFIX}/{place}", undo)
                if "*" not in place:
                    self._order(place)
            while not self._stop.is_set():
                now_s = time.monotonic()
                due = [place for place, due_s in self._due_s.items() if due_s <= now_s]
                for place in due:
                    self._ask(self._orders[place])
                next_s = min(self._due_s.values(), default=now_s + _STOP_S)
                self._listen(min(_STOP_S, max(0.0, next_s - time.monotonic())))

    def _subscribe(self, root: str, undo: ExitStack) -> None:
        for suffix, kept in (("alarm/event", _CACHED_EVENTS), ("alarm/state", 1)):
            subscriber = zenoh.ext.declare_advanced_subscriber(
                self._session,
                f"{root}/{suffix}",
                self._take,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=kept),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            )
            undo.callback(subscriber.undeclare)
        liveliness = self._session.liveliness()
        alive = liveliness.declare_subscriber(f"{root}/alive/monitor", self._take, history=True)
        undo.callback(alive.undeclare)

    def _take(self, sample: zenoh.Sample) -> None:
        """Put a message into the queue, on Zenoh's thread; if the queue is full, it is read from the log later."""
        if sample.kind != zenoh.SampleKind.PUT:
            return
        _, site, machine, topic, what = str(sample.key_expr).split("/")
        place = f"{site}/{machine}"
        if topic == "alive":
            message = _Message(place, "monitor", b"")
        else:
            message = _Message(place, "event" if what == "event" else "state", sample.payload.to_bytes())
        try:
            self._heard.put_nowait(message)
        except queue.Full:
            _log.debug("%s: a message was missed and will be read from the log", place)

    def _order(self, place: str) -> LogOrder:
        if place not in self._orders:
            self._orders[place] = LogOrder(place, self._after.get(place, -1))
            self._due_s[place] = 0.0
        return self._orders[place]

    def _listen(self, timeout_s: float) -> None:
        try:
            message = self._heard.get(timeout=timeout_s)
        except queue.Empty:
            return
        order = self._order(message.place)
        if message.kind == "monitor":
            self._due_s[message.place] = 0.0
            return
        try:
            if message.kind == "event":
                order.hear(understood(AlarmCloudEvent, message.text, message.place))
            else:
                order.announce(understood(AlarmStates, message.text, message.place).sequence)
        except ClientError as error:
            # A malformed message, from whatever sender: read the log, which is authoritative.
            _log.warning("%s", error)
            self._due_s[message.place] = 0.0
            return
        self._hand_over(order)
        if order.incomplete:
            # Wait a moment before asking the log: the missing events may still arrive.
            self._due_s[message.place] = min(self._due_s[message.place], time.monotonic() + _WAIT_FOR_MISSING_S)

    def _ask(self, order: LogOrder) -> None:
        """Read the log up to its end."""
        self._due_s[order.place] = time.monotonic() + self._ask_every_s
        while not self._stop.is_set():
            before = order.last
            page = self._page(order)
            if page is None:
                return
            order.read(understood(AlarmLogPage, page, order.place))
            self._hand_over(order)
            if not order.incomplete:
                return
            if order.last == before:  # announced, but not committed yet
                self._due_s[order.place] = time.monotonic() + min(1.0, self._ask_every_s)
                return

    def _page(self, order: LogOrder) -> str | None:
        """Query a monitor's alarm log: JSON of an `AlarmLogPage`.

        None if nobody answers within five seconds, or the monitor cannot read its log; the first time with a warning.
        """
        page, trouble = None, "nobody answers"
        selector = f"{_PREFIX}/{order.place}/alarm/event?after={order.ask_after};limit={_PAGE}"
        for reply in self._session.get(selector, timeout=_ANSWER_S):
            if reply.ok is not None:
                page = reply.ok.payload.to_string()
                break
            if reply.err is not None:
                trouble = _refusal(reply.err.payload.to_bytes()) or trouble
        if page is None and order.place not in self._silent:
            self._silent.add(order.place)
            _log.warning("%s: the alarm log cannot be read at present: %s", order.place, trouble)
        elif page is not None and order.place in self._silent:
            self._silent.discard(order.place)
            _log.warning("%s: the alarm log can be read again", order.place)
        return page

    def _hand_over(self, order: LogOrder) -> None:
        while not self._stop.is_set() and (event := order.next()) is not None:
            self._on_event(event)
            order.taken()


def _refusal(payload: bytes) -> str:
    """A monitor's error message; empty for errors of Zenoh itself, such as a timeout."""
    try:
        said = json.loads(payload)
    except ValueError:
        return ""
    return str(said["error"]) if isinstance(said, dict) and "error" in said else ""
