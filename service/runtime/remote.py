"""A machine that another process monitors, as seen by the one that serves it: its state as sent, and questions."""

import dataclasses
import json
import threading
import time
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import BaseModel, TypeAdapter

from models.checkpoint import from_bytes, to_bytes
from models.commissioning.commissioned import install
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import SampleBlock
from models.signals.waveform import Waveform
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Health, HealthState
from rotorwatch.records.machines import DetectableChanges
from rotorwatch.records.windows import Parameter, SensorFault
from service.analysis.snapshots.machine import LatestData, MachineSnapshots
from service.history.records import StoreError
from service.history.store import Store
from service.monitor.alarms.alarm import NotInTime, OperationConflict, OperationRefused, OperatorAction, UnknownAlarm
from service.monitor.reports import Identity
from service.settings.service import MachineEntry
from service.stream.monitored import MachineStatus, NoAnswerError, with_flow
from service.stream.shard_link import ask
from service.stream.transport import Link

_LATEST_S = 0.5
_SILENT_S = 10.0
"""Silence after which a shard is not believed any more; it sends its status every second."""
_ERRORS = (UnknownAlarm, OperationRefused, OperationConflict, NotInTime, StoreError)
_CALM = {HealthState.WARMING, HealthState.HEALTHY, HealthState.UNCHANGED, HealthState.WATCHING}
_PARTS: dict[str, Any] = {kind.__name__: kind for kind in (LatestData, WindowStatistics, Waveform, SampleBlock)}
_RECORDS: dict[str, type[BaseModel]] = {kind.__name__: kind for kind in (Parameter, SensorFault)}

EVENTS = TypeAdapter(tuple[AlarmCloudEvent, ...])


class Standing(BaseModel, frozen=True, arbitrary_types_allowed=True):
    """The state of a machine; the health is None if it has not changed."""

    process: str
    place: str
    number: int  # larger than in all earlier states of the machine from this process
    sequence: int  # of the latest alarm event
    status: MachineStatus
    # Changes of these are no reason to send the whole health.
    data_age_s: float | None
    accepted_blocks: int
    health: Health | None = None


class Question(BaseModel, frozen=True):
    """A question to the process that monitors a machine."""

    about: str  # ``standing``, ``alarms``, ``detectable``, ``operate``, ``latest``
    change: float | None = None
    include_normal: bool = False
    action: OperatorAction | None = None


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
        self._taking = threading.Lock()
        self._told_s = 0.0  # when the standing came

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
                self._standing, self._numbers[0] = standing, standing.number
            if standing.health is not None and standing.number > self._numbers[1]:
                self._health, self._numbers[1] = standing.health, standing.number

    @property
    def not_monitored(self) -> str:
        """Why the latest known state does not count any more; empty if it does."""
        if not self.down and time.monotonic() - self._told_s > _SILENT_S:
            return f"the process that monitors it has not responded for more than {_SILENT_S:g} s"
        return self.down

    @property
    def identity(self) -> Identity:
        """The machine, and the exact files its monitor runs on."""
        told = self._health
        return Identity(site=told.site, machine=told.machine, bundle=told.bundle, machine_hash=told.machine_hash)

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
            health, standing, told_s = self._health, self._standing, self._told_s
        age_s = standing.data_age_s
        if age_s is not None:
            age_s = round(age_s + time.monotonic() - told_s, 3)
        health = with_flow(health, age_s, standing.accepted_blocks)
        if not (why := self.not_monitored):
            return health
        state = HealthState.NOT_EVALUABLE if health.state in _CALM else health.state
        return health.model_copy(update={"state": state, "reason": why})

    def status(self) -> MachineStatus:
        """State of its monitoring."""
        status = self._standing.status
        if not (why := self.not_monitored):
            return status
        return dataclasses.replace(status, trouble=why, alive=status.alive and not self.down)

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


def latest_to_bytes(data: LatestData) -> bytes:
    """Latest data of a monitor as bytes that hold nothing but numbers and text."""
    arrays: list[np.ndarray] = []
    form = json.dumps(_to_plain(data, arrays))
    return to_bytes({"form": np.array([form])} | {str(number): array for number, array in enumerate(arrays)})


def latest_from_bytes(content: bytes) -> LatestData:
    """Latest data from the bytes of `latest_to_bytes`; raises `CheckpointError` if the bytes are damaged."""
    arrays = from_bytes(content)
    found: LatestData = _from_plain(json.loads(str(arrays["form"][0])), arrays)
    return found


def _to_plain(value: object, arrays: list[np.ndarray]) -> Any:
    """The value for JSON, with its arrays moved to `arrays`; what is not plain becomes a pair of kind and content."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return ["array", str(len(arrays) - 1)]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return ["tuple", [_to_plain(one, arrays) for one in value]]
    if isinstance(value, BaseModel):
        return [type(value).__name__, value.model_dump_json()]
    if dataclasses.is_dataclass(value):
        fields = {one.name: _to_plain(getattr(value, one.name), arrays) for one in dataclasses.fields(value)}
        return [type(value).__name__, fields]
    return value


def _from_plain(form: Any, arrays: dict[str, np.ndarray]) -> Any:
    if not isinstance(form, list):
        return form
    kind, content = form
    if kind == "array":
        return arrays[content]
    if kind == "tuple":
        return tuple(_from_plain(one, arrays) for one in content)
    if kind in _RECORDS:
        return _RECORDS[kind].model_validate_json(content)
    return _PARTS[kind](**{name: _from_plain(one, arrays) for name, one in content.items()})
