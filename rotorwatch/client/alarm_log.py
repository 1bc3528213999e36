"""Follows the alarm logs of machines over Zenoh: every event once, in order, from a given sequence number on."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing

import zenoh

from rotorwatch.client.alarm_topics import AlarmMessage, AlarmTopics, LogUnavailable
from rotorwatch.client.answers import understood
from rotorwatch.client.errors import ClientError
from rotorwatch.client.log_order import LogOrder
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmLogPage, AlarmStates

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
    _Follower(machines, after, on_event, stop or threading.Event(), ask_every_s).run(session)


class _Follower:
    def __init__(
        self,
        machines: Sequence[str],
        after: Mapping[str, int],
        on_event: Callable[[AlarmCloudEvent], None],
        stop: threading.Event,
        ask_every_s: float,
    ) -> None:
        self._machines = tuple(machines)
        self._after = after
        self._on_event = on_event
        self._stop = stop
        self._ask_every_s = ask_every_s
        self._heard: queue.Queue[AlarmMessage] = queue.Queue(_QUEUED)
        self._orders: dict[str, LogOrder] = {}
        self._due_s: dict[str, float] = {}
        self._silent: set[str] = set()
        for place in self._machines:
            if "*" not in place:
                self._order(place)

    def run(self, session: zenoh.Session) -> None:
        with closing(AlarmTopics(session, self._machines, self._hear)) as topics:
            while not self._stop.is_set():
                now_s = time.monotonic()
                due = [place for place, due_s in self._due_s.items() if due_s <= now_s]
                for place in due:
                    self._ask(topics, self._orders[place])
                next_s = min(self._due_s.values(), default=now_s + _STOP_S)
                self._listen(min(_STOP_S, max(0.0, next_s - time.monotonic())))

    def _hear(self, message: AlarmMessage) -> None:
        """Put a message into the queue, on Zenoh's thread; if the queue is full, it is read from the log later."""
        try:
            self._heard.put_nowait(message)
        except queue.Full:
            _log.debug("%s: a message was missed and will be read from the log", message.place)

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

    def _ask(self, topics: AlarmTopics, order: LogOrder) -> None:
        """Read the log up to its end."""
        self._due_s[order.place] = time.monotonic() + self._ask_every_s
        while not self._stop.is_set():
            before = order.last
            page = self._page(topics, order)
            if page is None:
                return
            order.read(understood(AlarmLogPage, page, order.place))
            self._hand_over(order)
            if not order.incomplete:
                return
            if order.last == before:  # announced, but not committed yet
                self._due_s[order.place] = time.monotonic() + min(1.0, self._ask_every_s)
                return

    def _page(self, topics: AlarmTopics, order: LogOrder) -> str | None:
        trouble = "nobody answers"
        try:
            page = topics.ask(order.place, order.ask_after, _PAGE)
        except LogUnavailable as error:
            page, trouble = None, str(error)
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
