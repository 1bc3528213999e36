"""Requests to stop a program by a signal."""

import queue
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

_TICK_S = 0.25


class StopRequest:
    """Whether SIGINT, SIGTERM or SIGHUP has come."""

    def __init__(self) -> None:
        # A threading.Event could deadlock: the handler may interrupt the main thread while that holds the event's lock.
        self._asked: queue.SimpleQueue[bool] = queue.SimpleQueue()

    def ask(self) -> None:
        """Ask for the stop."""
        self._asked.put(True)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the stop, at most `timeout_s`, and return whether it was requested.

        Polls, because the system may deliver the signal to one of Zenoh's threads, and Python runs the handler only
        when the main thread next executes bytecode.
        """
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            try:
                self._asked.put(self._asked.get(timeout=_TICK_S))  # put back for the next caller
            except queue.Empty:
                if deadline_s is not None and time.monotonic() >= deadline_s:
                    return False
            else:
                return True


@contextmanager
def stop_request() -> Iterator[StopRequest]:
    """Turn SIGINT, SIGTERM and SIGHUP into a request to stop within the block.

    SIGHUP is sent when the terminal is closed; if it is ignored (nohup), it stays ignored.
    """
    stop = StopRequest()
    numbers = [signal.SIGINT, signal.SIGTERM]
    numbers += [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    with handled(numbers, lambda *_: stop.ask()):
        yield stop


@contextmanager
def handled(numbers: Iterable[signal.Signals], handler: Callable[..., Any]) -> Iterator[None]:
    """Handle signals within the block; the previous handlers are restored afterwards."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)
