"""Faults that single channels show: stuck, clipped, peaks, an offset, or a sudden change of gain.

**Gain.** From one hop to the next the excitation may rise or the machine may change, but either shows in every channel.
Only a sensor can multiply one channel by a factor: its rotation-synchronous vector then keeps its angle and changes its
length, its fluctuation changes by the same factor, and all other channels stay as they were. A slower change, or one
that other channels share, cannot be distinguished from a change of the machine and is left to the misfit of its model.
"""

import re
from collections.abc import Collection, Iterator, Sequence

import numpy as np

from models.diagnosis.sensors.reference import Naming, SensorReference
from models.diagnosis.window.motion import motion_pairs
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import BoolArray, FloatArray
from models.signals.waveform import CountArray, stacked_waveform
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

STILL_S = 0.25  # longest time for which equal samples are put down to quantisation
# Part of a hop's samples at its extreme that is put down to chance, in addition to those of a quantised sine.
FLAT_PART = 0.005
# The range ends at a value if at least this part of the hops, and this number, have several samples exactly there and
# none beyond. Coarsely quantised or sine-like signals do so without a limit: hence the largest converter step and the
# least distance of the value from the mean, both as multiples of the channel's rms.
_LIMITED_PART, _FEWEST_LIMITED, _FINE, _BEYOND_SINE = 0.25, 4, 0.05, 2.0
# Least crest factor of a displacement with false peaks, largest one of the second sensor of the same motion, and least
# part of hops with such peaks. A real peak needs a high velocity, too; Gaussian noise hardly reaches 5. Rarer peaks do
# not affect the readings of the machine.
_PEAKS, _NO_PEAKS, _PEAKED_PART = 10.0, 6.0, 0.5
STEP_SPREADS = 8.0  # standard deviations of a hop's mean that a step of the mean must exceed
STEP_PART = 0.3  # part of the channel's rms that it must exceed, too
# A slow drift of the mean over a window, as of a gap voltage, is allowed up to this many rms of the channel.
DRIFT_PART = 3.0
# The mean may differ from the reference by this many rms of the channel: temperature and load move gap voltages.
MOVED_PART = 3.0
_SLOWER = 0.9  # of the speed beside it, below which the rest of a hop with a constant angle is a start or a stop
_FEWEST_DROPPED = 3  # least number of hops with drop-outs for a finding; fewer do not affect the readings
_SHAFT_PART = 0.3  # if another displacement moves by more than this part of a displacement's step, the shaft has moved


def stuck(window: WindowStatistics, naming: Naming, stood: BoolArray) -> Iterator[SensorFault]:
    """Channels that hold a value or show nothing but their quantisation, and a shaft angle that does not turn.

    The angle need not turn in the hops of `stood`, shape (n_hops,), in which the machine stood or was running down, nor
    throughout a hop in which it starts or stops.
    """
    hops = window.hop_waveform
    rate_hz = hops.n_samples * len(window.waveforms) / window.duration_s
    limit = max(3, min(round(STILL_S * rate_hz), hops.n_samples))
    for column, state in enumerate(window.sensors):
        runs, rms, step = hops.longest_run[:, column], hops.rms[:, column], hops.step[:, column]
        name, coarse = naming.name(state), rms < step
        if state == "theta":
            runs = np.where(stood | _starts_or_stops(window, runs), 0, runs)
        whole = int(np.sum(runs[runs >= hops.n_samples]))
        lost_s = max(whole, int(runs.max())) / rate_hz
        if state != "theta" and np.any(coarse):
            lost_s = float(coarse.sum()) * hops.n_samples / rate_hz
            text = (
                f"{name}: shows nothing but quantisation steps of {naming.value(state, float(step[coarse].max()))} for "
                f"{lost_s:.3g} s, expected a vibration of several steps: the sensor is dead or its range far too wide"
            )
        elif runs.max() < limit:
            continue
        elif state == "theta":
            text = (
                f"{name}: the shaft angle stood still for {lost_s:.3g} s: the phase reference is lost, or "
                "the machine has not run since the monitor started"
            )
        else:
            still = int(runs.argmax())  # the hop's mean is the repeated value only if the run fills the hop
            known = runs[still] >= hops.n_samples
            what = f"the value {naming.value(state, float(hops.mean[still, column]))}" if known else "one value"
            text = (
                f"{name}: repeated {what} for {lost_s:.3g} s, "
                f"expected to change within {STILL_S:g} s: the sensor or its line is stuck"
            )
        yield SensorFault(states=(state,), kind=FaultKind.STUCK, text=text, value=lost_s)


def _starts_or_stops(window: WindowStatistics, still: CountArray) -> BoolArray:
    """Hops in a part of which the angle stands, and in the rest turns slower than beside them, shape (n_hops,).

    An angle that is lost for a while turns as fast as before in the rest.
    """
    speeds = np.abs(window.hop_speed_rad_s)
    beside = np.fmax(np.append(speeds[1:], np.nan), np.append(np.nan, speeds[:-1]))
    moving = window.hop_waveform.n_samples - still
    return np.asarray((moving > 0) & (speeds * window.hop_waveform.n_samples < _SLOWER * beside * moving))


def dropped(window: WindowStatistics, naming: Naming) -> Iterator[SensorFault]:
    """Channels that jump to a constant and back in several hops, beyond the steps of a coarse converter."""
    hops = window.hop_waveform
    rate_hz = hops.n_samples * len(window.waveforms) / window.duration_s
    for column, state in enumerate(window.sensors):
        counts = hops.dropped[:, column]
        if state != "theta" and np.count_nonzero(counts) >= _FEWEST_DROPPED:
            lost_s = float(counts.sum()) / rate_hz
            text = (
                f"{naming.name(state)}: jumps to a constant and back, for {lost_s:.2g} s of {window.duration_s:.3g} s, "
                "expected an unbroken signal: a loose connector or a broken cable"
            )
            yield SensorFault(states=(state,), kind=FaultKind.STUCK, text=text, value=lost_s)


def clipped(window: WindowStatistics, naming: Naming) -> Iterator[SensorFault]:
    """Clipped channels: more samples lie exactly at a hop's extreme than even in a quantised sine."""
    hops = window.hop_waveform
    swing = (hops.maximum - hops.minimum) / 2
    step = np.where(np.isnan(hops.step), 0.0, hops.step)
    sine = np.sqrt(2 * step / np.where(swing > 0, swing, np.inf)) / np.pi
    allowed = FLAT_PART + 1.5 * sine
    for column, state in enumerate(window.sensors):
        if state == "theta":
            continue
        sides: dict[str, tuple[float, float]] = {}
        for side, counts, levels in (
            ("upper", hops.at_maximum, hops.maximum),
            ("lower", hops.at_minimum, hops.minimum),
        ):
            part = counts[:, column] / hops.n_samples
            over = (part > allowed[:, column]) & (hops.longest_run[:, column] < hops.n_samples)
            if np.any(over):
                sides[side] = (float(part[over].mean()), float(np.median(levels[over, column])))
        if sides:
            flat = sum(share for share, _ in sides.values())
            where = " and ".join(f"{naming.value(state, level)} ({side})" for side, (_, level) in sides.items())
            text = (
                f"{naming.name(state)}: cut off at {where}, {flat:.1%} of the samples lie exactly there, "
                f"expected less than {float(allowed[:, column].max()):.1%}: the measuring range is too small"
            )
            yield SensorFault(states=(state,), kind=FaultKind.CLIPPED, text=text, value=flat)


def at_range_end(windows: Sequence[WindowStatistics], naming: Naming, faulty: Collection[str] = ()) -> list[str]:
    """Say which channels often reach the end of their range, but with too few samples for `clipped`.

    Channels in `faulty` are left out: a stuck one, for example, is at one value in every hop.
    """
    hops, found = stacked_waveform([each for window in windows for each in window.waveforms]), []
    least = max(_FEWEST_LIMITED, _LIMITED_PART * len(hops.rms))
    for column, state in enumerate(windows[0].sensors):
        mean, rms, steps = hops.mean[:, column].mean(), hops.rms[:, column].mean(), hops.step[:, column]
        if state == "theta" or state in faulty or np.any(steps > _FINE * rms):
            continue
        for values, flat in ((hops.maximum, hops.at_maximum), (hops.minimum, hops.at_minimum)):
            furthest = values[np.argmax(np.abs(values[:, column] - mean)), column]
            hit = np.count_nonzero((values[:, column] == furthest) & (flat[:, column] > 1))
            if hit >= least and abs(furthest - mean) > _BEYOND_SINE * rms:
                name, value = naming.name(state), naming.value(state, float(furthest))
                found.append(f"{name} is at exactly {value} in {hit} of {len(hops.rms)} hops")
                break
    return found


def spiked(window: WindowStatistics, naming: Naming, _: SensorReference | None) -> Iterator[SensorFault]:
    """Displacements with peaks that the velocity or acceleration of the same motion does not show: no real motion."""
    hops = window.hop_waveform
    reach = np.maximum(hops.maximum - hops.mean, hops.mean - hops.minimum)
    crest = reach / np.where(hops.rms > 0, hops.rms, np.inf)
    for pair in motion_pairs(window.states):
        first, second = window.states[pair.first], window.states[pair.second]
        alone = (crest[:, pair.first] > _PEAKS) & (crest[:, pair.second] < _NO_PEAKS)
        if first.endswith("_dot") or not alone.mean() >= _PEAKED_PART:
            continue
        text = (
            f"{naming.name(first)}: peaks of up to {crest[alone, pair.first].max():.3g} times its rms in "
            f"{np.count_nonzero(alone)} of {len(alone)} hops, which {naming.name(second)} does not show: a loose "
            "connector, or a bad cable"
        )
        yield SensorFault(states=(first,), kind=FaultKind.INCOHERENT, text=text, value=None)


def offset(window: WindowStatistics, naming: Naming, reference: SensorReference | None) -> Iterator[SensorFault]:
    """Channels whose mean steps or drifts within the window, or differs from that in the reference."""
    means = window.hop_waveform.mean[:, : len(window.states)]
    # The median over the hops, so that a step within one does not raise the limit.
    rms, spread = np.median(window.hop_waveform.rms[:, : len(window.states)], axis=0), _spread(window)
    steps, drifts = _largest_step(means), means[-1] - means[0]
    moved, floor = np.full(len(window.states), np.nan), np.zeros(len(window.states))
    for column, state in enumerate(window.states):
        known = None if reference is None else reference.channel(state)
        if known is not None:
            moved[column] = means[:, column].mean() - known.mean
            floor[column] = max(STEP_SPREADS * max(known.mean_spread, spread[column]), MOVED_PART * known.rms)
    for column, state in enumerate(window.states):
        name, own = naming.name(state), float(rms[column])
        if not own > 0:  # `stuck` reports it
            continue
        step_z = float(abs(steps[column]) / spread[column]) if spread[column] > 0 else np.inf
        z: float | None = step_z
        jumped = step_z > STEP_SPREADS and abs(steps[column]) > STEP_PART * own
        drifted = abs(drifts[column]) > max(DRIFT_PART * own, STEP_SPREADS * spread[column])
        if jumped and not _shaft_moved(window.states, column, steps):
            value = float(steps[column])
            text = (
                f"{name}: the mean jumped by {naming.value(state, value)} within the window ({abs(value) / own:.3g} "
                f"times the channel's rms), expected a steady one: connector, supply or gap"
            )
        elif drifted and not _shaft_moved(window.states, column, drifts):
            value = float(drifts[column])
            z = abs(value) / float(spread[column])
            text = (
                f"{name}: the mean drifted by {naming.value(state, value)} within the window, the limit is "
                f"{DRIFT_PART:g} times the channel's rms ({naming.value(state, DRIFT_PART * own)})"
            )
        elif abs(moved[column]) > floor[column] and not _shaft_moved(window.states, column, moved):
            value, z = float(moved[column]), None
            text = (
                f"{name}: the mean stands {naming.value(state, value)} from where it was on the healthy machine, "
                f"expected within {naming.value(state, float(floor[column]))}"
            )
        else:
            continue
        yield SensorFault(states=(state,), kind=FaultKind.OFFSET, text=text, value=value, z=z)


CHECKS = (offset, spiked)
"""Checks of channels that are neither missing, stuck nor clipped, in their order."""


def _spread(window: WindowStatistics) -> FloatArray:
    """Robust standard deviation of a hop's mean from hop to hop, at least that which the lowest bins predict."""
    means, count = window.hop_waveform.mean[:, : len(window.states)], len(window.waveforms)
    between = np.zeros(len(window.states))
    if count > 3:
        steps = np.diff(means, axis=0)
        between = 1.4826 * np.median(np.abs(steps - np.median(steps, axis=0)), axis=0) / np.sqrt(2)
    lowest = np.median(np.einsum("fii->fi", window.spectrum[:10]).real, axis=0)
    return np.asarray(np.maximum(between, np.sqrt(lowest * count / window.duration_s)), dtype=np.float64)


def _largest_step(means: FloatArray) -> FloatArray:
    """Largest change of the mean beyond its usual drift, from the hop before to the hop after: a step may be in one."""
    if means.shape[0] < 4:
        return np.asarray(means[-1] - means[0], dtype=np.float64)
    across = means[2:] - means[:-2]
    across = across - np.median(across, axis=0)
    return np.asarray(across[np.abs(across).argmax(axis=0), np.arange(means.shape[1])], dtype=np.float64)


def _shaft_moved(states: tuple[str, ...], column: int, changes: FloatArray) -> bool:
    """Whether a displacement's mean changed together with another displacement's, as when the shaft moves."""
    places = [at for at, name in enumerate(states) if re.fullmatch(r"[yz][12]|\w+@[\d.]+", name)]
    others = [at for at in places if at != column] if column in places else []
    return any(abs(changes[at]) > _SHAFT_PART * abs(changes[column]) for at in others)


MOST_ERRORS = 6.0  # standard errors that a jump must exceed, tested at the most probable of all moments
_STAY_ERRORS = 3.0  # standard errors within which all else must be unchanged
LEAST_JUMP = 0.08
_FEWEST_SIDE = 3


def gain_jump(window: WindowStatistics, naming: Naming) -> Iterator[SensorFault]:
    """Find channels without a second sensor of their motion whose gain jumped within the window."""
    vectors, n = window.rotation_vectors, len(window.states)
    paired = {column for pair in motion_pairs(window.states) for column in (pair.first, pair.second)}
    if vectors is None or n < 3 or vectors.shape[0] < 2 * _FEWEST_SIDE + 2 or not np.all(np.abs(vectors) > 0):
        return
    length, angle = np.log(np.abs(vectors)), np.unwrap(np.angle(vectors), axis=0)
    angle = angle - np.median(angle, axis=1, keepdims=True)  # without a phase reference each hop has its own zero
    # Of what fluctuates alone: with the synchronous part, it would only repeat what the vectors say.
    fluctuation = window.hop_waveform.rms[:, :n] ** 2 - np.abs(vectors) ** 2 / 2
    level = np.log(np.maximum(fluctuation, np.finfo(float).tiny)) / 2
    for column in range(n):
        if column in paired:
            continue
        k = _moment(length[:, column])
        jumps, errors = _jumps(length, k)
        turns, turn_errors = _jumps(angle, k)
        levels, level_errors = _jumps(level, k)
        others = [i for i in range(n) if i != column]
        value = float(np.expm1(jumps[column]))
        z = float(abs(jumps[column]) / errors[column])
        alone = np.all(np.abs(jumps[others]) < np.maximum(_STAY_ERRORS * errors[others], abs(jumps[column]) / 4))
        quiet = np.all(np.abs(levels[others]) < np.maximum(_STAY_ERRORS * level_errors[others], abs(jumps[column]) / 4))
        straight = abs(turns[column]) < _STAY_ERRORS * turn_errors[column]
        moved = abs(levels[column]) > _STAY_ERRORS * level_errors[column]  # or a bearing that shows at 1x alone did it
        along = moved and abs(levels[column] - jumps[column]) < _STAY_ERRORS * level_errors[column]
        if z > MOST_ERRORS and abs(value) > LEAST_JUMP and alone and quiet and straight and along:
            state = window.states[column]
            why = "expected a change of the machine to show in more than one channel: its gain jumped"
            if state.startswith(("y1", "z1", "bearing")):  # others hardly show a bearing well below resonance
                why = "so either its gain jumped or the stiffness of that bearing did"
            text = (
                f"{naming.name(state)}: everything it measures changed by {value:+.0%} at once (± "
                f"{abs(value) / z:.1%}) while {naming.names(window.states[i] for i in others)} stayed as they were, "
                f"{why}"
            )
            yield SensorFault(states=(state,), kind=FaultKind.GAIN, text=text, value=value, z=z)


def _moment(series: FloatArray) -> int:
    """First hop after the most probable jump."""
    n = series.size
    sizes = [
        abs(series[k:].mean() - series[:k].mean()) * np.sqrt(k * (n - k) / n)
        for k in range(_FEWEST_SIDE, n - _FEWEST_SIDE + 1)
    ]
    return _FEWEST_SIDE + int(np.argmax(sizes))


def _jumps(series: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
    """Difference of the means after and before hop k, and its standard error from the scatter on either side."""
    before, after = series[:k], series[k:]
    left = ((before - before.mean(axis=0)) ** 2).sum(axis=0) + ((after - after.mean(axis=0)) ** 2).sum(axis=0)
    variance = left / (series.shape[0] - 2)
    error = np.sqrt(variance * (1 / k + 1 / (series.shape[0] - k)))
    return after.mean(axis=0) - before.mean(axis=0), np.maximum(error, np.finfo(float).tiny)
