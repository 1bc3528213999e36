"""A follower's side of Zenoh: what happens to alarms as it is published, and the alarm log by query."""

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


class LogUnavailable(ClientError):  # noqa: N818  # said to whoever follows, by its name
    """A monitor could not answer from its alarm log; the message is the monitor's."""


@dataclass(frozen=True, slots=True)
class AlarmMessage:
    """Something heard of a machine's alarms."""

    place: str  # ``<site>/<machine>``
    kind: Literal["event", "state", "monitor"]  # an alarm event, the alarms as they are now, or a monitor that has come
    text: bytes  # JSON; empty for a monitor


class AlarmTopics:
    """Subscriptions to the alarms of some machines, and questions to their monitors.

    A connection that is lost comes back by itself; what was published in between is not heard. `hear` takes each
    message, on a thread of Zenoh's: be short. Latest states and events that monitors still have come at once, possibly
    out of order and more than once.
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
        """Ask a monitor for an alarm log, JSON of an `AlarmLogPage`; None if nobody answers within five seconds.

        It has at most `limit` events, up to 1000, after this sequence number; -1 for the beginning.

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
    """What a monitor says; empty for what Zenoh itself says, such as that time is up."""
    try:
        said = json.loads(payload)
    except ValueError:
        return ""
    return str(said["error"]) if isinstance(said, dict) and "error" in said else ""
