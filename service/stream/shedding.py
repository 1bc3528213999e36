"""When a machine's worker evaluates: in its turn, and less often if the computer cannot keep up."""

import math
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

_LASTING_S = 30.0
_LONGEST_TURN_S = 3.0
_lock = threading.Lock()
_turns: deque[threading.Event] = deque()
"""Turns of the machines in order: the first one has begun and is set, the others wait."""


@contextmanager
def in_turn(*, completes_hop: bool) -> Iterator[None]:
    """Let the machines of the process complete hops one after the other, in the order in which they ask.

    Python computes in one thread at a time anyway. Workers that evaluate side by side only interrupt each other's
    arithmetic: each holds its intermediate results meanwhile, and finds the processor's caches filled with those of the
    others. In turns, all machines have their next window after a stall before any has its last one.

    The others wait for a turn no longer than `_LONGEST_TURN_S`, so that one that never ends stops none.
    """
    if not completes_hop:
        yield
        return
    mine = threading.Event()
    with _lock:
        _turns.append(mine)
        _turns[0].set()
    while not mine.is_set():
        with _lock:
            first = _turns[0]
        if not mine.wait(_LONGEST_TURN_S):
            _end(first)
    try:
        yield
    finally:
        _end(mine)


def _end(turn: threading.Event) -> None:
    """Let the next one begin, if this turn has not been ended before."""
    with _lock:
        if turn in _turns:
            _turns.remove(turn)
            if _turns:
                _turns[0].set()


class LoadShedding:
    """Decides which windows are skipped.

    A worker is behind if, when it completes a hop, all blocks of the next one wait already. After a stall or a restart
    the waiting blocks become fewer from hop to hop, and every window is evaluated, unless there is another stall
    meanwhile. If they have not become fewer for `_LASTING_S`, the computer is too small for its work: then a window is
    skipped if at least a quarter of the next hop waits at its end, until none has been skipped for `_LASTING_S`.
    """

    def __init__(self) -> None:
        self._fewest: float = math.inf  # blocks that have waited since the worker fell behind
        self._fewer_s = math.inf  # when they last became fewer
        self._skipped_s = -math.inf  # when a window was last skipped

    def skips(self, waiting: int, to_hop: int, now_s: float) -> bool:
        """Whether the window that a hop has completed is skipped, at a monotonic time.

        The number of `waiting` blocks (`Inbox.behind`) is compared with how many complete the next hop.
        """
        if waiting < to_hop:
            self._fewest, self._fewer_s = math.inf, now_s
        elif waiting < self._fewest:
            self._fewest, self._fewer_s = waiting, now_s
        lately = now_s - self._skipped_s < _LASTING_S and 4 * waiting >= to_hop
        skips = lately or now_s - self._fewer_s >= _LASTING_S
        if skips:
            self._skipped_s = now_s
        return skips
