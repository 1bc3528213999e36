"""The clocks of a machine's thread, and whether the thread still responds."""

import time
from collections.abc import Callable
from dataclasses import dataclass

STUCK_S = 60.0
"""A thread that is at work on one block for longer is stuck; an evaluation takes a fraction of a second."""


@dataclass(frozen=True, slots=True)
class Clocks:
    """The computer's clocks; tests replace them."""

    monotonic_s: Callable[[], float] = time.monotonic
    utc_ns: Callable[[], int] = time.time_ns  # time of day


COMPUTER = Clocks()


class Pulse:
    """Measures from outside how long a thread has been at work on the same thing.

    Its calls go before all waiting blocks, so that only the present block can hold them up.

    Parameters
    ----------
    call : callable
        Has a function called by the thread; False if it never will be. `service.stream.inbox.Inbox.call` is one.
    work : callable
        What the thread does with every beat that it answers.

    Examples
    --------
    >>> waiting, now_s = [], 5.0
    >>> pulse = Pulse(lambda function: not waiting.append(function), lambda: None, lambda: now_s)
    >>> pulse.beat()
    >>> now_s = 75.0
    >>> pulse.beat()
    >>> pulse.busy_s
    70.0
    >>> waiting.pop()()
    >>> pulse.busy_s
    0.0
    """

    def __init__(
        self,
        call: Callable[[Callable[[], None]], bool],
        work: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._call = call
        self._work = work
        self._clock = clock
        self._sent_s: float | None = None

    @property
    def busy_s(self) -> float:
        """How long the thread has not answered; 0 if it has."""
        sent_s = self._sent_s
        return 0.0 if sent_s is None else self._clock() - sent_s

    def beat(self) -> None:
        """Ask for a sign of life, unless one is still outstanding; called every now and then."""
        if self._sent_s is None:
            self._sent_s = self._clock()
            if not self._call(self._answered):
                self._sent_s = None

    def _answered(self) -> None:
        self._sent_s = None
        self._work()
