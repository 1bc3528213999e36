"""Partial knowledge: stiffness, damping and unbalance of a rotor with known masses and shaft, from healthy windows.

The likelihood reads changes relative to a nominal rotor. Starting from a guess, the nominal rotor is moved to the
readings repeatedly until it is identified; all later readings relative to it share its remaining uncertainty.

Without a shaft angle only the size of the unbalance is identified, if it is the same in all windows. This is done for a
rotor that is known, too, as the unbalance in its file is only an assumption.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.commissioning.commissioned import Gyroscopic, in_sense
from models.diagnosis.baseline.learned import learn_baseline
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.readings import Diagnosis
from models.diagnosis.verdict.stretch import added, stretch_of
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError, MachineFileError
from models.machine import ConditionRange, Machine, MachineFile, Operation
from models.physics.rotor import PARAMETERS, M_matrix, Q_matrix, RotorParameters, changed, natural_frequencies
from models.signals.block import FloatArray
from models.stream_settings import segment_for

_ROUNDS = 8
_SETTLED = 0.02  # largest relative move of a parameter in the last round
_ONE_SIZE = 0.1  # largest relative deviation of an unbalance's size that may come from another speed or load
_MOST_TURNED_DEG = 20.0  # between healthy windows; more is another zero of the shaft angle rather than a change
_MOST_LESS = 0.9  # largest relative reduction of the unbalance in a round
_Start = tuple[float, float, int, int]
_Progress = Callable[[int, int], None]  # called with the rounds or windows done, and their total
# Damping ratios of the planes, and which of their modes the strongest peaks are; the next where one is too far off.
_DAMPING = ((0.05, 0.05), (0.2, 0.2), (0.05, 0.2), (0.2, 0.05), (0.01, 0.01))
_MODES = ((0, 0), (1, 1), (0, 1), (1, 0), (0, 2), (2, 0))
_STARTS: tuple[_Start, ...] = (
    *((*damping, *_MODES[0]) for damping in _DAMPING),
    *((*damping, *modes) for damping in _DAMPING for modes in _MODES[1:]),
)
_UNSEEN = (1.0, 0.7, 1.4)  # stiffness of a plane without a sensor over that of the other, by its `mode`
_LEAST_TOLERANCE = 0.05
_CUTOFF_HZ = (20.0, 300.0)
_NO_STIFFNESS = 1e5  # N/m, placeholder where no plane has a sensor
_E = PARAMETERS.index("e")
_NEARLY_RESOLVED = 1.5  # segments shorter by this factor than suits the narrowest mode are still good enough
_SCALES = tuple(np.geomspace(0.1, 10.0, 9).tolist())


@dataclass(frozen=True, slots=True)
class Identified:
    """A rotor identified on healthy windows."""

    machine: Machine  # the machine file with every parameter filled in
    names: tuple[str, ...]  # parameters that were identified; for a known rotor none, or e alone
    # (6, 6): of the identified values, in the scale of the errors (`models.diagnosis.verdict.stretch`), in the order of
    # `PARAMETERS`; zero for parameters that were not identified
    covariance: FloatArray
    diagnoses: tuple[Diagnosis, ...]  # the healthy windows read against it, without its uncertainty


def identify(
    machine: MachineFile, windows: Sequence[WindowStatistics], progress: _Progress, sense: Gyroscopic, *, sized: bool
) -> Identified:
    """Identify stiffness, damping and unbalance, given masses and shaft, in healthy windows that do not overlap.

    With `sized`, the size of the unbalance is identified if there is no shaft angle.

    Raises
    ------
    EstimationError
        If the parameters do not settle, or with `sized` the windows do not have the same unbalance.
    MachineFileError
        If masses or shaft are missing.
    """
    tried: list[Machine] = []
    failures: list[EstimationError] = []
    by_forces: dict[str, float] = {} if machine.rotor is None else _from_forces(machine.rotor.m2_kg, windows)
    for start in _STARTS:
        guess = in_sense(_first_guess(machine, windows, start, by_forces), sense)
        if guess in tried:  # the file or the relation of bearing and disc gives what the starts differ in
            continue
        tried.append(guess)
        try:
            return _settled(machine, guess, windows, progress, sense, sized=sized)
        except EstimationError as error:
            failures.append(error)
    if by_forces and (narrow := unresolved(machine, tried[0])):
        raise EstimationError(f"{failures[0]}. {narrow}") from failures[0]
    raise failures[0]


def unresolved(machine: MachineFile, found: Machine) -> str:
    """What to do if the segments of a machine file do not resolve the narrowest mode of its rotor; empty if they do."""
    modes, longer = natural_frequencies(found.rotor, found.operation.speed_rad_s), max(1.0, machine.time_scale)
    longer_s = segment_for(*modes, machine.window.band_hz[1], longer)
    if machine.schedule is not None or longer_s <= _NEARLY_RESOLVED * machine.window.segment_s:
        return ""
    return (
        f"A mode of this rotor is so narrow that segments of {machine.window.segment_s:g} s do not resolve it: the "
        f"healthy machine may raise alarms. Let segment_s in [window] be about {longer_s:g}, and commission again"
    )


def _settled(
    machine: MachineFile,
    whole: Machine,
    windows: Sequence[WindowStatistics],
    progress: _Progress,
    sense: Gyroscopic,
    *,
    sized: bool,
) -> Identified:
    """What is identified from one first guess; `EstimationError` if it is too far off to read the windows or settle."""
    diagnoses = [diagnosis for _, diagnosis in _read(whole, windows, sized=sized)]
    for number in range(1, _ROUNDS + 1):
        together = added([stretch_of(each, w.start_ns, w.end_ns) for each, w in zip(diagnoses, windows, strict=True)])
        values, covariance = together.estimate
        moves = dict(zip(together.names, values.tolist(), strict=True))
        whole, diagnoses = _moved(whole, moves, windows, sized=sized)
        progress(number, _ROUNDS)
        restless, *others = sorted(moves, key=lambda name: -abs(moves[name]))
        if abs(moves[restless]) < _SETTLED:
            break
        turned = [one.unbalance.turned_deg or 0.0 for one in diagnoses if one.unbalance and one.unbalance.turned]
        apart_deg = max(turned, default=0.0) - min(turned, default=0.0)
        other_zeros = restless == "e" and apart_deg > _MOST_TURNED_DEG
        # The mean of vectors that are turned so far apart is shorter than each of them, in every further round as well.
        if number == _ROUNDS or (other_zeros and all(abs(moves[name]) < _SETTLED for name in others)):
            why = "masses or shaft of [rotor] may be wrong, or the machine is not a bearing with an overhung disc"
            if other_zeros:
                why = (
                    f"its heavy spot is at angles that differ by {apart_deg:.0f}°: the zero of the shaft angle must be "
                    "the same in all recordings, as with one pulse per revolution; or leave the angle out"
                )
            raise EstimationError(
                f"{machine.title}: the rotor cannot be identified: after {number} rounds {restless} still moves; {why}"
            )
    total = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    total[np.ix_(together.known, together.known)] = covariance
    if sized and not has_angle(windows):
        total[_E, _E] = max(total[_E, _E], _size(machine, diagnoses)[1])
    as_described = in_sense(whole, sense)  # the opposite sense applied twice is the original
    return Identified(as_described, together.names, total, tuple(diagnoses))


def compare(
    machine: Machine, windows: Sequence[WindowStatistics], progress: _Progress, sense: Gyroscopic, *, sized: bool
) -> Identified:
    """Read healthy windows of a known rotor, as for `identify`; with `sized`, identify the size of its unbalance.

    Raises
    ------
    EstimationError
        If, without a shaft angle, the windows do not have the same unbalance.
    """
    whole, covariance = in_sense(machine, sense), np.zeros((len(PARAMETERS), len(PARAMETERS)))
    read = _read(whole, windows, progress, sized=sized)
    diagnoses = tuple(diagnosis for _, diagnosis in read)
    if not sized or has_angle(windows):
        return Identified(machine, (), covariance, diagnoses)
    size, covariance[_E, _E] = _size(machine, diagnoses)
    found = whole.model_copy(update={"rotor": changed(whole.rotor, {"e": size - 1})})
    relative = [fit.balanced(found, window, diagnosis) for (fit, diagnosis), window in zip(read, windows, strict=True)]
    return Identified(in_sense(found, sense), ("e",), covariance, tuple(relative))


def has_angle(windows: Sequence[WindowStatistics]) -> bool:
    """Whether a shaft angle was measured in any window."""
    return any(window.synchronous is not None for window in windows)


def _size(machine: MachineFile, diagnoses: Sequence[Diagnosis]) -> tuple[float, float]:
    """Size of the unbalance over the nominal one, and the relative variance of the size in a later window."""
    read = [reading for each in diagnoses for reading in each.evaluable if reading.name == "e"]
    sizes = np.array([1 + (reading.relative_change or 0.0) for reading in read])
    variances = np.array([(reading.standard_error or 0.0) ** 2 for reading in read])
    if len(read) < len(diagnoses) or not np.all(sizes > 0):
        raise EstimationError(f"{machine.title}: the unbalance is not read in all windows")
    weights = 1 / variances
    size = float(weights @ sizes / weights.sum())
    if np.any(np.abs(sizes - size) > _ONE_SIZE * size):
        raise EstimationError(f"{machine.title}: the unbalance is not of one size in all windows")
    scatter = max(0.0, float(np.mean((sizes - size) ** 2 - variances)))
    return size, (float(1 / weights.sum()) + scatter) / size**2


def _read(
    machine: Machine, windows: Sequence[WindowStatistics], progress: _Progress = lambda *_: None, *, sized: bool
) -> list[tuple[LikelihoodFit, Diagnosis]]:
    found = []
    for window in windows:
        fit = LikelihoodFit(machine, sized=sized)  # each from a cold start: conditions may differ
        try:
            found.append((fit, fit.diagnose(window)))
        except np.linalg.LinAlgError as error:
            raise EstimationError(f"{machine.name}: {error} in a healthy window") from error
        progress(len(found), len(windows))
    return found


def _moved(
    machine: Machine, moves: dict[str, float], windows: Sequence[WindowStatistics], *, sized: bool
) -> tuple[Machine, list[Diagnosis]]:
    """The machine with its parameters moved to the readings, and the windows read relative to it.

    Moves are in the scale of the errors. The unbalance is moved to the mean of the vectors read in the windows or,
    without vectors, to the size read.
    """
    steps = {name: math.expm1(min(1.5, max(-1.5, value))) for name, value in moves.items() if name != "e"}
    if "e" in moves and not has_angle(windows):
        steps["e"] = max(-_MOST_LESS, moves["e"])
    moved = machine.model_copy(update={"rotor": changed(machine.rotor, steps)})
    read = _read(moved, windows, sized=sized)
    vectors = [diagnosis.unbalance for _, diagnosis in read if diagnosis.unbalance is not None]
    if "e" not in moves or not vectors:
        return moved, [diagnosis for _, diagnosis in read]
    weights = np.array([1 / (one.variance_real + one.variance_imaginary) for one in vectors])
    parts = weights @ np.array([(one.real, one.imaginary) for one in vectors]) / weights.sum()
    size, turned = math.hypot(*parts), math.atan2(parts[1], parts[0])
    phase = math.remainder(moved.operation.unbalance_phase_rad + turned, 2 * math.pi)
    rotor = moved.rotor.model_copy(update={"e_m": moved.rotor.e_m * size})
    operation = moved.operation.model_copy(update={"unbalance_phase_rad": phase})
    balanced = moved.model_copy(update={"rotor": rotor, "operation": operation})
    pairs = zip(read, windows, strict=True)
    return balanced, [fit.balanced(balanced, window, diagnosis) for (fit, diagnosis), window in pairs]


def _first_guess(
    machine: MachineFile, windows: Sequence[WindowStatistics], start: _Start, by_forces: Mapping[str, float]
) -> Machine:
    """First guess of every parameter: from the file, the relation of bearing and disc, or the strongest peak."""
    known = machine.rotor
    if known is None or known.m2_kg is None or known.m1_kg is None:
        raise MachineFileError(f"{machine.title}: [rotor] gives no masses")
    speeds = [window.speed_rad_s for window in windows if np.isfinite(window.speed_rad_s)]
    if machine.operation is None and not speeds:
        why = "the recordings have no phase reference: give speed_rpm in [operation]"
        raise MachineFileError(f"{machine.title}: {why}")
    speed = machine.operation.speed_rad_s if machine.operation is not None else float(np.median(speeds))
    spread = max((abs(one / speed - 1) for one in speeds), default=0.0)
    tolerance = max(_LEAST_TOLERANCE, 1.5 * spread)
    operation = machine.operation or Operation(speed_rpm=speed * 30 / math.pi, speed_tolerance=tolerance)
    # e of the order of the synchronous motion; never 0, because e is read as a ratio.
    sizes = [float(np.max(np.abs(window.synchronous))) for window in windows if window.synchronous is not None]
    guesses = {"e_m": float(np.clip(np.median(sizes), 1e-7, 1e-3)) if sizes else 1e-6, **by_forces}
    given: dict[str, float] = known.model_dump(exclude_none=True)
    if "k_by_N_per_m" not in guesses or "k_bz_N_per_m" not in guesses:
        guesses |= _from_peak({**guesses, **given}, windows, start[2:])
    fields = {**guesses, **given}
    for axis, damping in zip("yz", start[:2], strict=True):
        k = fields[f"k_b{axis}_N_per_m"]
        fields.setdefault(f"c_b{axis}_N_s_per_m", 2 * damping * math.sqrt(k * (known.m1_kg + known.m2_kg)))
    low_hz, high_hz = (edge / machine.time_scale for edge in _CUTOFF_HZ)
    condition = machine.condition or ConditionRange(cutoff_hz=(low_hz, high_hz))
    tables = {"rotor": RotorParameters.model_validate(fields), "operation": operation, "condition": condition}
    return Machine.model_validate(machine.model_dump() | tables)


def _from_forces(m2_kg: float | None, windows: Sequence[WindowStatistics]) -> dict[str, float]:
    """Stiffness and damping from the relation of bearing and disc, whose first coefficients are -c/k and -m2/k."""
    if m2_kg is None:
        return {}
    try:
        baseline = learn_baseline([window.without_lines for window in windows])
    except EstimationError:
        return {}
    found = {}
    for axis, relation in zip("yz", baseline.relations, strict=True):
        if relation is not None and relation.coefficients[1] < 0:
            k = -m2_kg / float(relation.coefficients[1])
            found[f"k_b{axis}_N_per_m"] = k
            found[f"c_b{axis}_N_s_per_m"] = -float(relation.coefficients[0]) * k
    return found


def _from_peak(
    fields: dict[str, float], windows: Sequence[WindowStatistics], modes: tuple[int, int]
) -> dict[str, float]:
    """Stiffness for which one of the `modes` of each plane, from 0, is at its strongest peak."""
    found: dict[str, float] = {}
    window = windows[0]
    for axis, mode in zip("yz", modes, strict=True):
        columns = [n for n, name in enumerate(window.states) if name[0] == axis]
        if not columns:
            continue
        density = window.spectrum[:, columns[0], columns[0]].real
        peak_rad_s = 2 * np.pi * float(window.frequencies_hz[int(np.argmax(density))])
        mass = fields["m1_kg"] + fields["m2_kg"]
        rigid = mass * peak_rad_s**2
        filler = {name: fields.get(name, rigid) for name in ("k_by_N_per_m", "k_bz_N_per_m")}
        best = min(
            _SCALES,
            key=lambda scale: abs(
                _natural(fields | filler | {f"k_b{axis}_N_per_m": rigid * scale}, axis, mode) - peak_rad_s
            ),
        )
        found[f"k_b{axis}_N_per_m"] = rigid * best
    # A plane without a sensor is about as stiff as the other: the gyroscopic moments show something of it.
    like = next(iter(found.values()), _NO_STIFFNESS)
    return {
        name: found.get(name, fields.get(name, _UNSEEN[mode] * like))
        for name, mode in zip(("k_by_N_per_m", "k_bz_N_per_m"), modes, strict=True)
    }


def _natural(fields: dict[str, float], axis: str, mode: int) -> float:
    """Natural frequency in a plane, rad/s, at rest; `mode` counts from the lowest."""
    damping = {f"c_b{each}_N_s_per_m": fields.get(f"c_b{each}_N_s_per_m", 1.0) for each in "yz"}
    rotor = RotorParameters.model_validate({"e_m": 1e-6, **fields, **damping})
    at = slice(0, 3) if axis == "y" else slice(3, 6)
    squares = np.linalg.eigvals(np.linalg.solve(M_matrix(rotor)[at, at], Q_matrix(rotor)[at, at]))
    return float(np.sqrt(np.sort(squares.real)[mode]))
