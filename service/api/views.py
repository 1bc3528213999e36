"""What the HTTP API needs to know about the service and its machines, and the arguments its routes share."""

import re
from collections.abc import Sequence
from typing import Annotated, Protocol

from fastapi import HTTPException, Path, Query
from pydantic import AfterValidator

from models.alarm_names import ALARMS, LEVEL, is_alarm
from models.machine import MachineFile
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Health
from rotorwatch.records.machines import DetectableChanges, MachineDescription
from rotorwatch.records.monitor import Readiness
from service.analysis.snapshots.heading import LatestData
from service.analysis.snapshots.machine import MachineSnapshots
from service.api.routes.recordings import RecordingIndex
from service.api.routes.replays import ReplayDesk
from service.api.routes.service import MeasuredView
from service.delivery.event_feed import EventFeed
from service.history.machine import MachineStore
from service.history.shared import AuditLog
from service.monitor.alarms.operation import OperatorAction
from service.monitor.reports import Identity

PLACE = "/api/v1/machines/{site}/{machine}"
_LATEST_NS = 2**63 - 1

SiteName = Annotated[str, Path(description="site of the machine", examples=["demo"])]
MachineName = Annotated[str, Path(description="name of the machine", examples=["lab"])]
SinceNs = Annotated[int | None, Query(ge=0, le=_LATEST_NS, description="from this time on, ns since 1970-01-01 UTC")]
UntilNs = Annotated[int | None, Query(ge=0, le=_LATEST_NS, description="before this time, ns since 1970-01-01 UTC")]
Limit = Annotated[int, Query(ge=1, le=1000, description="at most this many")]


def _known_alarm(name: str) -> str:
    if not is_alarm(name):
        raise ValueError(f"no alarm {name[:64]!r}; there are: {', '.join(ALARMS)} and {LEVEL}CHANNEL for each channel")
    return name


_NAMES = "|".join(map(re.escape, ALARMS))
AlarmName = Annotated[
    str,
    AfterValidator(_known_alarm),
    Query(json_schema_extra={"pattern": f"^({_NAMES}|{LEVEL}[A-Za-z0-9_.:-]{{1,64}})$"}, examples=["k_by"]),
]


class MachineView(Protocol):
    """What the API needs to know about one machine; `service.stream.worker.MachineWorker` is one."""

    @property
    def machine(self) -> MachineFile:
        """The machine file."""

    @property
    def identity(self) -> Identity:
        """Who speaks."""

    @property
    def history(self) -> MachineStore:
        """What is kept of the machine."""

    @property
    def snapshots(self) -> MachineSnapshots:
        """Makes snapshots of what the monitor holds."""

    @property
    def latest(self) -> LatestData:
        """What the monitor holds."""

    def description(self) -> MachineDescription:
        """Identity, stream, keys, and the present state."""

    def health(self) -> Health:
        """Where the machine stands now."""

    def alarms(self, *, include_normal: bool = False) -> AlarmStates:
        """Return the alarms as they are now."""

    def detectable(self, change: float | None) -> DetectableChanges:
        """Return what would be found on the machine as it runs now."""

    def operate(self, operation: OperatorAction) -> tuple[AlarmCloudEvent, ...]:
        """Do what an operator asks for, and say what happened.

        Raises
        ------
        UnknownAlarm, OperationConflict, OperationRefused, NotInTime
            If it was not done, or nobody knows.
        """


class ServiceView(MeasuredView, Protocol):
    """What the API needs to know about the service; `service.runtime.Runtime` is one."""

    def machines(self) -> Sequence[MachineView]:
        """Every monitored machine."""

    def machine(self, site: str, name: str) -> MachineView | None:
        """One machine, or None if it is not monitored."""

    def readiness(self) -> Readiness:
        """Whether the service can do its work."""

    @property
    def feed(self) -> EventFeed:
        """Where news of alarms and health arrive."""

    @property
    def audit(self) -> AuditLog:
        """Who asked for what."""

    @property
    def catalogue(self) -> RecordingIndex | None:
        """Recordings, or None if no directory for them is set."""

    @property
    def replays(self) -> ReplayDesk:
        """Where replays are started."""


def found_machine(service: ServiceView, site: str, name: str) -> MachineView:
    """Find a machine.

    Raises
    ------
    HTTPException
        404, with the machines there are.
    """
    machine = service.machine(site, name)
    if machine is None:
        known = ", ".join(f"{one.machine.site}/{one.machine.name}" for one in service.machines())
        raise HTTPException(404, f"no machine {site[:64]}/{name[:64]}; there are: {known}")
    return machine
