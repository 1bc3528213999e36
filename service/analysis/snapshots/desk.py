"""Where a machine's snapshots are asked for: what is known of it, and the theory of its latest window."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass

from models.commissioning.installed import Installed
from models.diagnosis.window import WindowStatistics
from models.machine import Machine
from models.signals.block import SampleBlock
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot, Units
from rotorwatch.records.windows import Parameter
from service.analysis.snapshots.correlation import correlation_snapshot
from service.analysis.snapshots.orbit import orbit_snapshot
from service.analysis.snapshots.prediction import NO_PARAMETERS, Prediction, predict
from service.analysis.snapshots.spectrum import spectrum_snapshot
from service.monitor.reports import Identity

__all__ = ["LatestData", "SnapshotDesk"]

_NO_WINDOW = "there is no window yet"


@dataclass(frozen=True, slots=True)
class LatestData:
    """What a monitor holds at one moment; nothing in it is changed afterwards.

    Attributes
    ----------
    window : WindowStatistics or None
        The latest full window.
    filled : float
        Fraction of a full window that is there now.
    parameters : tuple of Parameter
        Readings of that window by the diagnostician that decides; empty if it was not evaluated.
    why_not : str
        Why it was not evaluated.
    blocks : tuple of SampleBlock
        The newest blocks, without a gap.
    """

    window: WindowStatistics | None = None
    filled: float = 0.0
    parameters: tuple[Parameter, ...] = ()
    why_not: str = ""
    blocks: tuple[SampleBlock, ...] = ()


class SnapshotDesk:
    """Makes snapshots of one machine; any thread may ask.

    The theory of a window takes longer than all the rest, and is kept until another window comes.

    Parameters
    ----------
    installed : Installed
    identity : Identity
    """

    def __init__(self, installed: Installed, identity: Identity) -> None:
        self._machine, self._identity = installed.machine, identity
        self._known: Machine | None = installed.known
        self._lock = threading.Lock()
        self._of: WindowStatistics | None = None
        self._prediction: Prediction | None = None

    def correlations(
        self, data: LatestData, first: Sequence[str] = (), second: Sequence[str] = (), units: Units = "channel"
    ) -> CorrelationSnapshot:
        """Correlation functions of the latest window, see `correlation_snapshot`."""
        return correlation_snapshot(
            self._identity, self._machine, data.window, self._theory(data), data.filled, first, second, units
        )

    def spectra(
        self,
        data: LatestData,
        channels: Sequence[str] = (),
        first: Sequence[str] = (),
        second: Sequence[str] = (),
        band_hz: tuple[float, float] | None = None,
        units: Units = "channel",
    ) -> SpectrumSnapshot:
        """Power spectral densities of the latest window, see `spectrum_snapshot`."""
        return spectrum_snapshot(
            self._identity,
            self._machine,
            data.window,
            self._theory(data),
            data.filled,
            channels,
            first,
            second,
            band_hz,
            units,
        )

    def orbits(self, data: LatestData, revolutions: int = 0, units: Units = "channel") -> OrbitSnapshot:
        """Orbits of the latest window and the newest revolutions, see `orbit_snapshot`."""
        return orbit_snapshot(
            self._identity,
            self._machine,
            self._known,
            data.window,
            data.parameters,
            data.why_not,
            data.filled,
            data.blocks,
            revolutions,
            units,
        )

    def _theory(self, data: LatestData) -> Prediction:
        if data.window is None:
            reason = NO_PARAMETERS if self._known is None else _NO_WINDOW
            return Prediction(self._known, None, {}, reason, reason)
        with self._lock:
            if self._prediction is None or self._of is not data.window:
                self._prediction = predict(self._known, data.window, data.parameters, data.why_not)
                self._of = data.window
            return self._prediction
