"""The phase reference: a shaft angle that loses pulses, jumps, slips, jitters, or turns at another speed.

The rotation-synchronous vectors are constant relative to the shaft. If those of all channels turn together and keep
their lengths, either the measured angle or the heavy spot has moved: any other change of the machine alters each vector
differently, and a growing unbalance keeps its angle. An angle that jumps does so within a turn, faster than any shaft;
if the angle went on steadily, the heavy spot has moved, and the angle is not at fault. If the vectors of only some
sensors turn, evenly and in both planes, those sensors are sampled by another clock.
"""

from collections.abc import Sequence

import numpy as np

from models.diagnosis.sensors.reference import Naming, SensorReference
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import ComplexArray, FloatArray
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

MOST_ERRORS = 8.0  # standard errors that a jump or slip must exceed; jumps are tested at the most probable moment
SEEN_ERRORS = 4.0  # the same if the angle itself jumps by as much at that moment
_HALF_RAD = 0.35  # largest distance from 180° of a turn that counts as reversed signs, with a straddling hop's error
LEAST_JUMP_RAD = 0.35  # a smaller jump does little harm and may come from the machine
LEAST_SLIP_RAD = 0.2  # least slip from hop to hop; thermal bending turns vectors, too, but by less
LEAST_JITTER = 0.05  # least power of the line left at 1x over that of the line removed: a jitter of 0.47 rad
LEAST_WILD_JITTER = 0.1  # the same if jitter makes the speed erratic, and the line is removed hop by hop
_ERRATIC = 2.5  # least total variation of the hops' speed over its range: 1 for a run-up, 2 for up and down again
# Range in which an erratic shaft's true speed is searched for, relative to the slowest and fastest hop.
_WILD_SPEEDS = (0.7, 1.5)
_JITTER_ERRORS = 6.0
# Least part of a line's power that keeps its phase: to the angle, or from segment to segment. For a resonance with
# 0.05 % damping driven by noise, it was at most 0.02 and 0.83.
_SHAFTS_PHASE, _LINES_PHASE = 0.5, 0.9
# Largest scatter of the turns per hop of a steady shaft, and largest distance of a loss from a whole number of turns.
_STEADY_TURNS, _WHOLE_TURNS = 0.02, 0.05
# A shaft angle is not in radians if every hop covers this part of the same range and at least so many radians, and the
# range is off a whole number of turns by so much.
_BOUNDED, _LEAST_RANGE_RAD, _OFF_TURNS = 0.95, 0.5, 0.2
_FEWEST_HOPS, _FEWEST_SIDE = 6, 3
_CLOCK_HOPS = 8  # number of newest hops in which a clock is found that has only just begun to run at another rate
LEAST_CLOCK_RAD = 0.1  # least turn from hop to hop of sensors on a clock of their own: 130 ppm at 24 Hz and 5 s
_ALIKE = 0.25
_MOST_Z, _LEAST_Z, _NEAR_BEST_PART = 3.0, 4.0, 0.8
_LENGTH = 0.15  # largest relative change of the vectors' common length that counts as unchanged
_LINE_BINS, _AROUND_BINS, _FEWEST_AROUND, _AROUND_HZ = 1, 12, 4, 6.0
_LINE_STRENGTH = 15.0  # least factor by which the power of a line exceeds its surroundings, mean over the channels
# The 1x is missing below this part of its healthy amplitude; a line elsewhere is the 1x within this factor of it.
_GONE, _THERE = 1 / 3, 3.0


def phase_faults(
    window: WindowStatistics, columns: Sequence[int], naming: Naming, reference: SensorReference | None
) -> list[SensorFault]:
    """At most one finding on the shaft angle or on the clocks of sensors, from channels without other faults.

    A speed that contradicts the vibration is only found with a reference.
    """
    vectors, speed = window.hop_synchronous, window.speed_rad_s
    if window.speed_source != "phase reference" or vectors is None or not columns or not abs(speed) > 0:
        return []
    name = naming.name("theta")
    found = _missing_turns(window, name) or _line_at_other_speed(window, columns, name, reference)
    if found is None and len(vectors) >= _FEWEST_HOPS:
        if not window.removed_by_hop:
            scaled, course = _common(columns, vectors)
            found = _slip(window, course, name) or _jump(window, scaled, course, name)
            found = found or _clock(window, columns, vectors, naming)
        found = found or _jitter(window, columns, vectors, name)
    return [found] if found else []


def no_angle(window: WindowStatistics, naming: Naming) -> list[SensorFault]:
    """Finding on a shaft angle that runs through the same range in every hop, other than a whole number of turns."""
    if "theta" not in window.sensors:
        return []
    hops, column = window.hop_waveform, window.sensors.index("theta")
    low, high = hops.minimum[:, column], hops.maximum[:, column]
    turns, least = np.ptp([low, high]) / (2 * np.pi), (high - low).min()
    if least < max(_LEAST_RANGE_RAD, _BOUNDED * 2 * np.pi * turns):  # it stands still, or keeps counting up
        return []
    rate_hz = hops.n_samples * len(low) / window.duration_s
    step = abs(window.speed_rad_s) / (2 * np.pi * rate_hz) if np.isfinite(window.speed_rad_s) else 0.0
    if abs(turns - max(1, round(turns))) <= _OFF_TURNS + (step if turns < 1 else 0):
        return []
    text = (
        f"{naming.name('theta')}: runs from {low.min():.1f} to {high.max():.1f} rad in every hop, expected 0 to 2π: "
        "turns, degrees or the volts of a pulse are not an angle in radians"
    )
    return [_theta(FaultKind.INCOHERENT, text, turns)]


def _theta(kind: FaultKind, text: str, value: float, z: float | None = None) -> SensorFault:
    return SensorFault(states=("theta",), kind=kind, text=text, value=value, z=z)


def _missing_turns(window: WindowStatistics, name: str) -> SensorFault | None:
    """Finding on whole turns missing from or added to single hops of an otherwise steady shaft."""
    hops = len(window.waveforms)
    if hops < _FEWEST_HOPS:
        return None
    turns = window.hop_speed_rad_s * (window.duration_s / hops) / (2 * np.pi)
    off = turns - np.median(turns)
    steady = np.abs(off) < 3 * _STEADY_TURNS
    if steady.all() or 2 * steady.sum() < hops or not (steady[0] and steady[-1]):
        return None
    spread = float(1.4826 * np.median(np.abs(off[steady])))
    strange = np.flatnonzero(~steady)
    stretches = np.split(strange, np.flatnonzero(np.diff(strange) > 1) + 1)
    sums = np.array([off[stretch].sum() for stretch in stretches])
    whole = np.round(sums)
    if spread > _STEADY_TURNS or np.any(whole == 0) or np.any(np.abs(sums - whole) > _WHOLE_TURNS):
        return None
    if any(stretch.size > 2 for stretch in stretches):
        return None
    lost = float(-whole.sum())
    what = "lost" if lost > 0 else "counted too many"
    text = (
        f"{name}: {abs(whole).sum():.0f} whole turns {what} in {strange.size} of {hops} hops of a shaft that turns "
        f"{np.median(turns):.4g} ± {spread:.2g} times in each otherwise: pulses are missing or doubled"
    )
    return _theta(FaultKind.INCOHERENT, text, lost)


def _surroundings(window: WindowStatistics, columns: Sequence[int], at: int) -> tuple[FloatArray, FloatArray]:
    """Mean square of a line beyond its surroundings, and the spectral density of the surroundings."""
    power = np.einsum("fii->fi", window.spectrum).real[:, list(columns)]
    step_hz = window.frequencies_hz[1] - window.frequencies_hz[0]
    # If bins are wide, as many would reach beyond a resonance, whose flank is not a line.
    around = min(_AROUND_BINS, max(_FEWEST_AROUND, round(_AROUND_HZ / step_hz)))
    near = np.arange(max(0, at - around), min(power.shape[0], at + around + 1))
    beside = np.maximum(np.median(power[near[np.abs(near - at) > _LINE_BINS + 1]], axis=0), np.finfo(float).tiny)
    bins = power[max(0, at - _LINE_BINS) : at + _LINE_BINS + 1]
    return np.asarray(2 * step_hz * (bins - beside).sum(axis=0)), np.asarray(beside)


def _line_at_other_speed(
    window: WindowStatistics, columns: Sequence[int], name: str, reference: SensorReference | None
) -> SensorFault | None:
    """Finding on a healthy 1x that is missing at the angle's speed and appears at another one."""
    vectors = window.hop_synchronous
    if reference is None or vectors is None or window.frequencies_hz.size <= 4 * _AROUND_BINS:
        return None
    known = [(column, reference.channel(window.states[column])) for column in columns]
    usual = {column: one.rotation for column, one in known if one is not None and one.rotation}
    if len(usual) < min(2, len(columns)):
        return None
    there, amplitude = list(usual), np.array(list(usual.values()))
    # Mean length, not length of the mean: vectors that pass through zero, as when a bow grows, are not missing.
    if np.median(np.abs(vectors[:, there]).mean(axis=0) / amplitude) > _GONE:
        return None
    power = np.einsum("fii->fi", window.spectrum).real[:, there]
    count = power.shape[0] // _AROUND_BINS
    rows = power[: count * _AROUND_BINS].reshape(count, _AROUND_BINS, -1)
    ratio = (rows / np.maximum(np.median(rows, axis=1, keepdims=True), np.finfo(float).tiny)).mean(axis=2).ravel()
    at = int(ratio[2:-2].argmax()) + 2
    f = window.frequencies_hz
    turned = np.any(np.abs(np.abs(window.hop_speed_rad_s) / (2 * np.pi) - f[at]) <= f[1] - f[0])
    if ratio[at] < _LINE_STRENGTH or turned:  # the shaft may have turned at that speed earlier in the window
        return None
    line, _ = _surroundings(window, there, at)
    seen = np.sqrt(2 * np.maximum(line, 0.0)) / amplitude
    if not 1 / _THERE < float(np.median(seen)) < _THERE:
        return None
    rpm, own_rpm = 60 * window.frequencies_hz[at], window.speed_rad_s * 30 / np.pi
    pulses = "there are too many pulses throughout" if abs(own_rpm) > rpm else "pulses are missing throughout"
    text = (
        f"{name}: turns at {own_rpm:.5g} rpm, but the vibration shows the rotation at {rpm:.5g} rpm and not there: "
        f"the angle is not this shaft's, or {pulses}"
    )
    return _theta(FaultKind.INCOHERENT, text, float(own_rpm / rpm))


def _common(columns: Sequence[int], vectors: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Vectors of all hops, each channel in units of its own noise, and their common course (rank-1 SVD), (n_hops,)."""
    own = vectors[:, list(columns)]
    size = np.sqrt((np.abs(own) ** 2).mean(axis=0))
    noise = np.abs(np.diff(np.abs(own), axis=0)).mean(axis=0)
    unit = own / np.maximum(noise, np.maximum(1e-3 * size, np.finfo(float).tiny))
    left, singular, _ = np.linalg.svd(unit, full_matrices=False)
    return unit, np.asarray(left[:, 0] * singular[0], dtype=np.complex128)


def _slip(window: WindowStatistics, course: ComplexArray, name: str) -> SensorFault | None:
    """Finding on vectors that keep their length and turn evenly from hop to hop."""
    length = np.abs(course)
    if length.std() > _ALIKE * length.mean():
        return None
    steps = np.angle(course[1:] * course[:-1].conj())
    mean = float(np.angle(np.exp(1j * steps).mean()))
    error = float(np.std(np.angle(np.exp(1j * (steps - mean))))) / np.sqrt(steps.size)
    if abs(mean) < max(LEAST_SLIP_RAD, MOST_ERRORS * error):
        return None
    per_minute = mean / (2 * np.pi) * len(course) / window.duration_s * 60
    text = (
        f"{name}: slips against the vibration by {per_minute:+.3g} turns a minute, expected none: "
        "the angle is not this shaft's, or pulses are missing throughout"
    )
    value = 1 + per_minute / (window.speed_rad_s * 30 / np.pi)
    return _theta(FaultKind.INCOHERENT, text, value, abs(mean) / max(error, 1e-9))


def _clock(
    window: WindowStatistics, columns: Sequence[int], vectors: ComplexArray, naming: Naming
) -> SensorFault | None:
    """Finding on sensors of both planes whose vectors turn evenly at constant length, while others in both do not.

    A change of the machine turns the vectors of one plane, or all with the heavy spot, and mostly by a bounded angle.
    """
    states = [window.states[column] for column in columns]
    planes = np.array([state[0] for state in states])
    for hops in sorted({_CLOCK_HOPS, len(vectors)}):
        own = vectors[-hops:, list(columns)]
        if len(own) < _CLOCK_HOPS:
            return None
        phases, at = np.unwrap(np.angle(own), axis=0), np.arange(len(own)) - (len(own) - 1) / 2
        rates = at @ phases / (at @ at)
        left = phases - phases.mean(axis=0) - np.outer(at, rates)
        errors = np.maximum(np.sqrt((left**2).sum(axis=0) / (len(own) - 2) / (at @ at)), 1e-3)
        surest = int((np.abs(rates) / errors).argmax())
        rate, z = float(rates[surest]), float(np.abs(rates[surest]) / errors[surest])
        turning = np.abs(rates - rate) < np.abs(rates)
        apart = np.abs(np.where(turning, rates - rate, rates)) > np.maximum(_MOST_Z * errors, _ALIKE * abs(rate))
        lengths = np.abs(own[:, turning])
        if abs(rate) < LEAST_CLOCK_RAD or z < MOST_ERRORS or np.any(apart) or np.any(_LEAST_Z * errors > abs(rate)):
            continue
        if np.any(lengths.std(axis=0) > _ALIKE * lengths.mean(axis=0)):
            continue
        if set(planes[turning]) != set("yz") or set(planes[~turning]) != set("yz"):
            continue
        found = tuple(state for state, one in zip(states, turning, strict=True) if one)
        ahead_s = rate / window.speed_rad_s  # lead over the others that each hop adds
        part = ahead_s * len(vectors) / window.duration_s
        text = (
            f"{naming.names(found)} turn by {np.degrees(rate):+.0f}° from hop to hop against the shaft angle and the "
            f"other sensors, expected none: they are sampled by a clock of their own, about {abs(part) * 1e6:.0f} ppm "
            f"{'slow' if part > 0 else 'fast'}"
        )
        return SensorFault(states=found, kind=FaultKind.DELAY, text=text, value=-ahead_s * len(vectors), z=z)
    return None


def _jump(window: WindowStatistics, vectors: ComplexArray, course: ComplexArray, name: str) -> SensorFault | None:
    """Finding if all vectors turned by one angle between two hops at constant length, and the shaft angle jumped.

    If data are missing between the hops, a jump of the angle cannot be seen, and the vectors alone decide. They also
    decide if they turned by half a turn, as when the signs of all sensors are reversed.
    """
    turns = [_turn(course[:, None], k) for k in range(1, len(course) - _FEWEST_SIDE + 1)]
    z = np.array([abs(float(change[0])) / float(error[0]) for change, error in turns])
    best = float(z.max())
    if best < SEEN_ERRORS:
        return None
    # The hop that straddles the jump has an angle in between or, for half a turn, only a shorter vector.
    longer = np.array([_longer(course, k) for k in range(1, len(z) + 1)])
    at = 1 + int(np.where(z > _NEAR_BEST_PART * best, longer, np.inf).argmin())
    change, error = turns[at - 1]
    value = float(change[0])
    own = window.hop_jump_rad[max(1, at - 2) : at + 2]
    seen = np.abs(np.angle(np.exp(1j * (own + value)))) < max(_MOST_Z * float(error[0]), _ALIKE * abs(value))
    lengths = np.abs(np.delete(course, [0, at - 1, at]))
    steady = lengths.std() < _LENGTH * lengths.mean()  # not where a bow grows through the unbalance to the other side
    half = steady and best > MOST_ERRORS and np.pi - abs(value) < _HALF_RAD
    if seen.any():
        value = float(np.angle(np.exp(-1j * own[seen.argmax()])))
    elif best < MOST_ERRORS or not (half or np.isnan(own).any()):
        return None
    own_turns, errors = _turn(vectors, at)
    together = np.abs(np.angle(np.exp(1j * (own_turns - value)))) < np.maximum(_MOST_Z * errors, _ALIKE * abs(value))
    clear = _MOST_Z * errors < abs(value) / 2
    known = seen.any() or 2 * clear.sum() >= clear.size
    # The first hop may itself be astride half a turn: shorter, but not turned by another angle.
    most = np.inf if half and at <= 2 else max(_LENGTH, _MOST_Z * float(error[0]))
    if abs(value) < LEAST_JUMP_RAD or longer[at - 1] > most or not np.all(together) or not known:
        return None
    if half and not seen.any():
        text = (
            f"{name}: went on as before, but every channel's 1× vector turned by 180° (± "
            f"{np.degrees(float(error[0])):.1f}°) within the window and kept its length: the signs of all sensors were "
            "reversed, or the heavy spot has moved to the opposite side at once"
        )
        return _theta(FaultKind.OFFSET, text, np.pi, best)
    text = (
        f"{name}: jumped by {np.degrees(-value):+.0f}° (± {np.degrees(float(error[0])):.1f}°) within the window: every "
        "channel's 1× vector turned by as much and kept its length, expected a machine to change each differently"
    )
    return _theta(FaultKind.OFFSET, text, -value, best)


def _longer(course: ComplexArray, k: int) -> float:
    """Relative change of the common length at hop k, without the hops next to it."""
    before, after = np.abs(course[: max(1, k - 1)]), np.abs(course[k + 1 :])
    return abs(float(after.mean() / before.mean()) - 1)


def _turn(vectors: ComplexArray, k: int) -> tuple[FloatArray, FloatArray]:
    """Angle by which each column turned at hop k, without the hops next to it, and its standard error."""
    before, after = vectors[: max(1, k - 1)], vectors[k + 1 :]
    first, second = before.mean(axis=0), after.mean(axis=0)
    scatter = np.concatenate([np.angle(before * first.conj()), np.angle(after * second.conj())])
    freedom = max(1, len(scatter) - 2)
    variance = (scatter**2).sum(axis=0) / freedom
    error = np.sqrt(variance * (1 / len(before) + 1 / len(after)))
    return np.asarray(np.angle(second * first.conj())), np.asarray(np.maximum(error, 1e-3))


def _jitter(window: WindowStatistics, columns: Sequence[int], vectors: ComplexArray, name: str) -> SensorFault | None:
    """Finding on a line that remains in the spectrum at 1x although the synchronous part was removed."""
    speeds = np.abs(window.hop_speed_rad_s)
    edges = [window.speed_rad_s, window.speed_rad_s]
    if window.removed_by_hop:
        if np.abs(np.diff(speeds)).sum() < _ERRATIC * np.ptp(speeds):
            return None
        edges = [_WILD_SPEEDS[0] * speeds.min(), _WILD_SPEEDS[1] * speeds.max()]
    f = window.frequencies_hz
    first, last = (round((abs(edge) / (2 * np.pi) - f[0]) / (f[1] - f[0])) for edge in edges)
    inside = first > 2 * _LINE_BINS and last < f.size - 2 * _LINE_BINS
    own = vectors[:, list(columns)]
    out = (np.abs(own if window.removed_by_hop else own.mean(axis=0, keepdims=True)) ** 2).mean(axis=0) / 2
    kept = window.phase_kept
    if not inside or kept is None or not np.all(out > 0):
        return None
    step_hz, hop_s = f[1] - f[0], window.duration_s / len(own)
    # Jitter of more than half a radian miscounts turns at random: the line is then only near the speeds of the hops.
    power = np.einsum("fii->fi", window.spectrum[first : last + 1]).real[:, list(columns)]
    # A resonance also stands out of the spectrum, but its noise does not keep its phase.
    least = _LINES_PHASE if window.removed_by_hop else _SHAFTS_PHASE
    lines = np.median(kept[first : last + 1, list(columns)], axis=1) >= least
    if not lines.any():
        return None
    strength = (power / np.maximum(power.mean(axis=0), np.finfo(float).tiny)).sum(axis=1)
    middle = first + int(np.where(lines, strength, -1.0).argmax())
    left, beside = _surroundings(window, columns, middle)
    if not window.removed_by_hop:
        # Real changes of amplitude also leave a line; scatter of the amplitudes due to the surrounding noise does not.
        moved = (np.abs(own - own.mean(axis=0)) ** 2).mean(axis=0) / 2 - 2 * beside / hop_s
        left = left - 2 * np.maximum(moved, 0.0)
    error = 2 * step_hz * beside * np.sqrt((2 * _LINE_BINS + 1) * 2.0 / window.n_segments)
    share, z = float(np.median(left / out)), float(np.median(left / error))
    if share < (LEAST_WILD_JITTER if window.removed_by_hop else LEAST_JITTER) or z < _JITTER_ERRORS:
        return None
    jitter_rad = float(np.sqrt(2 * np.arcsinh(np.sqrt(share) / 2)))
    text = (
        f"{name}: jitters by about {np.degrees(jitter_rad):.0f}° rms: {share:.0%} of the rotation's power is still in "
        f"every channel after the part synchronous with the angle was removed, expected next to nothing"
    )
    return _theta(FaultKind.NOISE, text, jitter_rad, z)
