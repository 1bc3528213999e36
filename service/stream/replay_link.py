"""Publishes replayed messages over Zenoh, apart from live ones.

Under a prefix, a namespace to subscribers, nobody who watches the live machine can receive them. On the original keys a
replay is refused as long as a publisher or a monitor of the machine is alive, and stops when one appears.
"""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial

import zenoh
import zenoh.ext

from models.errors import RotorwatchError
from models.signals.keys import MachineKeys
from models.signals.link import LinkSettings
from models.signals.recording import RecordedMessage
from models.signals.wire import REPLAY_MARK
from rotorwatch.records.replays import ReplayProgress
from service.recordings.replay.player import Control, PlayPlan, play
from service.recordings.replay.source import RecordingSource
from service.stream.transport import Link, answering

_JSON = "application/json"
_CACHE_STREAM = 300
_CACHE_OTHER = 100
_HEARTBEAT_S = 0.5
_POLL_S = 0.02
_DRAIN_S = 60.0
_PATIENT = {"transport/link/tx/queue/congestion_control/block/wait_before_close": str(20_000_000)}
"""By default Zenoh closes the connection to a subscriber that makes the sender wait for five seconds."""
_LIVENESS_TIMEOUT_S = 2.0

_Publisher = zenoh.Publisher | zenoh.ext.AdvancedPublisher


@dataclass(frozen=True, slots=True)
class NetworkPlan:
    """How recordings are replayed onto the network."""

    link: LinkSettings
    machines: tuple[MachineKeys, ...]
    everything: bool  # every recorded key, not only what a machine sends: stream, descriptor and truth
    prefix: str  # what goes before every key; with several passes, the number of the pass comes after it
    pace: float | None  # seconds of data per second; None is as fast as subscribers take it
    passes: int | None  # repetitions; None is without end
    # Times of the data.
    from_ns: int
    to_ns: int
    wait_for_subscriber_s: float = 0.0  # hold the first message of a pass back at most this long
    # How long a pass stays open after its last message, so that a subscriber can fetch what it missed.
    linger_s: float = 2.0

    def prefix_of(self, number: int) -> str:
        """Prefix of a pass.

        The blocks keep their own times, and a monitor refuses to take the same hour twice: so each pass is a network of
        its own to subscribers.
        """
        return self.prefix if self.passes == 1 else f"{self.prefix}/{number}"


class LiveMachineError(RotorwatchError):
    """A replay on the original keys would meet a live machine; the message says which."""


class ReplayLink:
    """A Zenoh session that publishes one pass of a replay after the other.

    Parameters
    ----------
    settings : LinkSettings
        Endpoints; gives up if nobody answers at those to connect to.
    on_live : callable
        Called with a sentence when a live publisher or monitor appears on the original keys, on a thread of Zenoh's.

    Raises
    ------
    LinkError
        If the session cannot be opened.
    """

    def __init__(self, settings: LinkSettings, on_live: Callable[[str], None]) -> None:
        self._link = Link(settings, fail_fast=bool(settings.connect), more=_PATIENT)
        self._on_live = on_live
        self._machines: tuple[MachineKeys, ...] = ()
        self._prefix, self._wait = "", False
        self._publishers: dict[str, _Publisher] = {}
        self._lock = threading.Lock()
        self._live = ""
        self._undo = ExitStack()

    def close(self) -> None:
        """Undeclare all of the pass, and close the session."""
        self.end_pass()
        self._link.close()

    def begin_pass(self, machines: dict[MachineKeys, bytes | None], prefix: str, *, wait: bool) -> None:
        """Declare what one pass needs, as a live publisher would.

        The machines whose messages are replayed come with their recorded channel descriptors. The prefix goes before
        every key; empty is the original keys. If it waits, subscribers slow the replay down instead of missing
        messages.

        Raises
        ------
        LiveMachineError
            If the original keys are asked for and a live publisher or monitor of a machine is there.
        """
        session = self._link.session
        self._machines, self._prefix, self._wait = tuple(machines), prefix, wait
        if not prefix:
            for keys in machines:
                self._undo.callback(session.liveliness().declare_token(keys.replay_alive).undeclare)
            self._watch_for_live()
        for keys, descriptor in machines.items():
            self._publisher(keys.stream)
            self._publisher(keys.descriptor)
            if descriptor is not None:
                key = self._key(keys.descriptor)
                reply = answering(key, partial(bytes, descriptor))
                self._undo.callback(session.declare_queryable(key, self._link.guarded(reply)).undeclare)
            if prefix:
                # On the original keys there is no token: it would say that a live machine is there, and hide one.
                self._undo.callback(session.liveliness().declare_token(self._key(keys.publisher_alive)).undeclare)

    def end_pass(self) -> None:
        """Undeclare all of the pass."""
        with self._lock:
            self._publishers.clear()
        self._undo.close()

    def put(self, message: RecordedMessage) -> None:
        """Publish a message as it was recorded: key below the prefix, payload, attachment and encoding.

        On the original keys the encoding of a block says that it is replayed, so that no monitor takes it for the
        machine's, whenever it comes.
        """
        with self._lock:
            if self._live:
                return
        marked = not self._prefix and message.key.endswith("/stream")
        encoding = message.encoding + REPLAY_MARK if marked else message.encoding
        self._publisher(message.key).put(message.payload, attachment=message.attachment or None, encoding=encoding)

    def wait_for_subscribers(self, timeout_s: float, stopped: Callable[[], bool]) -> None:
        """Wait until somebody subscribes to every machine's stream, or the time is over."""
        deadline_s = time.monotonic() + timeout_s
        for keys in self._machines:
            # The advanced publisher does not say whether it has subscribers; a plain one on the same key does.
            probe = self._link.session.declare_publisher(self._key(keys.stream))
            try:
                while not probe.matching_status.matching:  # type: ignore[attr-defined]  # the stub says bool
                    if stopped() or time.monotonic() > deadline_s:
                        return
                    time.sleep(_POLL_S)
            finally:
                probe.undeclare()  # type: ignore[no-untyped-call]

    def drain(self, timeout_s: float) -> None:
        """Wait until monitors have received everything; without a monitor there is nothing to wait for.

        A query of lower priority leaves after all messages, and a link is handled in order: its answer says that they
        have arrived.
        """
        for keys in self._machines:
            for _ in self._link.session.get(
                self._key(keys.health), priority=zenoh.Priority.BACKGROUND, timeout=timeout_s
            ):
                pass

    def _key(self, key: str) -> str:
        return f"{self._prefix}/{key}" if self._prefix else key

    def _publisher(self, key: str) -> _Publisher:
        if (known := self._publishers.get(key)) is not None:
            return known
        session = self._link.session
        congestion = zenoh.CongestionControl.BLOCK if self._wait else zenoh.CongestionControl.DROP
        publisher: _Publisher
        if self._prefix:
            publisher = zenoh.ext.declare_advanced_publisher(
                session,
                self._key(key),
                encoding=_JSON,
                congestion_control=congestion,
                priority=zenoh.Priority.DATA_LOW,  # what is live goes first
                cache=zenoh.ext.CacheConfig(max_samples=_CACHE_STREAM if key.endswith("/stream") else _CACHE_OTHER),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        else:
            # No cache: a monitor that starts later must not be able to fetch what was replayed.
            publisher = session.declare_publisher(
                key, encoding=_JSON, congestion_control=congestion, priority=zenoh.Priority.DATA_LOW
            )
        self._undo.callback(publisher.undeclare)
        self._publishers[key] = publisher
        return publisher

    def _watch_for_live(self) -> None:
        session = self._link.session
        for keys in self._machines:
            for key, who in ((keys.publisher_alive, "publisher"), (keys.monitor_alive, "monitor")):
                text = f"a live {who} of {keys.site}/{keys.machine} is there ({key})"
                if any(reply.ok is not None for reply in session.liveliness().get(key, timeout=_LIVENESS_TIMEOUT_S)):
                    raise LiveMachineError(f"{text}: replay under a prefix, or stop it first")
                watch = session.liveliness().declare_subscriber(
                    key, self._link.guarded(self._appeared(f"{text}: the replay on the original keys was stopped")),
                    history=True,
                )  # fmt: skip
                self._undo.callback(watch.undeclare)

    def _appeared(self, text: str) -> Callable[[zenoh.Sample], None]:
        def take(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                with self._lock:
                    self._live = text
                self._on_live(text)

        return take


def replay_to_network(
    source: RecordingSource,
    plan: NetworkPlan,
    control: Control,
    on_progress: Callable[[ReplayProgress], None] = lambda _: None,
) -> int:
    """Publish recordings until the end of the last pass, or until `control` says stop.

    Raises `LinkError` if there is no session; `LiveMachineError` if a live publisher or monitor is, or appears, on the
    original keys; `RecordingError` where a recording is damaged.
    """
    count, number = 0, 0
    with closing(ReplayLink(plan.link, control.stop)) as link:
        while not control.stopped and (plan.passes is None or number < plan.passes):
            number += 1
            described = {keys: source.descriptor(keys, plan.from_ns) for keys in plan.machines}
            announced = {keys: None if found is None else found.payload for keys, found in described.items()}
            link.begin_pass(announced, plan.prefix_of(number), wait=plan.pace is None)
            if plan.wait_for_subscriber_s:
                link.wait_for_subscribers(plan.wait_for_subscriber_s, lambda: control.stopped)
            for keys, found in described.items():
                if found is not None and source.span(keys).start_ns < plan.from_ns:  # else it is played in its place
                    link.put(found)
            sent = frozenset(key for keys in plan.machines for key in (keys.stream, keys.descriptor, keys.truth))
            stretch = PlayPlan(None if plan.everything else sent, plan.pace, plan.from_ns, plan.to_ns, number)
            count += play(source, link.put, stretch, control, on_progress)
            if not control.stopped:
                if plan.pace is None:
                    link.drain(_DRAIN_S)
                control.wait_until(control.now_s() + plan.linger_s)
            link.end_pass()
    if control.reason:
        raise LiveMachineError(control.reason)
    return count
