"""The time by a machine's data, also while none come, and for how long there have been none."""

from service.stream.liveness import Clocks

_LONGEST_TICK_S = 2.0
"""Ticks are a fraction of this apart; if not, the program itself stood still."""
_RESTARTING_S = 20.0  # to hear a stream again after a restart: the publishers' cached blocks of all machines come first


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
