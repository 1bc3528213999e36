"""A process that monitors some of the machines for another one, which serves them.

It runs until the other one stops it or ends. Nobody on the network can tell it from a monitor of its own.
"""

import threading
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing.connection import Connection

from models.errors import RotorwatchError
from models.signals.link import LinkSettings
from rotorwatch.records.health import Health
from service.history.store import Store
from service.runtime.machines import LocalMachines
from service.runtime.remote import EVENTS, Question, Standing, latest_to_bytes
from service.settings.service import ServiceSettings
from service.stream.shard_link import ShardLink
from service.stream.transport import Link
from service.stream.worker import MachineWorker
from service.terminal.logs import configure_logging, logger
from service.terminal.memory import keep_loaded, prepare_memory

_STATUS_S = 1.0
_PATIENCE_S = 15.0
"""Longest wait for SQLite's one lock, which other processes hold in turn."""

_log = logger(part="shard")


def run_shard(settings: ServiceSettings, inner: LinkSettings, connection: Connection) -> None:
    """Monitor machines until something comes over the connection, or its other end is closed.

    The settings are those of this process alone; by `inner` it connects to the process that serves its machines.

    Sends over the connection, once ready, the identity of this process in its answers and news, or else the kind of an
    error and, after a line break, what is wrong; and at its end what was lost.
    """
    prepare_memory()
    configure_logging(settings.log)
    undo = ExitStack()
    try:
        with ExitStack() as starting:
            shard = _Shard(settings, inner, starting)
            undo = starting.pop_all()
            keep_loaded()
    except Exception as error:  # whatever it is, the other process waits to be told
        if not isinstance(error, RotorwatchError):
            _log.exception("a shard cannot begin")
        connection.send_bytes(f"{type(error).__name__}\n{error}".encode())
        return
    connection.send_bytes(shard.process.encode())
    lost = ""
    try:
        with undo:
            while not connection.poll(_STATUS_S):
                for place in shard.workers:
                    shard.tell(place)
    except RotorwatchError as error:
        lost = str(error)
    lost = "; ".join(filter(None, (lost, shard.refused())))
    try:
        connection.send_bytes(lost.encode())
    except OSError:  # nobody is there any more
        return


class _Shard:
    """The machines of this process, and the news and answers that it sends about them."""

    def __init__(self, settings: ServiceSettings, inner: LinkSettings, undo: ExitStack) -> None:
        self.process = uuid.uuid4().hex
        self._store = Store(settings.history.database, settings.history.retention, timeout_s=_PATIENCE_S, shared=True)
        self._machines = machines = LocalMachines(settings, self._store, self)
        self.refused = machines.refused
        self._told: dict[str, int] = {}
        self._looking = threading.Lock()
        machines.connect(undo)
        self._store.open()
        undo.callback(self._store.close)
        self.workers = {one.history.title: one for one in machines.open(undo)}
        link = Link(inner)
        undo.callback(link.close)
        self._link = ShardLink(link, self.process, tuple(self.workers), self._answer)
        undo.callback(self._link.close)
        machines.start(undo)

    def health(self, health: Health) -> None:
        self.tell(f"{health.site}/{health.machine}", changed=True)

    def wake(self) -> None:
        for place, worker in self.workers.items():
            if worker.told - 1 != self._told.get(place):
                self.tell(place, changed=True)

    def tell(self, place: str, *, changed: bool = False) -> None:
        """Send the state of a machine, with its health if that has changed."""
        self._link.tell(self._standing(place, changed=changed).model_dump_json().encode())

    def _standing(self, place: str, *, changed: bool) -> Standing:
        worker = self.workers[place]
        with self._looking:  # so that a larger number means a later look
            number = time.monotonic_ns()
            sequence = worker.told - 1  # before the health, which then contains the event
            changed = changed or sequence != self._told.get(place)
            self._told[place] = sequence
            health, status = worker.health(), worker.status()
        status = replace(status, history_trouble=self._store.writer.trouble, session_open=self._machines.session_open)
        return Standing(
            process=self.process,
            place=place,
            number=number,
            sequence=sequence,
            status=status,
            data_age_s=health.stream.data_age_s,
            accepted_blocks=health.quality.accepted_blocks,
            health=health if changed else None,
        )

    def _answer(self, place: str, content: bytes) -> bytes:
        question = Question.model_validate_json(content)
        answers: dict[str, Callable[[MachineWorker], bytes]] = {
            "standing": lambda _: self._standing(place, changed=True).model_dump_json().encode(),
            "alarms": lambda one: one.alarms(include_normal=question.include_normal).model_dump_json().encode(),
            "detectable": lambda one: one.detectable(question.change).model_dump_json().encode(),
            "operate": lambda one: EVENTS.dump_json(() if question.action is None else one.operate(question.action)),
            "latest": lambda one: latest_to_bytes(one.latest),
        }
        return answers[question.about](self.workers[place])
