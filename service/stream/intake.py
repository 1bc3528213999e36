"""One thread that takes the messages for many machines, many at a time."""

import threading
from collections.abc import Callable

_EVERY_S = 0.05


class Intake:
    """Has all channels emptied every twentieth of a second.

    A thread for each channel that is woken for each message takes nearly three times the processor time: most of that
    goes into waking up and waiting for Python's lock.
    """

    def __init__(self) -> None:
        self._takers: list[Callable[[], None]] = []
        self._lock = threading.Lock()  # held while messages are taken
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)

    def add(self, take: Callable[[], None]) -> Callable[[], None]:
        """Have a channel emptied by `take` from now on; returns a function that ends this at once.

        `take` must not raise; all other channels wait for it.
        """
        with self._lock:
            self._takers.append(take)
            if self._thread.ident is None:
                self._thread.start()

        def end() -> None:
            with self._lock:
                self._takers = [one for one in self._takers if one is not take]

        return end

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._closed.wait(_EVERY_S):
            with self._lock:
                for take in self._takers:
                    take()
