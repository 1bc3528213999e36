"""Common parts of all snapshots: machine, window, and the parameter changes that theory assumes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.diagnosis.sensors.missing import no_data
from models.diagnosis.sensors.reference import implicated
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine, MachineFile
from models.signals.block import SampleBlock
from models.signals.channels import state_name
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.snapshots import PredictedChange, Theory
from rotorwatch.records.windows import Parameter, SensorFault
from service.monitor.reports import Identity


@dataclass(frozen=True, slots=True)
class Subject:
    """The machine that a snapshot is of."""

    identity: Identity
    machine: MachineFile
    known: Machine | None  # the machine with all its parameters


@dataclass(frozen=True, slots=True)
class LatestData:
    """Immutable copy of a monitor's latest data."""

    window: WindowStatistics | None = None  # the latest full window
    filled: float = 0.0  # fraction of a full window that is filled now
    # Readings of that window by the diagnostician that decides; empty if it was not evaluated.
    parameters: tuple[Parameter, ...] = ()
    why_not: str = ""  # why the window was not evaluated
    blocks: tuple[SampleBlock, ...] = ()  # the newest blocks, without a gap
    lacking: str = ""  # why there is no window, unless it is still filling
    sensors: tuple[SensorFault, ...] = ()  # sensor faults in the window

    @property
    def missing(self) -> frozenset[str]:
        """States without numbers in the window, whose substitute values must not be shown."""
        return frozenset(implicated(one for one in self.sensors if one.kind is FaultKind.MISSING))

    def mark(self) -> tuple[object, ...]:
        """Key of everything on which an answer about the window depends; small, so that it can be cached."""
        return None if self.window is None else self.window.end_ns, self.parameters, self.filled, self.why_not


def heading(subject: Subject, data: LatestData) -> dict[str, Any]:
    """First fields of every snapshot: the machine, its window and speed."""
    window = data.window
    speed = np.nan if window is None or "theta" in data.missing else window.speed_rad_s
    return {
        **subject.identity,
        "start_ns": None if window is None else window.start_ns,
        "end_ns": None if window is None else window.end_ns,
        "filled": data.filled,
        "speed_rad_s": float(speed) if np.isfinite(speed) else None,
    }


def unsent(machine: MachineFile, data: LatestData) -> str:
    """Message on channels without numbers in the window; empty if all had numbers."""
    return no_data([one.name for one in machine.sensors if state_name(one) in data.missing])


def no_window(machine: MachineFile, data: LatestData) -> str:
    """Reason for showing nothing: the first window is not full yet, or only levels are watched."""
    if data.lacking:
        return data.lacking
    if data.window is not None:
        return f"{machine.title}: only levels are watched at the places of its channels"
    return f"{machine.title}: no window of {machine.window.length_s:g} s is full yet, {data.filled:.0%} of one is there"


def theory(changes: Mapping[str, float], nominal_reason: str, estimated_reason: str) -> Theory:
    """Parameter changes that the predictions assume, and reasons for missing predictions."""
    shown = {} if estimated_reason else changes
    return Theory(
        changes=tuple(
            PredictedChange(name=name, relative_change=float(f"{value:.6g}")) for name, value in shown.items()
        ),
        nominal_reason=nominal_reason,
        estimated_reason=estimated_reason,
    )
