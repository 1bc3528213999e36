"""Commission a machine from healthy recordings, with as much physics as its file gives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from models.commissioning.checks import (
    Check,
    check_agreement,
    check_data,
    check_halves,
    check_lines,
    check_sensors_of,
    check_steady,
)
from models.commissioning.commissioned import Commissioned, IdentifiedRecord, RecordingEntry, described
from models.commissioning.conditions import OperatingRange
from models.commissioning.healthy import HealthyRecording
from models.commissioning.identified import identify
from models.commissioning.knowledge import KnowledgeLevel, knowledge_of
from models.commissioning.report import CommissioningReport, EquationRow, parameter_summaries
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.learned import learn_baseline
from models.diagnosis.baseline.rows import evaluable_rows
from models.diagnosis.baseline.stored import BaselineRecord
from models.diagnosis.fallback.shape import HealthyShape, learn_shape
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.networks.equations import EQUATIONS, missing
from models.diagnosis.readings import Diagnosis
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.reference import learn_sensor_reference
from models.diagnosis.verdict.determined import determined, with_shared_error
from models.diagnosis.window import WindowStatistics, window_statistics
from models.errors import EstimationError
from models.machine import Machine, MachineFile
from models.physics.parameters import FAULT_FIELDS, PARAMETERS

__all__ = ["Commissioning", "commission"]

_Read = tuple[str, int, Diagnosis]
_SHORTEST_HOPS = 4
"""Fewer say too little of how they scatter."""
_TABLES = ("rotor", "operation", "condition")


@dataclass(frozen=True, slots=True)
class Commissioning:
    """What came of it.

    Attributes
    ----------
    report : CommissioningReport
    commissioned : Commissioned or None
        None if it was refused.
    machine : Machine or None
        With all parameters, where they are given or identified: networks can be trained for it.
    """

    report: CommissioningReport
    commissioned: Commissioned | None
    machine: Machine | None


@dataclass(frozen=True, slots=True)
class _Learned:
    """What one level of knowledge made of the windows."""

    checks: tuple[Check, ...]
    diagnoses: tuple[_Read, ...] = ()
    compared: tuple[_Read, ...] = ()
    machine: Machine | None = None
    identified: IdentifiedRecord | None = None
    baseline: BaselineRecord | None = None
    shape: HealthyShape | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Piece:
    """A healthy window and where it comes from."""

    recording: str
    late: bool
    window: WindowStatistics


def commission(
    machine: MachineFile,
    recordings: Sequence[HealthyRecording],
    entries: Sequence[RecordingEntry],
    *,
    wished: float | None = None,
    replaces: Commissioned | None = None,
    why: str = "",
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Commissioning:
    """Commission a machine.

    Parameters
    ----------
    machine : MachineFile
    recordings : sequence of HealthyRecording
        One for each file; of one steady condition each.
    entries : sequence of RecordingEntry
        What is kept of each file.
    wished : float, optional
        Relative change that shall be found; the alarm limit without it.
    replaces : Commissioned, optional
        The version before.
    why : str
        Why it is commissioned again.
    progress : callable, optional
        Told what is being done, how much of it is done, and how much there is.
    """
    knowledge = knowledge_of(machine)
    checks = [check_data(machine, recordings)]
    pieces = [] if checks[0].verdict == "refused" else _pieces(recordings)
    learned = _Learned(())
    if pieces:
        by_recording = {
            one.name: [piece.window for piece in pieces if piece.recording == one.name] for one in recordings
        }
        findings = {
            name: [f for window in windows for f in sensor_findings(window, None, machine.sensors)]
            for name, windows in by_recording.items()
        }
        checks += [check_sensors_of(findings), check_steady(recordings, by_recording), check_lines(recordings)]
        if all(check.verdict != "refused" for check in checks):
            try:
                learned = _LEVELS[knowledge.level](machine, pieces, progress)
            except EstimationError as error:
                learned = _Learned((_not_learned(knowledge.level, str(error)),))
            checks += learned.checks
    refused = any(check.verdict == "refused" for check in checks)
    windows = [piece.window for piece in pieces]
    commissioned = None
    if not refused and (learned.machine is not None or learned.baseline is not None or learned.shape is not None):
        commissioned = Commissioned(
            site=machine.site,
            machine=machine.name,
            described=described(machine),
            level=knowledge.level,
            version=1 if replaces is None else replaces.version + 1,
            replaces=None if replaces is None else replaces.identity,
            why=why,
            recordings=tuple(entries),
            conditions=OperatingRange.of(windows),
            identified=learned.identified,
            baseline=learned.baseline,
            shape=learned.shape,
            sensors=learn_sensor_reference(windows),
        )
    return Commissioning(
        _report(machine, recordings, checks, learned, commissioned, pieces, wished), commissioned, learned.machine
    )


def _pieces(recordings: Sequence[HealthyRecording]) -> list[_Piece]:
    """Windows that do not overlap, none longer than the monitor's, at least two of every stretch that allows it."""
    found = []
    for recording in recordings:
        plan = recording.plan
        for stretch in recording.stretches:
            count = max(2, -(-len(stretch) // plan.hops)) if len(stretch) >= 2 * _SHORTEST_HOPS else 1
            if len(stretch) < _SHORTEST_HOPS:
                continue
            cuts = np.linspace(0, len(stretch), count + 1).round().astype(int)
            windows = [window_statistics(plan, stretch[a:b]) for a, b in pairwise(cuts.tolist())]
            found += [
                _Piece(recording.name, 2 * number >= len(windows), window) for number, window in enumerate(windows)
            ]
    return found


def _not_learned(level: KnowledgeLevel, text: str) -> Check:
    return Check(
        name="can be learned",
        verdict="refused",
        text=f"at level {level}: {text}",
        advice="record longer, at more than one speed or load, and while more than the unbalance moves the machine",
    )


def _read_known(
    machine: Machine, pieces: Sequence[_Piece], progress: Callable[[str, int, int], None]
) -> tuple[_Read, ...]:
    found = []
    for number, piece in enumerate(pieces):
        diagnosis = LikelihoodFit(machine).diagnose(piece.window)
        found.append(
            (piece.recording, piece.window.end_ns, determined(diagnosis, piece.window, machine.window.length_s))
        )
        progress("comparing with theory", number + 1, len(pieces))
    return tuple(found)


def _learn_full(machine: MachineFile, pieces: Sequence[_Piece], progress: Callable[[str, int, int], None]) -> _Learned:
    assert isinstance(machine, Machine)  # noqa: S101  # the level says so
    read = _read_known(machine, pieces, progress)
    check = check_agreement([each for _, _, each in read], "the parameters in the machine file")
    if check.verdict == "refused":
        check = check.model_copy(
            update={
                "advice": "the file describes another machine than was recorded: correct it, or leave out of [rotor] "
                "what is not known for certain, so that it is identified"
            }
        )
    return _Learned((check,), read, read, machine)


def _learn_partial(
    machine: MachineFile, pieces: Sequence[_Piece], progress: Callable[[str, int, int], None]
) -> _Learned:
    windows = [piece.window for piece in pieces]
    identified = identify(machine, windows, partial(progress, "identifying the rotor"))
    read = tuple(
        (piece.recording, piece.window.end_ns, with_shared_error(stated, identified.covariance))
        for piece, diagnosis in zip(pieces, identified.diagnoses, strict=True)
        for stated in [determined(diagnosis, piece.window, machine.window.length_s)]
    )
    filled = identified.machine.model_dump(mode="json", include=set(_TABLES))
    record = IdentifiedRecord(
        machine=filled,
        names=identified.names,
        covariance=tuple(tuple(row) for row in identified.covariance.tolist()),
    )
    check = check_agreement([each for _, _, each in read], "the identified rotor")
    return _Learned((check,), read, read, identified.machine, record)


def _learn_none(_: MachineFile, pieces: Sequence[_Piece], progress: Callable[[str, int, int], None]) -> _Learned:
    windows = [piece.window for piece in pieces]
    try:
        shape = learn_shape(windows)
        no_shape = ""
    except EstimationError as error:
        shape, no_shape = None, str(error)
    evaluable = [
        row for row, reason in evaluable_rows(windows[0].states, windows[0].synchronous is not None) if not reason
    ]
    if not evaluable:
        return _without_equations(shape, no_shape)
    baseline = learn_baseline(windows, [piece.recording for piece in pieces])
    diagnostician = BaselineDiagnostician(baseline)
    read = []
    for number, piece in enumerate(pieces):
        read.append((piece.recording, piece.window.end_ns, diagnostician.diagnose(piece.window)))
        progress("learning the relations", number + 1, len(pieces))
    compared = _halves(pieces)
    return _Learned(
        (check_halves([each for _, _, each in compared]),),
        tuple(read),
        compared,
        baseline=BaselineRecord.of(baseline),
        shape=shape,
    )


def _without_equations(shape: HealthyShape | None, no_shape: str) -> _Learned:
    advice = (
        "for the bearing in one plane: a displacement, velocity or acceleration at the bearing and at the disc in that "
        "plane"
    )
    if shape is None:
        check = Check(
            name="equations", verdict="refused", text=f"these sensors allow no equation; {no_shape}", advice=advice
        )
        return _Learned((check,))
    text = (
        "these sensors allow no equation: each channel will only be called changed or not changed, and no part of the "
        "machine will be named"
    )
    return _Learned((Check(name="equations", verdict="limited", text=text, advice=advice),), shape=shape)


def _halves(pieces: Sequence[_Piece]) -> tuple[_Read, ...]:
    """Every window read against what the other halves of the recordings teach."""
    found: list[_Read] = []
    for late in (False, True):
        teaching = [piece for piece in pieces if piece.late is not late]
        asked = [piece for piece in pieces if piece.late is late]
        if not teaching or not asked:
            continue
        try:
            half = learn_baseline([piece.window for piece in teaching], [piece.recording for piece in teaching])
        except EstimationError:
            continue  # half of the data is too little for this machine; the whole may be enough
        diagnostician = BaselineDiagnostician(half)
        found += [(p.recording, p.window.end_ns, diagnostician.diagnose(p.window)) for p in asked]
    return tuple(sorted(found, key=lambda read: read[1]))


_LEVELS = {
    KnowledgeLevel.FULL: _learn_full,
    KnowledgeLevel.PARTIAL: _learn_partial,
    KnowledgeLevel.NONE: _learn_none,
}


def _report(
    machine: MachineFile,
    recordings: Sequence[HealthyRecording],
    checks: Sequence[Check],
    learned: _Learned,
    commissioned: Commissioned | None,
    pieces: Sequence[_Piece],
    wished: float | None,
) -> CommissioningReport:
    knowledge = knowledge_of(machine)
    healthy_s = sum(one.duration_s for one in recordings)
    rotor = None if learned.identified is None or learned.machine is None else learned.machine.rotor
    parameters = (
        parameter_summaries(
            machine,
            learned.diagnoses,
            learned.compared,
            healthy_s,
            float(np.median([piece.window.duration_s for piece in pieces])),
            wished=machine.alarms.limits.raise_above if wished is None else wished,
            short=learned.machine is not None,
            identified={} if rotor is None else {name: getattr(rotor, FAULT_FIELDS[name]) for name in PARAMETERS},
        )
        if learned.diagnoses
        else ()
    )
    verdict = "refused" if commissioned is None else "commissioned"
    if commissioned is not None and any(check.verdict == "limited" for check in checks):
        verdict = "limited"
    return CommissioningReport.model_validate(
        {
            "site": machine.site,
            "machine": machine.name,
            "level": knowledge.level,
            "level_text": knowledge.text,
            "verdict": verdict,
            "summary": _summary(verdict, checks, [one.name for one in parameters if one.evaluable]),
            "version": 0 if commissioned is None else commissioned.version,
            "identity": None if commissioned is None else commissioned.identity,
            "healthy_s": healthy_s,
            "window_s": machine.window.length_s,
            "false_alarms_per_month": machine.alarms.false_alarms_per_month,
            "checks": tuple(checks),
            "equations": _equations(machine, learned),
            "parameters": parameters,
            "conditions": None if commissioned is None else commissioned.conditions,
            "notes": learned.notes,
        }
    )


def _summary(verdict: str, checks: Sequence[Check], evaluable: Sequence[str]) -> str:
    told = {each: [check for check in checks if check.verdict == each] for each in ("refused", "limited")}
    if verdict == "refused":
        reasons = told["refused"] or told["limited"]
        return "; ".join(f"{check.text}; instead: {check.advice}" for check in reasons) or "nothing could be learned"
    read = f"changes of {', '.join(evaluable)} can be read" if evaluable else "only changed or not changed can be said"
    if verdict == "limited":
        return f"{read}; limited by: {'; '.join(check.text for check in told['limited'])}"
    return read


def _equations(machine: MachineFile, learned: _Learned) -> tuple[EquationRow, ...]:
    """The whole table: what is compared with theory where the rotor is known, and what is learned where it is not."""
    states = machine.descriptor.states
    known = learned.machine is not None
    found = []
    for equation in EQUATIONS:
        lacking = missing(equation, states)
        reason = f"not measured: {', '.join(lacking)}" if lacking else ""
        if not known:
            reason = "; ".join(filter(None, [reason, "needs the rotor's masses and shaft"]))
        found.append(
            EquationRow(
                number=equation.number,
                title=equation.title,
                parameters=equation.parameters,
                used=not reason,
                reason=reason,
            )
        )
    for row, reason in evaluable_rows(states, "theta" in states):
        why = "the rotor is known: theory says more" if known and not reason else reason
        found.append(
            EquationRow(
                number=row.number,
                title=row.title,
                parameters=tuple(own.parameter for own in row.own),
                used=not why,
                reason=why,
            )
        )
    return tuple(found)
