"""A monitored machine as seen from outside its thread, in this process or from another one."""

from dataclasses import dataclass, field
from typing import Protocol

from models.errors import RotorwatchError
from models.machine import MachineFile
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Health
from rotorwatch.records.machines import DetectableChanges
from service.analysis.snapshots.machine import LatestData, MachineSnapshots
from service.history.machine import MachineStore
from service.monitor.alarms.alarm import OperatorAction
from service.monitor.reports import Identity, Tally
from service.recordings.recorder import RecorderStatus


class NoAnswerError(RotorwatchError):
    """The process that monitors a machine did not answer, or not in time."""


@dataclass(frozen=True, slots=True)
class MachineStatus:
    """State of the monitoring of a machine; counts are since it was started."""

    alive: bool = False  # the thread that evaluates the blocks runs
    errors: int = 0  # blocks lost to an error inside the monitor
    last_error: str = ""
    session_open: bool = True  # the Zenoh session that its stream comes in by
    trouble: str = ""  # why the machine is not monitored as it should be; empty if it is
    busy_s: float = 0.0  # how long the thread has been at work on the same block
    queue_blocks: int = 0  # blocks that wait for evaluation
    history_waiting: int = 0  # steps that are not in the history yet
    history_trouble: str = ""  # why the history cannot be written; empty if it can
    restart: str = ""  # what was restored at its start
    tally: Tally = field(default_factory=Tally)
    recorder: RecorderStatus | None = None  # None if it is not recorded


def with_flow(health: Health, data_age_s: float | None, accepted_blocks: int) -> Health:
    """Health with new values of the fields that change with every block, which is no reason to publish it."""
    stream = health.stream.model_copy(update={"data_age_s": data_age_s})
    quality = health.quality.model_copy(update={"accepted_blocks": accepted_blocks})
    return health.model_copy(update={"stream": stream, "quality": quality})


class Monitored(Protocol):
    """A monitored machine; for any thread. `service.stream.worker.MachineWorker` is one."""

    machine: MachineFile
    history: MachineStore

    @property
    def identity(self) -> Identity:
        """The machine, and the exact files its monitor runs on."""

    @property
    def snapshots(self) -> MachineSnapshots:
        """Makes snapshots of a window."""

    @property
    def latest(self) -> LatestData:
        """Latest data of the monitor."""

    def health(self) -> Health:
        """State of the machine now."""

    def status(self) -> MachineStatus:
        """State of its monitoring."""

    def alarms(self, *, include_normal: bool = False) -> AlarmStates:
        """Return the alarms as they are now."""

    def detectable(self, change: float | None) -> DetectableChanges:
        """Return what would be found on the machine as it runs now."""

    def operate(self, operation: OperatorAction) -> tuple[AlarmCloudEvent, ...]:
        """Do what an operator asks for, and say what happened; raises as `AlarmBook.operate`, `NotInTime`."""
