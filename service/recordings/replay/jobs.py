"""Replays in processes of their own, so that they do not share the interpreter with the live monitors.

A job's process gets its orders on standard input and says on standard output how far it is. When the service ends,
however it ends, the input ends, and so does the replay. Results go to a folder of the job and nowhere else.
"""

import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from models.errors import RotorwatchError
from rotorwatch.records.replays import ReplayJob, ReplayLine
from service.terminal.logs import logger

REPLAYS = ".replays"
_RESULTS = "results.jsonl"
_MESSAGES = "messages.txt"
_MACHINE = "machine.toml"
_STOP_S = 5.0
_ERROR_CHARACTERS = 2000
_FOLDER = re.compile(r"[0-9a-f]{12}")
_log = logger(part="replay")


class ReplayJobError(RotorwatchError):
    """A replay cannot be started; the message says why."""


class TooManyReplaysError(ReplayJobError):
    """As many replays as allowed are running."""


@dataclass(frozen=True, slots=True)
class JobPlan:
    """A job as it is to be started."""

    job: ReplayJob  # what the API says of it; id, state, times and results are filled in
    arguments: tuple[str, ...]  # of ``rotorwatch replay``: files and options other than those below
    machine_file: str = ""  # text of a machine file that was sent
    bundle: str | None = None  # bundle of networks, or of what was commissioned, that it is evaluated with


class ReplayJobs:
    """Starts, watches and ends the processes: at most `limit` at once, at niceness `nice`.

    Results go to a folder per job in `folder`; without it there are no jobs. Beyond `kept`, the oldest are removed.
    """

    def __init__(self, folder: Path | None, *, limit: int, nice: int, kept: int) -> None:
        self._folder = folder
        self._limit = limit
        self._nice = nice
        self._kept = max(kept, limit)
        self._lock = threading.Lock()
        self._jobs: dict[str, RunningJob] = {}
        self._closed = False

    def start(self, plan: JobPlan) -> ReplayJob:
        """Start a job.

        Raises
        ------
        TooManyReplaysError
            If as many as allowed are running.
        ReplayJobError
            If its folder cannot be written or its process not be started.
        """
        with self._lock:
            if self._closed or self._folder is None:
                raise ReplayJobError("the service is stopping" if self._closed else "there is no folder for results")
            running = [job.view.id for job in self._jobs.values() if job.running]
            if len(running) >= self._limit:
                raise TooManyReplaysError(
                    f"{len(running)} of at most {self._limit} replays run ({', '.join(running)}): wait or stop one"
                )
            folder = self._folder / plan.job.id
            try:
                folder.mkdir(parents=True)
                if plan.machine_file:
                    (folder / _MACHINE).write_text(plan.machine_file, encoding="utf-8")
                self._make_room(self._folder)
                job = self._jobs[plan.job.id] = RunningJob(plan, folder, self._nice)
            except OSError as error:
                raise ReplayJobError(f"{folder}: no replay can be started ({error.strerror or error})") from error
        _log.info("replay started", id=plan.job.id, recordings=len(plan.job.recordings), mode=plan.job.mode)
        return job.view

    def jobs(self) -> tuple[ReplayJob, ...]:
        """Every job since the service started whose results are kept, the latest first."""
        with self._lock:
            return tuple(job.view for job in reversed(self._jobs.values()))

    def find(self, job_id: str) -> "RunningJob | None":
        """One job, or None if there is none of this id."""
        with self._lock:
            return self._jobs.get(job_id)

    def close(self) -> None:
        """End every job."""
        with self._lock:
            self._closed = True
            jobs = list(self._jobs.values())
        for job in jobs:
            job.ask_to_end()
        for job in jobs:
            job.end()

    def _make_room(self, within: Path) -> None:
        """Remove the oldest folders beyond the number that is kept, also those of an earlier service."""
        folders = [entry for entry in within.iterdir() if _FOLDER.fullmatch(entry.name) and not entry.is_symlink()]
        busy = {job.view.id for job in self._jobs.values() if job.running}
        for folder in sorted(folders, key=lambda entry: entry.stat().st_mtime_ns, reverse=True)[self._kept :]:
            if folder.name not in busy:
                self._jobs.pop(folder.name, None)
                shutil.rmtree(folder, ignore_errors=True)


class RunningJob:
    """One process and the thread that reads its output; its result stays here when the process has ended."""

    def __init__(self, plan: JobPlan, folder: Path, nice: int) -> None:
        self.folder = folder
        self.results = folder / _RESULTS  # result lines; may not be there yet
        self._lock = threading.Lock()
        self._stop_asked = False
        self.view = plan.job  # what the API says of the job
        # Path of the machine file that was sent with it, with its bundle as FILE@BUNDLE; None if none was sent.
        bundle = "" if plan.bundle is None else f"@{plan.bundle}"
        self.machine_file = f"{folder / _MACHINE}{bundle}" if plan.machine_file else None
        with (folder / _MESSAGES).open("wb") as messages:
            self._process = subprocess.Popen(  # noqa: S603  # our own program; every argument is checked by the caller
                self._command(plan, nice),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=messages,
                start_new_session=True,  # Ctrl-C is for the service, which ends its jobs itself
            )
        self._thread = threading.Thread(target=self._listen, name=f"replay {plan.job.id}", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the process has not ended yet."""
        return self.view.state in ("running", "paused")

    def order(self, order: str) -> None:
        """Send an order to the process, see `service.recordings.replay.console`; ignored if it has ended."""
        with self._lock:
            if not self.running or self._process.stdin is None:
                return
            with suppress(OSError, ValueError):  # it may just have ended
                self._process.stdin.write(order.encode() + b"\n")
                self._process.stdin.flush()
            if order in ("pause", "resume"):
                state = "paused" if order == "pause" else "running"
                self.view = self.view.model_copy(update={"state": state})

    def ask_to_end(self) -> None:
        """Ask the process to end."""
        with self._lock:
            self._stop_asked = True
            if self._process.stdin is not None:
                with suppress(OSError, ValueError):
                    self._process.stdin.close()

    def end(self) -> None:
        """Ask the process to end, and kill it if it does not in time."""
        self.ask_to_end()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_STOP_S)
        if self._process.poll() is None:
            self._process.kill()
        self._thread.join()

    def _command(self, plan: JobPlan, nice: int) -> Sequence[str]:
        command = [sys.executable, "-m", "service", "replay", *plan.arguments]
        command += ["--progress", "json", "--control", "--nice", str(nice)]
        if self.machine_file is not None:
            command += ["--machine", self.machine_file]
        return command + (["--out", str(self.results)] if plan.job.mode == "offline" else [])

    def _listen(self) -> None:
        if self._process.stdout is not None:
            with self._process.stdout as lines:
                for text in lines:
                    self._take(text)
        code = self._process.wait()
        with self._lock:
            state = "stopped" if self._stop_asked else "finished" if code == 0 else "failed"
            update: dict[str, object] = {"state": state}
            if state == "failed":
                update["error"] = self._last_words() or f"the process ended with code {code}"
            self.view = self.view.model_copy(update=update)
            if self._process.stdin is not None:
                with suppress(OSError):
                    self._process.stdin.close()
        _log.info("replay ended", id=self.view.id, state=state, why=self.view.error)

    def _take(self, text: bytes) -> None:
        try:
            line = ReplayLine.model_validate_json(text)
        except ValidationError:
            _log.warning("a replay sent an unknown message", id=self.view.id, line=text[:200])
            return
        update = {name: value for name in ("progress", "summary") if (value := getattr(line, name)) is not None}
        with self._lock:
            self.view = self.view.model_copy(update=update)

    def _last_words(self) -> str:
        """End of what the process wrote to standard error; a traceback goes to the log instead."""
        try:
            text = (self.folder / _MESSAGES).read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""
        if "Traceback (most recent call last)" in text:
            _log.error("a replay ended with a defect", id=self.view.id, messages=text[-_ERROR_CHARACTERS:])
            return "an error inside the replay; the service's log says more"
        return text.strip()[-_ERROR_CHARACTERS:].replace(f"{self.folder}/", "")
