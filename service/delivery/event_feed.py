"""News of all machines for listeners over HTTP: alarm events from the history, and changes of health.

::

    worker -- committed --> wake() ---.
    supervisor ---------> health() ---+--> every stream looks into the history after its own cursor

A stream keeps nothing but its cursor, so a reader that is slow, or stops reading, holds up nobody else and
costs no memory. What is in the history is delivered once, in the order of each machine's log.
"""

import asyncio
import itertools
import re
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Container, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from starlette.concurrency import run_in_threadpool

from models.errors import RotorwatchError
from models.signals.keys import NAME_PATTERN
from rotorwatch.records.health import Health
from service.analysis.overview import overview
from service.history.machine import MachineStore
from service.history.records import StoreError

Cursor = dict[str, int]
"""Sequence of the last alarm event that was delivered, for each ``site/machine``; -1 before the first."""

_PAGE = 100
_KEEP_ALIVE_S = 15.0
_AGAIN_S = 1.0
_PAUSE_S = 0.05
_LAST_S = 2.0
_RETRY_MS = 2000
_ENTRY = f"({NAME_PATTERN}/{NAME_PATTERN})=(-1|[0-9]{{1,18}})"
CURSOR_PATTERN = f"^({_ENTRY}(,{_ENTRY})*)?$"
"""Form of the id of an event; each ``site/machine`` is there once."""


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
    """Take the id of an event apart; raises `CursorError` if it is not one.

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


@dataclass(slots=True, eq=False)
class _Listener:
    """How a stream is woken, from any thread."""

    loop: asyncio.AbstractEventLoop
    news: asyncio.Event = field(default_factory=asyncio.Event)
    woken: bool = False


@dataclass(frozen=True, eq=False)
class _Said:
    """The latest health of a machine, converted to text once for all listeners."""

    number: int
    health: Health

    @cached_property
    def whole(self) -> str:
        return f"event: health\ndata: {self.health.model_dump_json()}\n\n"

    @cached_property
    def overview(self) -> str:
        return f"event: overview\ndata: {overview(self.health).model_dump_json()}\n\n"

    def text(self, *, in_full: bool) -> str:
        return self.whole if in_full else self.overview


class EventFeed:
    """Tells streams that there is news; `wake`, `health` and `close` are for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Condition()
        self._listeners: set[_Listener] = set()
        self._health: dict[str, _Said] = {}  # in the order in which they were said
        self._number = 0
        self.closed = False  # whether streams have been told to end

    def wake(self) -> None:
        """Say that alarm events were committed."""
        with self._lock:
            for listener in self._listeners:
                if not listener.woken:
                    listener.woken = True
                    listener.loop.call_soon_threadsafe(listener.news.set)

    def health(self, health: Health) -> None:
        """Say that a machine's health has changed."""
        place = f"{health.site}/{health.machine}"
        with self._lock:
            self._number += 1
            self._health.pop(place, None)
            self._health[place] = _Said(self._number, health)
            self.wake()

    def close(self) -> None:
        """End every stream once it has sent what is committed; slow readers are waited for `_LAST_S` at most."""
        self.closed = True
        self.wake()
        with self._lock:
            self._lock.wait_for(lambda: not self._listeners, _LAST_S)

    async def follow(
        self,
        logs: Mapping[str, MachineStore],
        cursor: Cursor,
        admitted: Callable[[], Awaitable[bool]],
        health: Callable[[str], Health],
        whole: Container[str] | None = None,
    ) -> AsyncIterator[str]:
        """Server-sent events from a cursor on, until the service or the right to listen ends.

        Parameters
        ----------
        logs : mapping of str to MachineStore
            Logs of the machines that are listened to, by ``site/machine``.
        cursor : dict
            Latest event that the listener has had of each of `logs`.
        admitted : callable
            Whether the listener still has access; asked every now and then.
        health : callable
            Returns a machine's health as it is now: the one published last may be old, and with it the age of the data.
        whole : container of str, optional
            Machines whose health is sent in full, and not as an overview; by default all.
        """
        listener = _Listener(asyncio.get_running_loop())
        with self._lock:
            self._listeners.add(listener)
        try:
            yield f"retry: {_RETRY_MS}\nid: {cursor_text(cursor)}\nevent: start\ndata: {{}}\n\n"
            number, told = 0, dict[str, int]()
            asked_s = time.monotonic()
            while True:
                closes = self.closed
                listener.woken = False
                listener.news.clear()
                behind = [place for place, log in logs.items() if cursor[place] < log.last_sequence]
                for place in behind:
                    async for event in self._alarm_events(place, logs[place], cursor):
                        yield event
                waits = any(cursor[place] < logs[place].last_sequence for place in behind)
                changed = self._health_after(number)
                for place, said in changed:
                    number = said.number
                    if place in logs:
                        in_full = whole is None or place in whole
                        async for event in self._health_events(place, said, health, told, in_full=in_full):
                            yield event
                if closes:
                    return
                if changed:
                    await asyncio.sleep(_PAUSE_S)  # the machines of a plant change one after the other
                try:
                    await asyncio.wait_for(listener.news.wait(), _AGAIN_S if waits else _KEEP_ALIVE_S)
                except TimeoutError:
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

    def _health_after(self, number: int) -> list[tuple[str, _Said]]:
        """Health published after this number, in that order."""
        with self._lock:
            newer = itertools.takewhile(lambda one: one[1].number > number, reversed(self._health.items()))
            return list(newer)[::-1]

    async def _health_events(
        self, place: str, said: _Said, health: Callable[[str], Health], told: dict[str, int], *, in_full: bool
    ) -> AsyncIterator[str]:
        """Latest published health of a machine, unless it was sent already; the first time, as it is now."""
        first, latest = place not in told, self._health.get(place, said)
        if told.get(place) == latest.number:
            return
        told[place] = latest.number
        if first:
            yield await run_in_threadpool(lambda: _Said(latest.number, health(place)).text(in_full=in_full))
        else:
            yield latest.text(in_full=in_full)

    async def _alarm_events(self, place: str, log: MachineStore, cursor: Cursor) -> AsyncIterator[str]:
        """Events in the log after the cursor, which moves along; none while the history cannot be read."""
        while cursor[place] < log.last_sequence:
            try:
                page = await run_in_threadpool(log.events, after=cursor[place], limit=_PAGE)
            except StoreError:
                return
            for event in page:
                cursor[place] = event.sequence
                yield f"id: {cursor_text(cursor)}\nevent: alarm\ndata: {event.text}\n\n"
            if not page:
                return
