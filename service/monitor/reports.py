"""What a monitor returns: its identity, the result of one block, the machine's health, and the state to restore."""

import hashlib
import json
from dataclasses import dataclass
from typing import TypedDict

from models.commissioning.commissioned import Installed
from models.ingest import Admission
from models.machine import MachineFile
from rotorwatch.records.health import HealthState, Quality, Report
from service.monitor.alarms.alarm import Alarm, AlarmEvent


class Identity(TypedDict):
    """Origin of every record: the machine and the exact files its monitor runs on."""

    site: str
    machine: str
    bundle: str | None
    machine_hash: str


def identity_of(installed: Installed) -> Identity:
    """Identity of a machine with what it is monitored with."""
    machine = installed.machine
    return {
        "site": machine.site,
        "machine": machine.name,
        "bundle": installed.identity,
        "machine_hash": machine_hash(machine),
    }


def machine_hash(machine: MachineFile) -> str:
    """Twelve hexadecimal digits that change with anything in the machine file but comments and layout."""
    text = json.dumps(machine.model_dump(mode="json"), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def counted(quality: Quality, verdict: Admission) -> Quality:
    """Count one more block that was refused, or before which data are missing."""
    if verdict.reason is not None:
        refused = {**quality.refused_blocks}
        refused[verdict.reason.value] = refused.get(verdict.reason.value, 0) + 1
        return quality.model_copy(
            update={"refused_blocks": dict(sorted(refused.items())), "last_refusal": verdict.text}
        )
    gap = {"gaps": quality.gaps + 1, "missing_s": quality.missing_s + verdict.gap_s, "last_gap": verdict.text}
    return quality.model_copy(update=gap)


@dataclass(frozen=True, slots=True)
class MonitorReport:
    """Result of one block."""

    verdict: Admission  # accepted or refused, and why
    windows: tuple[Report, ...] = ()  # one per hop that the block completed
    events: tuple[AlarmEvent, ...] = ()  # what happened to alarms
    data_s: float = 0.0  # length of the block, if it was accepted
    # A defect of the monitor that came to light with the block; its consequences are in `windows` and `events`.
    fault: Exception | None = None


@dataclass(frozen=True, slots=True)
class MonitorState:
    """All that a monitor remembers between two blocks."""

    alarms: str  # the alarms, JSON
    state: bytes  # everything else that is small (`models.checkpoint`)
    new_parts: tuple[tuple[str, bytes], ...]  # large arrays that are not known to be kept already, by name
    parts: tuple[str, ...]  # names of all parts that belong to the state
    end_ns: int | None  # end of the newest data; None before the first


@dataclass(frozen=True, slots=True)
class MachineHealth:
    """State of the machine now, and why."""

    state: HealthState
    filled: float  # fraction of a full window
    latest: Report | None
    alarms: tuple[Alarm, ...]  # all that have been seen so far
    quality: Quality
    sequence: int = -1  # number of the latest alarm event
    reason: str = ""  # why nothing is said of the machine; empty if something is
    end_ns: int | None = None  # end of the newest data; None before the first


@dataclass(slots=True)
class Tally:
    """What a worker has done since it started, for measuring the service."""

    # Windows evaluated, without skipped ones; blocks taken.
    windows: int = 0
    blocks: int = 0
    step_s: float = 0.0  # time spent in the monitor altogether
    commit_s: float = 0.0  # time spent waiting for the history altogether
    data_s: float = 0.0  # length of the data taken altogether
