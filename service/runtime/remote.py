"""A machine that another process monitors, as seen by the process that serves it."""

import threading
import time
from dataclasses import replace
from functools import cached_property

from models.commissioning.commissioned import install
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Health, HealthState
from rotorwatch.records.machines import DetectableChanges
from service.analysis.snapshots.machine import LatestData, MachineSnapshots
from service.history.records import StoreError
from service.history.store import Store
from service.monitor.alarms.operation import (
    NotInTime,
    OperationConflict,
    OperationRefused,
    OperatorAction,
    UnknownAlarm,
)
from service.monitor.reports import Identity
from service.runtime.standing import EVENTS, Question, Standing, latest_from_bytes
from service.settings.service import MachineEntry
from service.stream.monitored import MachineStatus, NoAnswerError, with_flow
from service.stream.shard_link import ask
from service.stream.transport import Link

_LATEST_S = 0.5
_SILENT_S = 10.0
"""Silence after which a shard is not believed any more; it sends its status every second."""
_ERRORS = (UnknownAlarm, OperationRefused, OperationConflict, NotInTime, StoreError)
_CALM = {HealthState.WARMING, HealthState.HEALTHY, HealthState.UNCHANGED, HealthState.WATCHING}


class RemoteMachine:
    """A machine that a shard monitors."""

    def __init__(self, entry: MachineEntry, link: Link, store: Store) -> None:
        self._entry = entry
        self._link = link
        self._lock = threading.Lock()
        self._process = ""  # the one that is believed
        self._numbers = [-1, -1]  # of status and health
        self._latest: LatestData | None = None
        self._latest_s = 0.0
        self.machine = entry.load()
        self.history = store.reader(self.machine.site, self.machine.name)
        self.down = ""  # why nobody monitors it now; empty if somebody does
        self._status = MachineStatus()
        self._taking = threading.Lock()
        self._told_s = 0.0
        self._data_age_s: float | None = None
        self._accepted = 0

    def follow(self, process: str) -> None:
        """Believe this process from now on, and ask it for the complete state."""
        with self._taking:
            self._process, self._numbers = process, [-1, -1]
        self.take(Standing.model_validate_json(self._answer(Question(about="standing"))))

    def take(self, standing: Standing) -> None:
        """Take note of a state that its shard sent, from any thread; one older than what is known does not count."""
        with self._taking:
            if standing.process != self._process:  # that process was given up and does not know it
                return
            self.history.go_on_from(standing.sequence)
            if standing.number > self._numbers[0]:
                self._told_s = time.monotonic()
                self._status, self._numbers[0] = standing.status, standing.number
                self._data_age_s, self._accepted = standing.data_age_s, standing.accepted_blocks
            if standing.health is not None and standing.number > self._numbers[1]:
                self._health, self._numbers[1] = standing.health, standing.number

    @property
    def not_monitored(self) -> str:
        """Why the latest known state does not count any more; empty if it does."""
        silent_s = time.monotonic() - self._told_s
        return self.down or (
            f"the process that monitors it has not responded for more than {_SILENT_S:g} s"
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
        """Makes snapshots of a window; the machine's files are read when somebody first looks."""
        return MachineSnapshots(install(self._entry.load(), self._entry.bundle), self.identity)

    @property
    def latest(self) -> LatestData:
        """Latest data of its monitor, fetched twice a second at most."""
        with self._lock:
            self._check()
            if self._latest is None or time.monotonic() - self._latest_s > _LATEST_S:
                self._latest, self._latest_s = latest_from_bytes(self._ask(Question(about="latest"))), time.monotonic()
            return self._latest

    def health(self) -> Health:
        """State of the machine now, by the latest message of its shard."""
        with self._taking:
            health, age_s, told_s, accepted = self._health, self._data_age_s, self._told_s, self._accepted
        if age_s is not None:
            age_s = round(age_s + time.monotonic() - told_s, 3)
        health = with_flow(health, age_s, accepted)
        if not (why := self.not_monitored):
            return health
        state = HealthState.NOT_EVALUABLE if health.state in _CALM else health.state
        return health.model_copy(update={"state": state, "reason": why})

    def status(self) -> MachineStatus:
        """State of its monitoring."""
        if not (why := self.not_monitored):
            return self._status
        return replace(self._status, trouble=why, alive=self._status.alive and not self.down)

    def alarms(self, *, include_normal: bool = False) -> AlarmStates:
        """Return the alarms as they are now."""
        return AlarmStates.model_validate_json(self._ask(Question(about="alarms", include_normal=include_normal)))

    def detectable(self, change: float | None) -> DetectableChanges:
        """Return what would be found on the machine as it runs now."""
        return DetectableChanges.model_validate_json(self._ask(Question(about="detectable", change=change)))

    def operate(self, operation: OperatorAction) -> tuple[AlarmCloudEvent, ...]:
        """Do what an operator asks for, and say what happened; raises as `MachineWorker.operate`."""
        try:
            return EVENTS.validate_json(self._ask(Question(about="operate", action=operation)))
        except NoAnswerError as error:
            raise NotInTime(f"{error}; look at the alarm before trying again") from error

    def _ask(self, question: Question) -> bytes:
        """Ask its shard; raise at once, rather than wait, if that hangs or has ended."""
        self._check()
        return self._answer(question)

    def _answer(self, question: Question) -> bytes:
        content = question.model_dump_json().encode()
        return ask(self._link, f"{self._process}/{self.history.title}", content, _ERRORS)

    def _check(self) -> None:
        if why := self.not_monitored:
            raise NoAnswerError(f"{self.history.title}: {why}")
