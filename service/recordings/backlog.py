"""Messages of one machine between their arrival and the disk."""

import threading
from collections import deque

from models.signals.recording import RecordedMessage

_BATCH_BYTES = 1_000_000
_MESSAGE_BYTES = 300  # memory that a message takes beyond its bytes


class Backlog:
    """Bounded queue between the network's thread and the recorder's; putting never waits.

    When it is full, all waiting messages of the stream are thrown away at once and counted: one long gap costs the
    evaluation less than many short ones. The few and small messages on other keys stay, unless they alone fill it.
    """

    def __init__(self, bound_bytes: int, stream: str) -> None:
        self._bound = bound_bytes
        self._stream = stream  # key of the sample blocks
        self._messages: deque[RecordedMessage] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._closed = False
        self.received = 0  # messages that arrived
        self.dropped = 0  # messages thrown away because the disk did not keep up or could not be written

    def put(self, message: RecordedMessage) -> None:
        """Append a message; after `close` it is ignored."""
        with self._changed:
            if self._closed:
                return
            self.received += 1
            size = _size(message)
            if self._bytes + size > self._bound:
                self._keep(deque(waiting for waiting in self._messages if waiting.key != self._stream))
            if self._bytes + size > self._bound:
                self._keep(deque())
            if size > self._bound:
                self.dropped += 1
                return
            self._messages.append(message)
            self._bytes += size
            self._changed.notify()

    def take(self, timeout_s: float) -> list[RecordedMessage]:
        """Take the oldest messages, about a megabyte at most; none if none arrives in time, or after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or bool(self._messages), timeout_s)
            batch: list[RecordedMessage] = []
            taken = 0
            while self._messages and taken < _BATCH_BYTES:
                message = self._messages.popleft()
                taken += _size(message)
                batch.append(message)
            self._bytes -= taken
            return batch

    @property
    def exhausted(self) -> bool:
        """Whether it is closed and empty."""
        return self._closed and not self._messages

    def close(self) -> None:
        """Take no more messages; those that wait can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _keep(self, messages: deque[RecordedMessage]) -> None:
        self.dropped += len(self._messages) - len(messages)
        self._messages = messages
        self._bytes = sum(map(_size, messages))


def _size(message: RecordedMessage) -> int:
    return len(message.payload) + len(message.attachment) + _MESSAGE_BYTES
