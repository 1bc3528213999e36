"""Values of plots: waveforms, full spectra, spectra over time or speed, vectors and centreline over speed."""

from typing import Any, Literal

import numpy as np

from models.diagnosis.sensors.missing import no_data
from models.errors import RotorwatchError
from models.signals.block import FloatArray
from models.signals.channels import Channel
from rotorwatch.records.plots import (
    CentrelineSeries,
    ChannelVectors,
    ChannelWaveform,
    FullSpectrumSnapshot,
    PlaceCentreline,
    PlaceSpectrum,
    VectorSeries,
    WaterfallRow,
    WaterfallSnapshot,
    WaveformSnapshot,
)
from service.analysis.orbit import orbit_pairs, recorded_pairs
from service.analysis.past import Past
from service.analysis.recorded import Recorded, Sampled
from service.analysis.revolutions import Excerpt, newest_revolutions
from service.analysis.runup import read_centreline, read_run_up
from service.analysis.snapshots.channels import averaged, figures, known_figures
from service.analysis.spectrum import lowest_hz, read_full_spectrum, read_waterfall, shown_as, steady, unit_shown

_MOST_SAMPLES = 20_000
_SOON_S = 10.0
_WITHOUT_SPEED_S = 0.5
_FULL_S, _FULL_HZ = 10.0, 1.0
_MOST_ROWS, _MOST_LINES = 60, 400
_ROW_S = 0.5
_UM = "µm pp"
_MOST_VECTORS = 1000
_CENTRELINE_S = 1.0


def waveform_snapshot(
    data: Sampled, channels: tuple[Channel, ...], revolutions: int, speed_rad_s: float | None
) -> WaveformSnapshot:
    """The newest whole revolutions of the channels, from the phase reference's pulses or, without, the mean speed."""
    sent = data.sent(channels)
    if not sent:
        raise RotorwatchError(data.lacking)
    excerpt = data.latest(sent, _SOON_S)[-1]
    found = newest_revolutions(excerpt, revolutions, speed_rad_s, _MOST_SAMPLES)
    shown = found.excerpt or _newest(excerpt)
    speed = figures([shown.speed_rad_s if np.isfinite(shown.speed_rad_s) else speed_rad_s or np.nan])[0]
    return WaveformSnapshot(
        **_whose(data),
        start_ns=shown.start_ns,
        end_ns=shown.end_ns,
        speed_rad_s=speed,
        revolutions=found.count,
        times_s=known_figures(np.arange(shown.samples.shape[0]) / shown.rate_hz),
        pulses_s=known_figures(found.pulses / shown.rate_hz),
        waveforms=tuple(
            ChannelWaveform(
                channel=channel.name,
                unit=unit_shown(channel)[0],
                mean=figures([unit_shown(channel)[1] * column.mean()])[0],
                values=figures(unit_shown(channel)[1] * (column - column.mean())),
            )
            for channel, column in zip(sent, shown.samples.T, strict=True)
        ),
        reason="; ".join(filter(None, (found.reason, no_data([one.name for one in channels if one not in sent])))),
    )


def full_spectrum_snapshot(data: Sampled) -> FullSpectrumSnapshot:
    """Full spectra of the newest seconds at every location with displacements in both directions."""
    resolution_hz = min(_FULL_HZ, data.descriptor.rate_hz / 16)
    found = read_full_spectrum(data, recorded_pairs(data), _FULL_S, resolution_hz, orders=False)
    lines = np.abs(found.lines) <= found.useful
    clear = np.abs(found.lines) >= lowest_hz(found.resolution) * (1 - 1e-9)
    values = np.where(clear, found.values_um, np.nan)[:, lines]
    group = -(-values.shape[1] // (2 * _MOST_LINES))
    return FullSpectrumSnapshot(
        **_whose(data),
        start_ns=found.start_ns,
        end_ns=found.end_ns,
        speed_rad_s=figures([found.speed_rad_s])[0],
        frequencies_hz=known_figures(averaged(found.lines[lines], group)),
        resolution_hz=found.resolution * group,
        averages=found.averages,
        places=tuple(
            PlaceSpectrum(
                location=pair[0].location,
                channels=tuple(one.name for one in pair),
                unit=_UM,
                values=figures(_highest(row, group)),
            )
            for pair, row in zip(found.pairs, values, strict=True)
        ),
        reason=data.lacking,
    )


def waterfall_snapshot(data: Sampled, channel: Channel, over: Literal["time", "speed"]) -> WaterfallSnapshot:
    """Amplitude spectra of one channel over time or speed; of many lines, groups of adjacent ones give their maximum.

    Raises
    ------
    RotorwatchError
        If there are too few samples or, over speed, if the speed is unknown or does not change.
    """
    rate_hz = data.descriptor.rate_hz
    if over == "speed" and not data.has_angle:
        raise RotorwatchError("spectra over speed need the shaft angle (keyphasor), which is not measured")
    row_s = max(_ROW_S, (data.to_ns - data.from_ns) / 1e9 / _MOST_ROWS, 16 / rate_hz)
    if not data.sent([channel]):
        raise RotorwatchError(no_data([channel.name]))
    found = read_waterfall(data, channel, row_s, max(1 / row_s, 1.0 if row_s > 1 else 0.0), "amplitude")
    if over == "speed":
        if text := steady(found.speed_rad_s):
            raise RotorwatchError(f"spectra over speed need a run-up or coast-down: {text}")
        edges, mean = found.over_speed()
        times = [(None, None)] * len(mean)
        speeds, values = (edges[1:] + edges[:-1]) / 2, mean
    else:
        times = list(zip(found.start_ns.tolist(), found.end_ns.tolist(), strict=True))
        speeds, values = found.speed_rad_s, found.values
    lines = (found.frequencies_hz >= lowest_hz(found.resolution_hz)) & (found.frequencies_hz <= found.useful_hz)
    group = -(-int(lines.sum()) // _MOST_LINES) or 1
    return WaterfallSnapshot(
        **_whose(data),
        start_ns=int(found.start_ns[0]),
        end_ns=int(found.end_ns[-1]),
        channel=channel.name,
        unit=shown_as(channel, "amplitude")[0],
        over=over,
        frequencies_hz=known_figures(averaged(found.frequencies_hz[lines], group)),
        resolution_hz=found.resolution_hz * group,
        rows=tuple(
            WaterfallRow(
                start_ns=start_ns,
                end_ns=end_ns,
                speed_rad_s=figures([speed])[0],
                values=figures(_highest(row[lines], group)),
            )
            for (start_ns, end_ns), speed, row in zip(times, speeds, values, strict=True)
            if np.isfinite(row).all()
        ),
    )


def vector_series(
    data: Sampled | Past, channels: tuple[Channel, ...], order: int, revolutions: int, slow_roll_rpm: float | None
) -> VectorSeries:
    """Vectors of channels: of every window of a history, or of every `revolutions` revolutions of samples."""
    if not (sent := data.sent(channels)):
        raise RotorwatchError(data.lacking)
    found = read_run_up(data, sent, order, revolutions, slow_roll_rpm)
    gone = [one.name for one in sent if one not in found.channels]
    every = -(-found.time_ns.size // _MOST_VECTORS)
    return VectorSeries(
        **_whose(data),
        order=order,
        revolutions=found.revolutions,
        slow_roll_rpm=found.slow_roll_rpm,
        times_ns=tuple(found.time_ns[::every].tolist()),
        speeds_rad_s=figures(found.speed_rad_s[::every]),
        channels=tuple(
            ChannelVectors(
                channel=channel.name,
                unit=unit,
                amplitude=figures(found.amplitude[::every, number]),
                phase_lag_deg=figures(found.lag_deg[::every, number]),
            )
            for number, (channel, unit) in enumerate(zip(found.channels, found.units, strict=True))
        ),
        steady=steady(found.speed_rad_s),
        reason="; ".join(
            filter(
                None,
                (
                    no_data([one.name for one in channels if one not in sent]),
                    f"no amplitude and phase of {order}x of {', '.join(gone)}" if gone else "",
                ),
            )
        ),
    )


def centreline_series(data: Sampled | Past) -> CentrelineSeries:
    """Mean shaft positions at all locations with displacements in both directions."""
    pairs = recorded_pairs(data)
    found = read_centreline(data, pairs, _CENTRELINE_S)
    gone = [pair[0].location for pair in orbit_pairs(data.descriptor.channels) if pair not in found.pairs]
    return CentrelineSeries(
        **_whose(data),
        times_ns=tuple(found.time_ns.tolist()),
        speeds_rad_s=figures(np.asarray(found.speed_rad_s, dtype=np.float64)),
        places=tuple(
            PlaceCentreline(
                location=pair[0].location, channels=tuple(one.name for one in pair), y_um=figures(y), z_um=figures(z)
            )
            for pair, y, z in zip(found.pairs, found.y_um.T, found.z_um.T, strict=True)
        ),
        reason=f"no mean positions at the {' and the '.join(gone)}" if gone else "",
    )


def _whose(data: Sampled | Past) -> dict[str, Any]:
    """First fields of every plot's values: the machine, and the source of the data."""
    site, machine = data.name.split("/")
    samples = "recordings" if isinstance(data, Recorded) else "newest samples"
    return {"site": site, "machine": machine, "source": "history" if isinstance(data, Past) else samples}


def _newest(excerpt: Excerpt) -> Excerpt:
    size = excerpt.samples.shape[0]
    return excerpt.part(max(0, size - min(_MOST_SAMPLES, round(_WITHOUT_SPEED_S * excerpt.rate_hz))), size)


def _highest(values: FloatArray, group: int) -> FloatArray:
    """Maxima of groups of adjacent values, of those that `averaged` gives the means."""
    return np.asarray(values[: values.size // group * group].reshape(-1, group).max(axis=-1), dtype=np.float64)
