"""Gain and delay between two sensors of one motion: v = jωx, whatever the machine does.

Sensor noise makes |S_xv| / S_xx too small and S_vv / |S_xv| too large. The signals w at the machine's other places
contain neither noise, so they serve as instrumental variables: h = S_wv / S_wx. Without any other place, the two biased
ratios bracket the gain. The rotation-synchronous vectors add one more frequency, with little noise.

AC-coupled sensors and amplifiers, including all that measure a rate on a casing, lead. Well above the corner of the
high-pass the lead in phase falls as 1/frequency, whereas the lag of a delay grows in proportion to the frequency.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from models.diagnosis.window.motion import MotionPair, motion_pairs, pair_bands
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import BoolArray, ComplexArray, FloatArray, IndexArray

LONGEST_DELAY_S = 0.02  # longest delay searched for
_DELAY_STEP_S = 2.5e-4
# The shortest delay with at least this part of the best fit is taken: narrow-band signals fit again a period later.
_AS_GOOD = 0.98
# The 1x vectors are rejected if they move gain or delay by more than so many standard errors: run-out falsifies them,
# and so does cross-axis sensitivity, as the other plane's 1x comes a quarter turn later.
_MOST_LINE_ERRORS = 5.0
_RUNOUT = 0.03  # least change of the log gain to reject them, and largest standard error without them
_TOLD_APART = 2 * math.log(1e3)  # least fall of χ² with which a model of the phases is preferred: 1000 times likelier
_MOST_ACROSS = 0.15  # largest cross-axis sensitivity that is corrected for: more has another cause
_PLANES, _RATES = str.maketrans("yz", "zy"), {"": 0, "dot": 1, "ddot": 2}
_ONE_SPEED, _LEAKS = 0.01, 2  # relative change of speed from which on a line has moved; bins into which it leaks
_UNSURE = 1e3  # factor on the error of a hop that does not count
_HANN_LOSS = 0.95  # part of the data's information that half-overlapping Hann segments keep
_FLOOR = 1e-10
_LEAKED = 0.4
"""Spread of a Hann window's power, bins squared: 1/3 for a smooth spectrum, up to 1/2 for a line. Beside a resonance
the power in a bin is of a frequency nearer to it, by this times the slope of the power over the power."""


@dataclass(frozen=True, slots=True)
class Banded:
    """Cross-spectra of z = (jω)ᵒʳᵈᵉʳ x, of v and of the other places, in bands, of one pair or of several.

    Index 0 is z, 1 is v.
    """

    w: FloatArray  # (…, n_bands), angular frequency at the centroid of each band's power
    averages: FloatArray  # (n_bands,), number of effectively independent samples
    leaked: FloatArray  # (…, n_bands), relative error of z by power that the window leaks across the edges of a band
    # (…, n_bands, 2 + n_others, 2 + n_others): ``spectra[b, i, j]`` = E{a_i a_j*}, without the synchronous part
    spectra: ComplexArray
    total: ComplexArray  # (…, n_bands, 2, 2), including the synchronous part
    # Mean speed, and the 1x vectors of z and v in each hop of known speed, shape (…, n_hops, 2); None without vectors
    rotation: tuple[float, ComplexArray] | None

    def of(self, at: int | Sequence[int]) -> "Banded":
        """Those of one of several pairs, or of some."""
        rotation = None if self.rotation is None else (self.rotation[0], self.rotation[1][at])
        return Banded(self.w[at], self.averages, self.leaked[at], self.spectra[at], self.total[at], rotation)


def banded(window: WindowStatistics, pairs: Sequence[MotionPair]) -> Banded:
    """Cross-spectra of several pairs."""
    w, edges = 2 * np.pi * window.frequencies_hz, pair_bands(window.frequencies_hz.size)
    step_hz, counts = window.frequencies_hz[1] - window.frequencies_hz[0], np.diff(np.append(edges, w.size))
    columns = np.array([[pair.first, pair.second, *_others(window.states, pair)] for pair in pairs], dtype=np.intp)
    first, second = columns[:, 0], columns[:, 1]
    turn = np.stack([(1j * w) ** pair.order for pair in pairs], axis=1)
    turned = window.spectrum[:, first[:, None], columns] * turn[:, :, None]
    turned[:, :, 0] *= turn.conj()
    own = window.spectrum[:, second, second].real
    power = own + _FLOOR * own.max(axis=0) + np.finfo(float).tiny
    spectra = window.banded_spectrum[:, columns[:, :, None], columns[:, None]]
    spectra[:, :, 0] = np.add.reduceat(turned, edges)
    spectra[:, :, 1:, 0] = spectra[:, :, 0, 1:].conj()
    spectra = np.ascontiguousarray((spectra / counts[:, None, None, None]).swapaxes(0, 1))
    total, rotation = spectra[:, :, :2, :2].copy(), None
    vectors, speeds = window.rotation_vectors, window.hop_speed_rad_s
    if vectors is not None:
        known = np.isfinite(speeds)
        z = vectors[:, first] * np.stack([(1j * speeds) ** pair.order for pair in pairs], axis=1)
        both, speed = np.stack([z, vectors[:, second]], axis=2)[known].swapaxes(0, 1), float(np.mean(speeds[known]))
        near = int(np.searchsorted(w[edges], speed, side="right")) - 1
        if near >= 0 and speed <= w[-1]:
            total[:, near] += both.swapaxes(1, 2) @ both.conj() / (both.shape[1] * 4 * counts[near] * step_hz)
        rotation = speed, both
    centre = np.ascontiguousarray((np.add.reduceat(power * w[:, None], edges) / np.add.reduceat(power, edges)).T)
    averages = np.maximum(counts * step_hz * window.duration_s * _HANN_LOSS, 1.0)
    of_x = window.spectrum[:, first, first].real
    across = np.add.reduceat(np.gradient(of_x, w, axis=0), edges) * [pair.order for pair in pairs]
    within = np.maximum(np.add.reduceat(of_x * w[:, None], edges), np.finfo(float).tiny)
    leaked = (_LEAKED * (w[1] - w[0]) ** 2 * across / within).T
    return Banded(centre, averages, leaked, spectra, total, rotation)


@dataclass(frozen=True, slots=True)
class PairReading:
    """Gain and delay of the second sensor of a motion relative to the first."""

    pair: MotionPair
    first: str  # states of the pair
    second: str
    bands: Banded
    # Logarithm of the second's gain over the first's, and its standard error.
    log_gain: float
    log_gain_error: float
    polarity: float  # -1 if one of them is reversed
    # Delay of the second, and its standard error.
    delay_s: float
    delay_error_s: float
    shared: float  # coherent part of the motion after matching gain and delay, 0 to 1, over the whole band
    # Additional phase lead of the second times the angular frequency; 0 unless that explains the phases and a delay
    # does not. For a first-order high-pass this is the corner frequency.
    lead_rad_s: float = 0.0

    @property
    def transfer(self) -> ComplexArray:
        """Transfer function from z to v in each band."""
        phase = self.lead_rad_s / self.bands.w - self.bands.w * self.delay_s
        return np.asarray(self.polarity * np.exp(self.log_gain + 1j * phase), dtype=np.complex128)


def _transfer_of(w: FloatArray, *figures: FloatArray) -> ComplexArray:
    """Transfer functions of pairs with these polarities, log gains and delays, shape (n_pairs, n_bands)."""
    polarity, log_gain, delay_s = (one[:, None] for one in figures)
    return np.asarray(polarity * np.exp(log_gain - 1j * w * delay_s), dtype=np.complex128)


def _others(states: tuple[str, ...], pair: MotionPair) -> list[int]:
    """First column of each place other than the pair's."""
    places = [name.partition("_")[0] for name in states]
    return [places.index(place) for place in dict.fromkeys(places) if place != places[pair.first]]


def same(bands: Banded) -> FloatArray:
    """Part of the motion that two sensors show with equal timing, size and sense; 1 if all, negative if opposed."""
    z, v, cross = _powers_over_frequency(bands)
    shown = 2 * cross.sum(axis=-1).real / np.maximum(z + v, np.finfo(float).tiny)
    return np.asarray(np.where((z > 0) & (v > 0), shown, 0.0), dtype=np.float64)


def _powers_over_frequency(bands: Banded) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """Powers of z and v, and cross-powers per band, over ω: amplifies neither's noise at an end of the band."""
    over = bands.total / bands.w[..., None, None]
    return over[..., 0, 0].real.sum(axis=-1), over[..., 1, 1].real.sum(axis=-1), over[..., 1, 0]


def _turned(w: FloatArray, cross: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Delays that bring cross-powers into phase, and their sums then; negative if one sensor is reversed.

    Both are of shape (n_pairs,), of cross-powers of shape (n_pairs, n_bands).
    """
    reach = round(LONGEST_DELAY_S / _DELAY_STEP_S)
    delays = _DELAY_STEP_S * np.arange(-reach, reach + 1)
    turns = np.cumprod(np.broadcast_to(np.exp(1j * _DELAY_STEP_S * w)[:, None], (len(w), reach, w.shape[1])), axis=1)
    at_once, later = cross.sum(axis=1, keepdims=True), turns @ cross[:, :, None]
    sums = np.concatenate([(turns[:, ::-1].conj() @ cross[:, :, None])[:, :, 0], at_once, later[:, :, 0]], axis=1).real
    sizes = np.abs(sums)
    good = sizes >= _AS_GOOD * sizes.max(axis=1, keepdims=True)
    found = np.where(good, np.abs(delays), np.inf).argmin(axis=1)
    # Climb to the peak from there: the shortest delay that fits well enough lies on its slope.
    for pair, own in enumerate(sizes):
        while 0 < found[pair] < delays.size - 1 and own[found[pair] - 1 : found[pair] + 2].argmax() != 1:
            found[pair] += own[found[pair] - 1 : found[pair] + 2].argmax() - 1
    return delays[found], sums[np.arange(len(found)), found]


def read_pairs(
    window: WindowStatistics, pairs: Sequence[MotionPair], bands: Banded, leads: Mapping[tuple[str, str], float]
) -> list[PairReading]:
    """Compare the two sensors of every motion, from their banded spectra; without motions that do not fluctuate.

    `leads` are those of healthy pairs of states, rad/s; others are estimated from the window.
    """
    alive = np.flatnonzero((np.einsum("pbii->pbi", bands.spectra[:, :, :2, :2]).real > 0).all(axis=(1, 2))).tolist()
    if not alive:
        return []
    bands, pairs = bands.of(alive), [pairs[at] for at in alive]
    states = [(window.states[pair.first], window.states[pair.second]) for pair in pairs]
    z, v = bands.spectra[:, :, 0, 0].real, bands.spectra[:, :, 1, 1].real
    incoherent = np.maximum(1 - np.abs(bands.spectra[:, :, 1, 0]) ** 2 / (z * v), _FLOOR)
    h, variance, bias = _transfer(bands, incoherent)
    level, other, cross = _powers_over_frequency(bands)
    delay_s, total = _turned(bands.w, cross)
    polarity, log_gain = np.where(total >= 0, 1.0, -1.0), np.log(np.maximum(np.abs(total) / level, _FLOOR))
    shared = np.minimum(1.0, np.abs(total) / (np.sqrt(level) * np.sqrt(other)))
    fitted = partial(_fitted, (polarity, log_gain, delay_s))
    alone = fitted(bands.w, h, variance, bias)
    planes = np.array([_other_plane(window.states, pair) for pair in pairs])
    across = _without_across(planes, bands, _transfer_of(bands.w, polarity, *alone[::2]), h, variance)
    if across is not None:
        h, variance = across
        alone = fitted(bands.w, h, variance, bias)
    given = np.array([leads.get(each, np.nan) for each in states])
    expected = _transfer_of(bands.w, polarity, *alone[::2])
    lead_rad_s = np.where(np.isnan(given), _lead(bands.w, polarity, expected, h, variance), given)
    if lead_rad_s.any():
        h = h * np.exp(-1j * lead_rad_s[:, None] / bands.w)
        alone = fitted(bands.w, h, variance, bias)
    found, line = alone, _transfer_at_1x(window, bands, incoherent)
    if line is not None:
        there, speed, ratio, spread = line
        w = np.append(bands.w, np.full((len(pairs), 1), speed), axis=1)
        turned = np.append(h, (ratio * np.exp(-1j * lead_rad_s / speed))[:, None], axis=1)
        both = fitted(w, turned, np.append(variance, spread[:, None], axis=1), np.pad(bias, ((0, 0), (0, 1))))
        foreign = np.abs(both[0] - alone[0]) > np.maximum(_MOST_LINE_ERRORS * alone[1], _RUNOUT)
        foreign |= np.abs(both[2] - alone[2]) > _MOST_LINE_ERRORS * alone[3]
        found = np.where(~there | (foreign & (alone[1] < _RUNOUT)), alone, both)
    figures = np.stack([*found[:2], polarity, *found[2:], shared, lead_rad_s], axis=1).tolist()
    return [
        PairReading(pair, *names, bands.of(at), *own)
        for at, (pair, names, own) in enumerate(zip(pairs, states, figures, strict=True))
    ]


def _fitted(
    start: tuple[FloatArray, FloatArray, FloatArray], w: FloatArray, h: ComplexArray, *errors: FloatArray
) -> FloatArray:
    """Weighted least-squares fits of gain and delay to the transfer functions of all bands, from a first guess.

    `start` are polarities, log gains and delays, `errors` the transfer functions' variances and biases. Returns log
    gains and delays, each followed by their standard errors, shape (4, n_pairs).
    """
    (polarity, log_gain, delay_s), (variance, bias) = (one[:, None] for one in start), errors
    weight, jw, right_way = 1 / variance, 1j * w, h * polarity
    total, by_delay = weight.sum(axis=1, keepdims=True), weight * w
    moment, y = (by_delay * w).sum(axis=1, keepdims=True), right_way
    for _ in range(4):
        y = right_way * np.exp(jw * delay_s - log_gain) - 1
        too_large = (weight * y.real).sum(axis=1, keepdims=True) / total
        log_gain = log_gain + np.log1p(np.minimum(np.maximum(too_large, -0.5), 1.0))
        early = (by_delay * y.imag).sum(axis=1, keepdims=True) / moment
        delay_s = delay_s - np.minimum(np.maximum(early, -1e-3), 1e-3)
    scatter = np.stack([y.real, y.imag]) ** 2
    scatter = np.maximum(1.0, (weight * scatter).sum(axis=2) * 2 / max(1, y.shape[1] - 1))
    total, moment, by_bias = total[:, 0], moment[:, 0], (weight * bias).sum(axis=1)
    gain_error, delay_error_s = np.sqrt(scatter[0] / (2 * total)) + by_bias / total, np.sqrt(scatter[1] / (2 * moment))
    return np.stack([log_gain[:, 0], gain_error, delay_s[:, 0], delay_error_s])


@lru_cache(maxsize=64)
def _other_plane(states: tuple[str, ...], pair: MotionPair) -> tuple[int, int]:
    """Where a pair's bands have the same place's motion in the other plane; 0 if not measured.

    With it comes by how many derivatives the pair's second sensor is ahead of that.
    """
    own, _, order = states[pair.second].partition("_")
    for at, column in enumerate(_others(states, pair), 2):
        place, _, other_order = states[column].partition("_")
        if place == own.translate(_PLANES):
            return at, _RATES[order] - _RATES[other_order]
    return 0, 0


def _without_across(
    planes: IndexArray, bands: Banded, expected: ComplexArray, h: ComplexArray, variance: FloatArray
) -> tuple[ComplexArray, FloatArray] | None:
    """Transfer functions less what the other plane contributes, if that fits beyond gain, delay and lead; else None.

    Their variances grow as not knowing its size widens the errors of gain and delay, whichever is wider.

    A sensor that is mounted at an angle or sensitive across its axis shows a small part of the other plane's motion. If
    one force moves both planes, that part distorts the transfer, most at frequencies where the sensor's own plane
    hardly moves, and would be mistaken for a gain or a delay.
    """
    column, rates = planes.T
    moved = bands.spectra[np.arange(len(planes)), :, column, 0] / bands.spectra[:, :, 0, 0].real
    other = moved * (1j * bands.w) ** rates[:, None]
    tried = np.flatnonzero((column > 0) & other.any(axis=1))  # a stuck sensor of the other plane gives zeros
    if not tried.size:
        return None
    other, w, expected = other[tried], bands.w[tried], expected[tried]
    aim, seen, weight = h[tried] / expected - 1, other / expected, np.sqrt(2 / variance[tried])
    sides = np.stack([np.ones_like(seen), 1j * w, 1j / w, seen], axis=2) * weight[:, :, None]
    design = np.concatenate([sides.real, sides.imag], axis=1)
    y = np.concatenate([aim.real * weight, aim.imag * weight], axis=1)
    design /= (lengths := np.linalg.norm(design, axis=1, keepdims=True))
    directions, triangle = np.linalg.qr(design)
    along = directions.swapaxes(1, 2) @ y[:, :, None]
    left = y - (directions @ along)[:, :, 0]
    scatter = np.maximum(1.0, (left**2).sum(axis=1) / max(1, y.shape[1] - design.shape[2]))
    size = along[:, -1, 0] / triangle[:, -1, -1] / lengths[:, 0, -1]
    fits = (along[:, -1, 0] ** 2 > _TOLD_APART * scatter) & (np.abs(size) < _MOST_ACROSS)
    if not fits.any():
        return None
    h, variance = h.copy(), variance.copy()
    h[tried[fits]] -= (size[:, None] * other)[fits]
    inverse = np.linalg.inv(np.linalg.qr(design[fits][:, :, [0, 1, 3]], mode="r"))  # of gain, delay, the other plane
    variance[tried[fits]] *= (inverse[:, :2] ** 2).sum(axis=2).max(axis=1)[:, None]
    return h, variance


def _lead(
    w: FloatArray, polarity: FloatArray, expected: ComplexArray, h: ComplexArray, variance: FloatArray
) -> FloatArray:
    """Phase lead of the second times w; 0 unless it explains the phases of all bands better than a delay."""
    weight, ahead = 2 / variance, np.angle(np.asarray(polarity[:, None] * h))
    lead_rad_s = (weight * ahead / w).sum(axis=1) / (weight * w**-2.0).sum(axis=1)
    late = np.angle(h / expected)
    as_delay, as_lead = ((weight * left**2).sum(axis=1) for left in (late, ahead - lead_rad_s[:, None] / w))
    scatter = np.maximum(1.0, as_lead / max(1, w.shape[1] - 1))
    return np.where(as_delay - as_lead > _TOLD_APART * scatter, lead_rad_s, 0.0)


def _transfer_at_1x(
    window: WindowStatistics, bands: Banded, incoherent: FloatArray
) -> tuple[BoolArray, float, ComplexArray, FloatArray] | None:
    """Where z has 1x power, the speed, and the transfer at 1x with its relative variance; None if nowhere."""
    if bands.rotation is None:
        return None
    speed, vectors = bands.rotation
    power = np.sum(np.abs(vectors[:, :, 0]) ** 2, axis=1)
    there = (power > 0) & np.isfinite(power)
    if not there.any():  # a shaft angle that stands still has no speed
        return None
    power = np.where(there, power, 1.0)
    ratio = np.where(there, np.sum(vectors[:, :, 0].conj() * vectors[:, :, 1], axis=1) / power, 1.0)
    near = np.arange(len(power)), np.abs(bands.w - speed).argmin(axis=1)
    noise = incoherent[near] * bands.spectra[:, :, 0, 0].real[near]
    return there, speed, ratio, 4 * noise * vectors.shape[1] / (window.duration_s * power)


def _transfer(bands: Banded, incoherent: FloatArray) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Transfer from z to v in each band, its relative variance, and the largest bias of its logarithm by noise."""
    S = bands.spectra
    z, v, cross, n = S[:, :, 0, 0].real, S[:, :, 1, 1].real, S[:, :, 1, 0], S.shape[-1]
    half = -0.5 * np.log(1 - np.minimum(incoherent, 1 - 1e-6))
    variance = incoherent / np.maximum(1 - incoherent, 1e-6) / bands.averages + 2 * bands.leaked**2
    if n == 2:
        return np.sqrt(v / z) * cross / np.maximum(np.abs(cross), _FLOOR * np.sqrt(z * v)), variance, half
    scale = 1 / np.sqrt(np.maximum(np.einsum("pbii->pbi", S).real, np.finfo(float).tiny))
    unit = S * scale[..., None] * scale[:, :, None]
    others = unit[:, :, 2:, 2:] + 1e-9 * np.eye(n - 2)
    a = np.linalg.solve(others, unit[:, :, 2:, :1]).conj().swapaxes(2, 3)  # prediction from the other places: z = a w
    seen, own = (a @ unit[:, :, 2:, :2])[:, :, 0].transpose(2, 0, 1)
    seen = seen.real
    overfit = (n - 2) / bands.averages  # part that the others would explain of pure noise
    explained = np.clip((seen - overfit) / (1 - np.minimum(overfit, 0.9)), 1e-6, 1.0)
    h = (own.conj() / np.maximum(seen, _FLOOR)) * scale[:, :, 0] / scale[:, :, 1]
    left = np.minimum(half * overfit / np.maximum(seen, _FLOOR), half)
    return h, variance / explained, left


def gain_courses(window: WindowStatistics, readings: Sequence[PairReading]) -> tuple[FloatArray, FloatArray]:
    """Relative deviation of the pairs' gains from their medians, hop by hop, and its standard error, in two ways.

    Both are of shape (2, n_pairs, n_hops).

    Sensor noise is constant while the motion varies: its share of the signal grows as a machine runs down and shrinks
    when a line appears. The ratio of such a hop is biased accordingly, so its standard error is increased. Bands that
    show only noise in the usual hop carry hardly any weight.

    The first way divides the cross-power by the power of the first sensor, so noise of the first lowers it; the second
    way divides by the power of the second. A change of gain shows in both, a change of one sensor's noise in one.

    Bands through which the 1x passes as the speed changes do not count, nor do hops of unknown speed among others.
    """
    total = np.stack([one.bands.total for one in readings])
    z, v = total[:, :, 0, 0].real, total[:, :, 1, 1].real
    incoherent = np.maximum(1 - np.abs(total[:, :, 1, 0]) ** 2 / (z * v), _FLOOR)
    aligned = np.stack([one.transfer.conj() / np.exp(one.log_gain) for one in readings])
    every, counts = motion_pairs(window.states), ~_passed_by_1x(window)
    at = [every.index(one.pair) for one in readings]
    powers = np.stack([hop[at] for hop in window.pair_powers], axis=1)[:, :, counts]
    own = np.maximum(powers[..., ::2].real.transpose(3, 0, 1, 2), np.finfo(float).tiny)
    ratio = np.real(aligned[:, None, counts] * powers[..., 1]) / own
    noise = np.minimum(incoherent[:, None, counts] * own.mean(axis=2, keepdims=True) / own, 1.0)
    kept = np.maximum(1 - noise, 1e-6)
    variance = noise / kept / (readings[0].bands.averages[counts] / powers.shape[1])
    # Each band about its own median: noise lowers the ratio equally in all hops of equal level.
    usual, usual_variance, usual_kept = np.median(np.stack([ratio, variance, kept]), axis=3, keepdims=True)
    weight = 1 / np.maximum(variance, usual_variance)
    weight /= (precision := weight.sum(axis=3, keepdims=True))
    course = np.sum(weight * (ratio / usual - 1), axis=3) * [[[1]], [[-1]]]
    by_noise = np.sum(weight * (kept / usual_kept - 1), axis=3)
    known = np.isfinite(window.hop_speed_rad_s)
    unsure = np.where(known | ~known.any(), 1.0, _UNSURE)
    return course, np.sqrt(1 / (2 * precision[..., 0]) + by_noise**2) * unsure


def _passed_by_1x(window: WindowStatistics) -> BoolArray:
    """Bands of a pair through which a changing speed takes the 1x, shape (n_bands,); none if that leaves none.

    The line leaks into bins beside it, whose jω is not its own: it falsifies the gain, by as much as the line is off.
    """
    first_hz = window.frequencies_hz[pair_bands(window.frequencies_hz.size)]
    step_hz = float(window.frequencies_hz[1] - window.frequencies_hz[0])
    speeds_hz = np.abs(window.hop_speed_rad_s[np.isfinite(window.hop_speed_rad_s)]) / (2 * np.pi)
    if not speeds_hz.size or np.ptp(speeds_hz) < _ONE_SPEED * speeds_hz.max():
        return np.full(first_hz.size, False)
    below = first_hz < speeds_hz.max() + _LEAKS * step_hz
    passed = below & (np.append(first_hz[1:], np.inf) > speeds_hz.min() - _LEAKS * step_hz)
    return np.asarray(passed & ~passed.all(), dtype=np.bool_)


def delay_course(window: WindowStatistics, reading: PairReading) -> tuple[FloatArray, FloatArray]:
    """Delay of the second beyond that of the reading, hop by hop, and the standard error of each hop, s."""
    bands, number = reading.bands, motion_pairs(window.states).index(reading.pair)
    powers = np.stack([hop[number] for hop in window.pair_powers])
    common = powers[:, :, 1] * reading.transfer.conj()
    coherent = np.abs(common) ** 2 / np.maximum(powers[:, :, 0].real * powers[:, :, 2].real, np.finfo(float).tiny)
    weight = coherent / np.maximum(1 - coherent, _FLOOR) * bands.w**2 * bands.averages / len(powers)
    total = np.maximum(weight.sum(axis=1), np.finfo(float).tiny)  # avoid 0 / 0 in a hop with a dead sensor
    course = -np.sum(weight * np.angle(common) / bands.w, axis=1) / total
    return np.asarray(course, dtype=np.float64), np.asarray(np.sqrt(1 / (2 * total)), dtype=np.float64)
