"""Spectra of a recorded stream: of its latest seconds, and over time or speed."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.signal import welch

from models.errors import MachineFileError, RotorwatchError
from models.signals.block import FloatArray
from models.signals.channels import Channel
from service.plots.stretches import RecordedStream, Stretch, begins_again

__all__ = ["Spectrum", "Waterfall", "read_spectrum", "read_waterfall", "summed_power"]

_MOST_SPECTRA = 400
_MOST_SPEEDS = 120
_STEADY = 0.02

Scaling = Literal["peak", "density"]


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Averaged spectra of some channels.

    Attributes
    ----------
    start_ns, end_ns : int
        Oldest and newest data in it.
    channels : tuple of Channel
    frequencies_hz : ndarray, shape (n_bins,)
    values : ndarray, shape (n_channels, n_bins)
        Amplitude, peak, in the channel's unit; or its square over Hz.
    scaling : str
        ``peak`` or ``density``.
    resolution_hz : float
        Distance of the lines.
    averages : int
        Segments, overlapping by half, whose power was averaged.
    speed_rad_s : float
        Mean speed; nan without a shaft angle.
    """

    start_ns: int
    end_ns: int
    channels: tuple[Channel, ...]
    frequencies_hz: FloatArray
    values: FloatArray
    scaling: Scaling
    resolution_hz: float
    averages: int
    speed_rad_s: float


@dataclass(frozen=True, slots=True)
class Waterfall:
    """Spectra of one channel, one after the other.

    Attributes
    ----------
    channel : Channel
    frequencies_hz : ndarray, shape (n_bins,)
    start_ns, end_ns : ndarray of int, shape (n_spectra,)
        Data in each.
    speed_rad_s : ndarray, shape (n_spectra,)
        Mean speed; nan without a shaft angle.
    values : ndarray, shape (n_spectra, n_bins)
        Amplitude, peak, in the channel's unit; or its square over Hz.
    scaling : str
        ``peak`` or ``density``.
    resolution_hz : float
    """

    channel: Channel
    frequencies_hz: FloatArray
    start_ns: npt.NDArray[np.int64]
    end_ns: npt.NDArray[np.int64]
    speed_rad_s: FloatArray
    values: FloatArray
    scaling: Scaling
    resolution_hz: float

    def over_speed(self) -> tuple[FloatArray, FloatArray]:
        """Mean spectra over the speed: edges of the speeds, rad/s, shape (n + 1,), and spectra, shape (n, n_bins).

        Raises
        ------
        RotorwatchError
            Without a shaft angle, or if the speed does not change.
        """
        speed = np.abs(self.speed_rad_s)
        if not np.isfinite(speed).all():
            raise RotorwatchError("--axis speed needs the shaft angle (keyphasor), which is not measured")
        slowest, fastest = float(speed.min()), float(speed.max())
        if fastest - slowest < _STEADY * max(fastest, 1e-9):
            raise RotorwatchError(
                f"--axis speed needs a run-up or coast-down: the speed stays between {slowest * 30 / np.pi:.4g} and "
                f"{fastest * 30 / np.pi:.4g} rpm; --axis time shows it"
            )
        count = min(_MOST_SPEEDS, max(2, speed.size // 2))
        edges = np.linspace(slowest, fastest, count + 1)
        place = np.clip(np.searchsorted(edges, speed, side="right") - 1, 0, count - 1)
        mean = np.full((count, self.frequencies_hz.size), np.nan)
        for number in range(count):
            if (place == number).any():
                of = self.values[place == number]
                mean[number] = of.mean(axis=0) if self.scaling == "density" else np.sqrt(np.mean(of**2, axis=0))
        return edges, mean


def read_spectrum(
    stream: RecordedStream, channels: tuple[Channel, ...], window_s: float, resolution_hz: float, scaling: Scaling
) -> Spectrum:
    """Spectra of the latest `window_s` of a recorded stream; segments never reach across a gap.

    Raises
    ------
    MachineFileError
        If the window is shorter than one segment, which is 1 / `resolution_hz` long.
    RotorwatchError
        If there is no stretch so long without a gap.
    """
    segment = _segment(stream, window_s, resolution_hz)
    found = stream.latest(channels, window_s)
    used = [stretch for stretch in found if stretch.samples.shape[0] >= segment]
    if not used:
        longest_s = max((stretch.length_s for stretch in found), default=0.0)
        raise RotorwatchError(
            f"{stream.place}: a spectrum with --resolution {resolution_hz:g} Hz needs {1 / resolution_hz:g} s without "
            f"a gap, the longest stretch of {stream.name} in the last {window_s:g} s is {longest_s:.3g} s"
        )
    total, averages = np.zeros((len(channels), segment // 2 + 1)), 0
    for stretch in used:
        power, count = summed_power(stretch, segment, scaling)
        total, averages = total + power, averages + count
    lengths = np.array([stretch.length_s for stretch in used])
    speeds = np.array([stretch.speed_rad_s for stretch in used])
    rate_hz = stream.descriptor.rate_hz
    return Spectrum(
        start_ns=used[0].start_ns,
        end_ns=used[-1].end_ns,
        channels=channels,
        frequencies_hz=_lines(segment, rate_hz),
        values=_values(total / averages, scaling),
        scaling=scaling,
        resolution_hz=rate_hz / segment,
        averages=averages,
        speed_rad_s=float(np.sum(speeds * lengths) / np.sum(lengths)),
    )


def read_waterfall(
    stream: RecordedStream, channel: Channel, window_s: float, resolution_hz: float, scaling: Scaling
) -> Waterfall:
    """Spectra of one channel over a recorded stream, one per window; in long recordings over longer windows.

    Raises
    ------
    MachineFileError
        If the window is shorter than one segment, which is 1 / `resolution_hz` long.
    RotorwatchError
        If there are not two stretches so long without a gap.
    """
    segment = _segment(stream, window_s, resolution_hz)
    each_s = max(window_s, (stream.to_ns - stream.from_ns) / 1e9 / _MOST_SPECTRA)
    rows: list[tuple[int, int, float, FloatArray]] = []
    for stretch in stream.stretches((channel,), each_s):
        if stretch.samples.shape[0] < segment:
            continue
        while rows and begins_again(rows[-1][1], stretch.start_ns):
            rows.pop()  # of several runs at the same time the one that was recorded last is shown
        power, count = summed_power(stretch, segment, scaling)
        rows.append((stretch.start_ns, stretch.end_ns, stretch.speed_rad_s, _values(power[0] / count, scaling)))
    if len(rows) < 2:
        raise RotorwatchError(
            f"{stream.place}: {len(rows)} spectra of {stream.name} over {window_s:g} s without a gap, expected at "
            "least 2 for a waterfall; a shorter --window may do"
        )
    starts, ends, speeds, values = zip(*rows, strict=True)
    rate_hz = stream.descriptor.rate_hz
    return Waterfall(
        channel=channel,
        frequencies_hz=_lines(segment, rate_hz),
        start_ns=np.array(starts, dtype=np.int64),
        end_ns=np.array(ends, dtype=np.int64),
        speed_rad_s=np.array(speeds),
        values=np.stack(values),
        scaling=scaling,
        resolution_hz=rate_hz / segment,
    )


def summed_power(stretch: Stretch, segment: int, scaling: Scaling) -> tuple[FloatArray, int]:
    """Power of Hann-windowed segments that overlap by half, each about its mean, summed.

    Parameters
    ----------
    stretch : Stretch
        At least one segment long.
    segment : int
        Samples of a segment.
    scaling : str
        ``peak``: squared amplitude of a sine; ``density``: one-sided power spectral density.

    Returns
    -------
    ndarray, shape (n_channels, segment // 2 + 1)
        Sum over the segments.
    int
        How many segments.
    """
    overlap = segment // 2
    count = (stretch.samples.shape[0] - overlap) // (segment - overlap)
    _, mean = welch(
        stretch.samples,
        stretch.rate_hz,
        window="hann",
        nperseg=segment,
        noverlap=overlap,
        scaling="spectrum" if scaling == "peak" else "density",
        axis=0,
    )
    factor = 2.0 if scaling == "peak" else 1.0  # the spectrum is that of rms values
    return np.asarray(mean.T * factor * count, dtype=np.float64), count


def _values(power: FloatArray, scaling: Scaling) -> FloatArray:
    return np.sqrt(power) if scaling == "peak" else power


def _segment(stream: RecordedStream, window_s: float, resolution_hz: float) -> int:
    """Samples of a segment, even."""
    rate_hz = stream.descriptor.rate_hz
    segment = 2 * round(rate_hz / resolution_hz / 2)
    if segment < 8:
        raise MachineFileError(
            f"--resolution is {resolution_hz:g} Hz, expected at most {rate_hz / 8:g} Hz at {rate_hz:g} samples per "
            "second"
        )
    if window_s * rate_hz < segment - 1e-6:
        raise MachineFileError(
            f"--window is {window_s:g} s, expected at least {1 / resolution_hz:g} s for --resolution "
            f"{resolution_hz:g} Hz"
        )
    return segment


def _lines(segment: int, rate_hz: float) -> FloatArray:
    return np.arange(segment // 2 + 1, dtype=np.float64) * (rate_hz / segment)
