"""News of all machines for whoever listens over HTTP: alarm events out of the history, and changes of health.

::

    worker -- committed --> wake() ---.
    supervisor ---------> health() ---+--> every stream looks into the history after its own cursor

A stream keeps nothing but how far it has come, so a reader who is slow, or stops reading, holds up nobody else and
costs no memory. What is in the history is delivered once, in the order of each machine's log.
"""

import asyncio
import re
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field

from starlette.concurrency import run_in_threadpool

from models.errors import RotorwatchError
from rotorwatch.records.health import Health
from service.history.machine import MachineStore
from service.history.records import StoreError

Cursor = dict[str, int]
"""Sequence of the last alarm event that was delivered, for each ``site/machine``; -1 before the first."""

_PAGE = 100
_KEEP_ALIVE_S = 15.0
_AGAIN_S = 1.0
_LAST_S = 2.0
_RETRY_MS = 2000
_ENTRY = r"([A-Za-z0-9][A-Za-z0-9_-]{0,63}/[A-Za-z0-9][A-Za-z0-9_-]{0,63})=(-1|[0-9]{1,18})"
CURSOR_PATTERN = f"^({_ENTRY}(,{_ENTRY})*)?$"
"""What the id of an event looks like; each ``site/machine`` is there once."""


class CursorError(RotorwatchError):
    """A cursor is not of the form that this service gives."""


def cursor_text(cursor: Mapping[str, int]) -> str:
    """A cursor as the id of an event.

    Examples
    --------
    >>> cursor_text({"demo/lab": 17, "demo/pump": -1})
    'demo/lab=17,demo/pump=-1'
    """
    return ",".join(f"{place}={sequence}" for place, sequence in cursor.items())


def parsed_cursor(text: str) -> Cursor:
    """Take the id of an event apart.

    Raises
    ------
    CursorError
        If it is not one.

    Examples
    --------
    >>> parsed_cursor("demo/lab=17,demo/pump=-1")
    {'demo/lab': 17, 'demo/pump': -1}
    """
    found: Cursor = {}
    for entry in text.split(","):
        part = re.fullmatch(_ENTRY, entry)
        if part is None or part[1] in found:
            raise CursorError(
                f"cursor: {entry[:80]!r} is not site/machine=sequence; pass the id of an event as it was received"
            )
        found[part[1]] = int(part[2])
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Listener:
    """How a stream is woken, from any thread."""

    loop: asyncio.AbstractEventLoop
    news: asyncio.Event = field(default_factory=asyncio.Event)

    def wake(self) -> None:
        self.loop.call_soon_threadsafe(self.news.set)


@dataclass(frozen=True, slots=True)
class _Said:
    """The latest health of a machine."""

    number: int
    text: str


class EventFeed:
    """Tells streams that there is news; `wake`, `health` and `close` are for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Condition()
        self._listeners: set[_Listener] = set()
        self._health: dict[str, _Said] = {}
        self._closed = False

    @property
    def closed(self) -> bool:
        """Whether streams have been told to end."""
        return self._closed

    def wake(self) -> None:
        """Say that alarm events were committed."""
        with self._lock:
            for listener in self._listeners:
                listener.wake()

    def health(self, health: Health) -> None:
        """Say that a machine's health has changed."""
        place = f"{health.site}/{health.machine}"
        with self._lock:
            before = self._health.get(place)
            self._health[place] = _Said(0 if before is None else before.number + 1, health.model_dump_json())
            for listener in self._listeners:
                listener.wake()

    def close(self) -> None:
        """End every stream once it has told what is committed; whoever reads slowly is waited for only so long."""
        self._closed = True
        self.wake()
        with self._lock:
            self._lock.wait_for(lambda: not self._listeners, _LAST_S)

    async def follow(
        self,
        logs: Mapping[str, MachineStore],
        cursor: Cursor,
        admitted: Callable[[], Awaitable[bool]],
        health: Callable[[str], str],
    ) -> AsyncIterator[str]:
        """Server-sent events from a cursor on, until the service or the right to listen ends.

        Parameters
        ----------
        logs : mapping of str to MachineStore
            Logs of the machines that are listened to, by ``site/machine``.
        cursor : dict
            How far each has been heard, for all of `logs`.
        admitted : callable
            Whether the listener still may; asked every now and then.
        health : callable
            JSON of a machine's health as it is now: what was said last may be old, and with it the age of the data.
        """
        listener = _Listener(asyncio.get_running_loop())
        with self._lock:
            self._listeners.add(listener)
        try:
            yield f"retry: {_RETRY_MS}\nid: {cursor_text(cursor)}\nevent: start\ndata: {{}}\n\n"
            told: dict[str, int] = {}
            asked_s = time.monotonic()
            while True:
                closes = self._closed
                listener.news.clear()
                waits = False
                for place, log in logs.items():
                    async for event in self._committed(place, log, cursor):
                        yield event
                    waits = waits or cursor[place] < log.last_sequence()
                    said = self._health.get(place)
                    if said is not None and told.get(place) != said.number:
                        text = said.text if place in told else await run_in_threadpool(health, place)
                        told[place] = said.number
                        yield f"event: health\ndata: {text}\n\n"
                if closes:
                    return
                quiet = not await _woken(listener.news, _AGAIN_S if waits else _KEEP_ALIVE_S)
                if quiet:
                    # No empty line: some readers take that for the end of an event without data.
                    yield ": still there\n"
                if time.monotonic() - asked_s >= _KEEP_ALIVE_S:
                    if not await admitted():
                        return
                    asked_s = time.monotonic()
        finally:
            with self._lock:
                self._listeners.discard(listener)
                self._lock.notify_all()

    async def _committed(self, place: str, log: MachineStore, cursor: Cursor) -> AsyncIterator[str]:
        """What is in the log after the cursor, which moves along; nothing while the history cannot be read."""
        while cursor[place] < log.last_sequence():
            try:
                page = await run_in_threadpool(log.events, after=cursor[place], limit=_PAGE)
            except StoreError:
                return
            for event in page:
                cursor[place] = event.sequence
                yield f"id: {cursor_text(cursor)}\nevent: alarm\ndata: {event.text}\n\n"
            if not page:
                return


async def _woken(news: asyncio.Event, timeout_s: float) -> bool:
    try:
        await asyncio.wait_for(news.wait(), timeout_s)
    except TimeoutError:
        return False
    return True
