"""What a channel shows that no other one shares: the noise of a sensor, as far as it can be told from the machine.

Two sensors of one motion differ by their noise alone, whatever moves the machine: |v - hjωx|². Where a motion has one
sensor, what the other channels do not explain of it holds the noise and a part of the machine. That part has the
machine's resonances in it; noise lies under it like a floor. A line that stands in one channel alone is none of the
machine's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.diagnosis.moments import ComplexArray
from models.diagnosis.pairs import MotionPair, motion_pairs, pair_bands
from models.diagnosis.sensors.kinematics import Banded, PairReading
from models.diagnosis.window import WindowStatistics
from models.signals.block import FloatArray

__all__ = ["ChannelNoise", "PairNoise", "channel_noise", "channel_rms", "floor", "matched", "pair_noise", "single"]

_FLAT = 2.0
"""Bands within this factor of the lowest lie on the floor."""
_LINE_BINS, _BLOCK = 3, 24
"""Bins that hold a line in Hann segments, and bins of its surroundings."""
_STANDS_OUT = 6.0
"""A bin this far above the median of its surroundings may hold a line."""
_OWN = 4.0
"""So far it must stand out still where the other channels have explained what they can."""
_HARMONIC = 0.002
"""Relative distance from a multiple of half the speed within which a line is the shaft's, beside its range."""
_RIDGE = 1e-9
_LEAKAGE = 1.0
_LEFT = 0.1
"""Least part of a difference that is still called noise after leakage was taken out."""
_SMOOTHED = 3


@dataclass(frozen=True, slots=True)
class PairNoise:
    """Noise of two sensors of one motion, in bands.

    Attributes
    ----------
    density : ndarray, shape (n_bands,)
        Power of their difference as the second shows it, two-sided, SI²/Hz.
    leakage : ndarray, shape (n_bands,)
        The part of it that two perfect sensors would show in segments of this length.
    scale : ndarray, shape (n_bands,)
        Power of the difference, times 1 Hz, if each sensor had white noise of its own rms in 1 Hz, SI².
    """

    pair: MotionPair
    density: FloatArray
    leakage: FloatArray
    scale: FloatArray

    @property
    def noise(self) -> FloatArray:
        """Power of the difference without the leakage."""
        return np.maximum(self.density - self.leakage, _LEFT * self.density)

    @property
    def share(self) -> FloatArray:
        """`noise` over `scale`, 1/Hz."""
        return self.noise / self.scale


@dataclass(frozen=True, slots=True)
class ChannelNoise:
    """What one channel does not share with the others.

    Attributes
    ----------
    density : ndarray, shape (n_bands,)
        What is left of it, two-sided, SI²/Hz.
    share : ndarray, shape (n_bands,)
        The same over the channel's mean square, 1/Hz.
    flat : float
        Part of the bands that lie on the floor, 0 to 1.
    line_rms, line_hz : float
        Strongest line that it alone shows, SI, and where; 0 without one.
    """

    column: int
    density: FloatArray
    share: FloatArray
    flat: float
    line_rms: float
    line_hz: float


def channel_rms(window: WindowStatistics) -> FloatArray:
    """Root mean square of each channel about its hops' means, rotation included; shape (n,)."""
    rms = np.stack([hop.rms[: len(window.states)] for hop in window.waveforms])
    return np.asarray(np.sqrt((rms**2).mean(axis=0)), dtype=np.float64)


def single(states: tuple[str, ...]) -> list[int]:
    """Columns without a second sensor of their motion."""
    paired = {column for pair in motion_pairs(states) for column in (pair.first, pair.second)}
    return [column for column in range(len(states)) if column not in paired]


def matched(bands: Banded, reading: PairReading) -> ComplexArray:
    """Spectra in bands with the first sensor brought to gain, sense and time of the second."""
    h = reading.polarity * np.exp(reading.log_gain - 1j * bands.w * reading.delay_s)
    spectra = bands.spectra.copy()
    spectra[:, 0] *= h[:, None]
    spectra[:, :, 0] *= h.conj()[:, None]
    return spectra


def pair_noise(window: WindowStatistics, bands: Banded, reading: PairReading) -> PairNoise:
    """Power of the difference of two sensors of one motion."""
    h = reading.polarity * np.exp(reading.log_gain - 1j * bands.w * reading.delay_s)
    z, v, cross = bands.spectra[:, 0, 0].real, bands.spectra[:, 1, 1].real, bands.spectra[:, 1, 0]
    power = np.abs(h) ** 2 * z + v
    density = np.maximum(power - 2 * (cross * h.conj()).real, 1e-12 * power)
    rms, pair = channel_rms(window), reading.pair
    scale = rms[pair.second] ** 2 + bands.w ** (2 * pair.order) * rms[pair.first] ** 2
    # v = jωx holds for the motion, not for its windowed segments: F{w dx/dt} = jω F{w x} - F{x dw/dt}. With a Hann
    # window of length T the last term has 1 / 3 (2π / ωT)² of the power.
    step_rad_s = 2 * np.pi * (window.frequencies_hz[1] - window.frequencies_hz[0])
    leakage = _LEAKAGE * v * (pair.order * step_rad_s / bands.w) ** 2 / 3
    return PairNoise(pair, np.asarray(density, dtype=np.float64), np.asarray(leakage, dtype=np.float64), scale)


def channel_noise(window: WindowStatistics, columns: Sequence[int]) -> list[ChannelNoise]:
    """What the other channels do not explain of some; nothing where there is too little data to tell."""
    rms = channel_rms(window)
    n_bins, n = window.frequencies_hz.size, len(window.states)
    if not columns or n < 2 or window.n_segments < 2 * n or not np.all(rms > 0):
        return []
    edges = pair_bands(n_bins)
    counts = np.diff(np.append(edges, n_bins))
    spectra = np.add.reduceat(window.spectrum, edges) / counts[:, None, None]
    left = _conditional(np.asarray(spectra, dtype=np.complex128))
    if left.shape[0] < _SMOOTHED:
        return []
    flat = (np.log(left) < floor(np.log(left)) + np.log(_FLAT)).mean(axis=0)
    lines = _lines(window, columns)
    return [
        ChannelNoise(
            column,
            left[:, column],
            left[:, column] / rms[column] ** 2,
            float(flat[column]),
            *lines.get(column, (0.0, 0.0)),
        )
        for column in columns
    ]


def floor(log_density: FloatArray) -> FloatArray:
    """Lowest mean of three neighbouring bands of log densities; shape (n_bands, ...) becomes (...)."""
    log_density = np.asarray(log_density, dtype=np.float64)
    return np.asarray(((log_density[:-2] + log_density[1:-1] + log_density[2:]) / _SMOOTHED).min(axis=0))


def _conditional(spectra: ComplexArray) -> FloatArray:
    """Power of each channel that the others do not explain; shape (..., n)."""
    power = np.maximum(np.einsum("...ii->...i", spectra).real, np.finfo(float).tiny)
    scale = 1 / np.sqrt(power)
    unit = spectra * scale[..., :, None] * scale[..., None, :] + _RIDGE * np.eye(spectra.shape[-1])
    precision = np.maximum(np.einsum("...ii->...i", np.linalg.inv(unit)).real, 1.0)
    return np.asarray(power / precision, dtype=np.float64)


def _lines(window: WindowStatistics, columns: Sequence[int]) -> dict[int, tuple[float, float]]:
    """Strongest line of its own of each channel that has one: its rms and frequency."""
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
        if on > _OWN * off:
            found[column] = (float(np.sqrt(2 * (on - off) * _LINE_BINS * (f[1] - f[0]))), float(f[peak]))
    return found
