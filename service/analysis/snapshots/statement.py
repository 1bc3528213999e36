"""Parts that all snapshots have in common: whose they are, of which window, and what the predictions are of."""

from collections.abc import Mapping

import numpy as np

from models.diagnosis.window import WindowStatistics
from models.machine import MachineFile
from rotorwatch.records.snapshots import PredictedChange, Theory
from service.monitor.reports import Identity

__all__ = ["Heading", "heading", "no_window", "theory"]


class Heading(Identity):
    """First fields of every snapshot."""

    start_ns: int | None
    end_ns: int | None
    filled: float
    speed_rad_s: float | None


def heading(identity: Identity, window: WindowStatistics | None, filled: float) -> Heading:
    """Whose snapshot this is, and of which window."""
    speed = np.nan if window is None else window.speed_rad_s
    return {
        **identity,
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
