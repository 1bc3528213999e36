"""Puts what is heard of one machine's alarm log in order: each event once, none left out.

Events arrive over three ways, each with its own weakness: as they are published (some may be missed), from the
publisher's cache (only the latest), and from the log itself by query (always complete, but it has to be asked)::

    published, cached --> hear(event)      ┐                  ┌ next() --> the caller --> taken()
    log, by query ------> read(page)       ├--> waiting[seq] -┤
    alarm/state --------> announce(latest) ┘                  └ incomplete: ask the log after `ask_after`
"""

from rotorwatch.client.errors import LogReplaced
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmLogPage

_MOST_WAITING = 2000


class LogOrder:
    """How far one machine's alarm log has been followed."""

    def __init__(self, place: str, last: int) -> None:
        self.place = place  # ``<site>/<machine>``
        self.last = last  # sequence number of the last event that was taken; -1 for none
        self._latest = last
        self._newest: AlarmCloudEvent | None = None
        self._waiting: dict[int, AlarmCloudEvent] = {}

    @property
    def incomplete(self) -> bool:
        """There are events that have not been taken, as far as is known."""
        return self._latest > self.last

    @property
    def ask_after(self) -> int:
        """What to ask the log for: the last event once more, if it is known, to see that the log is still the same."""
        return self.last if self._newest is None else self.last - 1

    def announce(self, latest: int) -> None:
        """Take note that there are events up to this sequence number."""
        self._latest = max(self._latest, latest)

    def hear(self, event: AlarmCloudEvent) -> None:
        """Take note of an event that was published, in any order and however often."""
        sequence = event.data.sequence
        self.announce(sequence)
        # What is far ahead will be read from the log when its turn comes.
        if self.last < sequence <= self.last + _MOST_WAITING:
            self._waiting.setdefault(sequence, event)

    def read(self, page: AlarmLogPage) -> None:
        """Take note of what the log says; it outranks what was heard.

        Raises
        ------
        LogReplaced
            If it is not the log that was followed so far.
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
        """Return the event that comes next, or None if it is not there yet."""
        return self._waiting.get(self.last + 1)

    def taken(self) -> None:
        """Go on to the event after the next one."""
        self.last += 1
        self._newest = self._waiting.pop(self.last)
