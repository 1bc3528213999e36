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
from service.recordings.backlog import Backlog
from service.recordings.catalogue import PART, SUFFIX, Catalogue, name_of
from service.recordings.leftovers import DAMAGED, leftovers, lock, loss_text, recover_leftover
from service.recordings.retention import AlarmMark, alarm_mark, decide, write_kept
from service.settings.service import RecordingSettings
from service.terminal.logs import Limiter, logger

_SYNC_S = 1.0
_RETRY_S = 1.0
_JOIN_S = 30.0
_TIDY_S = 600.0
_MOST_CHANNELS = 10_000
_ASSUMED = "application/json;assumed-from-machine-file"


@dataclass(frozen=True, slots=True)
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
        self._safe = self._synced = self._lost = self._files = self._failures = 0
        self._problem = ""
        self._give_up = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"recorder {self.folder}", daemon=True)

    def prepare(self) -> None:
        """Make the folder and take it for this recorder; `start` does it as well, and tries again if it fails.

        Raises
        ------
        RecordingError
            If the folder cannot be made or written, or another recorder writes there.
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
        name = self._file_name()
        return RecorderStatus(
            site=self.machine.site,
            machine=self.machine.name,
            state="failing" if self._problem else "recording" if self._safe or name else "idle",
            problem=self._problem,
            file=name,
            received=self._backlog.received,
            safe=self._safe,
            synced=self._synced,
            dropped=self._backlog.dropped,
            lost=self._lost,
            files=self._files,
            failures=self._failures,
        )

    def _file_name(self) -> str:
        writer = self._writer
        return "" if writer is None else writer.part.name

    def _run(self) -> None:
        last = False
        while True:
            try:
                self.prepare()
                if not self._problem:
                    self._tidy()
                self._record()
                break
            except RecordingError as error:
                self._fail(str(error))
            except Exception as error:
                # Nothing narrower: no error may end the recording of the machine; the message that caused it is left
                # out.
                if self._limiter.admit("defect") is not None:
                    self._log.exception("error in the recorder")
                self._give_up_message()
                self._fail(f"{type(error).__name__}: {error}")
            if self._give_up.wait(_RETRY_S):
                if last:
                    break
                last = True
        self._lost += len(self._pending)
        while batch := self._backlog.take(0.0):
            self._lost += len(batch)
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
                if self._is_due(writer, now_s):
                    self._close(writer)
                    self._tidy()
            elif now_s - self._tidied_s >= _TIDY_S:
                self._tidy()
            if self._backlog.exhausted and not self._pending:
                if self._writer is not None:
                    self._close(self._writer)
                    self._tidy()
                return

    def _is_due(self, writer: RecordingWriter, now_s: float) -> bool:
        """Whether the file is to be closed and another one begun."""
        return (
            writer.size_bytes >= self.settings.rotate_mb * 1e6
            or now_s - self._opened_s >= self.settings.rotate_s
            or writer.channels >= _MOST_CHANNELS
        )

    def _write(self, message: RecordedMessage) -> None:
        writer = self._writer
        if writer is None:
            writer = self._open(message)
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
        if first.key != self.machine.keys.descriptor:
            writer.write(self._head(start_ns))
        return writer

    def _head(self, time_ns: int) -> RecordedMessage:
        """The channel descriptor for the head of a file, logged with the file's first message."""
        known = self._descriptor
        if known is not None:
            return replace(known, log_time_ns=time_ns)
        text = json.dumps(self.machine.descriptor.model_dump(mode="json"))
        return RecordedMessage(self.machine.keys.descriptor, text.encode(), b"", _ASSUMED, time_ns, time_ns)

    def _count(self, writer: RecordingWriter) -> None:
        """Count safe messages, after anything that may have completed a chunk."""
        if writer.flushed == writer.messages and self._unsafe:
            self._safe += len(self._unsafe)
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
        self._synced += self._safe_in_file - self._synced_in_file
        self._synced_in_file = self._safe_in_file
        if self._problem:
            self._log.warning("recording again", file=writer.path.name, lost=self._lost, dropped=self._backlog.dropped)
            self._problem = ""
            self._tidy()
        self._synced_s = self._clock()

    def _check_there(self, writer: RecordingWriter) -> None:
        """Raise if the file was deleted: the system would go on writing into it, but nobody could open it."""
        if not writer.part.exists():
            self._lost += self._safe_in_file
            self._safe -= self._safe_in_file
            self._synced -= self._synced_in_file
            self._safe_in_file = self._synced_in_file = 0
            raise RecordingError(f"{writer.part}: vanished while it was being written")

    def _close(self, writer: RecordingWriter) -> None:
        self._sync(writer)
        self._check_there(writer)
        writer.close()
        self._writer = None
        self._files += 1
        self._log.info("recording closed", file=writer.path.name, messages=writer.messages, bytes=writer.size_bytes)

    def _fail(self, problem: str) -> None:
        """Abandon the file, take back the messages that are not safe in it, and log the problem."""
        self._failures += 1
        self._problem = problem
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

    def _give_up_message(self) -> None:
        """Give up the message at hand."""
        if self._writing_first:
            message = self._pending.popleft()
            if self._unsafe and self._unsafe[-1] is message:
                self._unsafe.pop()
            self._lost += 1
            self._writing_first = False

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
                self._log.warning(
                    "incomplete recording recovered", file=part.name, messages=salvage.count, lost=loss_text(salvage)
                )

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
        decision = decide(recordings, self._marks, self.settings, self._age_ns())
        kept = {one.path.name: one.kept_because for one in recordings if one.kept_because}
        if decision.kept != kept:
            write_kept(self.folder, decision.kept, self.settings)
        for recording, why in decision.dropped:
            recording.path.unlink(missing_ok=True)
            self._log.info("recording dropped", file=recording.path.name, why=why)
