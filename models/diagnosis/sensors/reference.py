"""Reference of the sensors of a healthy machine: their levels, how pairs compare, and the sensors' own noise.

Two sensors of one motion differ by their noise alone, whatever moves the machine: |v - hjωx|². If a motion has only one
sensor, the part of its power that the other channels do not explain contains its noise and some motion of the machine.
The motion shows the machine's resonances, the noise is the floor below them. A line in one channel alone may be mains
hum (`noise.is_hum`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, Field, model_validator

from models.diagnosis.sensors.kinematics import PairReading, banded, read_pairs, same
from models.diagnosis.window.motion import motion_pairs, pair_bands
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.signals.block import ComplexArray, FloatArray
from models.signals.channels import Channel, state_name, unit_in_text
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

WITHOUT_SIGNAL = {FaultKind.MISSING, FaultKind.STUCK}
"""Faults of a sensor without a signal: it is certain which sensor it is, and all others can be believed."""


def implicated(findings: Iterable[SensorFault]) -> set[str]:
    """States whose channels must not be used (``theta`` is the shaft angle)."""
    return {state for finding in findings for state in finding.states}


class Naming:
    """Names of channels, and values in their units, for texts.

    A state that none of the machine's channels measures is called by its own name, with values in SI units.
    """

    def __init__(self, channels: Iterable[Channel]) -> None:
        self._channels = {state_name(channel): channel for channel in channels}

    def name(self, state: str) -> str:
        """Name of the channel."""
        return self._channels[state].name if state in self._channels else state

    def names(self, states: Iterable[str]) -> str:
        """Names of several channels, with "and" before the last."""
        *first, last = [self.name(state) for state in states]
        return f"{', '.join(first)} and {last}" if first else last

    def value(self, state: str, value_SI: float) -> str:
        """Text of a value in the channel's unit."""
        if state not in self._channels:
            return f"{value_SI:.3g} (SI)"
        channel = self._channels[state]
        return f"{value_SI / channel.to_si:.3g} {unit_in_text(channel.unit)}"


_FLAT = 2.0  # bands within this factor of the lowest lie on the floor
_LINE_BINS, _BLOCK = 3, 24  # bins that hold a line in Hann segments, and bins of its surroundings
_STANDS_OUT = 6.0  # a bin with this many times the median power of its surroundings may hold a line
_STANDS_OUT_ALONE = 4.0  # the same factor for the conditional power, given the other channels
# Relative distance from a multiple of half the speed, in addition to the range of speed, within which a line is put
# down to the shaft.
_HARMONIC = 0.002
_RIDGE = 1e-9
_LEAKAGE = 1.0
_LEAST_NOISE_PART = 0.1  # least part of the difference's power that counts as noise after leakage was subtracted
_SMOOTHED = 3


@dataclass(frozen=True, slots=True)
class ChannelNoise:
    """Power of one channel that the others do not explain."""

    column: int
    density: FloatArray  # (n_bands,), conditional power, two-sided, SI²/Hz
    share: FloatArray  # (n_bands,), the same over the channel's mean square, 1/Hz
    flat: float  # part of the bands that lie on the floor, 0 to 1
    # Strongest line that only this channel shows: its rms in SI units, and its frequency; 0 without one.
    line_rms: float
    line_hz: float


def channel_rms(window: WindowStatistics) -> FloatArray:
    """Root mean square of each channel about the means of the hops, synchronous part included; shape (n,)."""
    rms = np.stack([hop.rms[: len(window.states)] for hop in window.waveforms])
    return np.asarray(np.sqrt((rms**2).mean(axis=0)), dtype=np.float64)


class PairNoise:
    """Noise of two sensors of one motion, in bands."""

    def __init__(self, window: WindowStatistics, reading: PairReading) -> None:
        bands, h, pair, rms = reading.bands, reading.transfer, reading.pair, channel_rms(window)
        z, v, cross = bands.spectra[:, 0, 0].real, bands.spectra[:, 1, 1].real, bands.spectra[:, 1, 0]
        power = np.abs(h) ** 2 * z + v
        # (n_bands,): power of their difference in the second's quantity, two-sided, SI²/Hz
        self.density: FloatArray = np.maximum(power - 2 * (cross * h.conj()).real, 1e-12 * power)
        # (n_bands,): power of the difference, times 1 Hz, if each sensor had white noise of its own rms in 1 Hz, SI²
        self.scale: FloatArray = rms[pair.second] ** 2 + bands.w ** (2 * pair.order) * rms[pair.first] ** 2
        # The part of the density that two perfect sensors would show: v = jωx holds for the motion, not for its
        # windowed segments, F{w dx/dt} = jω F{w x} - F{x dw/dt}. With a Hann window of length T the last term has
        # 1 / 3 (2π / ωT)² of the power.
        step_rad_s = 2 * np.pi * (window.frequencies_hz[1] - window.frequencies_hz[0])
        self.leakage: FloatArray = _LEAKAGE * v * (pair.order * step_rad_s / bands.w) ** 2 / 3
        self.noise = np.maximum(self.density - self.leakage, _LEAST_NOISE_PART * self.density)


def channel_noise(window: WindowStatistics) -> list[ChannelNoise]:
    """Power of channels without a second sensor that the others do not explain; empty if there are too few data."""
    rms = channel_rms(window)
    paired = {column for pair in motion_pairs(window.states) for column in (pair.first, pair.second)}
    columns = [column for column in range(len(window.states)) if column not in paired]
    n_bins, n = window.frequencies_hz.size, len(window.states)
    if not columns or n < 2 or window.n_segments < 2 * n or not np.all(rms > 0):
        return []
    counts = np.diff(np.append(pair_bands(n_bins), n_bins))
    left = _conditional(window.banded_spectrum / counts[:, None, None])
    if left.shape[0] < _SMOOTHED:
        return []
    flat = (np.log(left) < floor(np.log(left)) + np.log(_FLAT)).mean(axis=0)
    lines = _lines(window, columns)
    found = []
    for column in columns:
        own, line = left[:, column], lines.get(column, (0.0, 0.0))
        found.append(ChannelNoise(column, own, own / rms[column] ** 2, float(flat[column]), *line))
    return found


def floor(log_density: FloatArray) -> FloatArray:
    """Lowest mean of the log densities of three neighbouring bands; shape (n_bands, ...) becomes (...)."""
    log_density = np.asarray(log_density, dtype=np.float64)
    return np.asarray(((log_density[:-2] + log_density[1:-1] + log_density[2:]) / _SMOOTHED).min(axis=0))


def _conditional(spectra: ComplexArray) -> FloatArray:
    """Conditional power of each channel given all others; shape (..., n)."""
    power = np.maximum(np.einsum("...ii->...i", spectra).real, np.finfo(float).tiny)
    scale = 1 / np.sqrt(power)
    unit = spectra * scale[..., :, None] * scale[..., None, :] + _RIDGE * np.eye(spectra.shape[-1])
    precision = np.maximum(np.einsum("...ii->...i", np.linalg.inv(unit)).real, 1.0)
    return np.asarray(power / precision, dtype=np.float64)


def _lines(window: WindowStatistics, columns: Sequence[int]) -> dict[int, tuple[float, float]]:
    """Rms and frequency of the strongest line that a column alone shows, by column, for columns that have one."""
    f, count = window.frequencies_hz, window.frequencies_hz.size // _BLOCK
    if not count:
        return {}
    power = np.einsum("fii->fi", window.spectrum).real[: count * _BLOCK, list(columns)]
    usual = np.median(power.reshape(count, _BLOCK, -1), axis=1)
    high = power > _STANDS_OUT * np.repeat(usual, _BLOCK, axis=0)
    half_hz, (slowest, fastest) = abs(window.speed_rad_s) / (4 * np.pi), window.speed_range
    found: dict[int, tuple[float, float]] = {}
    for number, column in enumerate(columns):
        at = np.flatnonzero(high[:, number])
        at = at[(at >= _LINE_BINS) & (at < f.size - _LINE_BINS)]
        if np.isfinite(half_hz) and half_hz > 0:
            reach = f[1] - f[0] + (_HARMONIC + abs(fastest - slowest) / abs(window.speed_rad_s)) * f[at]
            at = at[np.abs(np.round(f[at] / half_hz) * half_hz - f[at]) > reach]
        if not at.size:
            continue
        peak = int(at[power[at, number].argmax()])
        near = np.arange(max(0, peak - _BLOCK // 2), min(f.size, peak + _BLOCK // 2))
        beside = near[np.abs(near - peak) > _LINE_BINS]
        both = np.stack([window.spectrum[peak - 1 : peak + 2].mean(axis=0), window.spectrum[beside].mean(axis=0)])
        on, off = _conditional(both)[:, column]
        if on > _STANDS_OUT_ALONE * off:
            found[column] = (float(np.sqrt(2 * (on - off) * _LINE_BINS * (f[1] - f[0]))), float(f[peak]))
    return found


class NoiseReference(BaseModel, extra="forbid", frozen=True, strict=True, allow_inf_nan=False):
    """Noise on the healthy machine, mean over the windows, in the bands of `models.diagnosis.sensors.reference`."""

    density: tuple[Annotated[float, Field(gt=0)], ...] = Field(description="two-sided, SI²/Hz")
    share: tuple[Annotated[float, Field(gt=0)], ...] = Field(description="over the channels' own mean squares, 1/Hz")
    line_rms: float = Field(default=0.0, ge=0, description="strongest line that one channel alone shows, SI")

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        if len(self.density) != len(self.share):
            raise ValueError(f"density holds {len(self.density)} bands and share {len(self.share)}, expected as many")
        return self


class _WithNoise(BaseModel, extra="forbid", frozen=True, strict=True, allow_inf_nan=False):
    """A reference with noise, or one from before noise was learned, which is written back unchanged."""

    noise: NoiseReference | None = Field(
        default=None, exclude_if=lambda noise: noise is None, description="None where it was not learned"
    )


class ChannelReference(_WithNoise):
    """One channel on the healthy machine, SI units."""

    state: str = Field(description="what it measures")
    mean: float = Field(description="mean of the samples")
    mean_spread: float = Field(ge=0, description="standard deviation of a hop's mean about it")
    rms: float = Field(ge=0, description="root mean square about the mean")
    rotation: float | None = Field(default=None, ge=0, description="amplitude of the rotation-synchronous part")
    rotation_spread: float | None = Field(default=None, ge=0, description="its relative standard deviation")


class PairReference(_WithNoise):
    """Two sensors of one motion on the healthy machine."""

    first: str
    second: str
    log_gain: float = Field(description="logarithm of the second's gain over the first's")
    log_gain_spread: float = Field(ge=0, description="standard deviation of one more window about it, its own aside")
    polarity: int = Field(ge=-1, le=1)
    delay_s: float = Field(description="by how much the second comes later")
    delay_spread_s: float = Field(ge=0)
    lead_rad_s: float = Field(
        default=0.0,
        exclude_if=lambda lead: not lead,
        description="phase by which the second runs ahead besides, as behind a high-pass, times the angular frequency",
    )
    shared: float = Field(ge=0, le=1, description="how much of the motion they share at the best delay")
    same: float = Field(ge=-1, le=1, description="how much of it they show alike, at the same time and size")


class SensorReference(BaseModel, extra="forbid", frozen=True, strict=True, allow_inf_nan=False):
    """Reference of all sensors, learned from healthy windows; reading it back from JSON gives the same bits."""

    # Numbers of healthy windows that it was learned from, and of hops in them.
    n_windows: int = Field(ge=1)
    n_hops: int = Field(ge=1)
    speed_rad_s: float | None = None  # mean speed in them
    channels: tuple[ChannelReference, ...]
    pairs: tuple[PairReference, ...]

    @model_validator(mode="after")
    def _known(self) -> "SensorReference":
        known = {channel.state for channel in self.channels}
        for pair in self.pairs:
            strange = {pair.first, pair.second} - known
            if strange:
                raise ValueError(f"pairs: {', '.join(sorted(strange))} not among channels ({', '.join(sorted(known))})")
        return self

    def channel(self, state: str) -> ChannelReference | None:
        """Reference of one channel, or None if it has none."""
        return next((channel for channel in self.channels if channel.state == state), None)

    def pair(self, first: str, second: str) -> PairReference | None:
        """Reference of two sensors of one motion, or None if they have none."""
        return next((pair for pair in self.pairs if (pair.first, pair.second) == (first, second)), None)


PERFECT = PairReference(
    first="", second="", log_gain=0, log_gain_spread=0, polarity=1, delay_s=0, delay_spread_s=0, shared=1, same=1
)
"""What is expected of two sensors without a reference."""


def learn_sensor_reference(windows: Sequence[WindowStatistics]) -> SensorReference:
    """Learn the sensors' reference from healthy windows that do not overlap.

    Raises
    ------
    EstimationError
        If there is no window, or a channel shows no fluctuation in one.
    """
    if not windows:
        raise EstimationError("no healthy window to learn the sensors from")
    windows = [window.as_mounted for window in windows]
    states = windows[0].states
    pairs = []
    for pair in motion_pairs(states):
        bands = [(window, [pair], banded(window, [pair])) for window in windows]
        there = [one for each in bands for one in read_pairs(*each, {})]
        if len(there) < len(windows):
            raise EstimationError(f"no fluctuation in {states[pair.first]} or {states[pair.second]}")
        lead_rad_s = float(np.median([one.lead_rad_s for one in there]))
        if any(one.lead_rad_s for one in there):
            leads = {(states[pair.first], states[pair.second]): lead_rad_s}
            there = [one for each in bands for one in read_pairs(*each, leads)]
        noises = [PairNoise(window, one) for window, one in zip(windows, there, strict=True)]
        pairs.append(_pair(there, _noise([(one.noise, one.noise / one.scale) for one in noises])))
    noise = {
        each[0].column: _noise([(one.density, one.share) for one in each], max(one.line_rms for one in each))
        for each in zip(*map(channel_noise, windows), strict=False)
    }
    speeds = np.concatenate([window.hop_speed_rad_s for window in windows])
    return SensorReference(
        n_windows=len(windows),
        n_hops=sum(len(window.waveforms) for window in windows),
        speed_rad_s=float(speeds.mean()) if np.all(np.isfinite(speeds)) else None,
        channels=tuple(
            _channel(windows, column, noise.get(column))
            for column, state in enumerate(windows[0].sensors)
            if state != "theta"
        ),
        pairs=tuple(pairs),
    )


def _noise(noises: Sequence[tuple[FloatArray, FloatArray]], line_rms: float = 0.0) -> NoiseReference | None:
    """Mean of the windows' noise densities and of their shares."""
    density, share = (np.mean(each, axis=0) for each in zip(*noises, strict=True))
    if not (np.all(density > 0) and np.all(share > 0) and np.all(np.isfinite(share))):
        return None
    return NoiseReference(density=tuple(density.tolist()), share=tuple(share.tolist()), line_rms=line_rms)


def _channel(windows: Sequence[WindowStatistics], column: int, noise: NoiseReference | None) -> ChannelReference:
    means = np.concatenate([window.hop_waveform.mean[:, column] for window in windows])
    squares = np.concatenate([window.hop_waveform.rms[:, column] ** 2 for window in windows])
    rotation = rotation_spread = None
    vectors = [window.rotation_vectors for window in windows]
    known = [np.abs(each[:, column]) for each in vectors if each is not None and column < each.shape[1]]
    if len(known) == len(windows):
        sizes = np.concatenate(known)
        rotation = float(sizes.mean())
        rotation_spread = float(sizes.std() / max(rotation, np.finfo(float).tiny))
    return ChannelReference(
        state=windows[0].sensors[column],
        mean=float(means.mean()),
        mean_spread=float(means.std()),
        rms=float(np.sqrt(squares.mean())),
        rotation=rotation,
        rotation_spread=rotation_spread,
        noise=noise,
    )


def _pair(readings: list[PairReading], noise: NoiseReference | None) -> PairReference:
    """Mean of the windows' readings; the spread combines their scatter beyond their own errors and the mean's error."""
    figures = [(one.log_gain, one.log_gain_error, one.delay_s, one.delay_error_s) for one in readings]
    gains, gain_errors, delays, delay_errors = np.array(figures).T.copy()
    return PairReference(
        first=readings[0].first,
        second=readings[0].second,
        log_gain=float(gains.mean()),
        log_gain_spread=_spread(gains, gain_errors),
        polarity=1 if sum(reading.polarity for reading in readings) >= 0 else -1,
        delay_s=float(delays.mean()),
        delay_spread_s=_spread(delays, delay_errors),
        lead_rad_s=readings[0].lead_rad_s,
        shared=min(reading.shared for reading in readings),
        same=float(min(same(reading.bands) for reading in readings)),
        noise=noise,
    )


def _spread(values: FloatArray, errors: FloatArray) -> float:
    own, n = float(np.mean(errors**2)), len(values)
    scatter = float(values.var(ddof=1)) if n > 1 else own
    return float(np.sqrt(max(scatter - own, 0.0) + max(scatter, own) / n))
