"""Blocks of one machine between their arrival and their evaluation, and what else its thread is to do."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

__all__ = ["Inbox", "RawBlock"]


@dataclass(frozen=True, slots=True)
class RawBlock:
    """One message of the stream as it arrived.

    Attributes
    ----------
    payload, attachment, encoding : bytes, bytes, str
    dropped_before : int
        Messages that arrived before it and were thrown away because the queue was full.
    """

    payload: bytes
    attachment: bytes
    encoding: str
    dropped_before: int = 0


class Inbox:
    """Bounded queue between the network's thread and the machine's worker.

    Parameters
    ----------
    bound : int
        Most blocks that wait.
    when_full : {"drop", "wait"}
        "drop" throws away everything that waits and counts it: one long gap. Dropping block by block would make many
        short gaps, and each of them costs the hop it falls into. "wait" makes `put` wait for the worker.
    """

    def __init__(self, bound: int, when_full: Literal["drop", "wait"]) -> None:
        self._bound = bound
        self._wait = when_full == "wait"
        self._blocks: deque[RawBlock] = deque()
        self._calls: deque[Callable[[], None]] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Blocks thrown away because the queue was full."""
        return self._dropped

    def __len__(self) -> int:
        return len(self._blocks)

    def put(self, block: RawBlock) -> None:
        """Append a block; after `close` it is ignored."""
        with self._changed:
            if self._wait:
                self._changed.wait_for(lambda: self._closed or len(self._blocks) < self._bound)
            elif len(self._blocks) >= self._bound:
                self._dropped += len(self._blocks)
                before = len(self._blocks) + sum(one.dropped_before for one in self._blocks)
                self._blocks.clear()
                block = replace(block, dropped_before=before)
            if not self._closed:
                self._blocks.append(block)
                self._changed.notify_all()

    def call(self, function: Callable[[], None]) -> bool:
        """Have a function called by the worker before the next block; False after `close`: it will not be."""
        with self._changed:
            if not self._closed:
                self._calls.append(function)
                self._changed.notify_all()
            return not self._closed

    def get(self) -> RawBlock | Callable[[], None] | None:
        """Take what is to be called, or else the oldest block, waiting for one; None after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or bool(self._calls) or bool(self._blocks))
            if self._calls:
                return self._calls.popleft()
            if self._closed:
                return None
            block = self._blocks.popleft()
            self._changed.notify_all()
            return block

    def close(self) -> None:
        """Wake everybody who waits; blocks that are queued are dropped, calls are still made."""
        with self._changed:
            self._closed = True
            self._blocks.clear()
            self._changed.notify_all()
