"""Subscribing to sample blocks: those in a publisher's cache first, then new ones, in order.

Zenoh's advanced subscriber can query caches, and fetch again what was lost on the way. If it does both, it loses all
cached blocks when a new one comes between the answers: it passes on the new one and takes older ones for late
(zenoh-ext 1.10, unless a cache holds as much as was asked for). Here it only fetches lost blocks, and this module
queries each publisher's cache as Zenoh's own subscriber would, once, when the publisher is first found or heard.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

import zenoh
import zenoh.ext

CACHED_BLOCKS = 1200
"""Most blocks taken from a cache: fewer than a queue holds by default, so that a restart does not overflow it."""
_WAITING_BLOCKS = 4096
"""Far more than come between two calls of `BlockSubscription.take`; beyond, the network waits."""
_HELD_UP_BLOCKS = 256
"""The same where the network waits anyway: more would only take memory."""
_ANSWER_S = 10.0
_QUESTIONS = 2
"""Queries to a cache without an answer: the link by which it was to come may have broken."""
_PUBLISHERS = 64
"""Most publishers remembered; of those no longer waited for, the latest half. Anybody may claim to be another one."""
_CACHES = "/@adv/pub/"
"""Below the key of the stream: the cache of each publisher, and its liveliness token."""
_WITH_HEARTBEATS = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
# The period has no use, but without one missing blocks would not be fetched at all.
_WITHOUT_HEARTBEATS = zenoh.ext.RecoveryConfig(periodic_queries=timedelta(days=365), heartbeat=None)  # type: ignore[arg-type]  # the stub says seconds
_NUMBERED_BY_TIME = "uhlc"
"""Stands for the number of a publisher whose messages carry times but no numbers."""


@dataclass(slots=True)
class _Kept:
    """The cached blocks of a publisher, until its new blocks follow on."""

    answers: Any = None  # of its cache, in order; None when there are no more
    new: dict[int, zenoh.Sample] = field(default_factory=dict)  # new blocks that came meanwhile, by number
    reached: int = -1  # number of the latest cached block received
    questions: int = _QUESTIONS  # queries left


class BlockSubscription:
    """The blocks of a stream.

    Parameters
    ----------
    on_missed : callable
        Takes Zenoh's count of messages that were lost on the way and could not be fetched again.
    holds_up : bool
        Whether the callback of `take` may wait, which holds up the network, and so the publishers. Their heartbeats are
        ignored then: one that overtakes blocks that are held up would make Zenoh skip these.
    """

    def __init__(
        self, session: zenoh.Session, key: str, on_missed: Callable[[zenoh.ext.Miss], None], *, holds_up: bool = False
    ) -> None:
        self._session = session
        self._key = key
        self._publishers: dict[str, _Kept | None] = {}  # None: new blocks are passed on as they come
        self._found: deque[zenoh.Sample] = deque()
        # Subscribe to new blocks before any cache is queried, so that none is missed in between.
        self._new: zenoh.ext.AdvancedSubscriber[Any] = zenoh.ext.declare_advanced_subscriber(
            session,
            key,
            zenoh.handlers.FifoChannel(_HELD_UP_BLOCKS if holds_up else _WAITING_BLOCKS),
            recovery=_WITHOUT_HEARTBEATS if holds_up else _WITH_HEARTBEATS,
            subscriber_detection=True,
        )
        self._missed = self._new.sample_miss_listener(on_missed)
        there = zenoh.handlers.Callback(self._found.append, indirect=False)
        self._cache_tokens = session.liveliness().declare_subscriber(f"{key}{_CACHES}**", there, history=True)

    def take(self, callback: Callable[[zenoh.Sample], None], most: int, *, last: bool = False) -> None:
        """Call back for every block that has come, about `most` at once; from one thread at a time.

        The `last` time new blocks no longer wait for cached ones.
        """
        while self._found:
            found = self._found.popleft()
            _, _, cache = str(found.key_expr).partition(_CACHES)
            if found.kind == zenoh.SampleKind.PUT and "*" not in cache:  # a hostile publisher may send one
                self._cached_blocks_of("/".join(cache.split("/")[:2]))
        received = iter(self._new.try_recv, None)
        for _, sample in zip(range(most), received, strict=False):
            origin = _origin(sample)
            if origin is None:
                callback(sample)
                continue
            publisher, number = origin
            if (kept := self._cached_blocks_of(publisher)) is not None:
                kept.new.setdefault(number, sample)
                continue
            if publisher in self._publishers:  # heard last, forgotten last
                self._publishers[publisher] = self._publishers.pop(publisher)
            callback(sample)
        awaited = [(publisher, kept) for publisher, kept in self._publishers.items() if kept is not None]
        if not awaited and len(self._publishers) <= _PUBLISHERS // 2:
            return
        waits = not last and sum(len(kept.new) for _, kept in awaited) <= _WAITING_BLOCKS
        for publisher, kept in awaited:
            for sample in self._join(publisher, kept, most if waits else _WAITING_BLOCKS, waits=waits):
                callback(sample)
        answered = [name for name, kept in self._publishers.items() if kept is None or kept.answers is None]
        for publisher in answered[: -_PUBLISHERS // 2]:
            del self._publishers[publisher]

    def _cached_blocks_of(self, publisher: str) -> _Kept | None:
        """Cached blocks to pass on before a publisher's new ones; the cache of an unknown publisher is queried."""
        if publisher not in self._publishers and len(self._publishers) < _PUBLISHERS:
            self._ask(publisher, _Kept())
        return self._publishers.get(publisher)

    def _join(self, publisher: str, kept: _Kept, most: int, *, waits: bool) -> list[zenoh.Sample]:
        """Blocks of a publisher to pass on now: cached ones and, once they meet them, the new ones."""
        joined, numbered = _received(publisher, kept, most), not publisher.endswith(_NUMBERED_BY_TIME)
        met = bool(kept.new) and min(kept.new) <= kept.reached + numbered
        if kept.answers is not None and waits and not met:
            return joined
        new = kept.new = {number: sample for number, sample in kept.new.items() if number > kept.reached}
        # Blocks in between were published before the subscription arrived, or their answers were lost with a link.
        if new and numbered and waits and not met and kept.questions:
            self._ask(publisher, kept)
            return joined
        self._publishers[publisher] = None if new or not waits else kept
        return [*joined, *new.values()]

    def _ask(self, publisher: str, kept: _Kept) -> None:
        kept.questions -= 1
        numbers = "" if publisher.endswith(_NUMBERED_BY_TIME) else f";_sn={kept.reached + 1}.."
        channel: Any = zenoh.handlers.FifoChannel(_WAITING_BLOCKS)
        kept.answers = self._session.get(
            f"{self._key}{_CACHES}{publisher}/**?_max={CACHED_BLOCKS}{numbers}",
            channel,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=_ANSWER_S,
        )
        self._publishers[publisher] = kept

    def close(self) -> None:
        """Receive nothing any more."""
        self._cache_tokens.undeclare()  # type: ignore[no-untyped-call]
        self._publishers.clear()  # with the answers still to come
        self._missed.undeclare()  # type: ignore[no-untyped-call]
        self._new.undeclare()  # type: ignore[no-untyped-call]


def _received(publisher: str, kept: _Kept, most: int) -> list[zenoh.Sample]:
    """Answers of a cache since the last call, with the new blocks in between that the cache no longer held."""
    received: list[zenoh.Sample] = []
    try:
        for _ in range(most):
            if kept.answers is None or (reply := kept.answers.try_recv()) is None:
                break
            if reply.ok is None:  # the query has timed out
                kept.questions = 0
                continue
            by, number = _origin(reply.ok) or ("", -1)
            if by != publisher or number <= kept.reached:
                continue
            while kept.new and (first := next(iter(kept.new))) <= number:
                sample = kept.new.pop(first)
                if kept.reached < first < number:
                    received.append(sample)
            kept.reached, kept.questions = number, _QUESTIONS
            received.append(reply.ok)
    except zenoh.ZError:  # no more will come
        kept.answers = None
    return received


def _origin(sample: zenoh.Sample) -> tuple[str, int] | None:
    """Place of the publisher's cache, and the number of the message or its time; None if it carries neither."""
    if (info := sample.source_info) is not None:
        return f"{info.source_id.zid}/{info.source_id.eid}", info.source_sn
    if sample.timestamp is not None:
        time, _, session = str(sample.timestamp).partition("/")
        return f"{session}/{_NUMBERED_BY_TIME}", int(time)
    return None
