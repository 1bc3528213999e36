"""The running service: which thread does what, start and stop.

::

    Zenoh threads            one thread per machine              supervisor            HTTP threads
    -------------            ----------------------              ----------            ------------
    stream callback --> Inbox --> MachineMonitor.step_payload
      (bounded, counts)           |        |        |            four times a second:
                                  |                 '--> snapshot --> health topic <-- /api/.../health
                                  '--> Store (one thread, commits) <----------------- /api/.../reports, alarms/events
                                         '--> then report, alarm topics
    queries on health, alarm/state <-------------------- snapshot
    queries on alarm/event <-- Store

The main thread waits for a signal. Only a machine's own thread touches its monitor; everybody else reads immutable
snapshots, or asks it to do something between two blocks (operators; the passing of time, four times a second). Silence
is noticed on the monotonic clock; the time of day is used for what is recorded when, and for how long a restart took.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from models.commissioning.commissioned import install
from models.machine import MachineFile
from models.signals.keys import MachineKeys
from models.signals.recording import RecordedMessage
from rotorwatch.records.health import Health
from rotorwatch.records.monitor import MachineReadiness, Readiness
from service.access.guard import Guard
from service.api.app import create_app
from service.api.readiness import readiness_of
from service.api.routes.replays import ReplayDesk
from service.api.server import HttpError, HttpServer
from service.delivery.event_feed import EventFeed
from service.delivery.metrics.collector import Metrics
from service.delivery.metrics.requests import RequestCounts, RequestMeter
from service.delivery.webhooks.webhooks import Webhooks
from service.history.holdings import Holdings
from service.history.records import StoreError
from service.history.shared import AuditLog
from service.history.store import Store
from service.recordings.catalogue import Catalogue
from service.recordings.recent import recent_messages, recorded_files
from service.recordings.recorder import MachineRecorder, RecorderStatus
from service.settings.service import ServiceSettings
from service.stream.evidence import EvidenceCollector
from service.stream.liveness import Pulse
from service.stream.transport import Link, MachineCallbacks, MachineLink, MachineTap
from service.stream.worker import MachineWorker
from service.terminal.logs import logger

_TICK_S = 0.25

_log = logger(part="runtime")


class Runtime:
    """Monitors of all machines with their links and the HTTP server.

    Building it reads every file; nothing runs or listens before `start`.

    Raises
    ------
    MachineFileError, BundleError
        If a machine file or bundle cannot be used.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        self.settings = settings
        self._installed = [install(entry.load(), entry.bundle) for entry in settings.machines]
        self._workers: list[MachineWorker] = []
        self._pulses: list[Pulse] = []
        self._history_open = False
        # What is heard in a namespace is a replay, of which nobody must be told.
        self.webhooks = Webhooks(() if settings.link.namespace else settings.webhooks)
        self._requests = RequestCounts()
        self.metrics = Metrics(self, self._requests)
        self.store = Store(settings.history.database, settings.history.retention)
        self.feed = EventFeed()
        directory = settings.recording.directory
        self.catalogue = None if directory is None else Catalogue(Path(directory))
        self.replays = ReplayDesk(settings, self.catalogue)
        self._recorders: dict[tuple[str, str], MachineRecorder] = {}
        self._link: Link | None = None
        self._server: HttpServer | None = None
        self._undo = ExitStack()

    @property
    def http_url(self) -> str:
        """Where the HTTP API is, once started."""
        if self._server is None:
            raise HttpError("the HTTP API is not started")
        return self._server.url

    @property
    def audit(self) -> AuditLog:
        """Who asked for what."""
        return self.store.audit

    @property
    def holdings(self) -> Holdings:
        """How far back the history goes."""
        return self.store.holdings

    def machines(self) -> tuple[MachineWorker, ...]:
        """Every monitored machine."""
        return tuple(self._workers)

    def machine(self, site: str, name: str) -> MachineWorker | None:
        """One machine, or None if it is not monitored."""
        for worker in self._workers:
            if (worker.machine.site, worker.machine.name) == (site, name):
                return worker
        return None

    def recorder_status(self, worker: MachineWorker) -> RecorderStatus | None:
        """How a machine's recorder stands; None without one."""
        recorder = self._recorders.get((worker.machine.site, worker.machine.name))
        return None if recorder is None else recorder.status()

    def readiness(self) -> Readiness:
        """Whether everything that monitoring needs works, and what does not."""
        machines = tuple(
            MachineReadiness(
                site=worker.machine.site,
                machine=worker.machine.name,
                state=worker.health().state,
                worker_alive=worker.alive,
                worker_errors=worker.errors,
                last_worker_error=worker.last_error,
                worker_busy_s=round(pulse.busy_s, 1),
                trouble=worker.trouble,
                queue_blocks=len(worker.inbox),
                history_waiting=worker.history.waiting,
                recording="off" if (recorder := self.recorder_status(worker)) is None else recorder.text,
            )
            for worker, pulse in zip(self._workers, self._pulses, strict=True)
        )
        return readiness_of(
            session_open=self._link is not None and self._link.is_open,
            machines=machines,
            history_open=self._history_open,
            history_trouble=self.store.trouble or self.store.unreachable(),
            history_lost=self.store.lost,
            failing_webhooks=self.webhooks.failing(),
        )

    def start(self) -> None:
        """Open the session, start the threads, serve HTTP.

        Raises
        ------
        LinkError
            If the Zenoh endpoints cannot be used.
        HttpError
            If the HTTP address cannot be listened on.
        StoreError
            If the history cannot be opened, or another monitor writes that of one of the machines.
        """
        with ExitStack() as undo:
            # Takes the port first: the commonest mistake, the quickest check.
            server = HttpServer(self.settings.http, self.settings.access)
            undo.callback(server.stop)
            guard = Guard(self.store.tokens, self.store.audit, self.settings.access, self.settings.http.host)
            self._link = Link(self.settings.link)
            undo.callback(self._link.close)
            self.store.open(set_aside=True)
            if self.store.lost:
                _log.error("the history begins anew", why=self.store.lost)
            undo.callback(self.store.close)
            self._history_open = True
            links = []
            for installed in self._installed:
                machine = installed.machine
                history = self.store.machine(machine.site, machine.name)
                worker = MachineWorker(
                    installed,
                    self.settings.queue,
                    history,
                    on_events=self._alarm_events,
                    recorded=self._recent(machine),
                )
                self._workers.append(worker)
                self._pulses.append(Pulse(worker.inbox.call))
                self.metrics.watch(worker)
            # After the workers, whose last events they tell, and before the history that these are read from.
            undo.callback(self.feed.close)
            undo.callback(self.webhooks.close)
            logs = {f"{worker.machine.site}/{worker.machine.name}": worker.history for worker in self._workers}
            self.webhooks.start(logs, self.store.webhooks)
            for worker in self._workers:
                self._record(worker.machine, self._link, undo)
                links.append(self._connect(worker, self._link, undo))
            supervisor = _Supervisor(list(zip(self._workers, links, self._pulses, strict=True)), self.feed)
            undo.callback(supervisor.stop)
            supervisor.start()
            undo.callback(self.replays.close)
            self._server = server
            app = create_app(self, guard)
            app.add_middleware(RequestMeter, counts=self._requests)  # around all others, so that refusals count
            server.start(app)
            self._undo = undo.pop_all()
        _log.info("running", http=server.url, machines=len(self._workers))

    def _alarm_events(self) -> None:
        self.feed.wake()
        self.webhooks.wake()

    def _recent(self, machine: MachineFile) -> Callable[[int], Iterable[RecordedMessage]]:
        """What was recorded of a machine until now, where anything of it is."""
        directory = self.settings.recording.directory
        if directory is None or self.settings.link.namespace:
            return lambda _: ()
        return partial(
            recent_messages, recorded_files(Path(directory) / machine.site / machine.name), machine.keys.stream
        )

    def _record(self, machine: MachineFile, link: Link, undo: ExitStack) -> None:
        """Record the machine, if that is wanted; trouble with the disk is the recorder's own affair."""
        if self.settings.recording.directory is None:
            return
        if self.settings.link.namespace:
            _log.warning("not recorded: what is heard in a namespace is a replay", machine=machine.name)
            return
        committed = partial(self.store.alarms.since, machine.site, machine.name)
        recorder = MachineRecorder(machine, self.settings.recording, committed)
        undo.callback(recorder.stop)
        recorder.start()
        # Before anything is published for the machine, and undeclared after everything is.
        undo.callback(MachineTap(link, machine.keys, recorder.put).close)
        self._recorders[machine.site, machine.name] = recorder

    def _connect(self, worker: MachineWorker, link: Link, undo: ExitStack) -> MachineLink:
        machine: MachineFile = worker.machine
        keys: MachineKeys = machine.keys
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
        machine_link = MachineLink(link, keys, callbacks, wait_when_full=self.settings.queue.when_full == "wait")
        undo.callback(machine_link.close)
        # The worker stops first, while its topics are still declared; closing the inbox also frees a waiting callback.
        undo.callback(worker.stop)
        worker.start(machine_link)
        machine_link.publish_alarm_state(worker.alarms().model_dump_json())
        return machine_link

    def stop(self) -> None:
        """Stop in the reverse order of starting.

        Raises
        ------
        StoreError
            Saying what is lost, if the history does not take the last of it; everything has stopped all the same.
        """
        try:
            self._undo.close()
            refused = [
                f"{worker.history.title}: {worker.steps.refused}" for worker in self._workers if worker.steps.refused
            ]
            if refused:
                raise StoreError(f"the history refused the latest step, which is lost: {'; '.join(refused)}")
        except StoreError as error:
            _log.error("stopped; not everything is in the history", why=str(error))
            raise
        _log.info("stopped")


@contextmanager
def running(settings: ServiceSettings) -> Iterator[Runtime]:
    """Run the service inside a ``with`` block.

    Raises
    ------
    RotorwatchError
        As `Runtime` and `Runtime.start`.
    """
    runtime = Runtime(settings)
    runtime.start()
    try:
        yield runtime
    finally:
        runtime.stop()


class _Supervisor:
    """Publishes health when it has changed, silence included."""

    def __init__(self, watched: list[tuple[MachineWorker, MachineLink, Pulse]], feed: EventFeed) -> None:
        self._watched = watched
        self._feed = feed
        self._stop = threading.Event()
        self._published: dict[int, Health] = {}
        self._evidence = [EvidenceCollector(worker) for worker, _, _ in watched]
        self._thread = threading.Thread(target=self._run, name="supervisor", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while True:
            for number, (worker, link, pulse) in enumerate(self._watched):
                try:
                    pulse.beat()
                    worker.tick()
                    self._look(number, worker, link)
                except Exception:  # of any kind: it would end the thread that notices the silence of every machine
                    _log.exception("health could not be published", machine=worker.machine.name)
            if self._stop.wait(_TICK_S):
                return

    def _look(self, number: int, worker: MachineWorker, link: MachineLink) -> None:
        health = worker.health()
        before = self._published.get(number)
        if before is not None and _news(before) == _news(health):
            return
        self._published[number] = health
        link.publish_health(health.model_dump_json())
        self._feed.health(health)
        if before is None or before.state != health.state:
            _log.info("state", machine=f"{health.site}/{health.machine}", state=health.state.value, why=health.reason)
        self._evidence[number].look(health)  # last: nothing waits for it


def _news(health: Health) -> Health:
    """Blank what changes with every block: it is no reason to publish.

    An alarm that changed and changed back is one, to whoever asked in between: the number of its event has changed.
    """
    return health.model_copy(
        update={
            "stream": health.stream.model_copy(update={"data_age_s": None}),
            "quality": health.quality.model_copy(update={"accepted_blocks": 0}),
        }
    )
