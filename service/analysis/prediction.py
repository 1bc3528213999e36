"""Theory for one window: spectra and correlation functions of the nominal machine, and of the machine as estimated.

Both use the same excitation, which is estimated from the window with the estimated machine (with the nominal one if
there is no estimate), so they differ by the effect of the parameters alone. Spectra are averaged with the spectral
kernel of the segments, as the measured spectra are. Correlation functions are their Fourier transforms (Eq. 18),

    R_ij(τ) = 2 Re ∫ S_ij(f) e^{-2πjfτ} df,

by Gauss-Legendre quadrature over panels that are narrow around the natural frequencies.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from models.diagnosis.likelihood.motions import group_bins
from models.diagnosis.window.moments import ComplexArray
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.physics.rotor import PARAMETERS, RotorParameters, changed, system_A
from models.signals.block import FloatArray
from rotorwatch.records.windows import Parameter
from service.analysis.excitation import Excitation, excitation_of

NOTHING_READ = "no parameter was read in this window"
NO_PARAMETERS = "the machine's parameters are not known, so there is no theory to predict from"
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_HALF_WIDTHS = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
"""Panel edges on either side of a natural frequency, in units of half its half-power bandwidth."""
_MOST_PANEL_CYCLES = 1.2
"""Largest width of a panel times the longest lag, i.e. periods of e^{-2πjfτ} in one panel."""
_GROWTH = 0.05
_OVER_BAND = 4.0


@dataclass(frozen=True, slots=True)
class Prediction:
    """Theory for one window."""

    machine: Machine | None  # as nominal
    excitation: Excitation | None
    changes: dict[str, float]  # relative changes of the machine as estimated
    # Why there is no prediction for the nominal or the estimated machine; empty if there is one.
    nominal_reason: str
    estimated_reason: str

    @property
    def nominal(self) -> RotorParameters | None:
        """The nominal rotor, or None if there is no prediction for it."""
        return None if self.machine is None or self.nominal_reason else self.machine.rotor

    @property
    def estimated(self) -> RotorParameters | None:
        """The rotor as estimated, or None if there is no prediction for it."""
        if self.machine is None or self.estimated_reason:
            return None
        return changed(self.machine.rotor, self.changes)

    def spectra(
        self, states: tuple[str, ...], frequencies_hz: FloatArray
    ) -> tuple[ComplexArray | None, ComplexArray | None]:
        """Expected cross-spectra of the segments, two-sided, SI²/Hz, shape (n_lines, n, n).

        Parameters
        ----------
        frequencies_hz : ndarray, shape (n_lines,)
            Lines of the window's spectrum, evenly spaced.

        Returns
        -------
        nominal, estimated : ndarray or None
            None if there is no prediction.
        """
        if self.excitation is None or self.machine is None:
            return None, None
        spacing_hz = float(frequencies_hz[1] - frequencies_hz[0])
        none_left_out = np.zeros(frequencies_hz.size, dtype=np.bool_)
        lines = group_bins(frequencies_hz, self.machine, none_left_out, spacing_hz)
        nodes, place = np.unique(np.round(lines.nodes_hz / spacing_hz, 6), return_inverse=True)
        found: list[ComplexArray | None] = []
        for rotor in (self.nominal, self.estimated):
            if rotor is None:
                found.append(None)
                continue
            at_nodes = self.excitation.spectra(rotor, states, nodes * spacing_hz)[place.reshape(lines.nodes_hz.shape)]
            found.append(np.asarray(np.einsum("lk,lkij->lij", lines.weights, at_nodes), dtype=np.complex128))
        return found[0], found[1]

    def correlations(
        self,
        states: tuple[str, ...],
        pairs: list[tuple[int, int]],
        lags_s: FloatArray,
        within_hz: tuple[float, float] | None = None,
    ) -> tuple[FloatArray | None, FloatArray | None]:
        """Correlation functions R_ij(τ), SI, shape (n_lags, n_pairs), nominal and estimated; None without a prediction.

        `pairs` are indices into `states`, reference and response; `within_hz` limits the integral to a band.
        """
        if self.excitation is None or self.machine is None:
            return None, None
        low_hz, high_hz = within_hz or (0.0, _highest_hz(self.machine, states))
        found: list[FloatArray | None] = []
        for rotor in (self.nominal, self.estimated):
            if rotor is None:
                found.append(None)
                continue
            frequencies_hz, weights = _nodes(self.excitation, rotor, low_hz, high_hz, float(lags_s[-1]))
            spectra = self.excitation.spectra(rotor, states, frequencies_hz)
            of_pairs = np.stack([spectra[:, i, j] for i, j in pairs], axis=1) * weights[:, None]
            phase = 2 * np.pi * np.outer(lags_s, frequencies_hz)
            found.append(2 * (np.cos(phase) @ of_pairs.real + np.sin(phase) @ of_pairs.imag))
        return found[0], found[1]


def _highest_hz(machine: Machine, states: tuple[str, ...]) -> float:
    """Upper limit of the quadrature: the Nyquist frequency, or less if the spectra are negligible above it."""
    nyquist_hz = machine.rate_hz / 2
    if any(state.endswith("_ddot") for state in states):
        return nyquist_hz
    poles = np.linalg.eigvals(system_A(machine.rotor, machine.operation.speed_rad_s))
    fastest_hz = float(np.abs(poles).max()) / (2 * np.pi)
    return min(nyquist_hz, max(_OVER_BAND * machine.window.band_hz[1], 1.5 * fastest_hz))


def _nodes(
    excitation: Excitation, rotor: RotorParameters, low_hz: float, high_hz: float, longest_s: float
) -> tuple[FloatArray, FloatArray]:
    """Frequencies, Hz, and weights of the quadrature."""
    poles = np.linalg.eigvals(system_A(rotor, excitation.speed_rad_s))
    poles = poles[poles.imag > 0]
    modes_hz, half_hz = poles.imag / (2 * np.pi), np.maximum(-poles.real / (2 * np.pi), 1e-9)
    around = (modes_hz[:, None] + half_hz[:, None] * np.concatenate([-_HALF_WIDTHS[:0:-1], _HALF_WIDTHS])).ravel()
    widest_hz = _MOST_PANEL_CYCLES / max(longest_s, 1 / excitation.machine.window.band_hz[1])
    even, at = [low_hz], low_hz
    beyond_hz = _OVER_BAND * excitation.machine.window.band_hz[1]
    while at < high_hz:
        at += widest_hz if at < beyond_hz else max(widest_hz, _GROWTH * at)
        even.append(min(at, high_hz))
    edges = np.unique(np.concatenate([even, around[(around > low_hz) & (around < high_hz)]]))
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    return (
        np.asarray((middle[:, None] + half[:, None] * _POINTS).ravel()),
        np.asarray((half[:, None] * _WEIGHTS).ravel()),
    )


def predict(
    known: Machine | None, window: WindowStatistics, readings: Iterable[Parameter], why_not: str = ""
) -> Prediction:
    """Predict a window from theory; if that is impossible, the result states the reason, and nothing is raised.

    Parameters
    ----------
    readings : iterable of Parameter
        Readings of this window by the diagnostician that decides; empty if it was not evaluated.
    """
    if known is None:
        return Prediction(None, None, {}, NO_PARAMETERS, NO_PARAMETERS)
    changes = read_changes(readings)
    estimated_reason = "" if changes else why_not or NOTHING_READ
    rotor = changed(known.rotor, changes)
    try:
        excitation = excitation_of(known.model_copy(update={"rotor": rotor}), window)
    except EstimationError as error:
        return Prediction(known, None, changes, str(error), estimated_reason or str(error))
    return Prediction(known, excitation, changes, "", estimated_reason)


def read_changes(readings: Iterable[Parameter]) -> dict[str, float]:
    """Relative changes of the parameters that were read, -0.99 at least: theory needs a remainder of each parameter."""
    read = {reading.name: reading.relative_change for reading in readings if reading.relative_change is not None}
    return {name: max(read[name], -0.99) for name in PARAMETERS if name in read}
