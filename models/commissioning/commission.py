"""Commission a machine from healthy recordings, with as much physics as its file gives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.commissioning.checks import Check, check_data, check_lines, check_sensors_of, check_steady
from models.commissioning.commissioned import Commissioned, RecordingEntry, described
from models.commissioning.conditions import OperatingRange
from models.commissioning.healthy import HealthyRecording
from models.commissioning.knowledge import KnowledgeLevel, knowledge_of
from models.commissioning.levels import LEVELS, Learned, Piece, Progress, pieces_of
from models.commissioning.report import CommissioningReport, EquationRow, parameter_summaries
from models.diagnosis.baseline.rows import evaluable_rows
from models.diagnosis.networks.equations import EQUATIONS, missing
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.reference import learn_sensor_reference
from models.errors import EstimationError
from models.machine import Machine, MachineFile
from models.physics.parameters import FAULT_FIELDS, PARAMETERS

__all__ = ["Commissioning", "commission"]


@dataclass(frozen=True, slots=True)
class Commissioning:
    """What came of it.

    Attributes
    ----------
    commissioned : Commissioned or None
        None if it was refused.
    machine : Machine or None
        With all parameters, where they are given or identified: networks can be trained for it.
    """

    report: CommissioningReport
    commissioned: Commissioned | None
    machine: Machine | None


def commission(
    machine: MachineFile,
    recordings: Sequence[HealthyRecording],
    entries: Sequence[RecordingEntry],
    *,
    wished: float | None = None,
    replaces: Commissioned | None = None,
    why: str = "",
    progress: Progress = lambda *_: None,
) -> Commissioning:
    """Commission a machine.

    Parameters
    ----------
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
    pieces = [] if checks[0].verdict == "refused" else pieces_of(recordings)
    learned = Learned(())
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
                learned = LEVELS[knowledge.level](machine, pieces, progress)
            except EstimationError as error:
                learned = Learned((_not_learned(knowledge.level, str(error)),))
            checks += learned.checks
    refused = any(check.verdict == "refused" for check in checks)
    windows = [piece.window for piece in pieces]
    commissioned = None
    if not refused and (learned.machine is not None or learned.baselines or learned.shape is not None):
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
            baselines=learned.baselines,
            shape=learned.shape,
            sensors=learn_sensor_reference(windows),
        )
    return Commissioning(
        _report(machine, recordings, checks, learned, commissioned, pieces, wished), commissioned, learned.machine
    )


def _not_learned(level: KnowledgeLevel, text: str) -> Check:
    return Check(
        name="can be learned",
        verdict="refused",
        text=f"at level {level}: {text}",
        advice="record longer, at more than one speed or load, and while more than the unbalance moves the machine",
    )


def _report(
    machine: MachineFile,
    recordings: Sequence[HealthyRecording],
    checks: Sequence[Check],
    learned: Learned,
    commissioned: Commissioned | None,
    pieces: Sequence[Piece],
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
            "equations": _equations(machine, learned, pieces),
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


def _equations(machine: MachineFile, learned: Learned, pieces: Sequence[Piece]) -> tuple[EquationRow, ...]:
    """The whole table: what is compared with theory where the rotor is known, and what is learned where it is not."""
    states = machine.descriptor.states
    known = learned.machine is not None
    has_speed = "theta" in states or any(np.isfinite(piece.window.speed_rad_s) for piece in pieces)
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
    for row, reason in evaluable_rows(states, has_speed):
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
