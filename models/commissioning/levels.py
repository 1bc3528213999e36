"""Learning from healthy windows at each knowledge level."""

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import get_args

import numpy as np

from models.commissioning.checks import (
    MATTERS,
    SAME_SPEED,
    Check,
    check_agreement,
    check_determined,
    check_recordings,
    check_shapes,
    check_sources,
)
from models.commissioning.commissioned import (
    ConditionBaseline,
    Gyroscopic,
    IdentifiedRecord,
    KnowledgeLevel,
    OperatingRange,
)
from models.commissioning.healthy import HealthyRecording
from models.commissioning.identified import Identified, compare, has_angle, identify, unresolved
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.lag_moments import passband_hz
from models.diagnosis.baseline.learned import (
    disagreements,
    learn_baseline,
    planes_coupled,
    references_of,
    undetermined,
    unsuitable,
)
from models.diagnosis.baseline.rows import (
    COUPLED_ROWS,
    ROWS,
    Row,
    evaluable_rows,
    formation_of,
    learned_rows,
    not_measured,
)
from models.diagnosis.baseline.stored import Baseline
from models.diagnosis.modes import HealthyModes, learn_modes
from models.diagnosis.readings import Diagnosis
from models.diagnosis.shape import HealthyShape, learn_shape
from models.diagnosis.verdict.sequential import SequentialSettings
from models.diagnosis.verdict.stretch import determined, with_shared_error
from models.diagnosis.window.statistics import WindowStatistics, levels_of, window_statistics
from models.errors import EstimationError
from models.levels.measures import WindowLevels
from models.machine import Machine, MachineFile
from models.physics.rotor import FAULT_FIELDS, PARAMETER_TEXT, PARAMETERS
from models.signals.channels import ACCELERATIONS
from models.stream_settings import LONGEST_LAG_STEP_S

Read = tuple[str, int, Diagnosis]  # recording, end of the window in ns, and its diagnosis
Progress = Callable[[str, int, int], None]  # called with the present step in words, the steps done, and their total
_SIZE = 0.05  # relative difference in size up to which the unbalance is that of the file, turned to another angle
_OPPOSITE = (
    "gyroscopic moments have the sense in which natural frequencies of forward whirl rise with the speed; "
    "in the other one, which is tried first, the machine file does not explain the recordings"
)
_VALUES = "values in the machine file"
_NO_CHANCE = 3.0  # standard errors beyond which an identified value is not the file's
_WELL = 0.03  # standard error of a stiffness up to which its reading shows more than natural frequencies do
_TEXT_OF = {"y": "horizontal", "z": "vertical"}
_SHORTEST_HOPS = 4  # with fewer hops, their scatter is too uncertain


@dataclass(frozen=True, slots=True)
class Learned:
    """Results of learning at one knowledge level."""

    checks: tuple[Check, ...]
    diagnoses: tuple[Read, ...] = ()
    compared: tuple[Read, ...] = ()
    machine: Machine | None = None
    identified: IdentifiedRecord | None = None
    gyroscopic: Gyroscopic = "Eq. 27"
    baselines: tuple[ConditionBaseline, ...] = ()
    shape: HealthyShape | None = None
    modes: HealthyModes | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class HealthyPiece:
    """A healthy window, its recording, and whether it is in the later half of its stretch."""

    recording: str
    late: bool
    window: WindowStatistics
    levels: WindowLevels


def pieces_of(recordings: Sequence[HealthyRecording]) -> list[HealthyPiece]:
    """Windows that do not overlap, none longer than the monitor's, at least two of every stretch that allows it."""
    found = []
    for recording in recordings:
        plan = recording.plan
        for stretch in recording.stretches:
            if len(stretch) < _SHORTEST_HOPS:
                continue
            count = max(2, -(-len(stretch) // plan.hops)) if len(stretch) >= 2 * _SHORTEST_HOPS else 1
            cuts = np.linspace(0, len(stretch), count + 1).round().astype(int)
            parts = [stretch[a:b] for a, b in pairwise(cuts.tolist())]
            for number, part in enumerate(parts):
                window, levels = window_statistics(plan, part, lines=None), levels_of(plan, part)
                found.append(HealthyPiece(recording.name, 2 * number >= count, window, levels))
    return found


NO_SUCH_ROTOR = (
    "if the machine is not one bearing and an overhung disc, leave [rotor] out of the machine file: it is then "
    "compared with its own healthy windows"
)


def _learn_by_theory(
    machine: MachineFile, pieces: Sequence[HealthyPiece], progress: Progress, sense: Gyroscopic
) -> Learned:
    """Read the windows with the theory; without a shaft angle, identify the unbalance's size if all windows agree."""
    windows = [piece.window for piece in pieces]
    read_by: Callable[..., Identified]
    if isinstance(machine, Machine):
        read_by = partial(compare, machine, windows, partial(progress, "comparing with theory"), sense)
        what = "the parameters in the machine file"
    else:
        read_by = partial(identify, machine, windows, partial(progress, "identifying the rotor"), sense)
        what = "the identified rotor"
    try:
        found = read_by(sized=True)
    except EstimationError:
        if has_angle(windows):
            raise
        found = read_by(sized=False)
    pairs = zip(windows, found.diagnoses, strict=True)
    stated = [determined(diagnosis, window, machine.window_data_s) for window, diagnosis in pairs]
    record = None
    if found.names:
        stated = [with_shared_error(each, found.covariance) for each in stated]
        tables = found.machine.model_dump(mode="json", include={"rotor", "operation", "condition"})
        covariance = tuple(map(tuple, found.covariance.tolist()))
        record = IdentifiedRecord(machine=tables, names=found.names, covariance=covariance)
    check = check_agreement(machine, stated, what)
    if check.verdict == "refused":
        advice = f"{check.advice}; {NO_SUCH_ROTOR}"
        if isinstance(machine, Machine):
            advice = _turned_unbalance_advice(machine, stated) or (
                "the file does not describe the machine that was recorded: correct it, or leave "
                "out of [rotor] what is not known for certain, so that it is identified"
            )
        check = check.model_copy(update={"advice": advice})
    notes: tuple[str, ...] = ()
    if any(name in ACCELERATIONS for name in windows[0].states):
        low, high = machine.window.band_hz
        notes = (f"Accelerations are integrated to velocities in the spectrum, valid from {low:g} to {high:g} Hz.",)
    if narrow := unresolved(machine, found.machine):
        notes += (f"{narrow}.",)
    read = tuple((piece.recording, piece.window.end_ns, each) for piece, each in zip(pieces, stated, strict=True))
    return Learned((check,), read, read, found.machine, record, sense, notes=notes)


def _turned_unbalance_advice(machine: Machine, read: Sequence[Diagnosis]) -> str:
    """Advice if the unbalance is as large as in the file but at another angle; empty otherwise."""
    vectors = [each.unbalance for each in read if each.unbalance is not None and not each.unbalance.foreign]
    turned = [complex(one.real, one.imaginary) for one in vectors if one.turned and abs(one.magnitude_change) < _SIZE]
    if 2 * len(turned) <= len(read):
        return ""
    phase_rad = machine.operation.unbalance_phase_rad
    found_rad = math.remainder(phase_rad + cmath.phase(sum(turned)), 2 * math.pi)
    return (
        f"the unbalance is as large as in the file, but its heavy spot is {math.degrees(found_rad):z.0f}° from the "
        f"phase reference, whereas the file has it at {math.degrees(phase_rad):z.0f}°: if nothing else differs, give "
        f"unbalance_phase_rad = {found_rad:z.2f} in [operation]"
    )


def _learn_none(machine: MachineFile, pieces: Sequence[HealthyPiece], progress: Progress) -> Learned:
    windows = [piece.window for piece in pieces]
    longest_s = LONGEST_LAG_STEP_S * machine.time_scale
    wrong, too_slow = unsuitable(windows[0]), machine.rate_hz * longest_s < 1
    if wrong and not too_slow:
        advice = "change lag_step_s, lag_to_s or length_s in [window] of the machine file; the recordings can stay"
        return Learned((Check(name="window settings", verdict="refused", text=wrong, advice=advice),))
    shape, no_shape = None, ""
    try:
        shape = learn_shape(windows)
    except EstimationError as error:
        no_shape = str(error)
    if too_slow:
        why = f"a sampling rate of {machine.rate_hz:g} Hz allows no equation"
        check = _no_equations(why, no_shape, f"sample at {math.ceil(1 / longest_s)} Hz or faster")
    elif all(reason for _, reason in evaluable_rows(windows[0].states, bool(np.isfinite(windows[0].speed_rad_s)))):
        advice = (
            "to diagnose the bearing in one plane, measure displacement, velocity or acceleration in that plane at the "
            "bearing and at the disc"
        )
        check = _no_equations("these sensors allow no equation", no_shape, advice)
    else:
        try:
            return _with_modes(machine, windows, replace(_with_relations(machine, pieces, progress), shape=shape))
        except EstimationError as error:
            if shape is None:
                raise
            check = check_determined([str(error)], only_shapes=True)
    learned = _with_modes(machine, windows, Learned((check,), shape=shape))
    if shape is None or learned.modes is not None:
        return learned
    powers = shape.powers(SequentialSettings.for_machine(machine, short=False).shape_rate)
    return replace(learned, checks=(check, check_shapes(machine, powers, shape.windows)))


def _with_modes(machine: MachineFile, windows: Sequence[WindowStatistics], learned: Learned) -> Learned:
    """The same with natural frequencies to watch, if the stiffness of a measured plane is read badly or not at all."""
    read = [each for _, _, each in learned.diagnoses]
    vague = [_TEXT_OF[plane] for plane in "yz" if _vague(plane, windows[0].states, read)]
    modes = learn_modes([one.without_lines for one in windows], references_of(windows[0].states)) if vague else None
    if modes is None:
        return learned
    limits = modes.limits(SequentialSettings.for_machine(machine, short=False).shape_rate)
    watched = ", ".join(f"{one.frequency_hz:.4g} Hz (by {limit:.1%})" for one, limit in limits)
    note = (
        f"In the {' and '.join(vague)} plane no relation tells the stiffness to {_WELL:.0%}, so natural frequencies "
        f"are watched; a change is reported once two windows without common data show it: {watched}."
    )
    return replace(learned, modes=modes, notes=(*learned.notes, note)) if limits else learned


def _vague(plane: str, states: Sequence[str], read: Sequence[Diagnosis]) -> bool:
    errors = [one.standard_error for each in read for one in each.evaluable if one.name == f"k_b{plane}"]
    known = [error for error in errors if error is not None and error <= _WELL]
    return any(state[0] == plane for state in states) and 2 * len(known) <= len(read)


def _no_equations(why: str, no_shape: str, advice: str) -> Check:
    """No relation can be learned; `no_shape` says why no channel's shape can be either, empty if it can."""
    if no_shape:
        return Check(name="equations", verdict="refused", text=f"{why}; {no_shape}", advice=advice)
    text = (
        f"{why}: at most, a natural frequency or a channel is called changed, and no part of the machine will be named"
    )
    return Check(name="equations", verdict="limited", text=text, advice=advice)


_LINEAR = (
    "The relations are linear. A bearing that stiffens with its displacement reads up to 5 % too stiff or too soft "
    "under a force of another direction or level: smaller changes of its stiffness are not reported."
)


def _with_relations(machine: MachineFile, pieces: Sequence[HealthyPiece], progress: Progress) -> Learned:
    """Learn the relations, in one baseline or, if the recordings disagree, in one for each speed."""
    pieces = [replace(piece, window=piece.window.without_lines) for piece in pieces]
    groups = [pieces]
    baselines = [_baseline(groups[0])]
    agreement = check_recordings(machine, disagreements(baselines[0]), _speeds(pieces))
    if agreement is not None and agreement.verdict == "limited" and len(by_speed := _by_speed(pieces)) > 1:
        groups, baselines = by_speed, [_baseline(group) for group in by_speed]
    read: list[Read] = []
    compared: list[Read] = []
    for group, baseline in zip(groups, baselines, strict=True):
        diagnostician = BaselineDiagnostician(baseline.without_force)  # the report must also hold under other forces
        for piece in group:
            stated = determined(diagnostician.diagnose(piece.window), piece.window, machine.window_data_s)
            read.append((piece.recording, piece.window.end_ns, stated))
            progress("learning the relations", len(read), len(pieces))
        compared += _read_across_halves(group, baseline.rows, machine.window_data_s)
    halves = check_agreement(machine, [each for _, _, each in compared])
    determined_ = check_determined([reason for baseline in baselines for reason in baseline.reasons if reason])
    names = dict.fromkeys(piece.recording for piece in pieces)
    sources = check_sources({name: [each.window for each in pieces if each.recording == name] for name in names})
    band = _differentiated(baselines[0], machine)
    checks = (determined_, sources, halves) if agreement is None else (determined_, sources, agreement, halves)
    records = tuple(
        ConditionBaseline(conditions=OperatingRange.of([piece.window for piece in group]), baseline=baseline)
        for group, baseline in zip(groups, baselines, strict=True)
    )
    return Learned(checks, tuple(read), tuple(compared), baselines=records, notes=(band, _LINEAR))


def learned_baseline(windows: Sequence[WindowStatistics], conditions: Sequence[str]) -> Baseline:
    """Learn a baseline from healthy windows that do not overlap, without relations that they hardly determine.

    Each window has a condition, for example its recording.

    Raises
    ------
    EstimationError
        If no row is determined or, with a single condition, not every row whose motions are measured.
    """
    rows = COUPLED_ROWS if planes_coupled(windows) else ROWS
    baseline = learn_baseline(windows, conditions, rows)
    weak = undetermined(baseline)
    relations = tuple(None if why else one for one, why in zip(baseline.relations, weak, strict=True))
    reasons = tuple(why or reason for why, reason in zip(weak, baseline.reasons, strict=True))
    states = windows[0].states
    measured = [not not_measured(row.motions, states) for row in learned_rows(baseline.rows)]
    lost = [relation is None for relation, there in zip(relations, measured, strict=True) if there]
    # If a single recording does not determine one of two planes, the other one is not trusted either.
    if all(lost) or (any(lost) and len(set(conditions)) < 2):
        raise EstimationError("; ".join(dict.fromkeys(reason for reason in reasons if reason)))
    return baseline.model_copy(update={"relations": relations, "reasons": reasons})


def _differentiated(baseline: Baseline, machine: MachineFile) -> str:
    """Sentence on the frequency up to which derivatives of the measured motions are valid."""
    pairs = zip(learned_rows(baseline.rows), baseline.relations, strict=True)
    known = [(row.terms, relation.states) for row, relation in pairs if relation is not None]
    deepest = max(formation_of([term.motions for term in terms], states).deepest for terms, states in known)
    edge = passband_hz(deepest, machine.window.band_hz[1], machine.time_scale)
    return (
        f"What is not measured is derived: up to {deepest} derivatives are taken of the correlation functions under "
        f"smooth kernels, valid from 0 to {edge:.0f} Hz; higher frequencies hardly count."
    )


def _baseline(pieces: Sequence[HealthyPiece]) -> Baseline:
    return learned_baseline([piece.window for piece in pieces], [piece.recording for piece in pieces])


def _speeds(pieces: Sequence[HealthyPiece]) -> dict[str, float]:
    """Mean speed of each recording, rad/s; NaN if it is not known."""
    return {
        name: float(np.mean([piece.window.speed_rad_s for piece in pieces if piece.recording == name]))
        for name in dict.fromkeys(piece.recording for piece in pieces)
    }


def _by_speed(pieces: Sequence[HealthyPiece]) -> list[list[HealthyPiece]]:
    """Pieces in groups of one speed, slowest first; in a single one if a speed is not known."""
    speeds = _speeds(pieces)
    if not all(map(math.isfinite, speeds.values())):
        return [list(pieces)]
    groups: list[list[HealthyPiece]] = []
    last = -np.inf
    for name in sorted(speeds, key=speeds.__getitem__):
        if speeds[name] > last * (1 + SAME_SPEED) or not groups:
            groups.append([])
        groups[-1] += [piece for piece in pieces if piece.recording == name]
        last = speeds[name]
    return groups


def _read_across_halves(pieces: Sequence[HealthyPiece], rows: Sequence[Row], length_s: float) -> tuple[Read, ...]:
    """Every window, read against a baseline learned on the other halves of the recordings, as far as it determines."""
    found: list[Read] = []
    for late in (False, True):
        teaching = [piece for piece in pieces if piece.late is not late]
        asked = [piece for piece in pieces if piece.late is late]
        if not teaching or not asked:
            continue
        try:
            half = learn_baseline([p.window for p in teaching], [p.recording for p in teaching], rows)
        except EstimationError:
            continue  # half of the data is not enough for this machine, but all may be
        diagnostician = BaselineDiagnostician(half.without_force)
        for p in asked:
            found.append(
                (p.recording, p.window.end_ns, determined(diagnostician.diagnose(p.window), p.window, length_s))
            )
    return tuple(sorted(found, key=lambda read: read[1]))


def learn(level: KnowledgeLevel, machine: MachineFile, pieces: Sequence[HealthyPiece], progress: Progress) -> Learned:
    """Learn from the windows at a knowledge level.

    If the theory fails with gyroscopic moments of either sense, the reasons are those for the sense of Eq. (27).
    """
    if level is KnowledgeLevel.NONE:
        return _learn_none(machine, pieces, progress)
    found: list[Learned] = []
    errors: list[EstimationError] = []
    for sense in get_args(Gyroscopic):
        try:
            found.append(_learn_by_theory(machine, pieces, progress, sense))
        except EstimationError as error:
            errors.append(error)
            continue
        if all(check.verdict == "passed" for check in found[-1].checks):
            break
    best = min(found, key=_doubt, default=None)  # the first sense if both are equally good
    refused = best is None or _doubt(best) == _REFUSED
    otherwise = _identified_otherwise(machine, pieces, progress) if refused and isinstance(machine, Machine) else ()
    if best is None or (best.gyroscopic == "opposite" and refused):
        if otherwise:
            return Learned(otherwise)
        raise errors[0]
    best = replace(best, checks=(*best.checks, *otherwise))
    if level is KnowledgeLevel.PARTIAL:
        best = replace(best, checks=(*best.checks, *_not_as_given(machine, best), *_units_in_doubt(best)))
    return best if best.gyroscopic == "Eq. 27" else replace(best, notes=(*best.notes, _OPPOSITE))


def _identified_otherwise(machine: Machine, pieces: Sequence[HealthyPiece], progress: Progress) -> tuple[Check, ...]:
    """Check that gives the values that a file which is refused has wrong; empty if its masses and shaft do not fit.

    One window of each recording, or two of the only one, are enough to find a wrong unit.
    """
    rotor = machine.rotor.model_dump(exclude={FAULT_FIELDS[name] for name in PARAMETERS if name != "EI"})
    less = MachineFile.model_validate(machine.model_dump() | {"rotor": rotor})
    first = list({piece.recording: piece for piece in reversed(pieces)}.values())
    try:
        learned = learn(KnowledgeLevel.PARTIAL, less, first if len(first) > 1 else pieces[:2], progress)
    except EstimationError:
        return ()
    if learned.machine is None or _doubt(learned) == _REFUSED:
        return ()
    found = learned.machine.rotor
    fields = [FAULT_FIELDS[name] for name in _not_given(machine, learned)]
    told = [f"{field} {getattr(found, field):.3g} instead of {getattr(machine.rotor, field):.3g}" for field in fields]
    if not told:
        return ()
    text = f"with its masses and shaft, the recordings are those of a rotor with {', '.join(told)}"
    advice = "look for a wrong unit, or values that were exchanged; correct them, or leave them out of [rotor]"
    return (Check(name=_VALUES, verdict="refused", text=text, advice=advice),)


def _not_given(machine: MachineFile, learned: Learned) -> dict[str, float]:
    """Parameters that the recordings contradict, with their relative difference from what the file gives."""
    record, found = learned.identified, dict[str, float]()
    if machine.rotor is None or learned.machine is None or record is None:
        return found
    for name, variance in zip(PARAMETERS, np.diag(record.matrix()).tolist(), strict=True):
        given, identified = (getattr(rotor, FAULT_FIELDS[name]) for rotor in (machine.rotor, learned.machine.rotor))
        by = 0.0 if given is None or name not in record.names else identified / given - 1
        if abs(by) > max(MATTERS * machine.alarms.for_parameter(name).raise_above, _NO_CHANCE * math.sqrt(variance)):
            found[name] = by
    return found


def _not_as_given(machine: MachineFile, learned: Learned) -> tuple[Check, ...]:
    """Check that names what the file gives and the recordings contradict; empty without."""
    told = [f"{PARAMETER_TEXT[name]} ({name}) {by:+.0%}" for name, by in _not_given(machine, learned).items()]
    if not told:
        return ()
    text = f"identified otherwise than the machine file gives, and used as identified: {', '.join(told)}"
    advice = (
        "correct these values in [rotor], or leave out those of the bearing and e_m; if you know them for certain, "
        "masses or dimensions are not those of the machine: weigh and measure again"
    )
    return (Check(name=_VALUES, verdict="limited", text=text, advice=advice),)


def _units_in_doubt(learned: Learned) -> tuple[Check, ...]:
    """Check that doubts the units where the identified unbalance is larger than the shaft is thick; empty without."""
    if learned.machine is None or learned.machine.rotor.e_m <= learned.machine.rotor.shaft_diameter_m:
        return ()
    rotor = learned.machine.rotor
    thick = f"the shaft's diameter of {1e3 * rotor.shaft_diameter_m:.3g} mm"
    text = f"the unbalance is identified as e_m = {1e3 * rotor.e_m:.3g} mm, more than {thick}"
    advice = "check unit and scale of every channel: one wrong factor for all leaves changes in % right, but not levels"
    return (Check(name="units", verdict="limited", text=text, advice=advice),)


_DOUBTS = ("passed", "limited", "refused")
_REFUSED = _DOUBTS.index("refused")


def _doubt(learned: Learned) -> int:
    return max(_DOUBTS.index(check.verdict) for check in learned.checks)
