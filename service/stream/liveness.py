"""The clocks of a machine's thread, whether it still responds, and the time by its data, also while none come."""

import time
from collections.abc import Callable
from dataclasses import dataclass

STUCK_S = 60.0
"""A thread that is at work on one block for longer is stuck; an evaluation takes a fraction of a second."""
_LONGEST_TICK_S = 2.0
"""Ticks are a fraction of this apart; if not, the program itself stood still."""
_RESTARTING_S = 20.0  # to hear a stream again after a restart: the publishers' cached blocks of all machines come first


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


class DataClock:
    """Goes on from the end of the newest data as time passes; its machine's thread ticks it, any thread may read it.

    Parameters
    ----------
    no_data_after_s : float
        How long a silence may last.
    """

    def __init__(self, clocks: Clocks, no_data_after_s: float) -> None:
        self._clocks = clocks
        self._no_data_after_s = no_data_after_s
        self._asleep_s = 0.0
        self._latest_s: float | None = None  # when the latest block came; None before the first
        self._operated_ns = 0
        self._begin_s = self._ticked_s = self._held_up_s = clocks.monotonic_s()

    def slept(self, since_ns: int) -> None:
        """Take note of when, by this computer's time of day, the latest known state or message was recorded."""
        self._asleep_s = max(0.0, (self._clocks.utc_ns() - since_ns) / 1e9)

    def wake(self) -> None:
        """Take note that all blocks so far came from a recording, none of them just now."""
        self._latest_s = None

    def begin(self) -> None:
        """Take note that blocks may come from now on."""
        self._begin_s = self._ticked_s = self._clocks.monotonic_s()

    def came(self, *, continuous: bool) -> None:
        """Take note of an accepted block."""
        if self._latest_s is None or not continuous:
            self._operated_ns = 0  # perhaps by another clock
        self._latest_s = self._clocks.monotonic_s()

    def tick(self) -> None:
        """Take note that time has passed; a standstill of the program is no silence unless one had begun before."""
        now_s = self._clocks.monotonic_s()
        if now_s - self._ticked_s > _LONGEST_TICK_S and self._ticked_s - self._heard_s < self._limit_s:
            self._held_up_s = now_s
        self._ticked_s = now_s

    @property
    def age_s(self) -> float | None:
        """Time since the latest block came; None before the first."""
        latest_s = self._latest_s
        return None if latest_s is None else round(max(0.0, self._clocks.monotonic_s() - latest_s), 3)

    @property
    def silent(self) -> bool:
        """Whether no usable block has come for longer than a silence may last."""
        before_s = self._asleep_s if self._latest_s is None else 0.0
        return self._clocks.monotonic_s() - self._heard_s + before_s > self._no_data_after_s

    @property
    def given_up(self) -> bool:
        """Whether, at the last tick, no block had come for so long that none is waited for any longer."""
        return self._ticked_s - self._heard_s >= self._limit_s

    @property
    def stands(self) -> bool:
        """Whether, at the last tick, blocks may have been lacking only because none could be heard yet."""
        return self._latest_s is None or self._ticked_s - self._latest_s >= self._limit_s

    @property
    def _limit_s(self) -> float:
        return max(self._no_data_after_s, _RESTARTING_S if self._latest_s is None else 0.0)

    @property
    def _heard_s(self) -> float:
        """When the latest block came or, if later, when this program went on after it had stood still."""
        return max(self._held_up_s, self._begin_s if self._latest_s is None else self._latest_s)

    def now_ns(self, end_ns: int | None) -> int:
        """Data time that has been reached: end of the newest data plus the time since; time of day before any data."""
        if end_ns is None:
            return self._clocks.utc_ns()
        now_s = self._clocks.monotonic_s()
        if self._latest_s is None:
            return end_ns + round((self._asleep_s + now_s - self._begin_s) * 1e9)
        return end_ns + round((now_s - self._latest_s) * 1e9)

    def next_ns(self, end_ns: int | None) -> int:
        """The same for an operator's action: no two actions have the same time."""
        self._operated_ns = max(self.now_ns(end_ns), self._operated_ns + 1)
        return self._operated_ns
