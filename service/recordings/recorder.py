"""Records one machine: a bounded queue and a thread that writes, rotates, keeps and drops files.

::

    put (Zenoh's thread) --> Backlog --> thread --> <site>/<machine>/<UTC start>.mcap.part --> .mcap
                             (bounded)     |
                                           '--> leftovers, retention, kept.json

Trouble with the disk never reaches the caller of `put`: it is logged, stated in the status, and tried again every
second; meanwhile the queue keeps what it can.
"""

import json
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from models.errors import RecordingError, RotorwatchError
from models.machine import MachineFile
from models.signals.recording import RecordedMessage, RecordingWriter, writing
from service.history.age import AgeClock, running_s
from service.history.records import StoredEvent
from service.recordings.catalogue import PART, SUFFIX, AlarmMark, Catalogue, alarm_mark, decide, name_of, write_kept
from service.recordings.leftovers import DAMAGED, leftovers, lock, loss_text, recover_leftover
from service.settings.service import RecordingSettings
from service.terminal.logs import Limiter, logger

_BATCH_BYTES = 1_000_000
_MESSAGE_BYTES = 300  # memory that a message takes beyond its bytes
_SYNC_S = 1.0
_RETRY_S = 1.0
_JOIN_S = 30.0
_TIDY_S = 600.0
_MOST_CHANNELS = 10_000
_ASSUMED = "application/json;assumed-from-machine-file"


@dataclass(slots=True)
class RecorderStatus:
    """State of a recorder; counts are since it was started."""

    site: str
    machine: str
    state: str = "idle"  # ``idle`` (no message yet), ``recording`` or ``failing``
    problem: str = ""  # why it is failing; empty otherwise
    file: str = ""  # name of the file being written; empty between files
    received: int = 0  # messages that arrived
    safe: int = 0  # messages in complete chunks: they survive a killed recorder
    synced: int = 0  # messages that the disk has confirmed: they survive a power failure as well
    dropped: int = 0  # messages thrown away because the queue was full
    lost: int = 0  # messages that had been taken and then could not be written, or vanished with their file
    files: int = 0  # files closed
    failures: int = 0  # attempts at writing that failed

    @property
    def text(self) -> str:
        """State, and what is wrong if anything is."""
        return f"{self.state}: {self.problem}" if self.problem else self.state


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


class MachineRecorder:
    """Records whatever is put into it.

    `committed` takes a time of this computer and returns the alarm events that the machine's monitor has recorded since
    then: what lies around them is kept longer. It is called on the recorder's thread and may raise `RotorwatchError`.
    `now_ns` is this computer's time, nanoseconds since 1970-01-01 UTC; only for the age of files.

    Raises
    ------
    RecordingError
        If the settings name no directory.
    """

    def __init__(
        self,
        machine: MachineFile,
        settings: RecordingSettings,
        committed: Callable[[int], Iterable[StoredEvent]],
        clock: Callable[[], float] = running_s,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        if settings.directory is None:
            raise RecordingError("recording has no directory")
        self.machine = machine
        self.settings = settings
        self.directory = Path(settings.directory)
        self.folder = self.directory / machine.site / machine.name
        self._committed = committed
        self._clock = clock
        self._age_ns = AgeClock(now_ns, clock)
        self._log = logger(part="recorder", machine=machine.title)
        self._limiter = Limiter(clock)
        self._backlog = Backlog(round(settings.queue_mb * 1e6), machine.keys.stream)
        self._catalogue = Catalogue(self.directory)
        self._pending: deque[RecordedMessage] = deque()  # taken out of the backlog, not written yet
        self._unsafe: deque[RecordedMessage] = deque()  # written, in a chunk that is not complete
        self._writing_first = False  # whether the first pending message is being written
        self._descriptor: RecordedMessage | None = None
        self._marks: tuple[AlarmMark, ...] = ()
        self._unread_reason = ""
        self._writer: RecordingWriter | None = None
        self._lock: int | None = None
        self._opened_s = self._synced_s = self._tidied_s = clock()
        self._safe_in_file = self._synced_in_file = 0
        self._status = RecorderStatus(machine.site, machine.name)
        self._give_up = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"recorder {self.folder}", daemon=True)

    def prepare(self) -> None:
        """Make the folder and take it for this recorder; `start` does it as well, and tries again if it fails.

        Raises `RecordingError` if the folder cannot be made or written, or another recorder writes there.
        """
        if self._lock is None:
            with writing(self.folder):
                self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = lock(self.folder)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def put(self, message: RecordedMessage) -> None:
        """Take a message; never waits, and never fails because of the disk."""
        self._backlog.put(message)

    def stop(self) -> None:
        """Write what waits, close the file, and end the thread; what cannot be written by then is given up."""
        self._backlog.close()
        self._give_up.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)
            if self._thread.is_alive():
                self._log.error("the disk does not respond; the recording remains incomplete", file=self._file_name())

    def status(self) -> RecorderStatus:
        """State of the recorder."""
        name, now = self._file_name(), replace(self._status)
        now.state = "failing" if now.problem else "recording" if now.safe or name else "idle"
        now.file, now.received, now.dropped = name, self._backlog.received, self._backlog.dropped
        return now

    def _file_name(self) -> str:
        writer = self._writer
        return "" if writer is None else writer.part.name

    def _run(self) -> None:
        last = False
        while True:
            try:
                self.prepare()
                if not self._status.problem:
                    self._tidy()
                self._record()
                break
            except RecordingError as error:
                self._fail(str(error))
            except Exception as error:  # of any kind: the message that caused it is left out, the recording goes on
                if self._limiter.admit("defect") is not None:
                    self._log.exception("error in the recorder")
                if self._writing_first:  # the message at hand
                    message = self._pending.popleft()
                    if self._unsafe and self._unsafe[-1] is message:
                        self._unsafe.pop()
                    self._status.lost += 1
                    self._writing_first = False
                self._fail(f"{type(error).__name__}: {error}")
            if self._give_up.wait(_RETRY_S):
                if last:
                    break
                last = True
        self._status.lost += len(self._pending)
        while batch := self._backlog.take(0.0):
            self._status.lost += len(batch)
        if self._lock is not None:
            os.close(self._lock)

    def _record(self) -> None:
        """Write until the backlog is closed and empty."""
        while True:
            if not self._pending:
                self._pending.extend(self._backlog.take(_SYNC_S / 4))
            if self._pending:
                self._writing_first = True
                self._write(self._pending[0])
                self._writing_first = False
                self._pending.popleft()
            writer, now_s = self._writer, self._clock()
            if writer is not None:
                if now_s - self._synced_s >= _SYNC_S:
                    self._sync(writer)
                if (
                    writer.size_bytes >= self.settings.rotate_mb * 1e6
                    or now_s - self._opened_s >= self.settings.rotate_s
                    or writer.channels >= _MOST_CHANNELS
                ):
                    self._close(writer)
                    self._tidy()
            elif now_s - self._tidied_s >= _TIDY_S:
                self._tidy()
            if self._backlog.exhausted and not self._pending:
                if self._writer is not None:
                    self._close(self._writer)
                    self._tidy()
                return

    def _write(self, message: RecordedMessage) -> None:
        writer = self._writer or self._open(message)
        if message.key == self.machine.keys.descriptor:
            self._descriptor = message
        self._unsafe.append(message)
        writer.write(message)
        if message.key == self.machine.keys.report:
            writer.flush()  # so that a monitor that is killed now can refill the window of this report
        self._count(writer)

    def _open(self, first: RecordedMessage) -> RecordingWriter:
        start_ns, number = first.log_time_ns, 1
        while any((self.folder / (name_of(start_ns, number) + end)).exists() for end in ("", PART, DAMAGED)):
            number += 1
        writer = self._writer = RecordingWriter(self.folder / name_of(start_ns, number))
        self._opened_s = self._synced_s = self._clock()
        self._safe_in_file = self._synced_in_file = 0
        key = self.machine.keys.descriptor
        if first.key != key:  # the channel descriptor, logged with the file's first message
            text = json.dumps(self.machine.descriptor.model_dump(mode="json"))
            assumed = RecordedMessage(key, text.encode(), b"", _ASSUMED, start_ns, start_ns)
            writer.write(replace(self._descriptor or assumed, log_time_ns=start_ns))
        return writer

    def _count(self, writer: RecordingWriter) -> None:
        """Count safe messages, after anything that may have completed a chunk."""
        if writer.flushed == writer.messages and self._unsafe:
            self._status.safe += len(self._unsafe)
            self._safe_in_file += len(self._unsafe)
            self._unsafe.clear()

    def _sync(self, writer: RecordingWriter) -> None:
        if self._synced_in_file == self._safe_in_file and not self._unsafe:
            self._synced_s = self._clock()
            return
        writer.flush()
        self._count(writer)
        writer.sync()
        self._check_there(writer)
        now = self._status
        now.synced += self._safe_in_file - self._synced_in_file
        self._synced_in_file = self._safe_in_file
        if now.problem:
            self._log.warning("recording again", file=writer.path.name, lost=now.lost, dropped=self._backlog.dropped)
            now.problem = ""
            self._tidy()
        self._synced_s = self._clock()

    def _check_there(self, writer: RecordingWriter) -> None:
        """Raise if the file was deleted: the system would go on writing into it, but nobody could open it."""
        if not writer.part.exists():
            self._status.lost += self._safe_in_file
            self._status.safe -= self._safe_in_file
            self._status.synced -= self._synced_in_file
            self._safe_in_file = self._synced_in_file = 0
            raise RecordingError(f"{writer.part}: vanished while it was being written")

    def _close(self, writer: RecordingWriter) -> None:
        self._sync(writer)
        self._check_there(writer)
        writer.close()
        self._writer = None
        self._status.files += 1
        self._log.info("recording closed", file=writer.path.name, messages=writer.messages, bytes=writer.size_bytes)

    def _fail(self, problem: str) -> None:
        """Abandon the file, take back the messages that are not safe in it, and log the problem."""
        self._status.failures += 1
        self._status.problem = problem
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.abandon()
            if not writer.flushed:  # nothing in it: attempts on a full disk would litter the folder
                with suppress(OSError):
                    writer.part.unlink(missing_ok=True)
        again = list(self._unsafe)
        if self._writing_first and again and again[-1] is self._pending[0]:
            again.pop()
        self._writing_first = False
        self._pending.extendleft(reversed(again))
        self._unsafe.clear()
        if self._lock is not None:  # the folder may not be the same any more
            os.close(self._lock)
            self._lock = None
        if (withheld := self._limiter.admit("failing")) is not None:
            self._log.error("recording fails, trying again", why=problem, waiting=len(again), withheld=withheld)

    def _tidy(self) -> None:
        """Complete files that a crash left, and drop files beyond the limits; errors here do not stop recording."""
        self._tidied_s = self._clock()
        try:
            self._recover()
            self._retain()
        except (RecordingError, OSError) as error:
            if (withheld := self._limiter.admit("tidy")) is not None:
                self._log.error("the recordings could not be cleaned up", why=str(error), withheld=withheld)

    def _recover(self) -> None:
        for unfinished in self.folder.glob(f"*{SUFFIX}.recovered*"):
            unfinished.unlink(missing_ok=True)
        for part in leftovers(self.folder, None if self._writer is None else self._writer.part):
            try:
                salvage = recover_leftover(part)
            except RecordingError as error:
                self._log.error("an incomplete recording could not be recovered", file=part.name, why=str(error))
                continue
            if salvage is None:
                self._log.warning("an incomplete recording is waiting for space on the disk", file=part.name)
            else:
                lost = loss_text(salvage)
                self._log.warning("incomplete recording recovered", file=part.name, messages=salvage.count, lost=lost)

    def _retain(self) -> None:
        recordings = self._catalogue.recordings(self.machine.site, self.machine.name)
        oldest_ns = min((one.start_ns for one in recordings), default=0)
        try:
            events = self._committed(oldest_ns - round(self.settings.alarm_after_s * 1e9))
            self._marks = tuple(map(alarm_mark, events))
            self._unread_reason = ""
        except RotorwatchError as error:  # the marks known so far still count
            if str(error) != self._unread_reason:
                self._log.warning("the history cannot be read: alarms keep no more recordings", why=str(error))
            self._unread_reason = str(error)
        kept, dropped = decide(recordings, self._marks, self.settings, self._age_ns())
        if kept != {one.path.name: one.kept_because for one in recordings if one.kept_because}:
            write_kept(self.folder, kept, self.settings)
        for recording, why in dropped:
            recording.path.unlink(missing_ok=True)
            self._log.info("recording dropped", file=recording.path.name, why=why)


def _size(message: RecordedMessage) -> int:
    return len(message.payload) + len(message.attachment) + _MESSAGE_BYTES
