"""Gain and delay between two sensors of one motion: v = jωx, whatever the machine does.

Sensor noise makes |S_xv| / S_xx too small and S_vv / |S_xv| too large. The signals w at the machine's other places
contain neither noise, so they serve as instrumental variables: h = S_wv / S_wx. Without any other place, the two biased
ratios bracket the gain. The rotation-synchronous vectors add one more frequency, with little noise.

AC-coupled sensors and amplifiers, including all that measure a rate on a casing, lead. Well above the corner of the
high-pass the lead in phase falls as 1/frequency, whereas the lag of a delay grows in proportion to the frequency.
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from models.diagnosis.window.motion import MotionPair, motion_pairs, pair_bands
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import BoolArray, ComplexArray, FloatArray

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


class Banded:
    """Cross-spectra of z = (jω)ᵒʳᵈᵉʳ x, of v and of the other places, in bands; index 0 is z, 1 is v."""

    def __init__(self, window: WindowStatistics, pair: MotionPair) -> None:
        w = 2 * np.pi * window.frequencies_hz
        columns = np.array([pair.first, pair.second, *_others(window.states, pair)])
        edges = pair_bands(w.size)
        counts = np.diff(np.append(edges, w.size))
        turn = (1j * w) ** pair.order
        turned = window.spectrum[:, pair.first, columns] * turn[:, None]
        turned[:, 0] *= turn.conj()
        own = window.spectrum[:, pair.second, pair.second].real
        power = own + _FLOOR * own.max() + np.finfo(float).tiny
        # (n_bands,), angular frequency at the centroid of each band's power
        self.w: FloatArray = np.add.reduceat(power * w, edges) / np.add.reduceat(power, edges)
        step_hz = window.frequencies_hz[1] - window.frequencies_hz[0]
        # (n_bands,), number of effectively independent samples
        self.averages: FloatArray = np.maximum(counts * step_hz * window.duration_s * _HANN_LOSS, 1.0)
        # (n_bands, 2 + n_others, 2 + n_others): ``spectra[b, i, j]`` = E{a_i a_j*}, without the synchronous part
        self.spectra = window.banded_spectrum[:, columns[:, None], columns]
        self.spectra[:, 0] = np.add.reduceat(turned, edges)
        self.spectra[:, 1:, 0] = self.spectra[:, 0, 1:].conj()
        self.spectra /= counts[:, None, None]
        self.total = self.spectra[:, :2, :2].copy()  # (n_bands, 2, 2), including the synchronous part
        # Mean speed, and the 1x vectors of z and v in each hop of known speed, shape (n_hops, 2); None without vectors
        self.rotation: tuple[float, ComplexArray] | None = None
        vectors, speeds = window.rotation_vectors, window.hop_speed_rad_s
        if vectors is not None:
            known = np.isfinite(speeds)
            z = vectors[:, pair.first] * (1j * speeds) ** pair.order
            both, speed = np.stack([z, vectors[:, pair.second]], axis=1)[known], float(np.mean(speeds[known]))
            near = int(np.searchsorted(w[edges], speed, side="right")) - 1
            if near >= 0 and speed <= w[-1]:
                line = both.T @ both.conj() / len(both)
                self.total[near] += line / (4 * counts[near] * step_hz)
            self.rotation = speed, both


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
    polarity: int  # -1 if one of them is reversed
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


def _others(states: tuple[str, ...], pair: MotionPair) -> list[int]:
    """First column of each place other than the pair's."""
    places = [name.partition("_")[0] for name in states]
    return [places.index(place) for place in dict.fromkeys(places) if place != places[pair.first]]


def same(bands: Banded) -> float:
    """Part of the motion that two sensors show with equal timing, size and sense; 1 if all, negative if opposed."""
    z, v, cross = _powers_over_frequency(bands)
    return float(2 * cross.sum().real / (z + v)) if z > 0 and v > 0 else 0.0


def _powers_over_frequency(bands: Banded) -> tuple[float, float, ComplexArray]:
    """Powers of z and v, and cross-powers per band, over ω: amplifies neither's noise at an end of the band."""
    z, v = bands.total[:, 0, 0].real / bands.w, bands.total[:, 1, 1].real / bands.w
    return float(z.sum()), float(v.sum()), np.asarray(bands.total[:, 1, 0] / bands.w, dtype=np.complex128)


def _turned(w: FloatArray, cross: ComplexArray) -> tuple[float, float]:
    """Delay that brings the cross-powers into phase, and their sum then; negative if one sensor is reversed."""
    reach = round(LONGEST_DELAY_S / _DELAY_STEP_S)
    delays = _DELAY_STEP_S * np.arange(-reach, reach + 1)
    turns = np.cumprod(np.broadcast_to(np.exp(1j * _DELAY_STEP_S * w), (reach, w.size)), axis=0)
    sums = np.real(np.concatenate([turns[::-1].conj() @ cross, [cross.sum()], turns @ cross]))
    good = np.flatnonzero(np.abs(sums) >= _AS_GOOD * np.abs(sums).max())
    best = int(good[np.argmin(np.abs(delays[good]))])
    # Climb to the peak from there: the shortest delay that fits well enough lies on its slope.
    while 0 < best < delays.size - 1 and np.abs(sums[best - 1 : best + 2]).argmax() != 1:
        best += int(np.abs(sums[best - 1 : best + 2]).argmax()) - 1
    return float(delays[best]), float(sums[best])


def read_pair(
    window: WindowStatistics, pair: MotionPair, bands: Banded, lead_rad_s: float | None = None
) -> PairReading | None:
    """Compare two sensors of one motion, from their banded spectra; None if either does not fluctuate.

    `lead_rad_s` is the lead of the healthy pair; if None, it is estimated from the window.
    """
    z, v = bands.spectra[:, 0, 0].real, bands.spectra[:, 1, 1].real
    if not (np.all(z > 0) and np.all(v > 0)):
        return None
    incoherent = np.maximum(1 - np.abs(bands.spectra[:, 1, 0]) ** 2 / (z * v), _FLOOR)
    h, variance, bias = _transfer(bands, incoherent)
    level, other, cross = _powers_over_frequency(bands)
    delay_s, total = _turned(bands.w, cross)
    polarity, log_gain = 1 if total >= 0 else -1, float(np.log(max(abs(total) / level, _FLOOR)))
    shared = min(1.0, abs(total) / (math.sqrt(level) * math.sqrt(other)))
    states = window.states[pair.first], window.states[pair.second]
    fitted = partial(_fitted, PairReading(pair, *states, bands, log_gain, 0.0, polarity, delay_s, 0.0, shared))
    alone = fitted(bands.w, h, variance, bias)
    across = _across(alone, _other_plane(window, pair, bands), h, variance)
    if across is not None:
        part, widening = across
        h, variance = h - part, variance * widening**2
        alone = fitted(bands.w, h, variance, bias)
    lead_rad_s = _lead(alone, h, variance) if lead_rad_s is None else lead_rad_s
    if lead_rad_s:
        h = h * np.exp(-1j * lead_rad_s / bands.w)
        alone = fitted(bands.w, h, variance, bias)
    line = _transfer_at_1x(window, bands, incoherent)
    if line is None:
        return replace(alone, lead_rad_s=lead_rad_s)
    speed, ratio, spread = line
    ratio *= complex(np.exp(-1j * lead_rad_s / speed))
    found = fitted(np.append(bands.w, speed), np.append(h, ratio), np.append(variance, spread), np.append(bias, 0.0))
    foreign = abs(found.log_gain - alone.log_gain) > max(_MOST_LINE_ERRORS * alone.log_gain_error, _RUNOUT)
    foreign |= abs(found.delay_s - alone.delay_s) > _MOST_LINE_ERRORS * alone.delay_error_s
    return replace(alone if foreign and alone.log_gain_error < _RUNOUT else found, lead_rad_s=lead_rad_s)


def _fitted(start: PairReading, w: FloatArray, h: ComplexArray, variance: FloatArray, bias: FloatArray) -> PairReading:
    """Weighted least-squares fit of gain and delay to the transfer functions of all bands, from a first guess."""
    log_gain, delay_s, weight = start.log_gain, start.delay_s, 1 / variance
    y, jw, total, by_delay = h * start.polarity, 1j * w, float(weight.sum()), weight * w
    moment, right_way = float(by_delay @ w), y
    for _ in range(4):
        y = right_way * np.exp(jw * delay_s - log_gain) - 1
        log_gain += math.log1p(min(max(float(weight @ y.real) / total, -0.5), 1.0))
        delay_s -= min(max(float(by_delay @ y.imag) / moment, -1e-3), 1e-3)
    freedom = max(1, y.size - 1)
    scatter_gain = max(1.0, float(weight @ y.real**2) * 2 / freedom)
    scatter_delay = max(1.0, float(weight @ y.imag**2) * 2 / freedom)
    gain_error = math.sqrt(scatter_gain / (2 * total)) + float(weight @ bias) / total
    delay_error_s = math.sqrt(scatter_delay / (2 * moment))
    return replace(start, log_gain=log_gain, log_gain_error=gain_error, delay_s=delay_s, delay_error_s=delay_error_s)


def _other_plane(window: WindowStatistics, pair: MotionPair, bands: Banded) -> ComplexArray | None:
    """Transfer function from z to the same place's motion in the other plane, (n_bands,); None if not measured."""
    others = _others(window.states, pair)
    own, _, order = window.states[pair.second].partition("_")
    for at, column in enumerate(others, 2):
        place, _, other_order = window.states[column].partition("_")
        if place == own.translate(_PLANES):
            rates = _RATES[order] - _RATES[other_order]
            moved = bands.spectra[:, at, 0] / bands.spectra[:, 0, 0].real
            return np.asarray(moved * (1j * bands.w) ** rates, dtype=np.complex128)
    return None


def _across(
    alone: PairReading, other: ComplexArray | None, h: ComplexArray, variance: FloatArray
) -> tuple[ComplexArray, float] | None:
    """Contribution of the other plane to the transfer function; None unless it fits beyond gain, delay and lead.

    With it comes the factor by which not knowing its size widens the errors of gain and delay, whichever is wider.

    A sensor that is mounted at an angle or sensitive across its axis shows a small part of the other plane's motion. If
    one force moves both planes, that part distorts the transfer, most at frequencies where the sensor's own plane
    hardly moves, and would be mistaken for a gain or a delay.
    """
    if other is None or not other.any():  # a stuck sensor of the other plane gives zeros
        return None
    w, expected = alone.bands.w, alone.transfer
    aim, seen = h / expected - 1, other / expected
    weight = np.tile(np.sqrt(2 / variance), 2)
    sides = [np.ones_like(h), 1j * w, 1j / w, seen]
    design = np.stack([np.concatenate([one.real, one.imag]) for one in sides], axis=1) * weight[:, None]
    design /= (lengths := np.linalg.norm(design, axis=0))
    y = np.concatenate([aim.real, aim.imag]) * weight
    directions, triangle = np.linalg.qr(design)
    along = directions.T @ y
    left = y - directions @ along
    if not along[-1] ** 2 > _TOLD_APART * max(1.0, float(left @ left) / max(1, y.size - design.shape[1])):
        return None
    size = float(along[-1] / triangle[-1, -1] / lengths[-1])
    if not abs(size) < _MOST_ACROSS:
        return None
    inverse = np.linalg.inv(np.linalg.qr(design[:, [0, 1, 3]], mode="r"))  # of gain, delay and the other plane
    return np.asarray(size * other, dtype=np.complex128), float(np.linalg.norm(inverse[:2], axis=1).max())


def _lead(alone: PairReading, h: ComplexArray, variance: FloatArray) -> float:
    """Phase lead of the second times w; 0 unless it explains the phases of all bands better than a delay."""
    w, weight, ahead = alone.bands.w, 2 / variance, np.angle(alone.polarity * h)
    lead_rad_s = float(weight @ (ahead / w) / (weight @ w**-2.0))
    late = np.angle(h / alone.transfer)
    as_delay, as_lead = (float(weight @ left**2) for left in (late, ahead - lead_rad_s / w))
    scatter = max(1.0, as_lead / max(1, w.size - 1))
    return lead_rad_s if as_delay - as_lead > _TOLD_APART * scatter else 0.0


def _transfer_at_1x(
    window: WindowStatistics, bands: Banded, incoherent: FloatArray
) -> tuple[float, complex, float] | None:
    """Speed, and transfer at 1x with its relative variance, from the 1x vectors; None if z has no 1x power."""
    if bands.rotation is None:
        return None
    speed, vectors = bands.rotation
    power = float(np.sum(np.abs(vectors[:, 0]) ** 2))
    if not (power > 0 and np.isfinite(power)):
        return None
    ratio = complex(np.sum(vectors[:, 0].conj() * vectors[:, 1]) / power)
    near = int(np.argmin(np.abs(bands.w - speed)))
    noise = incoherent[near] * bands.spectra[near, 0, 0].real
    return speed, ratio, float(4 * noise * len(vectors) / (window.duration_s * power))


def _transfer(bands: Banded, incoherent: FloatArray) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Transfer from z to v in each band, its relative variance, and the largest bias of its logarithm by noise."""
    S = bands.spectra
    z, v, cross = S[:, 0, 0].real, S[:, 1, 1].real, S[:, 1, 0]
    bracketed = np.sqrt(v / z) * cross / np.maximum(np.abs(cross), _FLOOR * np.sqrt(z * v))
    half = -0.5 * np.log(1 - np.minimum(incoherent, 1 - 1e-6))
    variance = incoherent / np.maximum(1 - incoherent, 1e-6) / bands.averages
    if S.shape[1] == 2:
        return bracketed, variance, half
    scale = 1 / np.sqrt(np.maximum(np.einsum("bii->bi", S).real, np.finfo(float).tiny))
    unit = S * scale[:, :, None] * scale[:, None, :]
    others = unit[:, 2:, 2:] + 1e-9 * np.eye(S.shape[1] - 2)
    a = np.linalg.solve(others, unit[:, 2:, :1])[:, :, 0]  # prediction of z from the other places: z = aᴴ w
    seen = np.einsum("bi,bi->b", a.conj(), unit[:, 2:, 0]).real
    own = np.einsum("bi,bi->b", a.conj(), unit[:, 2:, 1])
    overfit = (S.shape[1] - 2) / bands.averages  # part that the others would explain of pure noise
    explained = np.clip((seen - overfit) / (1 - np.minimum(overfit, 0.9)), 1e-6, 1.0)
    h = (own.conj() / np.maximum(seen, _FLOOR)) * scale[:, 0] / scale[:, 1]
    left = np.minimum(half * overfit / np.maximum(seen, _FLOOR), half)
    return h, variance / explained, left


def gain_courses(window: WindowStatistics, reading: PairReading) -> tuple[tuple[FloatArray, FloatArray], ...]:
    """Relative deviation of the pair's gain from its median, hop by hop, and each hop's standard error, in two ways.

    Sensor noise is constant while the motion varies: its share of the signal grows as a machine runs down and shrinks
    when a line appears. The ratio of such a hop is biased accordingly, so its standard error is increased. Bands that
    show only noise in the usual hop carry hardly any weight.

    The first way divides the cross-power by the power of the first sensor, so noise of the first lowers it; the second
    way divides by the power of the second. A change of gain shows in both, a change of one sensor's noise in one.

    Bands through which the 1x passes as the speed changes do not count, nor do hops of unknown speed among others.
    """
    bands, number = reading.bands, motion_pairs(window.states).index(reading.pair)
    z, v = bands.total[:, 0, 0].real, bands.total[:, 1, 1].real
    incoherent = np.maximum(1 - np.abs(bands.total[:, 1, 0]) ** 2 / (z * v), _FLOOR)
    aligned = reading.transfer.conj() / np.exp(reading.log_gain)
    powers = np.stack([hop[number] for hop in window.pair_powers])
    common = np.real(aligned * powers[:, :, 1])
    counts = ~_passed_by_1x(window)
    common, powers, averages = common[:, counts], powers[:, counts], bands.averages[counts] / len(powers)
    rises, error = _course(common, powers[:, :, 0].real, incoherent[counts], averages)
    falls, other_error = _course(common, powers[:, :, 2].real, incoherent[counts], averages)
    known = np.isfinite(window.hop_speed_rad_s)
    unsure = np.where(known | ~known.any(), 1.0, _UNSURE)
    return (rises, error * unsure), (-falls, other_error * unsure)


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


def _course(
    common: FloatArray, power: FloatArray, incoherent: FloatArray, averages: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Relative deviation of a ratio of powers, each (n_hops, n_bands), averaged over the bands; its standard error."""
    own = np.maximum(power, np.finfo(float).tiny)
    ratio = common / own
    # Each band about its own median: noise lowers the ratio equally in all hops of equal level.
    course = ratio / np.median(ratio, axis=0) - 1
    noise = np.minimum(incoherent * own.mean(axis=0) / own, 1.0)
    kept = np.maximum(1 - noise, 1e-6)
    variance = noise / kept / averages
    weight = 1 / np.maximum(variance, np.median(variance, axis=0))
    total = weight.sum(axis=1)
    by_noise = np.sum(weight * (kept / np.median(kept, axis=0) - 1), axis=1) / total
    error = np.sqrt(1 / (2 * total) + by_noise**2)
    return np.asarray(np.sum(course * weight, axis=1) / total, dtype=np.float64), np.asarray(error, dtype=np.float64)


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
