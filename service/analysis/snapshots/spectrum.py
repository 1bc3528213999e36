"""Power spectral densities of the latest window, with theory, and coherence of pairs of channels."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from scipy.special import chdtri

from models.diagnosis.window.moments import ComplexArray
from models.machine import MachineFile
from models.signals.block import FloatArray
from models.signals.channels import Channel, state_name
from rotorwatch.records.snapshots import ChannelDensity, CrossSpectrum, SpectrumSnapshot, Units
from service.analysis.excitation import LEFT_OUT_BINS
from service.analysis.prediction import Prediction
from service.analysis.snapshots.channels import (
    SnapshotError,
    check_held,
    chosen_channels,
    chosen_pairs,
    figures,
    known_figures,
    product_unit,
    seen_by,
)
from service.analysis.snapshots.heading import LatestData, Subject, heading, no_window, theory, unsent

MOST_LINES = 1000
"""Most lines in a snapshot; if the band has more, adjacent lines are averaged."""
_SEGMENT_CORRELATIONS = (1 + 2 / 36, 4 / 9 + 2 * 0.0200, 1 / 36 + 2 * 0.0069)
"""Sums of squared correlations of half-overlapping Hann segments' power: in one line, and in lines 1 and 2 apart."""
_OUTER = (0.025, 0.975)
_Array = TypeVar("_Array", FloatArray, ComplexArray)
_Spectra = tuple[ComplexArray, ComplexArray | None, ComplexArray | None]
"""Two-sided cross-spectra, SI²/Hz: measured, nominal, estimated; shape (n_lines, n, n), in the same order of states."""


def spectrum_snapshot(  # noqa: PLR0913  # options of the request
    subject: Subject,
    data: LatestData,
    prediction: Prediction,
    channels: Sequence[str] = (),
    first: Sequence[str] = (),
    second: Sequence[str] = (),
    band_hz: tuple[float, float] | None = None,
    units: Units = "channel",
) -> SpectrumSnapshot:
    """Power spectral densities of channels, and cross-spectra and coherence of pairs.

    Parameters
    ----------
    channels : sequence of str
        Names; without names, all channels of the first quantity measured (displacements first).
    first, second : sequence of str
        Names of the pairs whose cross-spectrum and coherence are given; none by default.
    band_hz : tuple of float, optional
        Lowest and highest frequency, limited to the machine file's band.

    Raises
    ------
    SnapshotError
        If there is no such channel, or the band holds too few lines.
    """
    machine, window = subject.machine, None if data.window is None else data.window.as_mounted
    chosen = chosen_channels(machine, channels)
    pairs = chosen_pairs(machine, first, second) if first or second else ()
    within = _checked(machine, band_hz)
    stated = theory(prediction.changes, prediction.nominal_reason, prediction.estimated_reason)
    head = heading(subject, data)
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
            theory=stated,
            reason=no_window(machine, data),
        )
    check_held(machine, used, window.states)
    lines = (window.frequencies_hz >= within[0] - 1e-9) & (window.frequencies_hz <= within[1] + 1e-9)
    frequencies_hz = window.frequencies_hz[lines]
    spacing_hz = float(window.frequencies_hz[1] - window.frequencies_hz[0])
    states = tuple(map(state_name, used))
    columns = [window.states.index(state) for state in states]
    group = -(-frequencies_hz.size // MOST_LINES)
    of_theory, parts = seen_by(used)
    nominal, estimated = (
        one if one is None else _grouped(one if parts is None else np.asarray(parts @ one @ parts.T), group)
        for one in prediction.spectra(of_theory, frequencies_hz)
    )
    measured = _grouped(window.spectrum[lines][:, columns][:, :, columns], group)
    gone = np.isin(states, list(data.missing))
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
        frequencies_hz=known_figures(_grouped(frequencies_hz, group)),
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
        theory=stated,
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


def _grouped(values: _Array, group: int) -> _Array:
    """Means of `group` adjacent values along the first axis; an incomplete last group is dropped."""
    if group == 1:
        return values
    whole = values[: values.shape[0] // group * group]
    return np.asarray(whole.reshape(-1, group, *values.shape[1:]).mean(axis=1), dtype=values.dtype)


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
