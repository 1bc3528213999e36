"""Subscribing to sample blocks: what publishers have kept first, then what comes, in order.

Zenoh's advanced subscriber can ask for what is kept at once, ask publishers that appear later, and have fetched again
what was lost on the way. One that is to do two of these loses all that is kept if a new block comes between the
answers: that is handed on, and what is older counts as late (zenoh-ext 1.10, unless a cache holds as much as was asked
for). So there are two, until one has caught up with the other.
"""

import time
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import zenoh
import zenoh.ext

CACHED_BLOCKS = 1200
"""Fewer than a queue takes by default: what comes at once after a restart must not overflow it."""
_WAITING_BLOCKS = 4096
"""Far more than come between two looks of whoever takes them; beyond, the network waits."""
_PATIENCE_S = 15.0
"""Longer than Zenoh waits for what is kept, which is 10 s."""
_PUBLISHERS = 64
_ANSWERS_S = 0.5
"""In which a publisher is noticed that was there when it was asked."""


class BlockSubscription:
    """The blocks of a stream.

    Parameters
    ----------
    on_missed : callable
        Takes what says how many messages were lost on the way and could not be fetched again.
    """

    def __init__(self, session: zenoh.Session, key: str, on_missed: Callable[[zenoh.ext.Miss], None]) -> None:
        # New blocks first: what is kept is asked for when none can be overlooked any more.
        self._new: zenoh.ext.AdvancedSubscriber[Any] = zenoh.ext.declare_advanced_subscriber(
            session,
            key,
            zenoh.handlers.FifoChannel(_WAITING_BLOCKS),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            subscriber_detection=True,
        )
        self._missed = self._new.sample_miss_listener(on_missed)
        self._ask: Callable[[], zenoh.ext.AdvancedSubscriber[Any]] = lambda: zenoh.ext.declare_advanced_subscriber(
            session,
            key,
            zenoh.handlers.FifoChannel(_WAITING_BLOCKS),
            history=zenoh.ext.HistoryConfig(max_samples=CACHED_BLOCKS),
        )
        self._kept: zenoh.ext.AdvancedSubscriber[Any] | None = self._ask()
        self._asked_s = time.monotonic()
        self._appeared = False
        self._ahead: dict[Hashable, zenoh.Sample] = {}  # new blocks, until what is kept has come to them
        self._ahead_s = self._asked_s  # since when
        self._reached: Hashable = None  # the latest of those that were kept
        self._numbers: dict[tuple[str, int], int] = {}  # of the latest that were handed on, by publisher

    def publisher_appeared(self) -> None:
        """Ask for what is kept again; from any thread."""
        self._appeared = True

    def take(self, callback: Callable[[zenoh.Sample], None], most: int, *, last: bool = False) -> None:
        """Call back for every block that has come, some `most` of them; from one thread at a time.

        The `last` time blocks wait no longer for what is kept.
        """
        for sample in self._come(most, last=last):
            number = _number(sample)
            if number is not None:
                if number[1] <= self._numbers.get(number[0], -1):
                    continue  # kept as well as new
                if len(self._numbers) > _PUBLISHERS:
                    self._numbers.clear()
                self._numbers[number[0]] = number[1]
            callback(sample)

    def _come(self, most: int, *, last: bool) -> Sequence[zenoh.Sample]:
        now_s = time.monotonic()
        if self._appeared and self._reached is None:
            self._appeared = False
            if now_s - self._asked_s > _ANSWERS_S:
                self._close_kept()
                self._kept, self._asked_s = self._ask(), now_s
        if self._kept is None:
            return _received(self._new, most)
        # In this order, so that all that has come as kept until now has also come as new, if it is new.
        kept = _received(self._kept, most)
        self._ahead |= {_identity(one): one for one in _received(self._new, most)}
        if not self._ahead:
            self._ahead_s = now_s
        new = list(self._ahead.values())
        if kept and self._reached is None and _identity(kept[0]) in self._ahead:  # which had all fetched again
            kept, caught_up = new, True
        else:
            self._reached = _identity(kept[-1]) if kept else self._reached
            caught_up = self._reached in self._ahead
            begin = list(self._ahead).index(self._reached) + 1 if caught_up else 0
            overdue = now_s - self._ahead_s > _PATIENCE_S
            if caught_up or last or overdue or len(new) > _WAITING_BLOCKS:
                kept, caught_up = kept + new[begin:], True
        if caught_up:
            self._close_kept()
            self._kept, self._reached, self._ahead = None, None, {}
        return kept

    def _close_kept(self) -> None:
        if self._kept is not None:
            self._kept.undeclare()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Receive nothing any more."""
        self._close_kept()
        self._missed.undeclare()  # type: ignore[no-untyped-call]
        self._new.undeclare()  # type: ignore[no-untyped-call]


def _received(subscriber: zenoh.ext.AdvancedSubscriber[Any], most: int) -> list[zenoh.Sample]:
    received = iter(subscriber.try_recv, None)
    return [sample for _, sample in zip(range(most), received, strict=False)]


def _number(sample: zenoh.Sample) -> tuple[tuple[str, int], int] | None:
    """The publisher and the number of the message; None of one who numbers nothing."""
    info = sample.source_info
    return None if info is None else ((str(info.source_id.zid), info.source_id.eid), info.source_sn)


def _identity(sample: zenoh.Sample) -> Hashable:
    attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
    return _number(sample) or (sample.payload.to_bytes(), attachment, str(sample.encoding))
