"""Pause, seek and stop a replay from another thread."""

import threading
import time
from collections.abc import Callable

# The main thread must wake up now and then: Python runs signal handlers nowhere else.
_SLICE_S = 0.25


class Control:
    """Orders to a running replay; safe to use from several threads.

    The thread that replays calls `wait_until` before each message, and `take_seek` afterwards.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._paused_since_s: float | None = None
        self._paused_total_s = 0.0
        self.stopped = False  # whether the replay is to end
        self.reason = ""  # why it is to end, if that needs saying
        self._seek_ns: int | None = None
        self.position_ns = 0  # where the replay is

    @property
    def paused(self) -> bool:
        """Whether the replay is paused."""
        return self._paused_since_s is not None

    def now_s(self) -> float:
        """Seconds of a clock that stands still while the replay is paused."""
        since_s = self._paused_since_s
        return (time.monotonic() if since_s is None else since_s) - self._paused_total_s

    def stop(self, reason: str = "") -> None:
        """End the replay; the first reason given is kept."""
        with self._changed:
            self.reason = self.reason or reason
            self.stopped = True
            self._changed.notify_all()

    def pause(self) -> None:
        """Wait before the next message."""
        with self._changed:
            if self._paused_since_s is None:
                self._paused_since_s = time.monotonic()
            self._changed.notify_all()

    def resume(self) -> None:
        """Go on."""
        with self._changed:
            if self._paused_since_s is not None:
                self._paused_total_s += time.monotonic() - self._paused_since_s
                self._paused_since_s = None
            self._changed.notify_all()

    def seek(self, to_ns: int) -> None:
        """Go on with the data from this time on; a paused replay stays paused there."""
        with self._changed:
            self._seek_ns = to_ns
            self._changed.notify_all()

    def seek_by(self, seconds: float) -> None:
        """Go on that much later, or earlier if negative, counted from where the replay is."""
        with self._changed:
            base = self.position_ns if self._seek_ns is None else self._seek_ns
            self._seek_ns = base + round(seconds * 1e9)
            self._changed.notify_all()

    def at(self, position_ns: int) -> None:
        """Take note of where the replay is."""
        with self._changed:
            self.position_ns = position_ns

    def wait_until(self, deadline_s: float | None, on_pause: Callable[[], None] | None = None) -> bool:
        """Wait until a moment of `now_s`, or not at all; return False as soon as the replay is to stop or to seek.

        While paused, wait on; `on_pause` is called once when the replay is found paused.
        """
        with self._changed:
            while not (self.stopped or self._seek_ns is not None):
                if self._paused_since_s is not None:
                    if on_pause is not None:
                        on_pause()
                        on_pause = None
                    self._changed.wait(_SLICE_S)
                    continue
                left_s = 0.0 if deadline_s is None else deadline_s - self.now_s()
                if left_s <= 0:
                    return True
                self._changed.wait(min(left_s, _SLICE_S))
            return False

    def take_seek(self) -> int | None:
        """Data time from which to go on, None for no change; the order is then forgotten."""
        with self._changed:
            wish, self._seek_ns = self._seek_ns, None
            return wish
