"""The running service: the machines, their listeners, and the HTTP server; start and stop.

::

    machines (threads, or processes that share them) --> Listener --> event stream, webhooks
        '--> Store <-- HTTP threads: reports, alarm events

The main thread waits for a signal. `service.runtime.machines` says which thread does what for a machine,
`service.runtime.shards` how processes share them.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from rotorwatch.records.health import Health
from rotorwatch.records.monitor import MachineReadiness, Readiness
from service.access.guard import Guard
from service.access.tls import lapses
from service.api.app import create_app
from service.api.routes.replays import ReplayRequests
from service.api.server import HttpError, HttpServer
from service.delivery.event_feed import EventFeed
from service.delivery.metrics import Metrics, RequestCounts, RequestMeter
from service.delivery.webhooks.dispatcher import Webhooks
from service.history.records import StoreError
from service.history.store import Store
from service.recordings.catalogue import Catalogue
from service.runtime.machines import LocalMachines
from service.runtime.processes import OneComputer
from service.runtime.shards import Shards, shard_count
from service.settings.service import ServiceSettings
from service.stream.liveness import STUCK_S
from service.stream.monitored import Monitored
from service.terminal.logs import logger

_log = logger(part="runtime")


class Runtime:
    """Monitors of all machines with their links and the HTTP server.

    Building it reads every file; nothing runs or listens before `start`.

    Parameters
    ----------
    ray_address : str, optional
        Ray cluster whose computers share the machines; without it, this computer monitors them.

    Raises
    ------
    MachineFileError, BundleError
        If a machine file or bundle cannot be used.
    """

    def __init__(self, settings: ServiceSettings, ray_address: str | None = None) -> None:
        self.settings = settings
        self._monitored: Sequence[Monitored] = ()
        self._history_open = False
        # What is received in a namespace is a replay, of which nobody must be notified.
        self.webhooks = Webhooks(() if settings.link.namespace else settings.webhooks)
        self._requests = RequestCounts()
        self.metrics = Metrics(self, self._requests)
        self.store = Store(settings.history.database, settings.history.retention)
        self.feed = EventFeed()
        directory = settings.recording.directory
        self.catalogue = None if directory is None else Catalogue(Path(directory))
        self.replays = ReplayRequests(settings, self.catalogue)
        self._machines: LocalMachines | Shards
        if ray_address is not None:
            from service.runtime.fleet import Fleet, fleet_count  # noqa: PLC0415  # needs Ray, which few have installed

            fleet = fleet_count(settings), Fleet(settings, ray_address)
            self._machines = Shards(settings, *fleet, self.store, self)
        elif (count := shard_count(settings)) == 1:
            self._machines = LocalMachines(settings, self.store, self)
        else:
            here = OneComputer(settings.link, waits=settings.queue.when_full == "wait")
            self._machines = Shards(settings, count, here, self.store, self)
        self._server: HttpServer | None = None
        self._undo = ExitStack()

    @property
    def http_url(self) -> str:
        """Address of the HTTP API, once started."""
        if self._server is None:
            raise HttpError("the HTTP API is not started")
        return self._server.url

    def machines(self) -> Sequence[Monitored]:
        """Every monitored machine."""
        return self._monitored

    def health(self, health: Health) -> None:
        """Hear that a machine's health has changed."""
        self.feed.health(health)

    def wake(self) -> None:
        """Hear that alarm events were committed."""
        self.feed.wake()
        self.webhooks.wake()

    def readiness(self) -> Readiness:
        """Whether everything that monitoring needs works, and what does not."""
        statuses = [(one, one.status()) for one in self._monitored]
        machines = tuple(
            MachineReadiness(
                site=one.machine.site,
                machine=one.machine.name,
                state=one.health().state,
                worker_alive=status.alive,
                worker_errors=status.errors,
                last_worker_error=status.last_error,
                worker_busy_s=status.busy_s,
                trouble=status.trouble,
                queue_blocks=status.queue_blocks,
                history_waiting=status.history_waiting,
                recording="off" if status.recorder is None else status.recorder.text,
            )
            for one, status in statuses
        )
        elsewhere = next((status.history_trouble for _, status in statuses if status.history_trouble), "")
        return readiness_of(
            session_open=self._machines.session_open,
            machines=machines,
            history_open=self._history_open,
            history_trouble=self.store.writer.trouble or elsewhere or self.store.unreachable(),
            history_lost=self.store.database.lost,
            failing_webhooks=self.webhooks.failing(),
        )

    def start(self) -> None:
        """Open the session, start the threads, serve HTTP.

        Raises `LinkError` if the Zenoh endpoints cannot be used; `HttpError` if the HTTP address cannot be listened on;
        `StoreError` if the history cannot be opened, or another monitor writes that of one of the machines.
        """
        with ExitStack() as undo:
            # Takes the port first: the commonest mistake, the quickest check.
            server = HttpServer(self.settings.http, self.settings.access)
            undo.callback(server.stop)
            guard = Guard(self.store.tokens, self.store.audit, self.settings.access, self.settings.http.host)
            self._machines.connect(undo)
            self.store.open(set_aside=True)
            if self.store.database.lost:
                _log.error("a new history is begun", why=self.store.database.lost)
            undo.callback(self.store.close)
            self._history_open = True
            # Closed after the machines, whose last events they send, and before the history, where they read these.
            undo.callback(self.feed.close)
            undo.callback(self.webhooks.close)
            self._monitored = self._machines.open(undo)
            for one in self._monitored:
                self.metrics.watch(one)
            logs = {one.machine.title: one.history for one in self._monitored}
            self.webhooks.start(logs, self.store.webhooks)
            self._machines.start(undo)
            undo.callback(self.replays.jobs.close)
            self._server = server
            app = create_app(self, guard)
            app.add_middleware(RequestMeter, counts=self._requests)  # around all others, so that refusals count
            server.start(app)
            self._undo = undo.pop_all()
        _log.info("running", http=server.url, machines=len(self._monitored))
        for said in lapses(self.settings):
            _log.warning("a certificate has to be renewed, and the monitor restarted", which=said)

    def stop(self) -> None:
        """Stop in the reverse order of starting.

        Raises
        ------
        StoreError
            If the history does not take the last steps, saying what is lost; everything has stopped all the same.
        """
        try:
            self._undo.close()
            if refused := self._machines.refused():
                raise StoreError(f"the history refused the latest step, which is lost: {refused}")
        except StoreError as error:
            _log.error("stopped; not everything was written to the history", why=str(error))
            raise
        _log.info("stopped")


def readiness_of(
    *,
    session_open: bool,
    machines: Sequence[MachineReadiness],
    history_open: bool,
    history_trouble: str,
    history_lost: str,
    failing_webhooks: Sequence[str],
) -> Readiness:
    """Judge whether everything that monitoring needs works.

    Recordings and webhooks are stated but are no reason against it: without them machines are still monitored, and
    alarms kept. `history_trouble` and `history_lost` are empty if nothing is wrong with the history.
    """
    reasons = []
    if not session_open:
        reasons.append("the Zenoh session is closed: nothing arrives and nothing is published")
    if not history_open:
        reasons.append("the history is not open, or its tables are not up to date")
    if history_trouble:
        reasons.append(f"the history cannot be written; events wait in memory: {history_trouble}")
    if history_lost:
        reasons.append(f"{history_lost}; see docs/history.md, and restart the monitor once that is fixed")
    for machine in machines:
        place = f"{machine.site}/{machine.machine}"
        if not machine.worker_alive:
            reasons.append(f"{place}: the thread that evaluates its blocks has stopped")
        elif machine.worker_busy_s > STUCK_S:
            reasons.append(f"{place}: one block has been in the monitor for {machine.worker_busy_s:.0f} s")
        if machine.trouble:
            reasons.append(f"{place}: {machine.trouble}")
    return Readiness(
        ready=not reasons,
        reasons=tuple(reasons),
        session_open=session_open,
        history_open=history_open,
        history_trouble=history_trouble,
        failing_webhooks=tuple(failing_webhooks),
        machines=tuple(machines),
    )


@contextmanager
def running(settings: ServiceSettings, ray_address: str | None = None) -> Iterator[Runtime]:
    """Run the service inside a ``with`` block; raises `RotorwatchError` as `Runtime` and `Runtime.start`."""
    runtime = Runtime(settings, ray_address)
    runtime.start()
    try:
        yield runtime
    finally:
        runtime.stop()
