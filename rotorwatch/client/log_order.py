"""Puts events of one machine's alarm log in order: each once, without a gap.

Events arrive in three ways, each with a weakness: as they are published (some may be missed), from the publisher's
cache (only the latest), and from the log itself by query (complete, but only on request)::

    published, cached --> hear(event)      ┐                  ┌ next() --> the caller --> taken()
    log, by query ------> read(page)       ├--> waiting[seq] -┤
    alarm/state --------> announce(latest) ┘                  └ incomplete: ask the log after `ask_after`
"""

from rotorwatch.client.errors import LogReplaced
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmLogPage

_MOST_WAITING = 2000


class LogOrder:
    """Position in one machine's alarm log, with events received ahead of it."""

    def __init__(self, place: str, last: int) -> None:
        self.place = place  # ``<site>/<machine>``
        self.last = last  # sequence number of the last event that was taken; -1 for none
        self._latest = last
        self._newest: AlarmCloudEvent | None = None
        self._waiting: dict[int, AlarmCloudEvent] = {}

    @property
    def incomplete(self) -> bool:
        """Whether events are known that have not been taken."""
        return self._latest > self.last

    @property
    def ask_after(self) -> int:
        """Sequence number for the query: the last event, if known, is read again to check that the log is the same."""
        return self.last if self._newest is None else self.last - 1

    def announce(self, latest: int) -> None:
        """Note that events up to this sequence number exist."""
        self._latest = max(self._latest, latest)

    def hear(self, event: AlarmCloudEvent) -> None:
        """Add a published event, in any order and possibly repeated."""
        sequence = event.data.sequence
        self.announce(sequence)
        # Events far ahead are read from the log when their turn comes.
        if self.last < sequence <= self.last + _MOST_WAITING:
            self._waiting.setdefault(sequence, event)

    def read(self, page: AlarmLogPage) -> None:
        """Add events read from the log, which take precedence over published ones.

        Raises
        ------
        LogReplaced
            If the log is not the one that was followed so far.
        """
        if page.latest < self.last:
            raise LogReplaced(
                f"{self.place}: event {self.last} was taken from the alarm log, which now ends at {page.latest}: the "
                "history was replaced or lost. Follow it from -1 to take it as it is now"
            )
        self.announce(page.latest)
        for event in page.events:
            sequence = event.data.sequence
            if sequence == self.last and self._newest not in (None, event):
                raise LogReplaced(
                    f"{self.place}: event {self.last} of the alarm log is not the one that was taken from it: the "
                    "history was replaced or lost. Follow it from -1 to take it as it is now"
                )
            if sequence > self.last:
                self._waiting[sequence] = event

    def next(self) -> AlarmCloudEvent | None:
        """Return the next event, or None if it has not arrived yet."""
        return self._waiting.get(self.last + 1)

    def taken(self) -> None:
        """Mark the event returned by `next` as taken."""
        self.last += 1
        self._newest = self._waiting.pop(self.last)
