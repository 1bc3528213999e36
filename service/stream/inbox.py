"""From the network to a machine's thread: one intake for all machines, and a queue for each, of blocks and of calls."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from models.signals.wire import sender_of

_MOST_NON_BLOCKS = 16
_PATIENCE_S = 0.5
_EVERY_S = 0.05


@dataclass(frozen=True, slots=True)
class RawBlock:
    """One message of the stream as it arrived."""

    payload: bytes
    attachment: bytes
    encoding: str
    source: str = ""  # session and number of its publisher; empty if it does not say
    dropped_before: int = 0  # messages that arrived before it and were thrown away because the queue was full

    @property
    def sender(self) -> tuple[str, str, int | None]:
        """Apparent sender: source, kind of encoding, and run."""
        return (self.source, *sender_of(self.attachment, self.encoding))


class Inbox:
    """Bounded queue between the network's thread and the machine's worker.

    Messages that cannot be blocks, and those of publishers other than the one that is followed, never displace a block
    of that publisher: its blocks are taken first, and the others make room for them.

    Parameters
    ----------
    bound : int
        Most blocks that wait.
    when_full : {"drop", "wait"}
        "drop" throws away the blocks of others or, if there are none, all that wait, and counts them: one long gap.
        Dropping block by block would make many short gaps, each of which costs the hop it falls into. "wait" makes
        `put` wait for the worker.
    most_bytes : int
        Most bytes that wait.
    may_be_block : callable
        Takes a message, and whether it is from the publisher that is followed; returns whether it may be one of the
        machine's blocks. Of those that cannot, a few are passed on, so that their error can be reported; the others
        are counted.
    """

    def __init__(
        self,
        bound: int,
        when_full: Literal["drop", "wait"],
        most_bytes: int = 2**26,
        may_be_block: Callable[[RawBlock, bool], bool] = lambda _, __: True,
    ) -> None:
        self._bound = bound
        self._wait = when_full == "wait"
        self._most_bytes = most_bytes
        self._may_be_block = may_be_block
        self._blocks: deque[RawBlock] = deque()
        self._others: deque[RawBlock] = deque()
        self._bytes = 0
        self._non_blocks: deque[RawBlock] = deque()
        self._followed: tuple[str, str, int | None] | None = None
        self._calls: deque[Callable[[], None]] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._enough = 1
        self._caught_up = False
        self.dropped = 0  # blocks of the publisher that is followed, thrown away because the queue was full
        self.unread = 0  # messages thrown away that could be no blocks, or came from others, because too many came

    @property
    def behind(self) -> int:
        """Waiting blocks of the publisher that is followed; 0 if the worker has taken everything since the last call.

        Blocks that come many at a time wait even for a worker that is not behind.
        """
        ready, self._caught_up = self._caught_up, False
        return 0 if ready else len(self._blocks)

    def __len__(self) -> int:
        return len(self._blocks) + len(self._others) + len(self._non_blocks)

    def follow(self, block: RawBlock) -> None:
        """Follow the publisher of a block that was used."""
        if block.sender == self._followed:
            return
        with self._changed:
            self._followed = block.sender
            waiting = (*self._blocks, *self._others)
            self._blocks = deque(one for one in waiting if one.sender == self._followed)
            self._others = deque(one for one in waiting if one.sender != self._followed)

    def put(self, block: RawBlock) -> None:
        """Append a block; after `close` it is ignored."""
        known = block.source != "" and block.sender == self._followed  # anybody may send the same run
        odd = not self._may_be_block(block, known)
        with self._changed:
            if self._closed:
                return
            if odd:
                if len(self._non_blocks) >= _MOST_NON_BLOCKS:
                    self.unread += 1
                    return
                self._non_blocks.append(block)
            else:
                if self._wait:
                    self._changed.wait_for(lambda: self._closed or not self._is_full)
                    if self._closed:
                        return
                theirs = self._followed is not None and block.sender != self._followed
                if self._is_full:
                    if theirs and self._blocks:
                        self.unread += 1
                        return
                    block = self._with_room(block)
                (self._others if theirs else self._blocks).append(block)
                self._bytes += len(block.payload)
            if self._worker_should_wake():
                self._changed.notify_all()

    def _worker_should_wake(self) -> bool:
        """Whether to wake the worker now, rather than wait for more blocks."""
        others = self._closed or self._calls or self._non_blocks or self._others
        return bool(others) or len(self._blocks) >= self._enough or (bool(self._blocks) and self._is_full)

    @property
    def _is_full(self) -> bool:
        return len(self._blocks) + len(self._others) >= self._bound or self._bytes >= self._most_bytes

    def _with_room(self, block: RawBlock) -> RawBlock:
        """Make room, if possible by dropping others' blocks; return the block with the count dropped before it."""
        if self._others:
            self.unread += len(self._others)
            self._others.clear()
            self._bytes = sum(len(one.payload) for one in self._blocks)
            return block
        before = len(self._blocks) + sum(one.dropped_before for one in self._blocks)
        self.dropped += len(self._blocks)
        self._blocks.clear()
        self._bytes = 0
        return replace(block, dropped_before=before)

    def call(self, function: Callable[[], None]) -> bool:
        """Have a function called by the worker before the next block; False after `close`: it will not be."""
        with self._changed:
            if not self._closed:
                self._calls.append(function)
                self._changed.notify_all()
            return not self._closed

    def get(self, enough: int = 1) -> RawBlock | Callable[[], None] | None:
        """Take the next function to be called, or else the oldest block, waiting for one; None after `close`.

        A worker that has taken everything may wait for `enough` blocks: to be woken for each of them costs more than
        most take to process. It waits half a second at most, and a call ends the wait.
        """
        with self._changed:
            if not (self._calls or len(self)):
                self._caught_up = True
                self._enough = min(enough, max(1, self._bound // 4))
                self._changed.wait_for(self._worker_should_wake, _PATIENCE_S)
                self._enough = 1
            self._changed.wait_for(lambda: self._closed or bool(self._calls) or len(self) > 0)
            if self._calls:
                return self._calls.popleft()
            if self._closed:
                return None
            waiting = self._blocks or self._others
            if not waiting:
                return self._non_blocks.popleft()
            block = waiting.popleft()
            self._bytes -= len(block.payload)
            self._changed.notify_all()
            return block

    def close(self) -> None:
        """Wake everybody who waits; blocks that are queued are dropped, calls are still made."""
        with self._changed:
            self._closed = True
            for waiting in (self._blocks, self._others, self._non_blocks):
                waiting.clear()
            self._changed.notify_all()


class Intake:
    """Has all channels emptied every twentieth of a second.

    A thread for each channel that is woken for each message takes nearly three times the processor time: most of that
    goes into waking up and waiting for Python's lock.
    """

    def __init__(self) -> None:
        self._takers: list[Callable[[], None]] = []
        self._lock = threading.Lock()  # held while messages are taken
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)

    def add(self, take: Callable[[], None]) -> Callable[[], None]:
        """Have a channel emptied by `take` from now on; returns a function that ends this at once.

        `take` must not raise; all other channels wait for it.
        """
        with self._lock:
            self._takers.append(take)
            if self._thread.ident is None:
                self._thread.start()

        def end() -> None:
            with self._lock:
                self._takers = [one for one in self._takers if one is not take]

        return end

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._closed.wait(_EVERY_S):
            with self._lock:
                for take in self._takers:
                    take()
