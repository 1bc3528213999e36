"""Correlation functions and power spectral densities of the latest window, with theory, and coherence of pairs."""

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from models.machine import MachineFile
from models.signals.block import ComplexArray, FloatArray
from models.signals.channels import Channel, state_name
from rotorwatch.records.snapshots import (
    ChannelDensity,
    CorrelationPair,
    CorrelationSnapshot,
    CrossSpectrum,
    SpectrumSnapshot,
    Units,
)
from service.analysis.correlation import MeasuredCorrelations, measured_correlations
from service.analysis.prediction import LEFT_OUT_BINS, Prediction
from service.analysis.snapshots.channels import (
    SnapshotError,
    averaged,
    check_held,
    chosen_channels,
    chosen_pairs,
    figures,
    known_figures,
    product_unit,
    seen_by,
)
from service.analysis.snapshots.machine import LatestData, MachineSnapshots, heading, no_window, unsent

_MOST_LINES = 1000
"""Most lines in a snapshot; if the band has more, adjacent lines are averaged."""
_SEGMENT_CORRELATIONS = (1 + 2 / 36, 4 / 9 + 2 * 0.0200, 1 / 36 + 2 * 0.0069)
"""Sums of squared correlations of half-overlapping Hann segments' power: in one line, and in lines 1 and 2 apart."""
_OUTER = (0.025, 0.975)

_Spectra = tuple[ComplexArray, ComplexArray | None, ComplexArray | None]
"""Two-sided cross-spectra, SI²/Hz: measured, nominal, estimated; shape (n_lines, n, n), in the same order of states."""


def correlation_snapshot(
    of: MachineSnapshots,
    data: LatestData,
    first: Sequence[str] = (),
    second: Sequence[str] = (),
    units: Units = "channel",
) -> CorrelationSnapshot:
    """Correlation functions of pairs of channels, see `chosen_pairs`, with standard errors and predictions."""
    machine, window = of.machine, None if data.window is None else data.window.as_mounted
    pairs = chosen_pairs(machine, first, second)
    prediction = of.theory(data)
    head = heading(of.identity, data, prediction)
    if window is not None and not (first or second):
        pairs = tuple(pair for pair in pairs if all(state_name(one) in window.states for one in pair))
    if window is None or not pairs:
        return CorrelationSnapshot(
            **head, lags_s=(), method="samples", band_hz=None, pairs=(), reason=no_window(machine, data)
        )
    used = tuple(dict.fromkeys(channel for pair in pairs for channel in pair))
    check_held(machine, used, window.states)
    states = tuple(map(state_name, used))
    columns = [window.states.index(state) for state in states]
    places = [(states.index(state_name(one)), states.index(state_name(other))) for one, other in pairs]
    measured = measured_correlations(machine, window, [(columns[i], columns[j]) for i, j in places])
    gone = [number for number, (i, j) in enumerate(places) if data.lost & {states[i], states[j]}]
    measured.values[:, gone] = measured.errors[:, gone] = measured.outside_band[gone] = np.nan
    nominal, estimated = _predicted(prediction, used, places, measured)
    return CorrelationSnapshot(
        **head,
        lags_s=tuple(measured.lags_s.tolist()),
        method="samples" if measured.band_hz is None else "spectrum",
        band_hz=measured.band_hz,
        pairs=tuple(_pair(pair, number, measured, nominal, estimated, units) for number, pair in enumerate(pairs)),
        reason=unsent(machine, data),
    )


def _predicted(
    prediction: Prediction, channels: Sequence[Channel], places: list[tuple[int, int]], measured: MeasuredCorrelations
) -> tuple[FloatArray | None, FloatArray | None]:
    """Theory for pairs of channels, nominal and estimated; inclined sensors are sums over the states they measure."""
    states, parts = seen_by(channels)
    if parts is None:
        return prediction.correlations(states, places, measured.lags_s, measured.band_hz)
    n = len(states)
    every = [(i, j) for i in range(n) for j in range(n)]
    first, second = zip(*places, strict=True)
    nominal, estimated = (
        None if one is None else (parts @ one.reshape(-1, n, n) @ parts.T)[:, list(first), list(second)]
        for one in prediction.correlations(states, every, measured.lags_s, measured.band_hz)
    )
    return nominal, estimated


def _pair(
    pair: tuple[Channel, Channel],
    number: int,
    measured: MeasuredCorrelations,
    nominal: FloatArray | None,
    estimated: FloatArray | None,
    units: Units,
) -> CorrelationPair:
    unit, factor = product_unit(*pair, units)
    values, errors = measured.values[:, number], measured.errors[:, number]
    (z_nominal, series_nominal), (z_estimated, series_estimated) = (
        (None, None) if one is None else (_rms_z(values - one[:, number], errors), figures(factor * one[:, number]))
        for one in (nominal, estimated)
    )
    return CorrelationPair(
        first=pair[0].name,
        second=pair[1].name,
        unit=unit,
        measured=figures(factor * values),
        standard_error=figures(factor * errors),
        nominal=series_nominal,
        estimated=series_estimated,
        nominal_z=z_nominal,
        estimated_z=z_estimated,
        outside_band=figures(measured.outside_band[number : number + 1])[0],
    )


def _rms_z(difference: FloatArray, errors: FloatArray) -> float | None:
    if not np.all(errors > 0):
        return None
    return figures([np.sqrt(np.mean((difference / errors) ** 2))])[0]


def spectrum_snapshot(
    of: MachineSnapshots,
    data: LatestData,
    channels: Sequence[str] = (),
    first: Sequence[str] = (),
    second: Sequence[str] = (),
    band_hz: tuple[float, float] | None = None,
    units: Units = "channel",
) -> SpectrumSnapshot:
    """Power spectral densities of channels, see `chosen_channels`, and cross-spectra and coherence of named pairs.

    The band is limited to that of the machine file; SnapshotError if it holds too few lines.
    """
    machine, window = of.machine, None if data.window is None else data.window.as_mounted
    chosen = chosen_channels(machine, channels)
    pairs = chosen_pairs(machine, first, second) if first or second else ()
    within = _checked(machine, band_hz)
    prediction = of.theory(data)
    head = heading(of.identity, data, prediction)
    if window is not None and not channels:
        chosen = tuple(channel for channel in chosen if state_name(channel) in window.states)
    used = tuple(dict.fromkeys((*chosen, *(one for pair in pairs for one in pair))))
    if window is None or not used:
        return SpectrumSnapshot(
            **head,
            frequencies_hz=(),
            line_spacing_hz=None,
            averaged_lines=1,
            degrees_of_freedom=None,
            interval_95=None,
            coherence_95=None,
            rotation_hz=None,
            left_out_hz=None,
            densities=(),
            cross=(),
            reason=no_window(machine, data),
        )
    check_held(machine, used, window.states)
    lines = (window.frequencies_hz >= within[0] - 1e-9) & (window.frequencies_hz <= within[1] + 1e-9)
    frequencies_hz = window.frequencies_hz[lines]
    spacing_hz = float(window.frequencies_hz[1] - window.frequencies_hz[0])
    states = tuple(map(state_name, used))
    columns = [window.states.index(state) for state in states]
    group = -(-frequencies_hz.size // _MOST_LINES)
    of_theory, parts = seen_by(used)
    nominal, estimated = (
        one if one is None else averaged(one if parts is None else np.asarray(parts @ one @ parts.T), group)
        for one in prediction.spectra(of_theory, frequencies_hz)
    )
    measured = averaged(window.spectrum[lines][:, columns][:, :, columns], group)
    gone = np.isin(states, list(data.lost))
    measured[:, gone[:, None] | gone] = np.nan
    spectra = measured, nominal, estimated
    averages = _averages(window.n_segments, group)
    freedom = 2 * averages
    speed = head["speed_rad_s"]
    rotation_hz = None if speed is None else abs(speed) / (2 * np.pi)
    reach_hz = LEFT_OUT_BINS * spacing_hz
    low, high = (float(freedom / chdtri(freedom, 1 - part)) for part in reversed(_OUTER))
    return SpectrumSnapshot(
        **head,
        frequencies_hz=known_figures(averaged(frequencies_hz, group)),
        line_spacing_hz=spacing_hz * group,
        averaged_lines=group,
        degrees_of_freedom=float(freedom),
        interval_95=(low, high),
        coherence_95=float(1 - 0.05 ** (1 / (averages - 1))) if averages > 1 else None,
        rotation_hz=rotation_hz,
        left_out_hz=None if rotation_hz is None else (rotation_hz - reach_hz, rotation_hz + reach_hz),
        densities=tuple(
            _density(channel, states.index(state_name(channel)), spectra, spacing_hz * group, units)
            for channel in chosen
        ),
        cross=tuple(
            _cross(pair, states.index(state_name(pair[0])), states.index(state_name(pair[1])), spectra, units)
            for pair in pairs
        ),
        reason=unsent(machine, data),
    )


def _checked(machine: MachineFile, band_hz: tuple[float, float] | None) -> tuple[float, float]:
    """Limits of the band, checked to hold at least two lines, so that a line spacing is defined."""
    there = machine.window.band_hz
    if band_hz is None:
        return there
    low_hz, high_hz = max(band_hz[0], there[0]), min(band_hz[1], there[1])
    if not high_hz - low_hz >= 2 / machine.window.segment_s:
        raise SnapshotError(
            f"{machine.title}: band is {band_hz[0]:g} to {band_hz[1]:g} Hz, expected at least "
            f"{2 / machine.window.segment_s:g} Hz within {there[0]:g} to {there[1]:g} Hz"
        )
    return low_hz, high_hz


def _averages(n_segments: int, group: int) -> float:
    """Effective number of independent averages in one line, or in `group` averaged lines."""
    near = sum(2 * (1 - apart / group) * _SEGMENT_CORRELATIONS[apart] for apart in (1, 2) if apart < group)
    return n_segments * group / (_SEGMENT_CORRELATIONS[0] + near)


def _density(channel: Channel, at: int, spectra: _Spectra, spacing_hz: float, units: Units) -> ChannelDensity:
    unit, factor = product_unit(channel, channel, units)
    measured = 2 * factor * spectra[0][:, at, at].real
    nominal, estimated = (None if one is None else figures(2 * factor * one[:, at, at].real) for one in spectra[1:])
    return ChannelDensity(
        channel=channel.name,
        quantity=channel.quantity.value,
        unit=f"{unit}/Hz",
        measured=figures(measured),
        nominal=nominal,
        estimated=estimated,
        rms=figures([np.sqrt(spacing_hz * measured.sum())])[0],
    )


def _cross(pair: tuple[Channel, Channel], i: int, j: int, spectra: _Spectra, units: Units) -> CrossSpectrum:
    unit, factor = product_unit(*pair, units)
    measured = spectra[0]
    (nominal, nominal_coherence), (estimated, estimated_coherence) = (
        (None, None) if one is None else (figures(2 * factor * np.abs(one[:, i, j])), figures(_coherence(one, i, j)))
        for one in spectra[1:]
    )
    return CrossSpectrum(
        first=pair[0].name,
        second=pair[1].name,
        unit=f"{unit}/Hz",
        magnitude=figures(2 * factor * np.abs(measured[:, i, j])),
        phase_deg=figures(np.degrees(np.angle(measured[:, j, i]))),
        coherence=figures(_coherence(measured, i, j)),
        nominal_magnitude=nominal,
        nominal_coherence=nominal_coherence,
        estimated_magnitude=estimated,
        estimated_coherence=estimated_coherence,
    )


def _coherence(spectra: ComplexArray, i: int, j: int) -> FloatArray:
    power = spectra[:, i, i].real * spectra[:, j, j].real
    with np.errstate(invalid="ignore", divide="ignore"):  # coherence is NaN if a channel has no motion
        share = np.abs(spectra[:, i, j]) ** 2 / power
    return np.asarray(np.where(power > 0, np.minimum(share, 1.0), np.nan), dtype=np.float64)
