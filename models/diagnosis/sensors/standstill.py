"""A machine that stands: it does not turn, and no channel shows much of the vibration that it has when it runs.

Channels have no motion in common then, so none says anything of another one, and an angle that does not change is no
fault. A phase reference that is lost leaves the vibration as it was.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from models.checkpoint import checked
from models.diagnosis.sensors.reference import SensorReference
from models.diagnosis.window.statistics import WindowStatistics
from models.levels.measures import STANDS_RAD_S
from models.levels.reference import QUIET
from models.signals.block import FloatArray

_SLOW = 0.5
"""Part of the window's highest speed."""
_STEADY = 0.15
"""Range of speed in a window, relative, up to which it shows how the machine runs: not while it slows down."""


def runs_down(window: WindowStatistics) -> npt.NDArray[np.bool_]:
    """Which hops have little or nothing of a running machine, shape (n_hops,), beside others that do: a slow end, say.

    None where no speed is known: hops may be quiet beside one that a blow or a disturbance has made loud. A channel
    that shows nothing in any hop says nothing. The window is that of its sensors as they are mounted.
    """
    hops, speeds = window.hop_waveform, np.abs(window.hop_speed_rad_s)
    vibrations = [column for column, state in enumerate(window.sensors) if state != "theta"]
    rms = hops.rms[:, vibrations]
    fastest = np.max(speeds, initial=0.0, where=np.isfinite(speeds))
    return np.asarray((rms <= QUIET * rms.max(axis=0)).all(axis=1) & ~(speeds >= _SLOW * fastest) & (fastest > 0))


class Standstill:
    """Tells windows in which the machine stood from those in which its phase reference is lost.

    The reference says how the healthy machine runs; otherwise, and for channels that are not in it, it is the newest
    window in which it ran steadily.
    """

    def __init__(self, reference: SensorReference | None) -> None:
        self._reference = reference
        self._running = np.empty(0)  # (n_sensors,), rms of a hop, SI units; the shaft angle among them

    def found(self, window: WindowStatistics) -> str:
        """How long the machine stood in the window, in a sentence; empty if it did not, or if that cannot be told."""
        window = window.as_mounted
        hops, speeds = window.hop_waveform, np.abs(window.hop_speed_rad_s)
        still = ~(speeds > STANDS_RAD_S)  # or not known
        if not still.any():
            if speeds.max() - speeds.min() <= _STEADY * speeds.mean():
                self._running = np.median(hops.rms, axis=0)
            return ""
        running = self._running_rms(window)
        vibrations = [column for column, state in enumerate(window.sensors) if state != "theta"]
        compared = [column for column in vibrations if running[column] > 0]
        if not compared:
            return ""
        quiet = (hops.rms[:, compared] < QUIET * running[compared]).all(axis=1)
        if len(vibrations) < len(window.sensors):
            angle = window.sensors.index("theta")
            if np.any((hops.longest_run[:, angle] >= hops.n_samples) & ~quiet):
                return ""  # the angle is lost while the machine runs
        stood_s = float(np.sum(still & quiet)) * window.duration_s / len(still)
        if not stood_s:
            return ""
        return (
            f"the machine is at a standstill, or all its sensors have lost their supply: for {stood_s:.3g} s of the "
            f"window no rotation, and in every channel less than {QUIET:.0%} of the vibration of the running machine; "
            "parameters are not judged, and channels are not compared"
        )

    def _running_rms(self, window: WindowStatistics) -> FloatArray:
        """By column; nan where it is not known."""
        running = self._running if self._running.size else np.full(len(window.sensors), np.nan)
        if self._reference is None or self._reference.speed_rad_s is None:
            return running
        known = [self._reference.channel(state) for state in window.sensors]
        return np.array([own if one is None else one.rms for own, one in zip(running, known, strict=True)])

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything as named arrays."""
        return {"running": self._running}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on where `checkpoint` was called.

        Raises
        ------
        CheckpointError
            If the array is missing or of another form.
        """
        self._running = checked(arrays, "running", np.float64, (None,))
