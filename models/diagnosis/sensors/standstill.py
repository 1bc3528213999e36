"""A machine at a standstill: it does not turn, and every channel has much less vibration than when it runs.

The channels then share no motion, so they cannot be compared, and a shaft angle that does not change is no fault. When
only the phase reference is lost, the vibration stays as it was.
"""

from collections.abc import Mapping

import numpy as np

from models.checkpoint import checked
from models.diagnosis.sensors.reference import SensorReference
from models.diagnosis.window.statistics import WindowStatistics
from models.levels.measures import STANDS_RAD_S
from models.levels.reference import QUIET
from models.signals.block import BoolArray

_SLOW = 0.5  # part of the window's highest speed from which on a hop counts as running, however quiet it is
_STEADY = 0.15  # largest relative range of speed in a window of steady running, not of slowing down


def runs_down(window: WindowStatistics) -> BoolArray:
    """Which hops are quiet in all channels and slow (or of unknown speed) beside the others, shape (n_hops,).

    Hops at the end of a run-down are an example. There are none if no speed is known: the others may only seem quiet
    beside a hop with a blow or a disturbance. A channel that is zero in all hops excludes none. The window must be that
    of the sensors as mounted.
    """
    hops, speeds = window.hop_waveform, np.abs(window.hop_speed_rad_s)
    vibrations = [column for column, state in enumerate(window.sensors) if state != "theta"]
    rms = hops.rms[:, vibrations]
    fastest = np.max(speeds, initial=0.0, where=np.isfinite(speeds))
    return np.asarray((rms <= QUIET * rms.max(axis=0)).all(axis=1) & ~(speeds >= _SLOW * fastest) & (fastest > 0))


class Standstill:
    """Distinguishes windows in which the machine stood from those in which its phase reference is lost.

    The rms of the running machine comes from the reference or, without one and for channels that are not in it, from
    the newest window of steady running.
    """

    def __init__(self, reference: SensorReference | None) -> None:
        self._reference = reference
        self._running = np.empty(0)  # (n_sensors,), median rms of a hop, SI units, including the shaft angle

    def found(self, window: WindowStatistics) -> str:
        """Sentence that says how long the machine stood in the window; empty if it did not, or if that is not known."""
        window = window.as_mounted
        hops, speeds = window.hop_waveform, np.abs(window.hop_speed_rad_s)
        still = ~(speeds > STANDS_RAD_S)  # or the speed is not known
        if not still.any():
            if speeds.max() - speeds.min() <= _STEADY * speeds.mean():
                self._running = np.median(hops.rms, axis=0)
            return ""
        running = self._running if self._running.size else np.full(len(window.sensors), np.nan)
        if self._reference is not None and self._reference.speed_rad_s is not None:
            known = [self._reference.channel(state) for state in window.sensors]
            running = np.array([own if one is None else one.rms for own, one in zip(running, known, strict=True)])
        vibrations = [column for column, state in enumerate(window.sensors) if state != "theta"]
        compared = [column for column in vibrations if running[column] > 0]
        if not compared:
            return ""
        quiet = (hops.rms[:, compared] < QUIET * running[compared]).all(axis=1)
        if len(vibrations) < len(window.sensors):
            angle = window.sensors.index("theta")
            if np.any((hops.longest_run[:, angle] >= hops.n_samples) & ~quiet):
                return ""  # the angle is lost while the machine runs
        stood = still & quiet
        if not stood.any():
            return ""
        stood_s = float(np.sum(stood)) * window.duration_s / len(stood)
        is_, have = ("is", "have") if stood[-1] else ("was", "had")
        return (
            f"the machine {is_} at a standstill, or all its sensors {have} lost their supply: for {stood_s:.3g} s of "
            f"the window no rotation, and in every channel less than {QUIET:.0%} of the vibration of the running "
            "machine; parameters are not judged, and channels are not compared"
        )

    def checkpoint(self) -> dict[str, np.ndarray]:
        """The complete state as named arrays."""
        return {"running": self._running}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the state that `checkpoint` returned."""
        self._running = checked(arrays, "running", np.float64, (None,))
