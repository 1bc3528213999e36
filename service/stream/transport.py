"""The service's side of Zenoh: sessions, and what is declared for a machine.

::

    stream ------------> on_block          descriptor, publisher_alive ---> on_descriptor, on_publisher
    report <------------ publish                   (dropped under congestion)
    alarm/event <------- publish                   (waits under congestion, the latest are kept for late joiners;
                                                   the whole log is there by query)
    alarm/state, health <- publish                 (latest kept; also answered by query)

Callbacks run on Zenoh's threads. An exception in one is logged and counted here, because Zenoh would only print it.
"""

import json
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import TypeVar

import zenoh
import zenoh.ext

from models.errors import RotorwatchError
from models.signals.keys import PREFIX, MachineKeys, Topic
from models.signals.link import LinkSettings
from models.signals.recording import RecordedMessage
from models.signals.wire import REPLAY_MARK
from service.stream.inbox import Intake, RawBlock
from service.stream.subscription import BlockSubscription
from service.terminal.logs import logger

_JSON = "application/json"
_CLOUD_EVENT = "application/cloudevents+json"
_HEARTBEAT_S = 1.0
_AT_ONCE, _AT_ONCE_HELD_UP = 1000, 64
"""Most blocks of one machine before the others have their turn; fewer where each block may have to wait."""
_CACHED_EVENTS = 200
_QUERY_TIMEOUT_S = 10.0
_QUICK_CONNECT_S = 3.0
_CONNECT_S = 10.0
_DROP_AFTER_US = 1_000_000
_CLOSE_AFTER_US = 2_000_000
"""How long a subscriber may hold up a link. With Zenoh's default of five seconds, the silence after which a stream is
called lost, the streams of other machines would be called lost."""

MOST_EVENTS = 1000
_DEFAULT_EVENTS = 100
_LIMITS = {"after": (-1, 2**53), "limit": (1, MOST_EVENTS)}

_T = TypeVar("_T")
_log = logger(part="transport")


class LinkError(RotorwatchError):
    """No Zenoh session with these endpoints; the message names them."""


@dataclass(frozen=True, slots=True)
class MachineCallbacks:
    """Callbacks of a machine's link, each on a thread of Zenoh's: be short."""

    on_block: Callable[[RawBlock], None]  # takes a message of the stream
    # Takes the number of messages that were lost on the way and could not be fetched again.
    on_missed: Callable[[int], None]
    on_descriptor: Callable[[bytes], None]  # takes a channel descriptor (JSON) that a publisher announced
    on_publisher: Callable[[bool], None]  # takes whether a publisher is alive
    # Return the present answer (JSON) to a query.
    health: Callable[[], str]
    alarm_state: Callable[[], str]
    # Takes a sequence number and a limit, returns (JSON) at most that many alarm events after the number. May take its
    # time; a `RotorwatchError` that it raises is sent to the caller.
    alarm_events: Callable[[int, int], str]
    # Takes whether a replay is announced on the machine's own keys. Anybody may announce one, so the stream goes on all
    # the same, only without blocks that are marked as replayed.
    on_replay: Callable[[bool], None] = lambda _: None


@dataclass(frozen=True, slots=True)
class TopicMessage:
    """A message a client received: its key and its JSON text."""

    key: str
    text: str


class Link:
    """A Zenoh session.

    Parameters
    ----------
    fail_fast : bool
        Give up when no endpoint in `connect` answers within three seconds. Otherwise a client tries for ten, and a
        peer for ever, in the background.
    more : mapping
        Further settings of Zenoh, by their paths.

    Raises
    ------
    LinkError
        If an endpoint is malformed, cannot be listened on, or does not answer in time.
    """

    def __init__(
        self, settings: LinkSettings, *, fail_fast: bool = False, more: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        self.errors = 0  # exceptions in callbacks so far
        self.intake = Intake()
        config = zenoh.Config()
        items = settings.zenoh_items() | dict(more)
        if fail_fast or settings.mode == "client":
            timeout_s = _QUICK_CONNECT_S if fail_fast else _CONNECT_S
            items["connect/timeout_ms"] = json.dumps(round(timeout_s * 1000))
            items["connect/exit_on_failure"] = "true"
        try:
            for path, value in items.items():
                config.insert_json5(path, value)
            self.session = zenoh.open(config)
        except zenoh.ZError as error:
            raise LinkError(_explain(settings, str(error))) from error

    @property
    def is_open(self) -> bool:
        """Whether the session is open."""
        return not self.session.is_closed()

    def guarded(self, callback: Callable[[_T], None]) -> Callable[[_T], None]:
        """Wrap a callback so that its exceptions are logged and counted."""

        def call(argument: _T) -> None:
            try:
                callback(argument)
            except Exception:  # Zenoh would only print what escapes from here
                self.errors += 1
                _log.exception("error in a callback")

        return call

    def close(self) -> None:
        """Close the session."""
        self.intake.close()
        self.session.close()  # type: ignore[no-untyped-call]


class MachineLink:
    """Everything declared for one machine, on a link that must outlive it.

    With `wait_when_full`, `on_block` may wait, which slows down the publisher and all machines on the same link.
    """

    def __init__(self, link: Link, keys: MachineKeys, callbacks: MachineCallbacks, *, wait_when_full: bool) -> None:
        self._link = link
        self._keys = keys
        self._callbacks = callbacks
        self._lock = threading.Lock()
        self._closed = False
        with ExitStack() as undo:
            self._declare(link.session, undo, wait_when_full)
            self._undeclare = undo.pop_all()

    def _declare(self, session: zenoh.Session, undo: ExitStack, wait_when_full: bool) -> None:
        keys, guarded, keep = self._keys, self._link.guarded, undo.callback
        self._publishers: dict[Topic, zenoh.Publisher | zenoh.ext.AdvancedPublisher] = {
            "report": session.declare_publisher(
                keys.report, encoding=_JSON, congestion_control=zenoh.CongestionControl.DROP
            ),
            "alarm_event": _advanced_publisher(session, keys.alarm_event, _CLOUD_EVENT, _CACHED_EVENTS),
            "alarm_state": _advanced_publisher(session, keys.alarm_state, _JSON, 1),
            "health": _advanced_publisher(session, keys.health, _JSON, 1),
        }
        for publisher in self._publishers.values():
            keep(publisher.undeclare)
        for key, answer in ((keys.alarm_state, self._callbacks.alarm_state), (keys.health, self._callbacks.health)):
            keep(session.declare_queryable(key, guarded(answering(key, answer))).undeclare)
        log = _answering_from_log(keys.alarm_event, self._callbacks.alarm_events)
        # On a thread of its own, as it waits for the database: other callbacks and Zenoh go on.
        events = zenoh.handlers.Callback(guarded(log), indirect=True)
        keep(session.declare_queryable(keys.alarm_event, events).undeclare)
        alive = session.liveliness()
        keep(alive.declare_subscriber(keys.replay_alive, guarded(self._take_replay), history=True).undeclare)
        # Descriptor and liveliness before the stream: they say what the stream should look like.
        keep(
            zenoh.ext.declare_advanced_subscriber(
                session,
                keys.descriptor,
                guarded(self._take_descriptor),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            ).undeclare
        )
        keep(alive.declare_subscriber(keys.publisher_alive, guarded(self._take_alive), history=True).undeclare)
        blocks = BlockSubscription(session, keys.stream, guarded(self._take_miss), holds_up=wait_when_full)
        keep(blocks.close)
        most = _AT_ONCE_HELD_UP if wait_when_full else _AT_ONCE
        keep(self._link.intake.add(partial(guarded(partial(blocks.take, guarded(self._take_block))), most)))
        # Before this monitor declares its own token.
        alive.get(keys.monitor_alive, guarded(self._take_other_monitor), timeout=_QUERY_TIMEOUT_S)
        keep(alive.declare_token(keys.monitor_alive).undeclare)

    def publish(self, topic: Topic, text: str) -> None:
        """Publish a message; if the network is congested all but reports wait."""
        with self._lock:
            if not self._closed:
                self._publishers[topic].put(text)

    def close(self) -> None:
        """Undeclare everything; what is published afterwards is ignored."""
        with self._lock:
            self._closed = True
        self._undeclare.close()

    def _take_other_monitor(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:  # it has another history: a second monitor on the same history is refused
            _log.warning(
                "another monitor of this machine is on the network: every alarm is told twice, from two logs",
                machine=f"{self._keys.site}/{self._keys.machine}",
            )

    def _take_replay(self, sample: zenoh.Sample) -> None:
        self._callbacks.on_replay(sample.kind == zenoh.SampleKind.PUT)

    def _take_block(self, sample: zenoh.Sample) -> None:
        encoding, info = str(sample.encoding), sample.source_info
        if sample.kind == zenoh.SampleKind.PUT and not encoding.endswith(REPLAY_MARK):
            attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
            # The publisher's session and its number there; empty if its messages are not numbered.
            source = "" if info is None else f"{info.source_id.zid}/{info.source_id.eid}"
            self._callbacks.on_block(RawBlock(sample.payload.to_bytes(), attachment, encoding, source))

    def _take_miss(self, miss: zenoh.ext.Miss) -> None:
        self._callbacks.on_missed(miss.nb)

    def _take_descriptor(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._callbacks.on_descriptor(sample.payload.to_bytes())

    def _take_alive(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        self._callbacks.on_publisher(alive)
        if alive:
            _ask(self._link, self._keys.descriptor, self._take_descriptor)  # publishers may have no cache


def tap(link: Link, keys: MachineKeys, on_message: Callable[[RecordedMessage], None]) -> Callable[[], None]:
    """Pass on every message under a machine's keys unchanged, whoever published it, this program included.

    `on_message` runs on a thread of the link's: be short. Descriptors also come as answers to a query, at the start
    and whenever a publisher appears, so that one announced earlier is known. Returns a function that ends it; the link
    must outlive it.
    """

    def take(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and str(sample.key_expr) != keys.stream:
            on_message(_verbatim(sample))

    def take_block(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            on_message(_verbatim(sample))

    def take_alive(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            _ask(link, keys.descriptor, take)

    session = link.session
    with ExitStack() as undo:
        undo.callback(session.declare_subscriber(f"{keys.root}/**", link.guarded(take)).undeclare)
        # The stream as the monitor takes it: blocks that were lost on the way are fetched again.
        blocks = BlockSubscription(session, keys.stream, lambda _: None)
        undo.callback(blocks.close)
        take_blocks = partial(blocks.take, link.guarded(take_block))
        undo.callback(link.guarded(partial(take_blocks, last=True)), _AT_ONCE)  # what has come by then
        undo.callback(link.intake.add(partial(link.guarded(take_blocks), _AT_ONCE)))
        liveliness = session.liveliness()
        alive = liveliness.declare_subscriber(keys.publisher_alive, link.guarded(take_alive), history=True)
        undo.callback(alive.undeclare)
        close = undo.pop_all().close
    _ask(link, keys.descriptor, take)
    return close


def streams_heard(link: Link, seconds: float) -> set[str]:
    """Keys under which sample blocks of any machine arrive within a time."""
    heard = set[str]()

    def take(sample: zenoh.Sample) -> None:
        heard.add(str(sample.key_expr))

    with link.session.declare_subscriber(f"{PREFIX}/*/*/stream", link.guarded(take)):
        time.sleep(seconds)
    return heard


@contextmanager
def follow(
    settings: LinkSettings, machines: str, topics: tuple[str, ...], callback: Callable[[TopicMessage], None]
) -> Iterator[Callable[[], bool]]:
    """Follow what monitors publish, as a client; yields a function that says whether it is still connected to anybody.

    Machines are ``<site>/<machine>``, where ``*`` stands for any, topics fields of `MachineKeys`, such as ``report`` or
    ``alarm_event``. `callback` runs on a thread of Zenoh's: at once for the latest health and alarm state, from now on
    for events and reports.

    Raises
    ------
    LinkError
        If nobody answers at the endpoints.
    """
    site, _, machine = machines.partition("/")

    def take(sample: zenoh.Sample) -> None:
        callback(TopicMessage(str(sample.key_expr), sample.payload.to_string()))

    with closing(Link(settings, fail_fast=True)) as link, ExitStack() as undo:
        for name in topics:
            suffix = getattr(MachineKeys("s", "m"), name).removeprefix(f"{PREFIX}/s/m/")
            current = name in {"health", "alarm_state"}
            subscriber = zenoh.ext.declare_advanced_subscriber(
                link.session,
                f"{PREFIX}/{site}/{machine}/{suffix}",
                link.guarded(take),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1) if current else None,
                recovery=None if name == "report" else zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            )
            undo.callback(subscriber.undeclare)
        yield lambda: link.is_open and bool(link.session.info.peers_zid() or link.session.info.routers_zid())


def relay_items(*, waits: bool) -> dict[str, str]:
    """Zenoh's settings of a router that brings streams to monitors, or to the shards of one.

    A publisher's cached samples come all at once, so the router waits for their subscribers. A publisher of several
    machines waits for the slowest subscriber. With `waits`, a subscriber that takes nothing at all slows down the
    source; otherwise it is cut off, and when it comes again it gets what it missed from publishers with a cache.
    """
    place = "transport/link/tx/queue/congestion_control"
    cut_off = {} if waits else {f"{place}/block/wait_before_close": str(_CLOSE_AFTER_US)}
    return {f"{place}/drop/wait_before_drop": str(_DROP_AFTER_US)} | cut_off


@contextmanager
def route(settings: LinkSettings) -> Iterator[None]:
    """Run a Zenoh router, whatever the role in the settings; raises `LinkError` if it cannot listen."""
    with closing(Link(settings.model_copy(update={"mode": "router"}), more=relay_items(waits=True))):
        yield


def _ask(link: Link, key: str, callback: Callable[[zenoh.Sample], None]) -> None:
    """Query a key; each answer is taken like a message."""

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            callback(reply.ok)

    link.session.get(key, link.guarded(take), timeout=_QUERY_TIMEOUT_S)


def _verbatim(sample: zenoh.Sample) -> RecordedMessage:
    """A sample with the time at which it arrived, and that of its publication if it carries one."""
    log_time_ns, stamp = time.time_ns(), sample.timestamp
    publish_time_ns = log_time_ns if stamp is None else stamp.get_time_as_ntp64().as_nanos()
    attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
    return RecordedMessage(
        str(sample.key_expr), sample.payload.to_bytes(), attachment, str(sample.encoding), log_time_ns, publish_time_ns
    )


def _advanced_publisher(session: zenoh.Session, key: str, encoding: str, cache: int) -> zenoh.ext.AdvancedPublisher:
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        encoding=encoding,
        congestion_control=zenoh.CongestionControl.BLOCK,
        cache=zenoh.ext.CacheConfig(max_samples=cache),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
        publisher_detection=True,
    )


def answering(key: str, answer: Callable[[], str | bytes]) -> Callable[[zenoh.Query], None]:
    """A queryable's callback that replies with JSON."""

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(key, answer(), encoding=_JSON)

    return reply


def _answering_from_log(key: str, answer: Callable[[int, int], str]) -> Callable[[zenoh.Query], None]:
    def reply(query: zenoh.Query) -> None:
        with query:
            try:
                text = answer(*read_log_query(str(query.selector.parameters)))
            except RotorwatchError as error:
                query.reply_err(json.dumps({"error": f"{key}: {error}"}), encoding=_JSON)
            else:
                query.reply(key, text, encoding=_JSON)

    return reply


def read_log_query(parameters: str) -> tuple[int, int]:
    """Read a query for an alarm log, ``after=17;limit=500``: after which sequence number, and at most how many events.

    `parameters` is the text behind the question mark; names that begin with an underscore are Zenoh's own. Raises
    `RotorwatchError`, naming what was found and what was expected.

    Examples
    --------
    >>> read_log_query("after=17")
    (17, 100)
    """
    found = {"after": -1, "limit": _DEFAULT_EVENTS}
    for part in filter(None, parameters.split(";")):
        name, _, value = part.partition("=")
        if name.startswith("_"):
            continue
        if name not in found:
            raise RotorwatchError(f"no parameter {name}, expected after or limit")
        least, most = _LIMITS[name]
        if not re.fullmatch(r"-?[0-9]{1,18}", value) or not least <= int(value) <= most:
            raise RotorwatchError(f"{name} is {value!r}, expected a whole number from {least} to {most}")
        found[name] = int(value)
    return found["after"], found["limit"]


def _explain(settings: LinkSettings, error: str) -> str:
    """Say which endpoints, and Zenoh's reason without the places in its source code."""
    named = {"listen": settings.listen, "connect": settings.connect}
    ends = [f"{what} {', '.join(where)}" for what, where in named.items() if where]
    return f"Zenoh session ({settings.mode}, {'; '.join(ends)}) could not be opened: {settings.explain(error)}"
