"""A follower's access over Zenoh: published alarm events and states, and queries to the alarm log."""

import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Literal

import zenoh
import zenoh.ext

from rotorwatch.client.errors import ClientError

_PREFIX = "rotorwatch"
_ANSWER_S = 5.0
_CACHED_EVENTS = 200


class LogUnavailable(ClientError):  # noqa: N818  # public name
    """A monitor could not answer from its alarm log; the message is the monitor's."""


@dataclass(frozen=True, slots=True)
class AlarmMessage:
    """A message about a machine's alarms."""

    place: str  # ``<site>/<machine>``
    kind: Literal["event", "state", "monitor"]  # an alarm event, the current alarms, or a monitor that has appeared
    text: bytes  # JSON; empty for a monitor


class AlarmTopics:
    """Subscriptions to the alarms of machines, and queries to their monitors.

    A lost connection is restored automatically, but messages published meanwhile are missed. `hear` is called with each
    message on a Zenoh thread, and must return quickly. Latest states and events cached by monitors are delivered at
    once, possibly out of order and repeatedly.
    """

    def __init__(self, session: zenoh.Session, machines: Sequence[str], hear: Callable[[AlarmMessage], None]) -> None:
        self._session = session
        self._hear = hear
        with ExitStack() as undo:
            for place in machines:
                self._subscribe(f"{_PREFIX}/{place}", undo)
            self._undo = undo.pop_all()

    def close(self) -> None:
        """End the subscriptions."""
        self._undo.close()

    def ask(self, place: str, after: int, limit: int) -> str | None:
        """Query a monitor's alarm log: JSON of an `AlarmLogPage`, or None without an answer within five seconds.

        The page has at most `limit` events, up to 1000, after sequence number `after`; -1 is the beginning.

        Raises
        ------
        LogUnavailable
            If the monitor cannot read its history now.
        """
        refusal = ""
        selector = f"{_PREFIX}/{place}/alarm/event?after={after};limit={limit}"
        for reply in self._session.get(selector, timeout=_ANSWER_S):
            if reply.ok is not None:
                return reply.ok.payload.to_string()
            if reply.err is not None:
                refusal = _refusal(reply.err.payload.to_bytes()) or refusal
        if refusal:
            raise LogUnavailable(refusal)
        return None

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
        if sample.kind != zenoh.SampleKind.PUT:
            return
        _, site, machine, topic, what = str(sample.key_expr).split("/")
        place = f"{site}/{machine}"
        if topic == "alive":
            self._hear(AlarmMessage(place, "monitor", b""))
        else:
            self._hear(AlarmMessage(place, "event" if what == "event" else "state", sample.payload.to_bytes()))


def _refusal(payload: bytes) -> str:
    """A monitor's error message; empty for errors of Zenoh itself, such as a timeout."""
    try:
        said = json.loads(payload)
    except ValueError:
        return ""
    return str(said["error"]) if isinstance(said, dict) and "error" in said else ""
