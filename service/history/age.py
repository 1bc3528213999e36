"""The time by which the age of kept data is measured: the computer's, unless that was just set forward."""

import time
from collections.abc import Callable

import structlog

_FORWARD_NS = 3600 * 10**9  # largest step believed at once, such as summer time or a correction at the start
_BELIEVED_S = 86_400.0

_BOOT_CLOCK: int | None = getattr(time, "CLOCK_BOOTTIME", None)

_log = structlog.get_logger("rotorwatch", part="history")


def running_s() -> float:
    """Monotonic time in seconds, on Linux counted also while the computer is suspended."""
    return time.monotonic() if _BOOT_CLOCK is None else time.clock_gettime(_BOOT_CLOCK)


class AgeClock:
    """The computer's time of day; a step forward of more than an hour counts once it has lasted for a day.

    Otherwise a time server or a clock that is wrong for some minutes would have everything deleted that is kept for
    days.

    Parameters
    ----------
    now_ns : callable
        Time of day, nanoseconds since 1970-01-01 UTC.
    monotonic_s : callable
        Monotonic time in seconds.
    """

    def __init__(self, now_ns: Callable[[], int] = time.time_ns, monotonic_s: Callable[[], float] = running_s) -> None:
        self._now_ns = now_ns
        self._monotonic_s = monotonic_s
        self._offset_ns = now_ns() - round(monotonic_s() * 1e9)
        self._ahead_ns: int | None = None  # offset that is not believed yet
        self._since_s = 0.0

    def __call__(self) -> int:
        """Nanoseconds since 1970-01-01 UTC."""
        now_ns, passed_s = self._now_ns(), self._monotonic_s()
        offset_ns = now_ns - round(passed_s * 1e9)
        if offset_ns - self._offset_ns <= _FORWARD_NS:
            self._ahead_ns = None
        else:
            if self._ahead_ns is None or abs(offset_ns - self._ahead_ns) > _FORWARD_NS:
                self._ahead_ns, self._since_s = offset_ns, passed_s
                _log.warning(
                    "the computer's clock was set forward: nothing is dropped for its age by the new time for a day",
                    forward_s=round((offset_ns - self._offset_ns) / 1e9),
                )
            if passed_s - self._since_s < _BELIEVED_S:
                return round(passed_s * 1e9) + self._offset_ns
        self._offset_ns = offset_ns
        return now_ns
