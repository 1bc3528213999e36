"""Parts that all snapshots have in common: whose they are, of which window, and what the predictions are of."""

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
    """What a monitor holds at one moment; nothing in it is changed afterwards."""

    window: WindowStatistics | None = None  # the latest full window
    filled: float = 0.0  # fraction of a full window that is filled now
    # Readings of that window by the diagnostician that decides; empty if it was not evaluated.
    parameters: tuple[Parameter, ...] = ()
    why_not: str = ""  # why it was not evaluated
    blocks: tuple[SampleBlock, ...] = ()  # the newest blocks, without a gap
    lacking: str = ""  # why there is no window, where it is not that one is still filling
    sensors: tuple[SensorFault, ...] = ()  # found in the window

    @property
    def missing(self) -> frozenset[str]:
        """States that lacked numbers in the window: what stands in for them is not to be shown."""
        return frozenset(implicated(one for one in self.sensors if one.kind is FaultKind.MISSING))

    def mark(self) -> tuple[object, ...]:
        """What an answer about the window depends on; short, so that it may be kept."""
        return None if self.window is None else self.window.end_ns, self.parameters, self.filled, self.why_not


def heading(subject: Subject, data: LatestData) -> dict[str, Any]:
    """Whose snapshot this is, and of which window: first fields of every snapshot."""
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
    """What is said of channels that lacked numbers in the window; empty if all had them."""
    return no_data([one.name for one in machine.sensors if state_name(one) in data.missing])


def no_window(machine: MachineFile, data: LatestData) -> str:
    """Why nothing can be shown: before the first window is full, or where only levels are watched."""
    if data.lacking:
        return data.lacking
    if data.window is not None:
        return f"{machine.title}: only levels are watched at the places of its channels"
    return f"{machine.title}: no window of {machine.window.length_s:g} s is full yet, {data.filled:.0%} of one is there"


def theory(changes: Mapping[str, float], nominal_reason: str, estimated_reason: str) -> Theory:
    """What the predictions are of."""
    shown = {} if estimated_reason else changes
    return Theory(
        changes=tuple(
            PredictedChange(name=name, relative_change=float(f"{value:.6g}")) for name, value in shown.items()
        ),
        nominal_reason=nominal_reason,
        estimated_reason=estimated_reason,
    )
