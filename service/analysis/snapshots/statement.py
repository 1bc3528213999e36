"""Parts that all snapshots have in common: whose they are, of which window, and what the predictions are of."""

from collections.abc import Mapping
from typing import Protocol, TypedDict

import numpy as np

from models.diagnosis.window import WindowStatistics
from models.machine import MachineFile
from rotorwatch.records.snapshots import PredictedChange, Theory

__all__ = ["Heading", "Speaker", "heading", "no_window", "theory"]


class Speaker(Protocol):
    """Who speaks: the machine and the exact files its monitor runs on."""

    @property
    def site(self) -> str:
        """Site of the machine."""

    @property
    def machine(self) -> str:
        """Name of the machine."""

    @property
    def bundle(self) -> str | None:
        """Identity of what was trained and commissioned; None without."""

    @property
    def machine_hash(self) -> str:
        """Changes with the machine file's content."""


class Heading(TypedDict):
    """First fields of every snapshot."""

    site: str
    machine: str
    bundle: str | None
    machine_hash: str
    start_ns: int | None
    end_ns: int | None
    filled: float
    speed_rad_s: float | None


def heading(identity: Speaker, window: WindowStatistics | None, filled: float) -> Heading:
    """Whose snapshot this is, and of which window."""
    speed = np.nan if window is None else window.speed_rad_s
    return {
        "site": identity.site,
        "machine": identity.machine,
        "bundle": identity.bundle,
        "machine_hash": identity.machine_hash,
        "start_ns": None if window is None else window.start_ns,
        "end_ns": None if window is None else window.end_ns,
        "filled": filled,
        "speed_rad_s": float(speed) if np.isfinite(speed) else None,
    }


def no_window(machine: MachineFile, filled: float) -> str:
    """Why nothing can be shown before the first window is full."""
    return (
        f"{machine.site}/{machine.name}: no window of {machine.window.length_s:g} s is full yet, "
        f"{filled:.0%} of one is there"
    )


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
