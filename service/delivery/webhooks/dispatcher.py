"""Webhooks: each sends its events in order for each machine, each until it is taken, remembering how far it has come.

::

    history --> lane of a machine --> attempt --delivered--> cursor saved, next event
                     ^                    |--trouble--> pause for all machines     (no answer, 5xx, 408, 425, 429)
                     |                    |--refused--> long pause for this one    (other 4xx, redirects)
                     '------ again -------'--gone-----> disabled                   (410)

The cursor is saved after the delivery: a monitor that is killed in between delivers the event again, with the same id.
"""

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from secrets import SystemRandom

from pydantic import ValidationError

from models.errors import RotorwatchError
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.monitor import WebhookList, WebhookStatus
from service.delivery.webhooks.receiver import Meaning, Receiver, pause_s
from service.history.machine import MachineStore
from service.history.records import StoredEvent, StoreError
from service.history.shared import WebhookCursors
from service.monitor.conversion import rfc3339
from service.settings.webhooks import WebhookSettings
from service.terminal.logs import Limiter, logger

_PAGE = 100
_QUIET_S = 15.0
_AGAIN_S = 1.0
_JOIN_S = 10.0
_CHANCE = SystemRandom().random


@dataclass(slots=True)
class _Lane:
    """One machine's events on their way; `next` is the sequence of the one that comes next, None if not known yet."""

    place: str
    log: MachineStore
    newest: int
    next: int | None = None
    saved: int = -1
    waiting: deque[StoredEvent] = field(default_factory=deque)
    failures: int = 0
    due_s: float = 0.0


class Dispatcher:
    """Serves one webhook in a thread of its own.

    Parameters
    ----------
    logs : mapping of str to MachineStore
        Logs of all machines, by ``site/machine``. A new webhook gets the events that come after this moment.
    cursors : WebhookCursors
        Hold the sequence of the next event, so that a webhook that begins with an empty log (0) can be told from a new
        one (-1).
    now_ns : callable
        Time of day, nanoseconds since 1970 UTC; only for the status.
    """

    def __init__(
        self,
        settings: WebhookSettings,
        receiver: Receiver,
        logs: Mapping[str, MachineStore],
        cursors: WebhookCursors,
        *,
        clock: Callable[[], float] = time.monotonic,
        now_ns: Callable[[], int] = time.time_ns,
        chance: Callable[[], float] = _CHANCE,
    ) -> None:
        self.settings = settings
        self._receiver = receiver
        self._cursors = cursors
        self._clock = clock
        self._now_ns = now_ns
        self._chance = chance
        wanted = (place for place in logs if any(fnmatchcase(place, pattern) for pattern in settings.machines))
        self._lanes = tuple(_Lane(place, logs[place], logs[place].last_sequence) for place in wanted)
        self._turns = deque(self._lanes)
        self._failures = 0
        self._due_s = self._save_due_s = float("-inf")
        self._disabled = False
        self._delivered = self._failed = 0
        self._last_delivered_ns: int | None = None
        self._last_error = ""
        self._last_error_ns: int | None = None
        self._log = logger(part="webhook", webhook=settings.name, target=settings.target)
        self._limiter = Limiter(clock)
        self._news = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=f"webhook {settings.name}", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        if not self._lanes:
            self._log.warning("none of the monitored machines is wanted", wanted=self.settings.machines)
        self._thread.start()

    def stop(self) -> None:
        """Give up the present attempt and end the thread; what is left is sent after the next start."""
        self._stopping = True
        self._receiver.interrupt()
        self._news.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)

    def wake(self) -> None:
        """Say that alarm events were committed; for any thread."""
        self._news.set()

    def status(self) -> WebhookStatus:
        """State of the webhook; for any thread."""
        settings = self.settings
        failing = bool(self._failures or any(lane.failures for lane in self._lanes))
        pending = sum(max(0, lane.log.last_sequence + 1 - lane.next) for lane in self._lanes if lane.next is not None)
        return WebhookStatus(
            name=settings.name,
            target=settings.target,
            machines=settings.machines,
            kinds=settings.kinds,
            severities=settings.severities,
            annunciated_only=settings.annunciated_only,
            state="disabled" if self._disabled else "failing" if failing else "working",
            pending=pending,
            delivered=self._delivered,
            failed_attempts=self._failed,
            last_delivered_ns=self._last_delivered_ns,
            last_error=self._last_error,
            last_error_ns=self._last_error_ns,
        )

    def turn(self) -> float:
        """Make the next attempt, if one is due; return the seconds until there may be something to do, perhaps 0."""
        now_s = self._clock()
        if self._disabled:
            return _QUIET_S
        if now_s < self._due_s:
            return self._due_s - now_s
        try:
            for lane in tuple(self._turns):
                if lane.due_s <= now_s and (event := self._head(lane)) is not None:
                    self._turns.remove(lane)
                    self._turns.append(lane)  # the other machines' events come first now
                    self._attempt(lane, event)
                    return 0.0
        except StoreError as error:
            self._due_s = now_s + _AGAIN_S
            self._note_store_error(error)
        return self._pause_s(now_s)

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._news.clear()
                try:
                    pause_s = self.turn()
                except Exception as error:
                    # Nothing narrower: an error in one attempt must not end the delivery of alarms.
                    self._failures += 1
                    pause_s, self._due_s = _QUIET_S, self._clock() + _QUIET_S
                    self._note(f"an error inside the service: {type(error).__name__}")
                    self._log.exception("an attempt failed with an error inside the service")
                if not self._stopping:
                    self._news.wait(pause_s)
        finally:
            self._receiver.close()

    def _pause_s(self, now_s: float) -> float:
        """Seconds until something is due; events not committed and cursors not saved are looked after every second."""
        pauses = [self._due_s - now_s]
        for lane in self._lanes:
            behind = lane.next is None or lane.next <= lane.log.last_sequence or lane.saved != lane.next
            pauses.append(max(lane.due_s - now_s, _AGAIN_S) if behind else _QUIET_S)
        return max(0.0, min((pause for pause in pauses if pause > 0.0), default=_QUIET_S))

    def _head(self, lane: _Lane) -> StoredEvent | None:
        """The event of a machine that is to be sent next, if it is committed."""
        if lane.next is None:
            saved = self._cursors.get(self.settings.name, lane.place)
            lane.next, lane.saved = (lane.newest + 1, -1) if saved < 0 else (saved, saved)
        self._save(lane)
        while not lane.waiting and lane.next <= lane.log.last_sequence:
            page = lane.log.events(after=lane.next - 1, limit=_PAGE)
            if not page:
                break
            lane.waiting.extend(event for event in page if self._wants(event))
            lane.next = lane.waiting[0].sequence if lane.waiting else page[-1].sequence + 1
            self._save(lane)
        return lane.waiting[0] if lane.waiting else None

    def _wants(self, event: StoredEvent) -> bool:
        settings = self.settings
        if settings.kinds and event.kind not in settings.kinds:
            return False
        if settings.severities and event.severity not in settings.severities:
            return False
        try:
            return not settings.annunciated_only or AlarmCloudEvent.model_validate_json(event.text).data.annunciated
        except ValidationError:  # written by another version of the program: rather one too many than one too few
            return True

    def _attempt(self, lane: _Lane, event: StoredEvent) -> None:
        answer = self._receiver.post(event.id, event.text.encode())
        if self._stopping and answer.meaning is not Meaning.DELIVERED:
            return
        if answer.meaning is Meaning.DELIVERED:
            self._conclude(lane, event)
            return
        self._failed += 1
        self._note(answer.text)
        if answer.meaning is Meaning.GONE:
            self._disabled = True
            self._log.error("disabled: the receiver refuses further events", why=answer.text)
            return
        if answer.meaning is Meaning.REFUSED:
            self._failures = 0  # it is there and answers
            lane.failures += 1
            pause = pause_s(answer, lane.failures, self.settings.longest_pause_s, self._chance())
            lane.due_s = self._clock() + pause
        else:
            self._failures += 1
            pause = pause_s(answer, self._failures, self.settings.longest_pause_s, self._chance())
            self._due_s = self._clock() + pause
        told = {"id": event.id, "why": answer.text, "pause_s": round(pause, 1)}
        self._limiter.say("attempt", self._log.warning, "not delivered, trying again", **told)

    def _conclude(self, lane: _Lane, event: StoredEvent) -> None:
        if self._failures or lane.failures:
            self._log.info("delivered again", id=event.id)
        self._failures = lane.failures = 0
        lane.waiting.popleft()
        lane.next = lane.waiting[0].sequence if lane.waiting else event.sequence + 1
        self._delivered += 1
        self._last_delivered_ns = self._now_ns()
        self._save(lane)

    def _save(self, lane: _Lane) -> None:
        """Remember how far a machine's events have come; if that fails, later: at worst some are delivered twice."""
        if lane.next is None or lane.saved == lane.next or self._clock() < self._save_due_s:
            return
        try:
            self._cursors.set(self.settings.name, lane.place, lane.next)
            lane.saved = lane.next
        except StoreError as error:
            self._save_due_s = self._clock() + _AGAIN_S
            self._note_store_error(error)

    def _note_store_error(self, error: StoreError) -> None:
        self._note(str(error))
        self._limiter.say("history", self._log.warning, "the history cannot be used", why=str(error))

    def _note(self, error: str) -> None:
        self._last_error, self._last_error_ns = error, self._now_ns()


class Webhooks:
    """Starts and stops webhooks and reports their states.

    Raises `MachineFileError` if a secret or certificate cannot be used.
    """

    def __init__(self, webhooks: Sequence[WebhookSettings]) -> None:
        self._receivers = [(settings, Receiver(settings)) for settings in webhooks]
        self._dispatchers: tuple[Dispatcher, ...] = ()

    def start(self, logs: Mapping[str, MachineStore], cursors: WebhookCursors) -> None:
        """Begin to send from logs by ``site/machine``; webhooks without cursors get what comes after this moment."""
        self._dispatchers = tuple(
            Dispatcher(settings, receiver, logs, cursors) for settings, receiver in self._receivers
        )
        for dispatcher in self._dispatchers:
            dispatcher.start()

    def wake(self) -> None:
        """Say that alarm events were committed; for any thread."""
        for dispatcher in self._dispatchers:
            dispatcher.wake()

    def statuses(self) -> WebhookList:
        """State of every webhook."""
        return WebhookList(webhooks=tuple(dispatcher.status() for dispatcher in self._dispatchers))

    def failing(self) -> tuple[str, ...]:
        """Those that do not work, each with what is wrong."""
        return tuple(
            f"{status.name}: {status.last_error}" for status in self.statuses().webhooks if status.state != "working"
        )

    def close(self) -> None:
        """Give up what is under way; it is sent after the next start."""
        for dispatcher in self._dispatchers:
            dispatcher.stop()


def send_test(settings: WebhookSettings) -> float:
    """Send an event that is no alarm (type ``org.rotorwatch.webhook.test``) and return how long it took, in seconds.

    Raises
    ------
    MachineFileError
        If the secret or certificate cannot be used.
    RotorwatchError
        If the receiver did not take it.
    """
    now_ns = time.time_ns()
    event = {
        "specversion": "1.0",
        "id": f"test/{now_ns}",
        "source": "/rotorwatch",
        "type": "org.rotorwatch.webhook.test",
        "time": rfc3339(now_ns),
        "datacontenttype": "application/json",
        "data": {"webhook": settings.name, "text": "This is a test: no machine has raised an alarm."},
    }
    begin_s = time.monotonic()
    with closing(Receiver(settings)) as receiver:
        answer = receiver.post(f"test/{now_ns}", json.dumps(event).encode())
    if answer.meaning is not Meaning.DELIVERED:
        raise RotorwatchError(f"{settings.name}: {settings.target} did not accept the test event: {answer.text}")
    return time.monotonic() - begin_s
