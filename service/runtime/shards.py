"""Processes that share the machines of one monitor, seen from the one that serves them.

A shard is a process with the machines it was given: streams in, evaluation, history, topics out. This process serves
HTTP, page, metrics and webhooks, from messages of the shards, their answers, and the history. A shard that ends is
started again and continues from its state. Where they run: `service.runtime.processes`, and `service.runtime.fleet`.
"""

import os
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress

from models.errors import BundleError, MachineFileError, RotorwatchError
from service.history.records import StoreError
from service.history.store import Store
from service.runtime.machines import Listener
from service.runtime.processes import Placement, ShardProcess
from service.runtime.remote import RemoteMachine, Standing
from service.settings.service import MachineEntry, ServiceSettings
from service.stream.shard_link import hear
from service.stream.transport import LinkError
from service.terminal.logs import logger

OF_A_SHARD = 15
"""Number of machines for which a further process is worth its memory."""
_START_S = 120.0
_STOP_S = 60.0
_LOOK_S = 0.25
_AGAIN_S = 1.0
_LONGEST_AGAIN_S = 30.0
_KINDS: dict[str, type[RotorwatchError]] = {
    kind.__name__: kind for kind in (MachineFileError, BundleError, LinkError, StoreError)
}

_log = logger(part="shards")


def shard_count(settings: ServiceSettings) -> int:
    """How many processes share the machines; 1 if this one monitors them itself.

    Raises
    ------
    MachineFileError
        If more are asked for than the settings allow.
    """
    wanted = settings.shards.count
    if (why := _why_one(settings)) is not None:
        if wanted is not None and wanted > 1:
            raise MachineFileError(f"shards.count is {wanted}, expected 1: {why}")
        return 1
    machines = len(settings.machines)
    if wanted is None:
        wanted = min(len(os.sched_getaffinity(0)), machines // OF_A_SHARD)
    return max(1, min(wanted, machines))


def _why_one(settings: ServiceSettings) -> str | None:
    link = settings.link
    if settings.history.in_memory:
        return "a history in memory cannot be shared"
    names = link.grants or link.user is not None or link.passwords_file is not None
    if link.listen and (names or (link.tls is not None and link.tls.mutual)):
        return "where link.listen asks for names, run rotorwatch router with these settings and connect to it"
    return None


class _Shard:
    """One of the processes, and the thread that starts it again when it ends."""

    def __init__(self, number: int, entries: Sequence[MachineEntry], process: ShardProcess, listener: Listener) -> None:
        self.entries = entries
        self.process = process
        self.machines: tuple[RemoteMachine, ...] = ()
        self._name = f"shard {number}"
        self._listener = listener
        self._log = _log.bind(shard=number)
        self._stopping = threading.Event()
        self._is_up = self._hangs = False
        self._watcher = threading.Thread(target=self._watch, name=self._name, daemon=True)

    def ready(self) -> str:
        """Wait until its machines are monitored; returns the identity of its process."""
        said = self._received(_START_S)
        if said is None:
            how = self.process.ended(0.0) or f"was not ready in {_START_S:g} s"
            said = f"\nthe process of {len(self.entries)} machines {how}"
        kind, failed, why = said.partition("\n")
        if failed:
            raise _KINDS.get(kind, RotorwatchError)(why)
        self._is_up = True
        return said

    def watch(self, machines: Sequence[RemoteMachine]) -> None:
        """Start the process again whenever it ends."""
        self.machines = tuple(machines)
        self._watcher.start()

    def ask_to_stop(self) -> None:
        """Ask it to end in order."""
        self._stopping.set()
        if self._watcher.is_alive():
            self._watcher.join()
        self.process.ask_to_stop()

    def stop(self) -> str:
        """Wait for the end, and say what was lost."""
        lost = self._received(_STOP_S, to_the_end=True)
        self.process.end(_STOP_S)
        if not self._is_up:
            return ""
        return f"{self._name} did not end in order" if lost is None else lost

    def _received(self, patience_s: float, *, to_the_end: bool = False) -> str | None:
        """Its next message; None if it has ended or sends nothing."""
        end_s = time.monotonic() + patience_s
        with suppress(EOFError):
            while time.monotonic() < end_s and (to_the_end or not self._stopping.is_set()):
                if (said := self.process.said(_LOOK_S)) is not None:
                    return said
        return None

    def _watch(self) -> None:
        wait_s = _AGAIN_S
        while not self._stopping.is_set():
            if not (how := self.process.ended(_LOOK_S)):
                self._report_hang()
                continue
            self._is_up = False
            why = f"the process that monitored it {how} and is being started again"
            self._log.error("a shard is started again", machines=len(self.machines), why=how)
            self._set_down(why)
            while not self._stopping.is_set():
                try:
                    self.process.begin_again()
                    known_by = self.ready()
                    for one in self.machines:
                        one.follow(known_by)
                    self._listener.wake()  # for events that were committed but no longer sent
                except Exception as error:  # whatever it is, the machines must not stay unmonitored
                    trace = None if isinstance(error, RotorwatchError) else error  # those explain themselves
                    self._log.error("a shard could not be started again", exc_info=trace, why=str(error))
                    self._set_down(f"{why}, which failed: {error}")
                    self._stopping.wait(wait_s)
                    wait_s = min(2 * wait_s, _LONGEST_AGAIN_S)
                else:
                    wait_s = _AGAIN_S
                    self._set_down("")
                    self._log.info("a shard continues")
                    break

    def _report_hang(self) -> None:
        """Report a process that hangs, and when it responds again."""
        hangs = any(one.not_monitored for one in self.machines)
        if hangs != self._hangs:
            self._hangs = hangs
            self._log.error("a shard does not respond" if hangs else "a shard responds again")
            self._publish_health()

    def _set_down(self, down: str) -> None:
        for one in self.machines:
            one.down = down
        self._publish_health()

    def _publish_health(self) -> None:
        for one in self.machines:
            self._listener.health(one.health())


class Shards:
    """All of the processes; the caller opens the store between `connect` and `open`."""

    def __init__(
        self, settings: ServiceSettings, count: int, placement: Placement, store: Store, listener: Listener
    ) -> None:
        self._settings = settings
        self._count = count
        self._placement = placement
        self._store = store
        self._listener = listener
        self._shards: list[_Shard] = []
        self._remote: dict[str, RemoteMachine] = {}
        self._lost = ""

    @property
    def session_open(self) -> bool:
        """Whether the Zenoh sessions by which streams come in are open."""
        return self._placement.session_open and all(one.status().session_open for one in self._remote.values())

    def connect(self, undo: ExitStack) -> None:
        """Listen for streams as the settings say, for shards, and for their messages; raises `LinkError`."""
        self._link = self._placement.connect(undo)
        undo.callback(hear(self._link, self._take_standing))

    def open(self, undo: ExitStack) -> Sequence[RemoteMachine]:
        """Start the processes, and wait until every machine is monitored.

        Raises
        ------
        RotorwatchError
            The error of the first process that cannot begin.
        """
        undo.callback(self._stop)
        for number in range(self._count):
            entries = self._settings.machines[number :: self._count]
            process = self._placement.process(number, self._settings.model_copy(update={"machines": entries}))
            self._shards.append(_Shard(number + 1, entries, process, self._listener))
        of_entry: dict[MachineEntry, RemoteMachine] = {}
        for shard in self._shards:
            known_by = shard.ready()
            for entry in shard.entries:
                of_entry[entry] = made = RemoteMachine(entry, self._link, self._store)
                self._remote[made.history.title] = made
                made.follow(known_by)
        for shard in self._shards:
            shard.watch([of_entry[entry] for entry in shard.entries])
        return [of_entry[entry] for entry in self._settings.machines]

    def start(self, undo: ExitStack) -> None:
        """Report the health of the machines, which are monitored already."""
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

    def _take_standing(self, content: bytes) -> None:
        standing = Standing.model_validate_json(content)
        machine = self._remote.get(standing.place)
        if machine is None:  # its shard is not ready yet, and will be asked for the complete state
            return
        before = machine.history.last_sequence
        machine.take(standing)
        if standing.sequence > before:
            self._listener.wake()
        if standing.health is not None:
            self._listener.health(standing.health)
