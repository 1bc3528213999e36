"""Processes that share the machines of one monitor, seen from the one that serves them.

::

    sensors --> Zenoh router in this process --> shard 1: its machines' threads --> history <-- this process
                    (no Python on the way)   '-> shard 2: its machines' threads -->    '
    this process <-- a Zenoh session within a folder of its own --> shards: standings, questions

A shard is a process with the machines it was given: streams in, evaluation, history, topics out. This process serves
HTTP, page, metrics and webhooks, from what the shards tell, what it asks them, and the history. A shard that ends is
started again and goes on where it stood.
"""

import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from models.commissioning.commissioned import install
from models.errors import BundleError, MachineFileError, RotorwatchError
from models.signals.link import LinkSettings
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Health, HealthState
from rotorwatch.records.machines import DetectableChanges, MachineDescription
from service.analysis.snapshots.heading import LatestData
from service.analysis.snapshots.machine import MachineSnapshots
from service.history.records import StoreError
from service.history.store import Store
from service.monitor import conversion
from service.monitor.alarms.operation import (
    NotInTime,
    OperationConflict,
    OperationRefused,
    OperatorAction,
    UnknownAlarm,
)
from service.monitor.reports import Identity
from service.runtime.machines import Listener
from service.runtime.shard import run_shard
from service.runtime.standing import EVENTS, Question, Standing, latest_from_bytes
from service.settings.service import MachineEntry, ServiceSettings
from service.stream.monitored import MachineStatus, NoAnswerError
from service.stream.shard_link import RelaySettings, ask, hear
from service.stream.transport import Link, LinkError
from service.terminal.logs import logger

_OF_A_SHARD = 15
"""Machines from which on another process is worth its memory."""
_START_S = 120.0
_STOP_S = 60.0
_LOOK_S = 0.25
_AGAIN_S = 1.0
_LONGEST_AGAIN_S = 30.0
_LATEST_S = 0.5
_SILENT_S = 10.0
"""A shard says every second how it stands."""
_ERRORS = (UnknownAlarm, OperationRefused, OperationConflict, NotInTime, StoreError)
_KINDS: dict[str, type[RotorwatchError]] = {
    kind.__name__: kind for kind in (MachineFileError, BundleError, LinkError, StoreError)
}
_CALM = {HealthState.WARMING, HealthState.HEALTHY, HealthState.UNCHANGED, HealthState.WATCHING}

_log = logger(part="shards")


def shard_count(settings: ServiceSettings) -> int:
    """How many processes share the machines; 1 if this one monitors them itself.

    Raises
    ------
    MachineFileError
        If more are asked for than can be.
    """
    wanted = settings.shards.count
    if (why := _why_one(settings)) is not None:
        if wanted is not None and wanted > 1:
            raise MachineFileError(f"shards.count is {wanted}, expected 1: {why}")
        return 1
    machines = len(settings.machines)
    if wanted is None:
        wanted = min(len(os.sched_getaffinity(0)), machines // _OF_A_SHARD)
    return max(1, min(wanted, machines))


def _why_one(settings: ServiceSettings) -> str | None:
    link = settings.link
    if settings.history.in_memory:
        return "a history in memory cannot be shared"
    names = link.grants or link.user is not None or link.passwords_file is not None
    if link.listen and (names or (link.tls is not None and link.tls.mutual)):
        return "where link.listen asks for names, run rotorwatch router with these settings and connect to it"
    return None


class RemoteMachine:
    """A machine that a shard monitors."""

    def __init__(self, entry: MachineEntry, link: Link, store: Store) -> None:
        self._entry = entry
        self._link = link
        self._lock = threading.Lock()
        self._numbers = [-1, -1]  # of status and health
        self._latest: LatestData | None = None
        self._latest_s = 0.0
        self.machine = entry.load()
        self.history = store.reader(self.machine.site, self.machine.name)
        self.down = ""  # why nobody monitors it now; empty if somebody does
        self._status = MachineStatus()
        self._taking = threading.Lock()
        self._heard_s = self._told_s = 0.0

    def ask_standing(self) -> None:
        """Ask for all that its shard tells."""
        question = Question(about="standing").model_dump_json().encode()
        self.take(Standing.model_validate_json(ask(self._link, self.history.title, question, _ERRORS)))

    def take(self, standing: Standing) -> None:
        """Take note of what its shard tells, from any thread; what is older than what is known does not count."""
        with self._taking:
            self.history.go_on_from(standing.sequence)
            self._told_s = time.monotonic()
            if standing.number > self._numbers[0]:
                self._status, self._numbers[0] = standing.status, standing.number
            if standing.health is not None and standing.number > self._numbers[1]:
                self._health, self._heard_s, self._numbers[1] = standing.health, self._told_s, standing.number

    @property
    def not_monitored(self) -> str:
        """Why what was told does not count any more; empty if it does."""
        silent_s = time.monotonic() - self._told_s
        return self.down or (
            f"the process that monitors it has said nothing for more than {_SILENT_S:g} s"
            if silent_s > _SILENT_S
            else ""
        )

    @property
    def identity(self) -> Identity:
        """The machine, and the exact files its monitor runs on."""
        told = self._health
        return {
            "site": told.site, "machine": told.machine, "bundle": told.bundle, "machine_hash": told.machine_hash
        }  # fmt: skip

    @cached_property
    def snapshots(self) -> MachineSnapshots:
        """What shows a window; its files are read when somebody first looks."""
        return MachineSnapshots(install(self._entry.load(), self._entry.bundle), self.identity)

    @property
    def latest(self) -> LatestData:
        """What its monitor holds; asked for twice a second at most."""
        with self._lock:
            self._check()
            if self._latest is None or time.monotonic() - self._latest_s > _LATEST_S:
                self._latest, self._latest_s = latest_from_bytes(self._ask(Question(about="latest"))), time.monotonic()
            return self._latest

    def health(self) -> Health:
        """Where the machine stands now, as far as it was told."""
        health = self._health
        age_s = health.stream.data_age_s
        if age_s is not None:
            age_s = round(age_s + time.monotonic() - self._heard_s, 3)
            health = health.model_copy(update={"stream": health.stream.model_copy(update={"data_age_s": age_s})})
        if not (why := self.not_monitored):
            return health
        state = HealthState.NOT_EVALUABLE if health.state in _CALM else health.state
        return health.model_copy(update={"state": state, "reason": why})

    def status(self) -> MachineStatus:
        """How its monitoring is at work."""
        if not (why := self.not_monitored):
            return self._status
        return replace(self._status, trouble=why, alive=self._status.alive and not self.down)

    def alarms(self, *, include_normal: bool = False) -> AlarmStates:
        """Return the alarms as they are now."""
        return AlarmStates.model_validate_json(self._ask(Question(about="alarms", include_normal=include_normal)))

    def detectable(self, change: float | None) -> DetectableChanges:
        """Return what would be found on the machine as it runs now."""
        return DetectableChanges.model_validate_json(self._ask(Question(about="detectable", change=change)))

    def description(self) -> MachineDescription:
        """Identity, stream, keys, and the present state."""
        return conversion.machine_description(self.identity, self.machine, self.health().state)

    def operate(self, operation: OperatorAction) -> tuple[AlarmCloudEvent, ...]:
        """Do what an operator asks for, and say what happened; raises as `MachineWorker.operate`."""
        try:
            return EVENTS.validate_json(self._ask(Question(about="operate", action=operation)))
        except NoAnswerError as error:
            raise NotInTime(f"{error}; look at the alarm before trying again") from error

    def _ask(self, question: Question) -> bytes:
        """Ask its shard; of one that hangs or has ended nothing is asked, for whoever asks waits."""
        self._check()
        return ask(self._link, self.history.title, question.model_dump_json().encode(), _ERRORS)

    def _check(self) -> None:
        if why := self.not_monitored:
            raise NoAnswerError(f"{self.history.title}: {why}")


class _Shard:
    """One of the processes, and the thread that starts it again when it ends."""

    def __init__(self, number: int, settings: ServiceSettings, inner: str, listener: Listener) -> None:
        self.settings = settings
        self.machines: tuple[RemoteMachine, ...] = ()
        self._inner = inner
        self._listener = listener
        self._log = _log.bind(shard=number)
        self._stopping = threading.Event()
        self._is_up = self._hangs = False
        self._watcher = threading.Thread(target=self._watch, name=f"shard {number}", daemon=True)
        self._begin()

    def ready(self) -> None:
        """Wait until its machines are monitored.

        Raises
        ------
        RotorwatchError
            Saying why they cannot be.
        """
        said = self._received(_START_S)
        if said is None:
            self._end(0.0)
            ended = f"ended (exit {self._process.exitcode}) or was not ready in {_START_S:g} s"
            said = f"\nthe process of {len(self.settings.machines)} machines {ended}"
        if said:
            kind, _, why = said.partition("\n")
            raise _KINDS.get(kind, RotorwatchError)(why)
        self._is_up = True

    def watch(self, machines: Sequence[RemoteMachine]) -> None:
        """Start the process again whenever it ends."""
        self.machines = tuple(machines)
        self._watcher.start()

    def ask_to_stop(self) -> None:
        """Let it end in order."""
        self._stopping.set()
        if self._watcher.is_alive():
            self._watcher.join()
        with suppress(OSError):
            self._connection.send_bytes(b"")

    def stop(self) -> str:
        """Wait for the end, and say what was lost."""
        lost = self._received(_STOP_S, to_the_end=True)
        self._end(_STOP_S)
        if not self._is_up:
            return ""
        return f"{self._process.name} did not end in order" if lost is None else lost

    def _begin(self) -> None:
        # Not a fork: threads of this process hold locks that nobody would let go of in a copy.
        context = multiprocessing.get_context("spawn")
        try:
            ours, theirs = context.Pipe()
            with theirs:
                process = context.Process(target=run_shard, args=(self.settings, self._inner, theirs))
                try:
                    process.start()
                except OSError:
                    ours.close()
                    raise
        except OSError as error:
            raise RotorwatchError(f"the system lets no further process begin: {error.strerror or error}") from error
        self._connection, self._process = ours, process

    def _end(self, patience_s: float) -> None:
        self._process.join(patience_s)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._connection.close()

    def _received(self, patience_s: float, *, to_the_end: bool = False) -> str | None:
        """What it says; None if it has ended instead, or says nothing."""
        end_s = time.monotonic() + patience_s
        try:
            while time.monotonic() < end_s and (to_the_end or not self._stopping.is_set()):
                if self._connection.poll(_LOOK_S):
                    return self._connection.recv_bytes().decode()
        except (EOFError, OSError):
            return None
        return None

    def _watch(self) -> None:
        wait_s = _AGAIN_S
        while not self._stopping.is_set():
            self._process.join(_LOOK_S)
            if self._process.exitcode is None:
                self._look()
                continue
            self._is_up = False
            why = f"the process that monitored it ended (exit {self._process.exitcode}) and is being started again"
            self._log.error("a shard ended", machines=len(self.machines), exit=self._process.exitcode)
            self._say(why)
            while not self._stopping.is_set():
                try:
                    self._end(0.0)
                    self._begin()
                    self.ready()
                    for one in self.machines:
                        one.ask_standing()
                    self._listener.wake()  # events that were committed and not told any more
                except Exception as error:  # whatever it is, the machines must not stay without anybody
                    self._log.error("a shard could not be started again", exc_info=_unknown(error), why=str(error))
                    self._say(f"{why}, which failed: {error}")
                    self._stopping.wait(wait_s)
                    wait_s = min(2 * wait_s, _LONGEST_AGAIN_S)
                else:
                    wait_s = _AGAIN_S
                    self._say("")
                    self._log.info("a shard goes on")
                    break

    def _look(self) -> None:
        """Tell of a process that hangs, and when it is heard again."""
        hangs = any(one.not_monitored for one in self.machines)
        if hangs != self._hangs:
            self._hangs = hangs
            self._log.error("a shard says nothing" if hangs else "a shard is heard again")
            self._tell()

    def _say(self, down: str) -> None:
        for one in self.machines:
            one.down = down
        self._tell()

    def _tell(self) -> None:
        for one in self.machines:
            self._listener.health(one.health())


def _unknown(error: Exception) -> Exception | None:
    """An error, unless it says by itself what is wrong."""
    return None if isinstance(error, RotorwatchError) else error


class Shards:
    """All of the processes.

    Parameters
    ----------
    count : int
        How many there are.
    store : Store
        Opened by whoever has it, between `connect` and `open`.
    """

    def __init__(self, settings: ServiceSettings, count: int, store: Store, listener: Listener) -> None:
        self._settings = settings
        self._count = count
        self._store = store
        self._listener = listener
        self._shards: list[_Shard] = []
        self._remote: dict[str, RemoteMachine] = {}
        self._router: Link | None = None
        self._lost = ""

    @property
    def session_open(self) -> bool:
        """Whether the Zenoh sessions are open that streams come in by."""
        opened = all(one.status().session_open for one in self._remote.values())
        return opened and (self._router is None or self._router.is_open)

    def connect(self, undo: ExitStack) -> None:
        """Listen where the settings say, for the shards, and for what they tell; raises `LinkError`."""
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="rotorwatch-")))  # of mode 700
        streams, self._end = (f"unixsock-stream/{folder / name}" for name in ("streams", "inner"))
        self._link = self._settings.link
        if self._link.listen:
            listen = (*self._link.listen, streams)
            self._router = Link(RelaySettings(**dict(self._link) | {"mode": "router", "listen": listen}))
            undo.callback(self._router.close)
            alone = {"mode": "client", "listen": (), "connect": (streams,), "tls": None, "user": None}
            self._link = self._link.model_copy(update=alone | {"password_file": None, "password_variable": None})
        self._inner = Link(LinkSettings(mode="router", listen=(self._end,)))
        undo.callback(self._inner.close)
        undo.callback(hear(self._inner, self._heard))

    def open(self, undo: ExitStack) -> Sequence[RemoteMachine]:
        """Start the processes, and wait until every machine is monitored.

        Raises
        ------
        RotorwatchError
            As the first of them says that cannot.
        """
        undo.callback(self._stop)
        for number in range(self._count):
            machines = self._settings.machines[number :: self._count]
            settings = self._settings.model_copy(update={"machines": machines, "link": self._link})
            self._shards.append(_Shard(number + 1, settings, self._end, self._listener))
        of_entry: dict[MachineEntry, RemoteMachine] = {}
        for shard in self._shards:
            shard.ready()
            for entry in shard.settings.machines:
                of_entry[entry] = made = RemoteMachine(entry, self._inner, self._store)
                self._remote[made.history.title] = made
                made.ask_standing()
        for shard in self._shards:
            shard.watch([of_entry[entry] for entry in shard.settings.machines])
        return [of_entry[entry] for entry in self._settings.machines]

    def start(self, undo: ExitStack) -> None:
        """Tell where the machines stand; they are monitored already."""
        _ = undo
        for one in self._remote.values():
            self._listener.health(one.health())

    def refused(self) -> str:
        """What the history did not take, which is lost; empty if it took everything."""
        return self._lost

    def _stop(self) -> None:
        for shard in self._shards:  # all at once: each waits for its own machines
            shard.ask_to_stop()
        self._lost = "; ".join(filter(None, [shard.stop() for shard in self._shards]))

    def _heard(self, content: bytes) -> None:
        standing = Standing.model_validate_json(content)
        machine = self._remote.get(standing.place)
        if machine is None:  # its shard is not ready yet; it is asked for all of it then
            return
        before = machine.history.last_sequence()
        machine.take(standing)
        if standing.sequence > before:
            self._listener.wake()
        if standing.health is not None:
            self._listener.health(standing.health)
