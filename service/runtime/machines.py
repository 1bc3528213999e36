"""The machines of one process: which thread does what, start and stop.

::

    one thread for all       one thread per machine              supervisor
    ------------------       ----------------------              ----------
    Intake ---------------> Inbox --> MachineMonitor.step_payload
              (bounded, counts)   |        |        |            twice a second:
                                  |                 '--> snapshot --> health topic, listener
                                  '--> Store (one thread, commits)
                                         '--> then report, alarm topics; listener
    queries on health, alarm/state <-------------------- snapshot
    queries on alarm/event <-- Store

Only a machine's own thread touches its monitor; other threads read immutable snapshots, or ask it to do something
between two blocks (operators; the passing of time, twice a second). Silence is noticed on the monotonic clock; the
time of day only says when something was recorded, and how long a restart took.
"""

import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Protocol

from models.commissioning.commissioned import install
from models.machine import MachineFile
from models.signals.recording import RecordedMessage
from rotorwatch.records.health import Health
from service.history.store import Store
from service.recordings.catalogue import recent_messages, recorded_files
from service.recordings.recorder import MachineRecorder
from service.settings.service import ServiceSettings
from service.stream.evidence import EvidenceCollector
from service.stream.monitored import with_flow
from service.stream.transport import Link, MachineCallbacks, MachineLink, tap
from service.stream.worker import MachineWorker
from service.terminal.logs import logger

_TICK_S = 0.5

_log = logger(part="runtime")


class Listener(Protocol):
    """Is told what happens to machines; called from any thread."""

    def health(self, health: Health) -> None:
        """Hear that a machine's health has changed."""

    def wake(self) -> None:
        """Hear that alarm events were committed."""


class LocalMachines:
    """Monitors of machines in this process, with their links and recorders.

    Building it reads every file; nothing runs before `start`.

    Raises
    ------
    MachineFileError, BundleError
        If a machine file or bundle cannot be used.
    """

    def __init__(self, settings: ServiceSettings, store: Store, listener: Listener) -> None:
        self._settings = settings
        self._store = store
        self._listener = listener
        self._installed = [install(entry.load(), entry.bundle) for entry in settings.machines]
        self._link: Link | None = None
        self.workers: tuple[MachineWorker, ...] = ()

    @property
    def session_open(self) -> bool:
        """Whether the Zenoh session is open."""
        return self._link is not None and self._link.is_open

    def connect(self, undo: ExitStack) -> None:
        """Open the session. Raises LinkError if the Zenoh endpoints cannot be used."""
        self._link = Link(self._settings.link)
        undo.callback(self._link.close)

    def open(self, undo: ExitStack) -> Sequence[MachineWorker]:
        """Make a worker for every machine, which continues from the history; that has to be open.

        Raises
        ------
        StoreError
            If another monitor writes the history of one of the machines.
        """
        _ = undo  # nothing to undo before `start`
        self.workers = tuple(
            MachineWorker(
                installed,
                self._settings.queue,
                self._store.machine(installed.machine.site, installed.machine.name),
                on_events=self._listener.wake,
                recorded=self._recent(installed.machine),
            )
            for installed in self._installed
        )
        return self.workers

    def start(self, undo: ExitStack) -> None:
        """Record, evaluate and publish, until the stack is unwound."""
        if self._link is None:
            raise RuntimeError("the session is not open")
        links = []
        for worker in self.workers:
            self._record(worker, self._link, undo)
            links.append(self._connect(worker, self._link, undo))
        undo.callback(_Supervisor(list(zip(self.workers, links, strict=True)), self._listener).stop)

    def refused(self) -> str:
        """Why the history refused the latest steps of machines, which are lost; empty if it took everything."""
        return "; ".join(f"{one.history.title}: {one.steps.refused}" for one in self.workers if one.steps.refused)

    def _recent(self, machine: MachineFile) -> Callable[[int], Iterable[RecordedMessage]]:
        """Function that reads the messages recorded so far, as `MachineWorker` takes it; without recording, none."""
        directory = self._settings.recording.directory
        if directory is None or self._settings.link.namespace:
            return lambda _: ()
        files = recorded_files(Path(directory) / machine.site / machine.name)
        return partial(recent_messages, files, machine.keys.stream)

    def _record(self, worker: MachineWorker, link: Link, undo: ExitStack) -> None:
        """Record the machine if the settings say so; the recorder itself deals with disk errors."""
        machine = worker.machine
        if self._settings.recording.directory is None:
            return
        if self._settings.link.namespace:
            _log.warning("not recorded: what is received in a namespace is a replay", machine=machine.name)
            return
        committed = partial(self._store.alarms_since, machine.site, machine.name)
        recorder = MachineRecorder(machine, self._settings.recording, committed)
        undo.callback(recorder.stop)
        recorder.start()
        # Declared before anything is published for the machine, and undeclared after everything has been.
        undo.callback(tap(link, machine.keys, recorder.put))
        worker.recorder = recorder

    def _connect(self, worker: MachineWorker, link: Link, undo: ExitStack) -> MachineLink:
        callbacks = MachineCallbacks(
            on_block=worker.inbox.put,
            on_missed=worker.missed,
            on_descriptor=worker.descriptor,
            on_publisher=worker.publisher,
            health=lambda: worker.health().model_dump_json(),
            alarm_state=lambda: worker.alarms().model_dump_json(),
            alarm_events=worker.alarm_log,
            on_replay=worker.replay,
        )
        waits = self._settings.queue.when_full == "wait"
        machine_link = MachineLink(link, worker.machine.keys, callbacks, wait_when_full=waits)
        undo.callback(machine_link.close)
        # The worker stops first, while its topics are still declared; closing the inbox also frees a waiting callback.
        undo.callback(worker.stop)
        worker.start(machine_link.publish)
        machine_link.publish("alarm_state", worker.alarms().model_dump_json())
        return machine_link


class _Supervisor:
    """Publishes health when it has changed, silence included, from the start on."""

    def __init__(self, watched: list[tuple[MachineWorker, MachineLink]], listener: Listener) -> None:
        self._watched = watched
        self._listener = listener
        self._stop = threading.Event()
        self._published: dict[int, Health] = {}
        self._evidence = [EvidenceCollector(worker) for worker, _ in watched]
        self._thread = threading.Thread(target=self._run, name="supervisor", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while True:
            for number, (worker, link) in enumerate(self._watched):
                try:
                    worker.tick()
                    self._look(number, worker, link)
                except Exception:  # of any kind: it would end the thread that notices the silence of every machine
                    _log.exception("health could not be published", machine=worker.machine.name)
            if self._stop.wait(_TICK_S):
                return

    def _look(self, number: int, worker: MachineWorker, link: MachineLink) -> None:
        health = worker.health()
        before, now = self._published.get(number), with_flow(health, None, 0)
        # An alarm that changed and changed back counts too, as somebody may have asked in between: its number differs.
        if before == now:
            return
        self._published[number] = now
        link.publish("health", health.model_dump_json())
        self._listener.health(health)
        if before is None or before.state != health.state:
            _log.info("state", machine=f"{health.site}/{health.machine}", state=health.state.value, why=health.reason)
        self._evidence[number].look(health)  # last: nothing waits for it
