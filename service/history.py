"""What happened to one machine, kept in memory within bounds."""

import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import TypeVar

from service.alarms import AlarmEvent
from service.monitor import WindowReport

__all__ = ["History"]

_T = TypeVar("_T")


class History:
    """Latest window reports and alarm events of one machine; safe to use from several threads.

    Parameters
    ----------
    reports, alarm_events : int
        How many of each are kept; the oldest are forgotten first.
    """

    def __init__(self, reports: int, alarm_events: int) -> None:
        self._lock = threading.Lock()
        self._reports: deque[WindowReport] = deque(maxlen=reports)
        self._events: deque[AlarmEvent] = deque(maxlen=alarm_events)

    def add(self, reports: Iterable[WindowReport], events: Iterable[AlarmEvent]) -> None:
        """Append what one block brought."""
        with self._lock:
            self._reports.extend(reports)
            self._events.extend(events)

    def reports(
        self, since_ns: int | None = None, until_ns: int | None = None, limit: int = 100
    ) -> tuple[WindowReport, ...]:
        """Window reports, newest first.

        Parameters
        ----------
        since_ns, until_ns : int, optional
            Only windows whose end lies in since_ns ≤ end_ns < until_ns.
        limit : int
            At most this many: the newest.
        """
        with self._lock:
            kept = tuple(self._reports)
        return _newest(kept, lambda report: report.end_ns, since_ns, until_ns, limit)

    def alarm_events(
        self, since_ns: int | None = None, until_ns: int | None = None, limit: int = 100
    ) -> tuple[AlarmEvent, ...]:
        """Alarm events, newest first; arguments as for `reports`, by the event's time."""
        with self._lock:
            kept = tuple(self._events)
        return _newest(kept, lambda event: event.time_ns, since_ns, until_ns, limit)


def _newest(
    kept: tuple[_T, ...], time_ns: Callable[[_T], int], since_ns: int | None, until_ns: int | None, limit: int
) -> tuple[_T, ...]:
    # Every entry is looked at: after a clock was set back the times are not in order.
    found: list[_T] = []
    for entry in reversed(kept):
        if len(found) == limit:
            break
        at_ns = time_ns(entry)
        if (since_ns is None or at_ns >= since_ns) and (until_ns is None or at_ns < until_ns):
            found.append(entry)
    return tuple(found)
