"""Limits on how often, and on how many at once: moving windows, and seats for event streams.

Counted on the monotonic clock, so that setting the time of day back locks nobody out, and for a bounded number of keys,
so that many addresses do not fill the memory. Both are used by the event loop alone.
"""

import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from starlette.exceptions import HTTPException

_MINUTE_S = 60.0
_KEYS = 10_000
_SEATS_RETRY_S = 5


class MovingWindow:
    """At most `amount` hits of a key within any minute; beyond `keys`, the key used longest ago is forgotten.

    Examples
    --------
    >>> now_s = 0.0
    >>> window = MovingWindow(1, clock=lambda: now_s)
    >>> window.hit("control room"), window.hit("control room"), window.hit("historian")
    (0.0, 60.0, 0.0)
    """

    def __init__(self, amount: int, *, clock: Callable[[], float] = time.monotonic, keys: int = _KEYS) -> None:
        self._amount = amount
        self._clock = clock
        self._keys = keys
        self._hits: OrderedDict[str, deque[float]] = OrderedDict()

    def __len__(self) -> int:
        """Keys that are remembered."""
        return len(self._hits)

    def hit(self, key: str) -> float:
        """Count a hit; seconds to wait if it is one too many (it is not counted then), 0 if it is admitted."""
        wait_s = self.wait(key)
        if wait_s == 0.0:
            self._hits.setdefault(key, deque()).append(self._clock())
            self._hits.move_to_end(key)
            if len(self._hits) > self._keys:
                self._hits.popitem(last=False)
        return wait_s

    def wait(self, key: str) -> float:
        """Seconds until a hit would be admitted; counts nothing."""
        hits = self._hits.get(key)
        if hits is None:
            return 0.0
        now_s = self._clock()
        while hits and hits[0] <= now_s - _MINUTE_S:
            hits.popleft()
        if not hits:
            del self._hits[key]
        return 0.0 if len(hits) < self._amount else hits[0] + _MINUTE_S - now_s


class StreamSeats:
    """Open event streams: at most `per_caller` of one caller, and `total` in all."""

    def __init__(self, per_caller: int, total: int) -> None:
        self._per_caller = per_caller
        self._total = total
        self._taken: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        """Streams that are open."""
        return self._taken.total()

    @contextmanager
    def seat(self, key: str) -> Iterator[None]:
        """Hold a seat inside a ``with`` block.

        Raises
        ------
        HTTPException
            429 if there is none; the message says whether the caller has too many streams or the service.
        """
        if self._taken[key] >= self._per_caller:
            raise _full(f"{self._per_caller} of your event streams are open, the most allowed: close one")
        if self.taken >= self._total:
            raise _full(f"{self._total} event streams are open, the most this service allows")
        self._taken[key] += 1
        try:
            yield
        finally:
            self._taken[key] -= 1
            if not self._taken[key]:
                del self._taken[key]


def _full(text: str) -> HTTPException:
    return HTTPException(429, text, {"Retry-After": str(_SEATS_RETRY_S)})
