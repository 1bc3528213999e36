"""Spectra of samples: of the latest seconds, and over time or speed.

Segments never reach across a gap. `MachineFileError` is raised if the window is shorter than one segment, which is
1 / `resolution_hz` long, and `RotorwatchError` if too few stretches without a gap hold one.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from models.errors import MachineFileError, RotorwatchError
from models.signals.block import FloatArray
from models.signals.channels import Channel, Quantity
from service.analysis.orbit import in_planes
from service.analysis.recorded import Sampled, begins_again
from service.analysis.revolutions import Excerpt

_MOST_SPECTRA = 400
_MOST_SPEEDS = 120
_MOST_SPEED_RANGE = 0.02
_LEAST_ROTATION_HZ = 0.5
_NYQUIST_OVER_SHOWN = 1.28
"""Analysers show spectra up to the sampling rate divided by 2.56."""

Scaling = Literal["amplitude", "density"]

_SHOWN = {
    "m": ("µm", 1e6),
    "mm": ("µm", 1e3),
    "um": ("µm", 1.0),
    "m/s": ("mm/s", 1e3),
    "m/s2": ("m/s²", 1.0),
    "in/s2": ("in/s²", 1.0),
}
_PEAK_TO_PEAK_QUANTITIES = (Quantity.DISPLACEMENT, Quantity.TILT)
_MEAN_LOBE_LINES = 2
_SHOWN_POWER_SHARE = 0.999
_HIGHEST_ORDER = 4
_ROUND = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)


def unit_shown(channel: Channel) -> tuple[str, float]:
    """Unit in which a channel's values are shown, and the factor to it from the channel's own unit."""
    return _SHOWN.get(channel.unit, (channel.unit, 1.0))


def shown_as(channel: Channel, scaling: Scaling) -> tuple[str, float]:
    """Unit of a spectrum's values as shown, and the factor to it from a peak amplitude or a density in channel units.

    Amplitudes of displacement and tilt are peak to peak (ISO 20816-1: S_p-p), those of velocity, tilt rate and
    acceleration root mean square.
    """
    unit, factor = unit_shown(channel)
    if scaling == "density":
        return (f"({unit})²/Hz" if "/" in unit or "²" in unit else f"{unit}²/Hz"), factor**2
    if channel.quantity in _PEAK_TO_PEAK_QUANTITIES:
        return f"{unit} pp", 2 * factor
    return f"{unit} rms", float(factor / np.sqrt(2))


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Averaged spectra of some channels."""

    # Start of the oldest and end of the newest data.
    start_ns: int
    end_ns: int
    channels: tuple[Channel, ...]
    frequencies_hz: FloatArray  # (n_bins,)
    values: FloatArray  # (n_channels, n_bins), in the units of `shown_as`
    scaling: Scaling  # ``amplitude`` or ``density``
    resolution_hz: float  # spacing of the lines
    averages: int  # segments, overlapping by half, whose power was averaged
    speed_rad_s: float  # mean speed; NaN without a shaft angle

    @property
    def useful_hz(self) -> float:
        """Upper end of the frequency range worth showing, see `_useful_hz`."""
        return max(_useful_hz(self.frequencies_hz, one, self.scaling, self.speed_rad_s) for one in self.values)


@dataclass(frozen=True, slots=True)
class FullSpectrum:
    """Full spectrum: diameters of the forward and reverse circles that add up to the shaft's motion at some locations.

    At each frequency y + jz is the sum of F e^{jωt}, which turns from y to z, and R e^{-jωt}, which turns from z to y.
    The circle in the sense of rotation is forward precession, the other reverse. Their sum is an ellipse with the axes
    2(|F| + |R|) and 2||F| - |R|| (D. E. Bently, C. T. Hatch, "Fundamentals of Rotating Machinery Diagnostics").
    """

    start_ns: int
    end_ns: int
    pairs: tuple[tuple[Channel, Channel], ...]
    # (n_lines,), frequencies, Hz, or orders; positive is forward, or from y to z if the rotation is unknown.
    lines: FloatArray
    values_um: FloatArray  # (n_pairs, n_lines), diameter of each circle, i.e. peak to peak
    orders: bool
    resolution: float
    averages: int
    speed_rad_s: float  # mean speed; NaN without a shaft angle

    @property
    def useful(self) -> float:
        """Upper end of the range of lines worth showing on either side, see `_useful_hz`."""
        ahead = self.lines[self.lines >= 0]
        both = [np.hypot(*(np.interp(one, self.lines, row) for one in (ahead, -ahead))) for row in self.values_um]
        speed_rad_s = 2 * np.pi if self.orders else self.speed_rad_s
        return max(_useful_hz(ahead, one, "amplitude", speed_rad_s) for one in both)


@dataclass(frozen=True, slots=True)
class Waterfall:
    """Spectra of one channel, one after the other."""

    channel: Channel
    frequencies_hz: FloatArray  # (n_bins,)
    # (n_spectra,), start and end of the data of each.
    start_ns: npt.NDArray[np.int64]
    end_ns: npt.NDArray[np.int64]
    speed_rad_s: FloatArray  # (n_spectra,), mean speed; NaN without a shaft angle
    values: FloatArray  # (n_spectra, n_bins), in the units of `shown_as`
    scaling: Scaling  # ``amplitude`` or ``density``
    resolution_hz: float

    @property
    def useful_hz(self) -> float:
        """Upper end of the frequency range worth showing, see `_useful_hz`."""
        fastest = float(np.max(np.abs(self.speed_rad_s)))
        return _useful_hz(self.frequencies_hz, self.values.max(axis=0), self.scaling, fastest)

    def over_speed(self) -> tuple[FloatArray, FloatArray]:
        """Mean spectra in n classes of speed: class edges, rad/s, shape (n + 1,), and spectra, shape (n, n_bins).

        Raises
        ------
        RotorwatchError
            Without a shaft angle, or if the speed does not change.
        """
        speed = np.abs(self.speed_rad_s)
        if not np.isfinite(speed).all():
            raise RotorwatchError("--axis speed needs the shaft angle (keyphasor), which is not measured")
        if text := steady(speed):
            raise RotorwatchError(f"--axis speed needs a run-up or coast-down: {text}; --axis time shows it")
        slowest, fastest = float(speed.min()), float(speed.max())
        count = min(_MOST_SPEEDS, max(2, speed.size // 2))
        # Classes are centred on the slowest and the fastest speed, at which a machine stays longest.
        half = (fastest - slowest) / (count - 1) / 2
        edges = np.linspace(slowest - half, fastest + half, count + 1)
        place = np.clip(np.searchsorted(edges, speed, side="right") - 1, 0, count - 1)
        mean = np.full((count, self.frequencies_hz.size), np.nan)
        for number in range(count):
            if (place == number).any():
                of = self.values[place == number]
                mean[number] = of.mean(axis=0) if self.scaling == "density" else np.sqrt(np.mean(of**2, axis=0))
        return edges, mean


def steady(speed_rad_s: FloatArray) -> str:
    """Message that the speed stays nearly the same; empty if it does not."""
    slowest, fastest = (float(one(np.abs(speed_rad_s))) for one in (np.min, np.max))
    if fastest - slowest >= _MOST_SPEED_RANGE * max(fastest, 1e-9):
        return ""
    low, high = f"{slowest * 30 / np.pi:.4g}", f"{fastest * 30 / np.pi:.4g}"
    return f"the speed stays {f'at {low}' if low == high else f'between {low} and {high}'} rpm"


def read_spectrum(
    data: Sampled, channels: tuple[Channel, ...], window_s: float, resolution_hz: float, scaling: Scaling
) -> Spectrum:
    """Spectra of the latest `window_s` of a recorded stream."""
    segment = _segment(data, window_s, resolution_hz)
    used, speed_rad_s = _used(data, channels, window_s, segment)
    rate_hz = data.descriptor.rate_hz
    powers, averages = _mean_power((stretch.samples for stretch in used), rate_hz, segment, scaling)
    return Spectrum(
        start_ns=used[0].start_ns,
        end_ns=used[-1].end_ns,
        channels=channels,
        frequencies_hz=_lines(segment, rate_hz),
        values=np.stack([_values(power, one, scaling) for power, one in zip(powers, channels, strict=True)]),
        scaling=scaling,
        resolution_hz=rate_hz / segment,
        averages=averages,
        speed_rad_s=speed_rad_s,
    )


def _used(data: Sampled, channels: Sequence[Channel], window_s: float, segment: int) -> tuple[list[Excerpt], float]:
    """Stretches within the latest `window_s` that hold at least one segment, and their mean speed."""
    found = data.latest(channels, window_s)
    used = [stretch for stretch in found if stretch.samples.shape[0] >= segment]
    if not used:
        longest_s = max((stretch.length_s for stretch in found), default=0.0)
        needed_s = segment / data.descriptor.rate_hz
        raise RotorwatchError(
            f"{data.place}: a spectrum with --resolution {1 / needed_s:g} Hz needs {needed_s:g} s without a gap, the "
            f"longest stretch of {data.name} in the last {window_s:g} s is {longest_s:.3g} s"
        )
    lengths_s = [stretch.length_s for stretch in used]
    return used, float(np.average([stretch.speed_rad_s for stretch in used], weights=lengths_s))


def read_full_spectrum(
    data: Sampled, pairs: Sequence[tuple[Channel, Channel]], window_s: float, resolution_hz: float, *, orders: bool
) -> FullSpectrum:
    """Full spectra of the latest `window_s` that were recorded; RotorwatchError if the shaft does not turn.

    Parameters
    ----------
    orders : bool
        Order spectrum: samples are resampled at equal shaft angles, so that a changing speed does not smear the lines;
        MachineFileError without a shaft angle.
    """
    if orders and not data.has_angle:
        raise MachineFileError(f"{data.place}: --axis orders needs the shaft angle (keyphasor), which is not measured")
    segment = _segment(data, window_s, resolution_hz)
    used, speed_rad_s = _used(data, [channel for pair in pairs for channel in pair], window_s, segment)
    start_ns, end_ns = used[0].start_ns, used[-1].end_ns
    if orders:
        turns_hz = abs(speed_rad_s) / (2 * np.pi)
        if turns_hz < _LEAST_ROTATION_HZ:
            raise RotorwatchError(f"{data.place}: --axis orders needs a shaft that turns, and it stands still")
        each = int(np.ceil(data.descriptor.rate_hz / turns_hz))
        used = [_at_equal_angles(stretch, each) for stretch in used]
        segment = 2 * round(each * max(1, round(turns_hz / resolution_hz)) / 2)
        used = [stretch for stretch in used if stretch.samples.shape[0] >= segment]
        if not used:
            raise RotorwatchError(f"{data.place}: the shaft does not turn {segment / each:.0f} times in any stretch")
    rate_hz, motions = used[0].rate_hz, (in_planes(stretch.samples, pairs) for stretch in used)
    powers, averages = _mean_power((y + 1j * z for y, z in motions), rate_hz, segment, "amplitude")
    lines = np.asarray((-1 if speed_rad_s < 0 else 1) * np.fft.fftfreq(segment, 1 / rate_hz), dtype=np.float64)
    order = np.argsort(lines)
    return FullSpectrum(
        start_ns=start_ns,
        end_ns=end_ns,
        pairs=tuple(pairs),
        lines=lines[order],
        values_um=2 * np.sqrt(powers[:, order]),
        orders=orders,
        resolution=rate_hz / segment,
        averages=averages,
        speed_rad_s=speed_rad_s,
    )


def _at_equal_angles(stretch: Excerpt, each: int) -> Excerpt:
    """Resample to `each` samples per revolution; the result's rate, in samples per revolution, is stated as Hz."""
    assert stretch.angle_rad is not None  # noqa: S101  # the caller has checked that there is one
    turns = np.unwrap(stretch.angle_rad) / (2 * np.pi)
    turned = np.maximum.accumulate(turns if turns[-1] >= turns[0] else -turns)
    at = np.arange(np.ceil(turned[0] * each), np.floor(turned[-1] * each) + 1) / each
    samples = np.stack([np.interp(at, turned, column) for column in stretch.samples.T], axis=1)
    return Excerpt(stretch.start_ns, float(each), samples, None)


def read_waterfall(
    data: Sampled, channel: Channel, window_s: float, resolution_hz: float, scaling: Scaling
) -> Waterfall:
    """Spectra of one channel, one per window of `window_s`; in long recordings windows are longer."""
    segment = _segment(data, window_s, resolution_hz)
    each_s = max(window_s, (data.to_ns - data.from_ns) / 1e9 / _MOST_SPECTRA)
    rows: list[tuple[int, int, float, FloatArray]] = []
    for stretch in data.stretches((channel,), each_s):
        if stretch.samples.shape[0] < segment:
            continue
        while rows and begins_again(rows[-1][1], stretch.start_ns):
            rows.pop()  # if runs overlap in time, the one recorded last is shown
        (power,), _ = _mean_power([stretch.samples], stretch.rate_hz, segment, scaling)
        rows.append((stretch.start_ns, stretch.end_ns, stretch.speed_rad_s, _values(power, channel, scaling)))
    if len(rows) < 2:
        raise RotorwatchError(
            f"{data.place}: {len(rows)} spectra of {data.name} over {window_s:g} s without a gap, expected at "
            "least 2 for a waterfall; a shorter --window may do"
        )
    starts, ends, speeds, values = zip(*rows, strict=True)
    rate_hz = data.descriptor.rate_hz
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


def _mean_power(
    pieces: Iterable[npt.NDArray[np.inexact]], rate_hz: float, segment: int, scaling: Scaling
) -> tuple[FloatArray, int]:
    """Mean power of Hann-windowed, half-overlapping segments, each with its mean removed, and the number of segments.

    With scaling ``amplitude``, a sine gives its squared amplitude, else the result is the one-sided power spectral
    density, shape (n_channels, segment // 2 + 1). Complex samples give shape (n_channels, segment), in the order of
    `numpy.fft.fft`. Every piece must hold at least one segment.
    """
    from scipy.signal import welch  # noqa: PLC0415  # slow to import; only for these spectra

    total, averages, overlap = np.zeros(()), 0, segment // 2
    for samples in pieces:
        count = (samples.shape[0] - overlap) // (segment - overlap)
        _, mean = welch(
            samples,
            rate_hz,
            window="hann",
            nperseg=segment,
            noverlap=overlap,
            scaling="spectrum" if scaling == "amplitude" else "density",
            axis=0,
        )
        # The one-sided spectrum gives squared rms values; the two-sided one of complex samples squared circle radii.
        factor = 2.0 if scaling == "amplitude" and not np.iscomplexobj(samples) else 1.0
        total, averages = total + mean.T * factor * count, averages + count
    return np.asarray(total / averages, dtype=np.float64), averages


def lowest_hz(resolution_hz: float) -> float:
    """Lowest frequency that the mean does not reach through the main lobe of the Hann window."""
    return _MEAN_LOBE_LINES * resolution_hz


def _useful_hz(frequencies_hz: FloatArray, values: FloatArray, scaling: Scaling, speed_rad_s: float) -> float:
    """Upper end of the range worth showing: 4x, or 1.5 times the frequency below which 99.9 % of the power lies.

    The larger of both is rounded up to a round number.
    """
    resolved = frequencies_hz >= lowest_hz(float(frequencies_hz[1]))
    power = np.cumsum((values if scaling == "density" else values**2) * resolved)
    reached_hz = float(frequencies_hz[np.searchsorted(power, _SHOWN_POWER_SHARE * power[-1])])
    turns_hz = abs(speed_rad_s) / (2 * np.pi) if np.isfinite(speed_rad_s) else 0.0
    wanted_hz = max(1.5 * reached_hz, _HIGHEST_ORDER * turns_hz, 8 * float(frequencies_hz[1]))
    decade = 10.0 ** np.floor(np.log10(wanted_hz))
    rounded_hz = next((step * decade for step in _ROUND if step * decade >= wanted_hz * (1 - 1e-3)), 10 * decade)
    return min(float(rounded_hz), float(frequencies_hz[-1]) / _NYQUIST_OVER_SHOWN)


def _values(power: FloatArray, channel: Channel, scaling: Scaling) -> FloatArray:
    _, factor = shown_as(channel, scaling)
    return factor * (np.sqrt(power) if scaling == "amplitude" else power)


def _segment(data: Sampled, window_s: float, resolution_hz: float) -> int:
    """Number of samples per segment, even."""
    rate_hz = data.descriptor.rate_hz
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
