"""One thread that takes what has come for many machines, many messages at a time."""

import threading
from collections.abc import Callable
from typing import Any

from service.terminal.logs import logger

_EVERY_S = 0.05
_AT_ONCE = 1000
"""Messages of one source before the others have their turn."""

_log = logger(part="intake")


class Intake:
    """Hands on what waits in the channels of subscriptions, every twentieth of a second.

    A thread for each subscription that is woken for each message takes several times the processor: most of it is
    waking up, and waiting for Python's lock.
    """

    def __init__(self) -> None:
        self._sources: list[tuple[Callable[[], Any], Callable[[Any], None]]] = []
        self._lock = threading.Lock()  # held while messages are handed on
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)

    def add(self, receive: Callable[[], Any], take: Callable[[Any], None]) -> Callable[[], None]:
        """Take what a channel holds from now on.

        Parameters
        ----------
        receive : callable
            Returns the next message, None if there is none; does not wait.
        take : callable
            Takes each message; neither raises nor waits.

        Returns
        -------
        callable
            Ends it; nothing is handed on afterwards.
        """
        source = (receive, take)
        with self._lock:
            self._sources.append(source)
            if self._thread.ident is None:
                self._thread.start()

        def end() -> None:
            with self._lock:
                self._sources = [one for one in self._sources if one is not source]

        return end

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._closed.wait(_EVERY_S):
            with self._lock:
                for source in tuple(self._sources):
                    receive, take = source
                    try:
                        for _ in range(_AT_ONCE):
                            if (message := receive()) is None:
                                break
                            take(message)
                    except Exception:  # a channel that is no more raises for ever; the others are taken all the same
                        _log.exception("messages can no longer be taken")
                        self._sources.remove(source)
