"""What the snapshots of one machine have in common, and the theory of the latest window, which is cached.

The modules that compute snapshots are imported at the first request, so a process that only evaluates does without.
"""

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from models.commissioning.commissioned import Installed
from models.diagnosis.sensors.missing import no_data
from models.diagnosis.sensors.reference import WITHOUT_SIGNAL, implicated
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine, MachineFile
from models.signals.block import SampleBlock
from models.signals.channels import state_name
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.snapshots import PredictedChange, Theory
from rotorwatch.records.windows import Parameter, SensorFault
from service.monitor.reports import Identity

if TYPE_CHECKING:
    from service.analysis.prediction import Prediction

_NO_WINDOW = "there is no window yet"


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
    def _silent(self) -> tuple[SensorFault, ...]:
        """Faults of sensors without a signal, and any of the shaft angle."""
        return tuple(one for one in self.sensors if one.kind in WITHOUT_SIGNAL or one.states == ("theta",))

    @property
    def lost(self) -> frozenset[str]:
        """States without a signal in the window, whose values must not be shown as measured; also a faulty angle."""
        return frozenset(implicated(self._silent))

    @property
    def why_lost(self) -> str:
        """Why states that have numbers are `lost`; empty if none are."""
        return "; ".join(one.text for one in self._silent if one.kind is not FaultKind.MISSING)

    def mark(self) -> tuple[object, ...]:
        """Key of everything on which an answer about the window depends; small, so that it can be cached."""
        return None if self.window is None else self.window.end_ns, self.parameters, self.filled, self.why_not


def heading(identity: Identity, data: LatestData, prediction: "Prediction") -> dict[str, Any]:
    """Fields of every snapshot: the machine, its window and speed, and the parameter changes that theory assumes."""
    window = data.window
    speed = np.nan if window is None or "theta" in data.lost else window.speed_rad_s
    shown = {} if prediction.estimated_reason else prediction.changes
    return {
        **identity,
        "start_ns": None if window is None else window.start_ns,
        "end_ns": None if window is None else window.end_ns,
        "filled": data.filled,
        "speed_rad_s": float(speed) if np.isfinite(speed) else None,
        "theory": Theory(
            changes=tuple(
                PredictedChange(name=name, relative_change=float(f"{value:.6g}")) for name, value in shown.items()
            ),
            nominal_reason=prediction.nominal_reason,
            estimated_reason=prediction.estimated_reason,
        ),
    }


def unsent(machine: MachineFile, data: LatestData) -> str:
    """Message on channels without a signal in the window; empty if all had one."""
    missing = implicated(one for one in data.sensors if one.kind is FaultKind.MISSING)
    gone = no_data([one.name for one in machine.sensors if state_name(one) in missing])
    return "; ".join(filter(None, (gone, data.why_lost)))


def no_window(machine: MachineFile, data: LatestData) -> str:
    """Reason for showing nothing: the first window is not full yet, or only levels are watched."""
    if data.lacking:
        return data.lacking
    if data.window is not None:
        return f"{machine.title}: only levels are watched at the places of its channels"
    return f"{machine.title}: no window of {machine.window.length_s:g} s is full yet, {data.filled:.0%} of one is there"


class MachineSnapshots:
    """The machine that snapshots are of; thread-safe.

    The theory of a window takes longest to compute, so it is cached for as long as the window exists.
    """

    def __init__(self, installed: Installed, identity: Identity) -> None:
        self.installed = installed
        self.identity = identity
        self.machine: MachineFile = installed.machine
        self.known: Machine | None = installed.known  # the machine with all its parameters
        self._lock = threading.Lock()
        self._predictions: WeakKeyDictionary[WindowStatistics, Prediction] = WeakKeyDictionary()

    def theory(self, data: LatestData) -> "Prediction":
        """Theory for the window of the data; without a window, or without all its signals, why there is none."""
        from service.analysis.prediction import NO_PARAMETERS, Prediction, predict  # noqa: PLC0415

        if data.window is None or data.lost & {*data.window.states, "theta"}:
            reason = NO_PARAMETERS if self.known is None else unsent(self.machine, data) or _NO_WINDOW
            return Prediction(self.known, None, {}, reason, reason)
        with self._lock:
            found = self._predictions.get(data.window)
            if found is None:
                found = predict(self.known, data.window, data.parameters, data.why_not)
                self._predictions[data.window] = found
            return found
