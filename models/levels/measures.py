"""Levels of a channel in one hop and in one window: overall, at orders of running speed, shape of the waveform.

========== ======================================================= ===================================================
measure    displacement (shaft)                                    velocity, acceleration (casing)
========== ======================================================= ===================================================
overall    peak to peak, mean of the hops (ISO 20816-1, S_p-p)     velocity: rms in the band; acceleration: rms
velocity                                                           of acceleration: rms velocity in the band, integrated
                                                                   in the frequency domain (ISO 20816-1)
s_max      largest distance from the mean position of the orbit
           (ISO 20816-1), at its first channel
peak       largest deviation from the mean: a true peak            the same
x_half, x1 peak to peak at half, once, twice and three times       rms there
x2, x3     running speed (ISO 13373-2)
not_x1     rms of what is not at running speed                     the same
mean       mean position: the gap (API 670)
crest      peak over rms                                           the same
kurtosis   fourth moment over the square of the second: 3 for      the same
           Gaussian vibration (ISO 13373-3)
growth     the band of a twelfth of an octave that has grown most, the same
           times the reference (`models.levels.bands`)
high                                                               of acceleration: rms above 1 kHz (ISO 13373-3)
envelope                                                           of acceleration: rms of the envelope of that, about
                                                                   its mean (ISO 13373-3, VDI 3832)
========== ======================================================= ===================================================

All in SI units here. A level of random vibration scatters: over a time T with bandwidth B an rms has a relative
standard error of 1/(2√(BT)) (J. S. Bendat, A. G. Piersol, "Random Data", 4th ed., chapter 8).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import scipy  # its sub-packages are loaded when they are first used

from models.checkpoint import checked
from models.levels.bands import ERRORS, NEIGHBOURHOOD, NYQUIST_PART, BandLevels, band_edges
from models.levels.kurtosis import random_kurtosis, random_share, swell
from models.levels.orders import ORDERS, Spectrum, hann_taper, order_vectors, without_orders
from models.signals.block import BoolArray, ComplexArray, FloatArray, IndexArray, SampleArray
from models.signals.channels import LEAST_APART_DEG, Channel, Quantity, apart_deg
from models.signals.waveform import Waveform

COMPARED = ("overall", "velocity", "s_max", "x1", "x2", "high", "envelope")
"""Measures that are compared with a reference."""

_SUMS = (
    "mean", "peak", "peak_to_peak", "fourth", "radius", "contact", "swell", "mean_square",
    "velocity_square", "high_square", "envelope_square",
)  # fmt: skip
CONTACT = _SUMS.index("contact")
"""Row of `HopLevels.sums` that has the contact statistics."""
_SQUARES = slice(7, None)  # mean squares, whose roots are shown
_HIGH_HZ = 1000.0
_HANN_BINS = 1.5
"""Bins of a Hann-tapered spectrum that carry as much information as one of an untapered spectrum."""
STANDS_RAD_S = 2 * np.pi * 0.5
"""Speed, rad/s, up to which a shaft counts as standing still."""
_LEAST_HOPS = 4  # fewest from which the scatter of a line is estimated

_Number = TypeVar("_Number", np.float64, np.complex128)


@dataclass(frozen=True)
class LevelPlan:
    """Which levels a machine's channels have."""

    rate_hz: float
    quantities: tuple[Quantity, ...]  # of the columns that levels are taken of
    band_hz: tuple[float, float]  # of velocities, from and to
    pairs: tuple[tuple[int, int], ...]  # columns of two displacements of one place
    # (n,), run-out, which is subtracted from 1x: q of x = Re{q e^{jθ}} at slow roll, for an angle that grows.
    runout: ComplexArray | None = None
    lines: bool = False  # whether the strongest bin of every narrow band is wanted
    # Columns examined for a contact: `pairs`, and velocities of the rotor at a place without one. Each with the cosine
    # of the angle between the axes: 0 at right angles, as nearly all are.
    contacts: tuple[tuple[int, int, float], ...] = ()

    @property
    def high_hz(self) -> tuple[float, float] | None:
        """The high-frequency band of accelerometers; None where the sampling rate allows none."""
        end_hz = NYQUIST_PART * self.rate_hz / 2
        return (_HIGH_HZ, end_hz) if end_hz >= 2 * _HIGH_HZ else None

    @cached_property
    def displacements(self) -> BoolArray:
        """Which columns are displacements or tilts."""
        return np.isin(self.quantities, (Quantity.DISPLACEMENT, Quantity.TILT))

    @cached_property
    def velocities(self) -> BoolArray:
        """Which columns are velocities."""
        return np.isin(self.quantities, Quantity.VELOCITY)

    @cached_property
    def accelerations(self) -> BoolArray:
        """Which columns are accelerations."""
        return np.isin(self.quantities, Quantity.ACCELERATION)

    @cached_property
    def shown(self) -> FloatArray:
        """Factor from an amplitude to the level shown: peak to peak of displacements, rms of others."""
        return np.where(self.displacements, 2.0, np.sqrt(0.5))


def level_plan(
    channels: Sequence[Channel],
    rate_hz: float,
    band_hz: tuple[float, float],
    runout: ComplexArray | None = None,
    *,
    lines: bool = False,
) -> LevelPlan:
    """Plan the levels of a machine's channels, none of them a shaft angle, in the order of the columns.

    The upper end of the band of velocities is limited by the sampling rate.
    """
    pairs = _pairs(channels, Quantity.DISPLACEMENT)
    unseen = {"bearing", "disc"} - {channels[first].location for first, _ in pairs}
    moving = [one for one in _pairs(channels, Quantity.VELOCITY) if channels[one[0]].location in unseen]
    contacts = tuple((first, second, _skew(channels[first], channels[second])) for first, second in pairs + moving)
    quantities, end_hz = tuple(one.quantity for one in channels), min(band_hz[1], NYQUIST_PART * rate_hz / 2)
    runout = runout if runout is not None and np.any(runout) else None
    return LevelPlan(rate_hz, quantities, (band_hz[0], end_hz), tuple(pairs), runout, lines, contacts)


def _pairs(channels: Sequence[Channel], quantity: Quantity) -> list[tuple[int, int]]:
    own = [(n, one) for n, one in enumerate(channels) if one.quantity is quantity]
    at = {(one.location, one.direction): n for n, one in own if one.angle_deg is None}
    pairs = [(at[place, "y"], at[place, "z"]) for place, way in at if way == "y" and (place, "z") in at]
    for place in dict.fromkeys(one.location for _, one in own):
        angled = [n for n, one in own if one.location == place and one.angle_deg is not None]
        if len(angled) == 2 and apart_deg(*(channels[n] for n in angled)) >= LEAST_APART_DEG:
            pairs.append((angled[0], angled[1]))
    return pairs


def _skew(first: Channel, second: Channel) -> float:
    (a, b), (c, d) = first.axis, second.axis
    cosine = a * c + b * d
    return cosine if abs(cosine) > 1e-12 else 0.0


@dataclass(frozen=True, slots=True)
class HopLevels:
    """Contribution of one hop to the levels of a window."""

    n_samples: int
    # (11, n): mean, largest deviation from it, peak to peak, fourth moment, at the first channel of a pair the largest
    # distance from the mean position; at the two of a pair the two numbers of `models.levels.contact`, where it is
    # looked for; `swell`, mean square about the mean, mean square velocity in the band, mean squares of the
    # high-frequency band and of its envelope about its mean. NaN where a quantity has none.
    sums: FloatArray
    # (4, n), q of x = Re{q e^{jkθ}} for the orders k of `ORDERS`; NaN without a rotation. At half running speed its
    # phase means nothing, because the shaft angle is known only modulo a turn.
    orders: ComplexArray
    bands: FloatArray  # (n_bands, n), mean squares in the bands of `models.levels.bands`
    lines: FloatArray  # (n_bands, n), mean square of each band's strongest bin; no rows if lines are not wanted

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything as named arrays."""
        arrays = {name: getattr(self, name) for name in ("sums", "orders", "bands", "lines")}
        return {"n_samples": np.array(self.n_samples, dtype=np.int64), **arrays}

    @classmethod
    def restored(cls, arrays: Mapping[str, np.ndarray]) -> "HopLevels":
        """Levels from what `checkpoint` gave, see `models.checkpoint`."""
        n_samples = int(checked(arrays, "n_samples", np.int64, ()))
        sums = checked(arrays, "sums", np.float64, (len(_SUMS), None))
        orders = checked(arrays, "orders", np.complex128, (len(ORDERS), sums.shape[1]))
        bands, lines = (checked(arrays, name, np.float64, (None, sums.shape[1])) for name in ("bands", "lines"))
        return cls(n_samples, sums, orders, bands, lines)


def hop_levels(
    plan: LevelPlan,
    waveform: Waveform,
    deviations: FloatArray,
    angle_rad: FloatArray | None,
    spectrum: Spectrum | None = None,
) -> HopLevels:
    """Take the levels of one hop.

    Parameters
    ----------
    waveform : Waveform
        Of the plan's columns first; others may follow.
    deviations : ndarray, shape (n, n_samples)
        From the mean, SI units, see `waveform_of`.
    angle_rad : ndarray, shape (n_samples,), or None
        Shaft angle, or one that turns with it from an unknown zero.
    spectrum : ndarray of complex, shape (n, n_samples // 2 + 1), optional
        Fourier transform of the Hann-tapered deviations, if it is known already, scaled so that its squared magnitude
        is the two-sided power spectral density per Hz; otherwise it is computed here.
    """
    x = deviations[: len(plan.quantities)]
    n, n_samples = x.shape
    mean, rms, low, high = (one[:n] for one in (waveform.mean, waveform.rms, waveform.minimum, waveform.maximum))
    square, peak = x * x, np.maximum(high - mean, mean - low)
    sums = np.full((len(_SUMS), n), np.nan)
    sums[:4] = mean, peak, high - low, np.vecdot(square, square) / n_samples
    sums[6], sums[7] = 0.0, rms**2
    # Strong lines must not leak into the low end of a band, where integration would magnify them.
    taper, scale = hann_taper(n_samples)
    # Relative to the peak, single precision is enough, and quicker.
    unit = amplitude = np.where(peak > 0, peak, 1.0)
    if spectrum is None:
        tapered = np.multiply(x, (1 / unit)[:, None], out=np.empty(x.shape, np.float32), casting="same_kind")
        tapered *= taper
        spectrum = scipy.fft.rfft(tapered, axis=1)
    else:
        amplitude = np.full(n, np.sqrt(2 * plan.rate_hz / (n_samples * scale)))
    parts = spectrum.view(spectrum.real.dtype)[:, : int(NYQUIST_PART * n_samples) + 4]  # real, imaginary, real ...
    parts = parts * parts
    cuts, edges, (first, last) = _band_cuts(n_samples, plan.rate_hz, plan.band_hz)
    power = (scale * amplitude**2)[:, None]
    between = power * np.add.reduceat(parts[:, : 2 * cuts[-1]], 2 * cuts[:-1], axis=1)
    bands = np.add.reduceat(between[:, : edges[-1]], edges[:-1], axis=1)
    sums[8, plan.velocities] = np.add.reduce(between[:, first:last], axis=1)[plan.velocities]
    if (accelerations := plan.accelerations).any():
        sums[8:, accelerations] = power[accelerations, 0] * _acceleration_squares(
            plan, spectrum[accelerations], parts[accelerations], slice(cuts[first], cuts[last]), n_samples
        )
    for y, z, skew in plan.contacts[: len(plan.pairs)]:
        distance = square[y] + square[z]
        if skew:
            distance -= 2 * skew * x[y] * x[z]
        sums[4, y] = np.sqrt(distance.max() / (1 - skew**2))
    orders = unit * order_vectors(x, unit, spectrum, amplitude, angle_rad)
    if angle_rad is not None:
        sums[6] = swell(without_orders(x, orders, angle_rad))
    lines = np.empty((n, 0))
    if plan.lines:
        bins = parts[:, : 2 * cuts[-1] : 2] + parts[:, 1 : 2 * cuts[-1] : 2]
        lines = power * np.maximum.reduceat(bins[:, : cuts[edges[-1]]], cuts[edges[:-1]], axis=1)
    return HopLevels(n_samples, sums, orders, np.ascontiguousarray(bands.T), np.ascontiguousarray(lines.T))


@lru_cache(maxsize=8)
def _band_cuts(
    n_samples: int, rate_hz: float, band_hz: tuple[float, float]
) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Bins at which any band begins or ends; their indices for the edges of narrow bands, and for the velocity band."""
    edges = band_edges(n_samples)
    low, high = (round(edge_hz / (rate_hz / n_samples)) for edge_hz in band_hz)
    band = np.array([min(max(low, 1), high + 1), high + 1])
    cuts = np.union1d(edges, band)
    return cuts, cuts.searchsorted(edges), cuts.searchsorted(band)


def _acceleration_squares(
    plan: LevelPlan, spectrum: Spectrum, parts: SampleArray, band: slice, n_samples: int
) -> FloatArray:
    """Squares for accelerations, shape (3, n): velocity in the band, the high-frequency band, and its envelope.

    They become mean squares with the factor that turns squared magnitudes of the spectrum's bins into mean squares.
    """
    step_hz = plan.rate_hz / n_samples
    found = np.full((3, len(spectrum)), np.nan)
    omega = 2 * np.pi * step_hz * np.arange(band.start, band.stop)
    found[0] = parts[:, 2 * band.start : 2 * band.stop] @ np.repeat(omega**-2, 2)
    if plan.high_hz is not None:
        taper, scale = hann_taper(n_samples)
        first, last = (round(edge / step_hz) for edge in plan.high_hz)
        high = spectrum[:, first : last + 1]
        found[1] = np.sum(np.abs(high) ** 2, axis=1)
        # The band shifted to zero frequency: its magnitude is the envelope, a sample for each of its bins.
        envelope = np.abs(scipy.fft.ifft(high, axis=1)) * (2 * high.shape[1] / n_samples)
        weights = np.interp(np.arange(high.shape[1]) / high.shape[1], np.arange(n_samples) / n_samples, taper)
        level = envelope.sum(axis=1) / weights.sum()  # the taper is on the envelope too: less a tapered mean
        found[2] = np.sum((envelope - level[:, None] * weights) ** 2, axis=1) / np.sum(weights**2) / scale
    return found


@dataclass(frozen=True, slots=True)
class WindowLevels:
    """Levels of one window, SI units."""

    values: Mapping[str, FloatArray]  # (n,) by measure; NaN where a quantity has none, or the rotation is not known
    # (n,), standard errors, from the scatter of the hops, of the measures in `COMPARED`; empty if not asked for.
    errors: Mapping[str, FloatArray]
    vectors: ComplexArray | None  # (4, n), mean of q of the hops at the orders, with a phase reference
    bands: BandLevels
    speed_rad_s: float | None = None  # mean; None where it is not known
    hops: int = 1
    lines: FloatArray | None = None  # (n_hops, n_bands, n), mean squares of each band's strongest bin, if looked for
    speeds_rad_s: FloatArray | None = None  # (n_hops,), NaN where it is not known
    # Of each hop: second and fourth moments, whole orders (all for `random_kurtosis`), mean squares in the bands.
    moments: tuple[FloatArray, FloatArray, ComplexArray, FloatArray] | None = None
    contact: FloatArray | None = None  # (n_hops, n), see `models.levels.contact`
    settled: BoolArray | None = None  # (n_hops,), whether the shaft is known to have turned at one speed

    def without(self, columns: Sequence[int], pairs: Sequence[tuple[int, int]]) -> "WindowLevels":
        """Copy these levels with NaN for some channels, and for levels of the pairs of displacements they are in.

        The copy serves to learn a reference and to detect faults; errors, vectors and lines stay.
        """
        if not columns:
            return self
        gone = np.isin(np.arange(self.bands.rms.shape[1]), columns)
        lone = gone.copy()
        for pair in pairs:
            lone[[*pair]] |= gone[[*pair]].any()
        bands = replace(self.bands, rms=np.where(gone, np.nan, self.bands.rms))
        values = {name: np.where(lone if name == "s_max" else gone, np.nan, one) for name, one in self.values.items()}
        moments = self.moments
        if moments is not None:
            square, fourth, orders, in_bands = moments
            moments = square, np.where(gone, np.nan, fourth), orders, np.where(gone, np.nan, in_bands)
        contact = None if self.contact is None else np.where(lone, np.nan, self.contact)
        return replace(self, values=values, bands=bands, moments=moments, contact=contact)

    @property
    def unsteady(self) -> float:
        """Range of the hops' speeds, over their mean; infinite if one is unknown or the shaft stands in a hop."""
        speeds = self.speeds_rad_s
        if not self.speed_rad_s or speeds is None or not np.all(np.abs(speeds) > STANDS_RAD_S):
            return math.inf
        return float(np.ptp(speeds)) / abs(self.speed_rad_s)

    @property
    def line_parts(self) -> FloatArray | None:
        """Share of each band's power that the strongest bin of a hop has; shape (n_bands, n)."""
        if self.lines is None or self.moments is None:
            return None
        return np.asarray(_mean(self.lines) / np.maximum(_mean(self.moments[3]), np.finfo(float).tiny))

    @property
    def random_kurtosis(self) -> FloatArray | None:
        """See `models.levels.kurtosis`; shape (n_hops, n)."""
        return None if self.moments is None else random_kurtosis(*self.moments[:3])

    @property
    def random_share(self) -> FloatArray | None:
        """See `models.levels.kurtosis`; shape (n_hops, n)."""
        return None if self.moments is None else random_share(self.moments[0], self.moments[2])

    @property
    def hidden_twice(self) -> BoolArray | None:
        """Whether the random vibration at its present level explains the 2x, shape (n,); None if that is not known.

        With a phase reference that level follows from the steps of 2x between hops, otherwise from the bands around it.
        """
        if self.moments is None or self.speed_rad_s is None or self.hops < _LEAST_HOPS:
            return None
        known = self.moments[2][~np.isnan(self.moments[2][:, 1]).any(axis=1), 1]
        if self.vectors is not None:
            if len(known) < _LEAST_HOPS:
                return np.full(known.shape[1], True)
            steps = np.abs(np.diff(known, axis=0)) ** 2
            # Where a line begins, it makes one of the steps. Where the speed changes, 2x passes resonances, in which
            # the noise of a few hops exceeds that of all others. The noise may have grown within the window.
            typical = np.maximum(*(np.median(some, axis=0) for some in (steps, steps[len(steps) // 2 :])))
            power = _mean(steps) if self.unsteady > NEIGHBOURHOOD else typical / math.log(2)
            # One hop in which something hit the machine, or after a gap, is no state of it.
            others = (known.sum(axis=0) - known[np.abs(known).argmax(axis=0), range(known.shape[1])]) / (len(known) - 1)
            least = np.minimum(np.abs(self.vectors[2]), np.abs(others))
            return np.asarray(least < ERRORS * np.sqrt(power / (2 * len(known))))
        at = int(np.searchsorted(self.bands.edges_hz, abs(self.speed_rad_s) / np.pi)) - 1
        if not 0 <= at < len(self.bands.rms) or not len(known):
            return None
        twice, around = _mean(np.abs(known) ** 2) / 2, slice(max(0, at - 1), at + 2)
        rest = np.maximum((self.bands.rms[around] ** 2).sum(axis=0) - twice, 0.0)
        cells = self.bands.freedom[around].sum() / (2 * self.hops)
        return np.asarray(twice < rest / cells * (1 + ERRORS / np.sqrt(len(known))))


def window_levels(
    plan: LevelPlan, hops: Sequence[HopLevels], speeds_rad_s: FloatArray, *, phase_reference: bool, errors: bool = True
) -> WindowLevels:
    """Combine the levels of hops into those of a window.

    Parameters
    ----------
    speeds_rad_s : ndarray, shape (n_hops,)
        NaN where the rotation is not known.
    phase_reference : bool
        Whether the angle is the shaft's own, so that the vectors of the hops can be added up.
    errors : bool
        Whether standard errors are wanted; only learning a reference needs them.
    """
    count, n = len(hops), len(plan.quantities)
    sums = np.concatenate([hop.sums for hop in hops]).reshape(count, len(_SUMS), n)
    in_bands = np.concatenate([hop.bands for hop in hops]).reshape(count, -1, n)
    every_order = np.concatenate([hop.orders for hop in hops]).reshape(count, len(ORDERS), n)
    turning = np.abs(speeds_rad_s) > STANDS_RAD_S  # False where it is not known
    orders = every_order if turning.all() else every_order[turning]
    speed_rad_s, vectors, amplitudes = None, None, np.full((len(ORDERS), n), np.nan)
    if len(orders):
        speed_rad_s = float(_mean(speeds_rad_s[turning]))
        amplitudes = np.sqrt(_mean((orders * orders.conj()).real))
        if phase_reference:
            vectors = _mean(orders)
            amplitudes[1:] = np.abs(vectors[1:])
    scatter: dict[str, FloatArray] = {}
    if errors:
        root = np.sqrt(max(1, count - 1))
        by_hop = _compared(plan, sums.swapaxes(0, 1))
        scatter = {name: each.std(axis=0) / root for name, each in by_hop.items()}
        scatter |= dict(zip(ORDERS, plan.shown * _order_errors(orders, vectors), strict=True))
    measured_1x = amplitudes[1]
    if plan.runout is not None and vectors is not None and speed_rad_s is not None:
        vectors, amplitudes = vectors.copy(), amplitudes.copy()
        vectors[1] -= plan.runout if speed_rad_s >= 0 else plan.runout.conj()
        amplitudes[1] = np.where(plan.runout == 0, amplitudes[1], np.abs(vectors[1]))
    # Peak to peak is the mean of the hops, an rms that of the whole window.
    average = _mean(sums)
    square = average[7] + _mean((sums[:, 0] - average[0]) ** 2)
    peak = np.maximum.reduce(sums[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        values = {
            **_compared(plan, average),
            **dict(zip(ORDERS, plan.shown * amplitudes, strict=True)),
            "peak": peak,
            "not_x1": np.sqrt(np.maximum(square - measured_1x**2 / 2, 0.0)),
            "mean": np.where(plan.displacements, average[0], np.nan),
            "crest": peak / np.sqrt(square),
            "kurtosis": average[3] / average[7] ** 2,
        }
    edges_hz, freedom = _band_grid(plan.rate_hz, hops[0].n_samples, count)
    error = np.sqrt(in_bands).std(axis=0) / np.sqrt(max(1, count - 1)) if errors else None
    bands = BandLevels(edges_hz, np.sqrt(_mean(in_bands)), error, freedom)
    lines = np.stack([hop.lines for hop in hops]) if plan.lines else None
    moments = sums[:, 7], sums[:, 3] - sums[:, 6], every_order[:, 1:], in_bands
    contact = sums[:, CONTACT]
    return WindowLevels(values, scatter, vectors, bands, speed_rad_s, count, lines, speeds_rad_s, moments, contact)


def _mean(values: npt.NDArray[_Number]) -> npt.NDArray[_Number]:
    """Mean over the hops; NumPy's own takes three times as long for such small arrays."""
    total: npt.NDArray[_Number] = np.add.reduce(values, axis=0)
    return total / len(values)


def _compared(plan: LevelPlan, sums: FloatArray) -> dict[str, FloatArray]:
    """Measures in `COMPARED` without the orders, from `HopLevels.sums` of each hop or their mean over a window."""
    rms, velocity, high, envelope = np.sqrt(sums[_SQUARES])
    return {
        "overall": np.where(plan.displacements, sums[2], np.where(plan.accelerations, rms, velocity)),
        "velocity": np.where(plan.accelerations, velocity, np.nan),
        "s_max": sums[4],
        "high": high,
        "envelope": envelope,
    }


def _order_errors(orders: ComplexArray, vectors: ComplexArray | None) -> FloatArray:
    """Standard errors of the amplitudes at the orders, shape (4, n)."""
    count, *shape = orders.shape
    if not count:
        return np.full(shape, np.nan)
    scatter = np.abs(orders).std(axis=0)
    if vectors is not None:
        scatter[1:] = np.sqrt((np.abs(orders - vectors) ** 2).mean(axis=0)[1:])
    return np.asarray(scatter / np.sqrt(max(1, count - 1)), dtype=np.float64)


@lru_cache(maxsize=64)
def _band_grid(rate_hz: float, n_samples: int, count: int) -> tuple[FloatArray, FloatArray]:
    """Edges of the bands, Hz, and degrees of freedom of mean squares in them, for windows of `count` hops."""
    edges = band_edges(n_samples) - 0.5  # halfway between bins
    edges_hz = np.asarray(edges * (rate_hz / n_samples), dtype=np.float64)
    freedom = 2 * count * np.maximum(1.0, np.diff(edges) / _HANN_BINS)
    edges_hz.flags.writeable = freedom.flags.writeable = False
    return edges_hz, freedom
