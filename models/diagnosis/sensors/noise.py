"""A sensor whose noise has risen: a bad cable, mains hum, a failing amplifier.

Noise differs from machine to machine and from day to day: some is proportional to the range, some to the vibration, and
temperature or an amplifier's supply changes it in all channels. The rise is therefore the smaller of those of the noise
and of its share of the vibration, less the median rise of the other channels. The noise must also be large enough to
matter: the diagnosis allows for noise, and a finding would stop it needlessly.
"""

from collections.abc import Iterator, Sequence, Set

import numpy as np

from models.diagnosis.sensors.kinematics import PairReading
from models.diagnosis.sensors.reference import Naming, PairNoise, SensorReference, channel_noise, channel_rms, floor
from models.diagnosis.window.excluded import MAINS_HZ
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import BoolArray, FloatArray
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

PAIR_RISE = 10.0
"""Least rise, over the healthy power and beyond the other pairs' rise, of the difference of two sensors of a motion.

Calibrated on 384 healthy windows, each under another excitation than its reference: the largest rise was 3.5, and an
exponential tail fitted to the uppermost tenth reaches 10 in one of a million windows with four pairs of sensors, in ten
of a million with two.
"""
ALONE_RISE = 40.0  # the same if there is no other pair to compare with
FLOOR_RISE, FLOOR_ALONE = 80.0, 5.0
"""For motions with one sensor: least rise of the conditional power's floor over the healthy one, and beyond the others.

Another excitation of the machine may cause such a rise, though hardly with a flat floor: in one of a thousand windows
by the same calculation.
"""
FLOOR_FLAT = 0.5  # part of the bands that must lie on the floor: a machine's own spectrum has resonances
LINE_RISE = 4.0
# Least rms of the noise over that of the channel to be reported: as seen by a pair, as a floor, and as a line.
LEAST_PART, LEAST_FLOOR, LEAST_LINE = 0.02, 0.1, 0.03
_MAINS_OFF_HZ = 0.2  # largest deviation of the mains frequency (EN 50160 allows 1 % in 99.5 % of a year)
_FEWEST = 4  # least number of channels needed to see that one of them rose alone
# Calibrated standard deviations of the logarithm of a healthy pair's rise, and of that of a healthy channel's floor.
_PAIR_SCATTER, _FLOOR_SCATTER = 0.2, 1.0
_LEAST_PART = 0.5  # one of two sensors is the noisy one if its noise exceeds the other's by more than this part of both
_MOST_SHARE_ERROR = 0.15
_COUNTS = 2.0  # bands in which the noise rose by a smaller factor do not contribute to its rms


def _alone(rise: FloatArray) -> FloatArray:
    """Rise (in logarithms) beyond the median of the others' rises; a fall of the others is not added."""
    n = rise.shape[0]
    if n < 2:
        return rise
    others = np.stack([np.median(np.delete(rise, row, axis=0), axis=0) for row in range(n)])
    return np.asarray(rise - np.maximum(others, 0.0), dtype=np.float64)


def noisy(
    window: WindowStatistics,
    readings: Sequence[PairReading],
    naming: Naming,
    reference: SensorReference | None,
    bad: Set[str],
) -> list[SensorFault]:
    """Findings on channels with more noise than on the healthy machine; none without a reference.

    The readings are those of pairs that see the same motion; `bad` are states with other faults.
    """
    if reference is None:
        return []
    sound = [one for one in readings if one.first not in bad and one.second not in bad]
    findings = list(_of_pairs(window, sound, naming, reference))
    if not findings and bad.isdisjoint(window.states):
        findings += _of_single(window, naming, reference)
    return findings


def _of_pairs(
    window: WindowStatistics, readings: Sequence[PairReading], naming: Naming, reference: SensorReference
) -> Iterator[SensorFault]:
    known = []
    for reading in readings:
        then = reference.pair(reading.first, reading.second)
        healthy = None if then is None else then.noise
        if healthy is not None and len(healthy.density) == reading.bands.w.size:
            known.append((reading, PairNoise(window, reading), healthy))
    if not known:
        return
    absolute = np.log([now.density / (np.array(then.density) + now.leakage) for _, now, then in known])
    relative = np.log([now.density / (np.array(then.share) * now.scale + now.leakage) for _, now, then in known])
    rise = np.minimum(_alone(absolute), _alone(relative))
    limit = np.log(PAIR_RISE if len(known) > 1 else ALONE_RISE)
    rms = channel_rms(window)
    for row, (reading, now, _) in enumerate(known):
        risen = rise[row] > limit
        if not np.any(risen):
            continue
        pair, own = reading.pair, reading.bands
        guilty = _guilty(reading, risen)
        width_hz = (window.frequencies_hz[-1] - window.frequencies_hz[0]) / own.w.size
        excess = 2 * width_hz * now.density * -np.expm1(-rise[row]) * (rise[row] > np.log(_COUNTS))
        # rms of the noise if all of it came from the first sensor, in the first sensor's quantity
        first = float(np.sqrt(np.sum(excess / own.w ** (2 * pair.order)))) * float(np.exp(-reading.log_gain))
        sizes = {pair.first: first, pair.second: float(np.sqrt(excess.sum()))}
        columns = [pair.first, pair.second] if guilty is None else [guilty]
        column = min((sizes[one] / rms[one], one) for one in columns)[1]
        if sizes[column] < LEAST_PART * rms[column]:
            continue
        states = tuple(window.states[one] for one in columns)
        factor = float(np.exp(rise[row].max() / 2))
        around = " to ".join(dict.fromkeys(f"{w / (2 * np.pi):.3g}" for w in (own.w[risen][0], own.w[risen][-1])))
        text = (
            f"{naming.names(states)}: noise of {naming.value(window.states[column], sizes[column])} rms "
            f"({sizes[column] / rms[column]:.0%} of what {naming.name(window.states[column])} shows) around "
            f"{around} Hz, up to {factor:.3g} times the healthy one, expected less than "
            f"{np.exp(limit / 2):.2g} times: cable, earthing or amplifier"
        )
        if guilty is None:
            text += "; which of the two it is cannot be told"
        z = float(rise[row].max()) / float(np.hypot(_PAIR_SCATTER, np.sqrt(1 / own.averages.min())))
        value = sizes[column] / float(rms[column])
        yield SensorFault(states=states, kind=FaultKind.NOISE, text=text, value=value, z=z)


def _guilty(reading: PairReading, risen: BoolArray) -> int | None:
    """Column of the noisy one of two sensors, from powers that the other places do not explain; None if unclear."""
    bands, h = reading.bands, reading.transfer
    spectra = bands.spectra.copy()
    spectra[:, 0] *= h[:, None]  # corrected to the gain, polarity and delay of the second
    spectra[:, :, 0] *= h.conj()[:, None]
    spectra = spectra[risen]
    power, n = np.maximum(np.einsum("bii->bi", spectra).real, np.finfo(float).tiny), spectra.shape[1]
    own = spectra[:, :2, :2]
    if n > 2:
        scale = 1 / np.sqrt(power[:, 2:])
        others = spectra[:, 2:, 2:] * scale[:, :, None] * scale[:, None, :] + 1e-9 * np.eye(n - 2)
        along = spectra[:, :2, 2:] * scale[:, None, :]
        own = own - along @ np.linalg.solve(others, along.conj().transpose(0, 2, 1))
    z, v, cross = own[:, 0, 0].real, own[:, 1, 1].real, own[:, 1, 0].real
    both = np.maximum(z + v - 2 * cross, 1e-12 * (z + v))  # sum of the noises; their difference is v - z
    common = np.maximum(z + v + 2 * cross, 0.0)
    variance = both * (common + both) / (2 * bands.averages[risen]) + (2 * reading.log_gain_error * common / 4) ** 2
    weight = 1 / variance
    share = float(weight @ (v - z) / (weight @ both))
    error = float(1 / np.sqrt(weight.sum()) / (weight @ both / weight.sum()))
    if error > _MOST_SHARE_ERROR or abs(share) < _LEAST_PART:
        return None
    return reading.pair.second if share > 0 else reading.pair.first


def is_hum(line_hz: float, speed_rad_s: float, resolution_hz: float) -> bool:
    """Whether a line can be mains hum: at 50 or 60 Hz or a harmonic, and not at an order of the shaft.

    Any other line in one channel is put down to a bearing, gear or blade of the machine that only one sensor sees.

    Examples
    --------
    >>> is_hum(100.1, 138.2, 0.5), is_hum(100.1, 2 * np.pi * 25.0, 0.5), is_hum(88.2, 138.2, 0.5)
    (True, False, False)
    """
    near = ((round(line_hz / mains_hz), mains_hz) for mains_hz in MAINS_HZ)
    if not any(n and abs(line_hz - n * mains_hz) <= n * _MAINS_OFF_HZ + resolution_hz / 2 for n, mains_hz in near):
        return False
    shaft_hz = abs(speed_rad_s) / (2 * np.pi)
    if not np.isfinite(shaft_hz) or shaft_hz == 0:
        return True
    return abs(line_hz - round(line_hz / shaft_hz) * shaft_hz) > resolution_hz


def _of_single(window: WindowStatistics, naming: Naming, reference: SensorReference) -> Iterator[SensorFault]:
    known = []
    for now in channel_noise(window):
        channel = reference.channel(window.states[now.column])
        healthy = None if channel is None else channel.noise
        if healthy is not None and len(healthy.density) == now.density.size:
            known.append((now, healthy))
    if not known:
        return
    absolute = np.array([floor(np.log(now.density)) - floor(np.log(then.density)) for now, then in known])
    relative = np.array([floor(np.log(now.share)) - floor(np.log(then.share)) for now, then in known])
    rise, alone = np.minimum(absolute, relative), np.minimum(_alone(absolute), _alone(relative))
    rms = channel_rms(window)
    band_hz = float(window.frequencies_hz[-1] - window.frequencies_hz[0])
    for row, (now, then) in enumerate(known):
        state, own = window.states[now.column], float(rms[now.column])
        name = naming.name(state)
        size = float(np.sqrt(2 * band_hz * np.exp(floor(np.log(now.density)))))
        risen = len(known) >= _FEWEST and rise[row] > np.log(FLOOR_RISE) and alone[row] > np.log(FLOOR_ALONE)
        hums = is_hum(now.line_hz, window.speed_rad_s, float(window.frequencies_hz[1] - window.frequencies_hz[0]))
        if hums and now.line_rms > max(LEAST_LINE * own, np.sqrt(LINE_RISE) * then.line_rms):
            text = (
                f"{name}: a line of {naming.value(state, now.line_rms)} rms at {now.line_hz:.4g} Hz that no other "
                f"channel shows ({now.line_rms / own:.0%} of what it shows, {naming.value(state, then.line_rms)} on "
                "the healthy machine), expected a machine to show in more than one channel: mains hum or a bad earth"
            )
            yield SensorFault(states=(state,), kind=FaultKind.NOISE, text=text, value=now.line_rms / own)
        elif risen and now.flat > FLOOR_FLAT and size > LEAST_FLOOR * own:
            factor = float(np.exp(rise[row] / 2))
            text = (
                f"{name}: noise of {naming.value(state, size)} rms in the band ({size / own:.0%} of what it shows), "
                f"{factor:.3g} times the healthy one, expected less than {np.sqrt(FLOOR_RISE):.2g} times: "
                "cable, earthing or amplifier"
            )
            z = float(rise[row]) / _FLOOR_SCATTER
            yield SensorFault(states=(state,), kind=FaultKind.NOISE, text=text, value=size / own, z=z)
