"""Makes the snapshots of one machine, and caches the theory of its latest window.

The modules that compute snapshots are imported at the first request, so a process that only evaluates does without.
"""

import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from models.commissioning.commissioned import Installed
from models.diagnosis.window.statistics import WindowStatistics
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot, Units
from service.analysis.snapshots.heading import LatestData, Subject, unsent
from service.monitor.reports import Identity

if TYPE_CHECKING:
    from service.analysis.prediction import Prediction

_NO_WINDOW = "there is no window yet"


class MachineSnapshots:
    """Makes snapshots of one machine; thread-safe.

    The theory of a window takes longest to compute, so it is cached for as long as the window exists.
    """

    def __init__(self, installed: Installed, identity: Identity) -> None:
        self.installed = installed
        self._subject = Subject(identity, installed.machine, installed.known)
        self._lock = threading.Lock()
        self._predictions: WeakKeyDictionary[WindowStatistics, Prediction] = WeakKeyDictionary()

    def correlations(
        self, data: LatestData, first: Sequence[str] = (), second: Sequence[str] = (), units: Units = "channel"
    ) -> CorrelationSnapshot:
        """Correlation functions of the latest window, see `correlation_snapshot`."""
        from service.analysis.snapshots.correlation import correlation_snapshot  # noqa: PLC0415

        return correlation_snapshot(self._subject, data, self._theory(data), first, second, units)

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
        from service.analysis.snapshots.spectrum import spectrum_snapshot  # noqa: PLC0415

        return spectrum_snapshot(self._subject, data, self._theory(data), channels, first, second, band_hz, units)

    def orbits(self, data: LatestData, revolutions: int = 0, units: Units = "channel") -> OrbitSnapshot:
        """Orbits of the latest window and the newest revolutions, see `orbit_snapshot`."""
        from service.analysis.snapshots.orbit import orbit_snapshot  # noqa: PLC0415

        return orbit_snapshot(self._subject, data, revolutions, units)

    def _theory(self, data: LatestData) -> "Prediction":
        from service.analysis.prediction import NO_PARAMETERS, Prediction, predict  # noqa: PLC0415

        if data.window is None or data.missing & {*data.window.states, "theta"}:
            known = self._subject.known
            reason = NO_PARAMETERS if known is None else unsent(self._subject.machine, data) or _NO_WINDOW
            return Prediction(known, None, {}, reason, reason)
        with self._lock:
            found = self._predictions.get(data.window)
            if found is None:
                found = predict(self._subject.known, data.window, data.parameters, data.why_not)
                self._predictions[data.window] = found
            return found
