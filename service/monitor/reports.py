"""What a monitor returns: identity, result of one block, health of the machine, and the state to restore, in parts."""

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import TypedDict

import numpy as np

from models.checkpoint import from_bytes, prefixed, to_bytes, unprefixed
from models.commissioning.commissioned import Installed
from models.diagnosis.verdict.sequential_state import hop_arrays
from models.diagnosis.verdict.stretch import Stretch
from models.ingest import Admission
from models.machine import MachineFile
from rotorwatch.records.health import HealthState, Quality, Report
from service.monitor.alarms.alarm import Alarm, AlarmEvent

_HOP = "hop "
_LARGE = 4096


class Identity(TypedDict):
    """Origin of every record: the machine and the exact files its monitor runs on."""

    site: str
    machine: str
    bundle: str | None
    machine_hash: str


def identity_of(installed: Installed) -> Identity:
    """Identity of a machine with what it is monitored with."""
    machine = installed.machine
    hashed = machine_hash(machine)
    return Identity(site=machine.site, machine=machine.name, bundle=installed.identity, machine_hash=hashed)


def machine_hash(machine: MachineFile) -> str:
    """Twelve hexadecimal digits that change with anything in the machine file but comments and layout."""
    text = json.dumps(machine.model_dump(mode="json"), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def counted(quality: Quality, verdict: Admission) -> Quality:
    """Count one more block that was refused, or before which data are missing."""
    if verdict.reason is not None:
        refused = Counter(quality.refused_blocks)
        refused[verdict.reason.value] += 1
        counts = {"refused_blocks": dict(sorted(refused.items())), "last_refusal": verdict.text}
        return quality.model_copy(update=counts)
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
    refused: bool = False  # whether the newest block was refused


@dataclass(slots=True)
class Tally:
    """What a worker has done since it started, for measuring the service."""

    # Windows evaluated, without skipped ones; blocks taken.
    windows: int = 0
    blocks: int = 0
    step_s: float = 0.0  # time spent in the monitor altogether
    commit_s: float = 0.0  # time spent waiting for the history altogether
    data_s: float = 0.0  # length of the data taken altogether


def divided(
    arrays: Mapping[str, np.ndarray], hops: Mapping[int, list[tuple[int, Stretch]]], kept: Collection[str]
) -> tuple[bytes, tuple[tuple[str, bytes], ...], tuple[str, ...]]:
    """Divide a state so that little of it is written with every hop; the hops are `SequentialState.hops`.

    Returns what is small, new parts (not in `kept`) by name, and the names of all parts.

    ::

        arrays -- small ------------> state, written with every hop
               '- 4 kB and more ----> parts, named by a digest of their content: most stay the same for many hops
        hops of the sequential test -> parts, each named by the hop's end: none changes afterwards
    """
    large = {name: array for name, array in arrays.items() if array.nbytes >= _LARGE}
    names = {f"{_HOP}{end_ns:019}": came for end_ns, came in hops.items()}
    known = frozenset(kept)
    parts = {f"{name} {_digest(array)}": {name: array} for name, array in large.items()}
    parts |= {name: prefixed(name, hop_arrays(came)) for name, came in names.items() if name not in known}
    return (
        to_bytes({name: array for name, array in arrays.items() if name not in large}),
        tuple((name, to_bytes(part)) for name, part in parts.items() if name not in known),
        (*parts, *(name for name in names if name in known)),
    )


def joined(state: bytes, parts: Iterable[bytes]) -> tuple[dict[str, np.ndarray], list[dict[str, np.ndarray]]]:
    """Arrays of the monitor, and arrays of each hop of the sequential test, oldest first; raises as `from_bytes`."""
    arrays, hops = from_bytes(state), []
    for part in map(from_bytes, parts):
        name = next(iter(part), "")
        if name.startswith(_HOP):
            hops.append((name, unprefixed(name.partition("/")[0], part)))
        else:
            arrays |= part
    return arrays, [hop for _, hop in sorted(hops, key=itemgetter(0))]


def _digest(array: np.ndarray) -> str:
    form = str(array.shape).encode()[:16]
    return hashlib.blake2b(np.ascontiguousarray(array).data, digest_size=8, person=form).hexdigest()
