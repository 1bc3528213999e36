"""Commission a machine from healthy recordings, with as much physics as its file gives, and report the result."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field
from scipy.special import ndtri

from models.commissioning.checks import (
    Check,
    check_data,
    check_lines,
    check_sensors_of,
    check_speed_given,
    check_speed_range,
    check_steady,
)
from models.commissioning.commissioned import (
    Commissioned,
    HealthyEntry,
    KnowledgeLevel,
    OperatingRange,
    described,
    knowledge_of,
)
from models.commissioning.healthy import HealthyRecording, known_lines
from models.commissioning.levels import NO_SUCH_ROTOR, HealthyPiece, Learned, Progress, learn, pieces_of
from models.diagnosis.baseline.rows import Row, evaluable_rows
from models.diagnosis.misfit import HealthyMisfit
from models.diagnosis.networks.equations import EQUATIONS, Equation, SynchronousEquation, missing
from models.diagnosis.readings import Diagnosis
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.disagreement import crossed_planes
from models.diagnosis.sensors.reference import Naming, learn_sensor_reference
from models.diagnosis.verdict.sequential import SequentialSettings
from models.diagnosis.verdict.stretch import from_scale, slope, to_scale
from models.diagnosis.window.moments import states_of
from models.errors import EstimationError
from models.levels.limits import GrowthToAlert, alerts_of
from models.levels.places import learn_gains, place_of
from models.levels.reference import learn_levels
from models.machine import Machine, MachineFile
from models.physics.rotor import FAULT_FIELDS, PARAMETER_TEXT, PARAMETERS

_POWER = 0.95
_NO_CHANCE = 3.0  # standard errors beyond which the healthy misfit is more than chance


class EquationRow(BaseModel, extra="forbid", frozen=True):
    """One row of the equation table, and whether it is used with these sensors."""

    number: str
    title: str
    parameters: tuple[str, ...]
    used: bool
    reason: str = Field(default="", description="why it is not used")


class HealthyReading(BaseModel, extra="forbid", frozen=True):
    """One parameter in one healthy window; at level none, read against the other half of the healthy data."""

    recording: str
    end_ns: int
    relative_change: float
    standard_error: float


class ParameterSummary(BaseModel, extra="forbid", frozen=True):
    """Results of the commissioning for one parameter."""

    name: str
    text: str
    evaluable: bool
    reason: str = ""
    identified: float | None = Field(default=None, description="identified value, SI; level partial")
    healthy_spread: float | None = Field(default=None, description="standard deviation of healthy windows' readings")
    window_error: float | None = Field(default=None, description="standard error that a window has of its own")
    commissioning_error: float | None = Field(
        default=None, description="standard error that all windows share because the healthy data were finite"
    )
    detectable_loss: float | None = Field(default=None, description="found by one window with 95 % probability")
    detectable_gain: float | None = None
    wished: float | None = Field(default=None, description="change that is wished to be found, either sign")
    window_s_for_wished: float | None = Field(default=None, description="window that this takes")
    healthy_s_for_wished: float | None = Field(default=None, description="healthy data that this takes in addition")
    readings: tuple[HealthyReading, ...] = ()


class CommissioningReport(BaseModel, extra="forbid", frozen=True):
    """The report of a commissioning."""

    site: str
    machine: str
    level: KnowledgeLevel
    level_text: str
    verdict: Literal["commissioned", "limited", "refused"]
    summary: str
    version: int
    identity: str | None = None
    healthy_s: float
    window_s: float
    false_alarms_per_month: float
    checks: tuple[Check, ...]
    equations: tuple[EquationRow, ...]
    parameters: tuple[ParameterSummary, ...]
    conditions: OperatingRange | None = None
    levels: tuple[GrowthToAlert, ...] = ()
    notes: tuple[str, ...] = ()


def parameter_summaries(
    machine: MachineFile,
    diagnoses: Sequence[tuple[str, int, Diagnosis]],
    compared: Sequence[tuple[str, int, Diagnosis]],
    healthy_s: float,
    window_s: float,
    *,
    wished: float,
    identified: Mapping[str, float],
) -> tuple[ParameterSummary, ...]:
    """Summarise the readings of each parameter in healthy windows.

    `diagnoses` are (recording, end_ns, diagnosis) of windows read as later ones will be, with the shared error in each;
    `compared` are the same windows read against what was learned without them. `healthy_s` of data were learned from,
    and the windows in `diagnoses` have `window_s`; identified values are SI.
    """
    settings = SequentialSettings.for_machine(machine)
    threshold = settings.thresholds(settings.window_hops).first + float(ndtri(_POWER))
    found = []
    for name in PARAMETERS:
        errors = [_errors(name, diagnosis) for _, _, diagnosis in diagnoses]
        known = [each for each in errors if each is not None]
        if not known:
            every = [each for _, _, diagnosis in diagnoses for each in diagnosis.parameters if each.name == name]
            reasons = dict.fromkeys(each.reason for each in every if each.reason)
            reason = "; ".join(reasons) or "cannot be told without the rotor's own parameters"
            found.append(ParameterSummary(name=name, text=PARAMETER_TEXT[name], evaluable=False, reason=reason))
            continue
        own, shared, elsewhere = (float(np.median(part)) for part in zip(*known, strict=True))
        own *= math.sqrt(window_s / machine.window_data_s)
        least = threshold * math.hypot(own, shared, elsewhere)
        readings = _readings(name, compared)
        changes = [one.relative_change for one in readings]
        found.append(
            ParameterSummary(
                name=name,
                text=PARAMETER_TEXT[name],
                evaluable=True,
                identified=identified.get(name),
                healthy_spread=float(np.std(changes, ddof=1)) if len(changes) > 1 else None,
                window_error=own,
                commissioning_error=shared,
                detectable_loss=max(-1.0, from_scale(name, -least)),
                detectable_gain=from_scale(name, least),
                wished=wished,
                readings=readings,
                **_needed(name, wished, threshold, (own, shared, elsewhere), healthy_s, machine.window_data_s),
            )
        )
    return tuple(found)


def _needed(
    name: str, wished: float, threshold: float, errors: tuple[float, float, float], healthy_s: float, window_s: float
) -> dict[str, float]:
    """Healthy data and window length needed to find a wished change.

    The window's error and the shared error fall as one over the root of the length. The result is empty if no length is
    enough because of the relation's error in other conditions.
    """
    own, shared, elsewhere = errors
    allowed = math.sqrt(max(0.0, (to_scale(name, wished) / threshold) ** 2 - elsewhere**2))
    if not allowed:
        return {}
    # The window gets at most half of the allowed variance; with none left, commissioning would take infinitely long.
    window = window_s * max(1.0, 2 * (own / allowed) ** 2)
    left = allowed**2 - own**2 * window_s / window
    return {"healthy_s_for_wished": healthy_s * shared**2 / left, "window_s_for_wished": window}


def _errors(name: str, diagnosis: Diagnosis) -> tuple[float, float, float] | None:
    """A window's own standard error, the shared one, and that from other conditions, in the scale of the errors."""
    names = [reading.name for reading in diagnosis.evaluable]
    if name not in names:
        return None
    at = names.index(name)
    factor = slope(name, to_scale(name, diagnosis.evaluable[at].relative_change or 0.0))
    total = float(diagnosis.full_covariance[at, at])
    shared = 0.0 if diagnosis.common is None else float(diagnosis.common[at, at])
    elsewhere = min(shared, diagnosis.elsewhere.get(name, 0.0))
    own = math.sqrt(max(0.0, total - shared))
    return own / factor, math.sqrt(shared - elsewhere) / factor, math.sqrt(elsewhere) / factor


def _readings(name: str, compared: Sequence[tuple[str, int, Diagnosis]]) -> tuple[HealthyReading, ...]:
    return tuple(
        HealthyReading(
            recording=recording,
            end_ns=end_ns,
            relative_change=reading.relative_change,
            standard_error=reading.standard_error,
        )
        for recording, end_ns, diagnosis in compared
        for reading in diagnosis.evaluable
        if reading.name == name and reading.relative_change is not None and reading.standard_error is not None
    )


@dataclass(frozen=True, slots=True)
class Commissioning:
    """Result of a commissioning."""

    report: CommissioningReport
    commissioned: Commissioned | None  # None if it was refused
    machine: Machine | None  # with all parameters, if they are given or identified: networks can be trained for it


def commission(
    machine: MachineFile,
    recordings: Sequence[HealthyRecording],
    entries: Sequence[HealthyEntry],
    *,
    wished: float | None = None,
    replaces: Commissioned | None = None,
    why: str = "",
    progress: Progress = lambda *_: None,
) -> Commissioning:
    """Commission a machine from recordings of one steady condition each.

    `wished` is the relative change that is to be found, by default the alarm limit.
    """
    knowledge = knowledge_of(machine)
    checks = [check_data(machine, recordings)]
    pieces = [] if checks[0].verdict == "refused" else pieces_of(recordings)
    windows = [piece.window for piece in pieces]
    if (unsuited := check_speed_given(machine, windows)) is not None:
        checks, pieces = [*checks, unsuited], []
    learned, states = Learned(()), states_of(machine)
    if pieces:
        by_recording = {one.name: [each.window for each in pieces if each.recording == one.name] for one in recordings}
        findings = {
            name: [
                fault
                for window in own
                for fault in (
                    *sensor_findings(window, None, machine.sensors),
                    *crossed_planes(window, Naming(machine.sensors)),
                )
            ]
            for name, own in by_recording.items()
        }
        if not states:  # levels can also be learned at standstill
            findings = {name: [f for f in found if f.states != ("theta",)] for name, found in findings.items()}
        checks.append(check_sensors_of(machine, findings, by_recording))
        if not states:
            checks.append(_only_levels(machine, knowledge.text))
        else:
            checks += [check_steady(machine, recordings, by_recording), check_lines(machine, recordings)]
            in_range = check_speed_range(machine, windows)
            if in_range is not None and knowledge.level is not KnowledgeLevel.NONE:
                checks.append(in_range)
        if states and all(check.verdict != "refused" for check in checks):
            try:
                learned = learn(knowledge.level, machine, pieces, progress)
            except EstimationError as error:
                learned = Learned((_not_learned(knowledge.level, str(error)),))
            checks += learned.checks
    refused = any(check.verdict == "refused" for check in checks)
    commissioned = None
    if pieces and not refused:
        channels = [machine.sensors[column] for column in recordings[0].plan.columns]
        bands = [[p.levels.bands for p in pieces if p.recording == one.name] for one in recordings]
        # Without a theory, only lines that can be taken out of correlations are excluded.
        everywhere = knowledge.level is not KnowledgeLevel.NONE
        excluded = [(line, one) for one in windows for line in one.lines if everywhere or line.power is not None]
        lines = {line.known(one.speed_rad_s) for line, one in excluded}
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
            gyroscopic=learned.gyroscopic,
            misfit=_healthy_misfit(machine, learned, pieces),
            lines=tuple(sorted(lines)),
            baselines=learned.baselines,
            shape=learned.shape,
            modes=learned.modes,
            sensors=learn_sensor_reference(windows),
            levels=learn_levels(
                "commissioned",
                [channel.name for channel in channels],
                [piece.levels for piece in pieces],
                learn_gains([place_of(channel) for channel in channels], [each for each in bands if each]),
                known_lines(recordings),
            ),
        )
    report = _report(machine, recordings, checks, learned, commissioned, pieces, wished)
    return Commissioning(report, commissioned, learned.machine)


def _only_levels(machine: MachineFile, text: str) -> Check:
    advice = (
        "for a diagnosis, not levels alone, give sensors beside a bearing the location bearing, those beside the disc "
        "or impeller the location disc, and the direction y (horizontal) or z (vertical)"
    )
    if not machine.holds_band:
        advice = "record longer snapshots, so that band_hz holds 20 frequencies of segment_s"
    return Check(name="can be learned", verdict="limited", text=text, advice=advice)


def _not_learned(level: KnowledgeLevel, text: str) -> Check:
    advice = "record longer, at more than one speed or load, while something besides the unbalance excites the machine"
    if level is not KnowledgeLevel.NONE:
        advice = f"check every value and unit in [rotor], above all masses and shaft; or {advice}"
        advice += f"; {NO_SUCH_ROTOR}"
    return Check(name="can be learned", verdict="refused", text=f"at level {level}: {text}", advice=advice)


def _report(
    machine: MachineFile,
    recordings: Sequence[HealthyRecording],
    checks: Sequence[Check],
    learned: Learned,
    commissioned: Commissioned | None,
    pieces: Sequence[HealthyPiece],
    wished: float | None,
) -> CommissioningReport:
    knowledge = knowledge_of(machine)
    healthy_s = sum(one.duration_s for one in recordings)
    rotor = None if learned.identified is None or learned.machine is None else learned.machine.rotor
    names = () if learned.identified is None else learned.identified.names
    parameters = (
        parameter_summaries(
            machine,
            learned.diagnoses,
            learned.compared,
            healthy_s,
            float(np.median([piece.window.duration_s for piece in pieces])),
            wished=machine.alarms.limits.raise_above if wished is None else wished,
            identified={} if rotor is None else {name: getattr(rotor, FAULT_FIELDS[name]) for name in names},
        )
        if learned.diagnoses
        else ()
    )
    evaluable = [one.name for one in parameters if one.evaluable]
    verdict: Literal["commissioned", "limited", "refused"] = "refused"
    growths: Iterable[GrowthToAlert] = ()
    if commissioned is not None:
        verdict = "limited" if any(check.verdict == "limited" for check in checks) else "commissioned"
        if commissioned.levels is not None and machine.levels.reference != "first windows":
            growths = alerts_of(commissioned.levels, machine.sensors, machine.levels, machine.window.hops)
    return CommissioningReport(
        site=machine.site,
        machine=machine.name,
        level=knowledge.level,
        level_text=knowledge.text,
        verdict=verdict,
        summary=_summary(machine, verdict, checks, evaluable, modes=learned.modes is not None),
        version=0 if commissioned is None else commissioned.version,
        identity=None if commissioned is None else commissioned.identity,
        healthy_s=healthy_s,
        window_s=machine.window.length_s,
        false_alarms_per_month=machine.alarms.false_alarms_per_month,
        checks=tuple(checks),
        equations=_equations(machine, learned, pieces),
        parameters=parameters,
        conditions=None if commissioned is None else commissioned.conditions,
        levels=tuple(growths),
        notes=(*learned.notes, *_misfit_notes(commissioned)),
    )


def _healthy_misfit(machine: MachineFile, learned: Learned, pieces: Sequence[HealthyPiece]) -> HealthyMisfit | None:
    """How far the healthy windows lie from the theory; None if there is no theory."""
    if learned.machine is None:
        return None
    found = [
        (diagnosis.goodness, piece.window.duration_s / machine.window_data_s)
        for (_, _, diagnosis), piece in zip(learned.diagnoses, pieces, strict=True)
        if diagnosis.goodness is not None
    ]
    return HealthyMisfit.of([goodness for goodness, _ in found], [part for _, part in found])


def _misfit_notes(commissioned: Commissioned | None) -> tuple[str, ...]:
    """Note that even the healthy windows deviate from the theory by more than chance; empty otherwise."""
    misfit = None if commissioned is None else commissioned.misfit
    if misfit is None or misfit.mean < _NO_CHANCE * misfit.error:
        return ()
    return (
        f"the healthy windows lie {misfit.mean:.1f} ± {misfit.error:.1f} standard deviations from the theory: masses "
        "and shaft in the machine file are not quite those of the machine; later windows are outside the model if "
        "they deviate more, or differently",
    )


def _summary(
    machine: MachineFile, verdict: str, checks: Sequence[Check], evaluable: Sequence[str], *, modes: bool
) -> str:
    refused, limited = ([check for check in checks if check.verdict == each] for each in ("refused", "limited"))
    if verdict == "refused":
        reasons = (f"{check.text}; advice: {check.advice}" for check in refused or limited)
        return "; ".join(reasons) or "nothing could be learned"
    seen = "natural frequencies have" if modes else "a channel has"
    read = f"it can only be told whether {seen} changed" if states_of(machine) else "only levels are compared"
    if evaluable:
        read = f"changes of {', '.join(evaluable)} can be read"
    return f"{read}; limited by: {'; '.join(check.text for check in limited)}" if verdict == "limited" else read


def _equations(machine: MachineFile, learned: Learned, pieces: Sequence[HealthyPiece]) -> tuple[EquationRow, ...]:
    """All equations, compared with theory if the rotor is known, and all rows, learned if it is not."""
    states = machine.descriptor.states
    known = learned.machine is not None
    has_speed = "theta" in states or any(np.isfinite(piece.window.speed_rad_s) for piece in pieces)
    found: list[EquationRow] = []

    def add(of: Equation | SynchronousEquation | Row, parameters: tuple[str, ...], reason: str) -> None:
        used = not reason
        found.append(EquationRow(number=of.number, title=of.title, parameters=parameters, used=used, reason=reason))

    for equation in EQUATIONS:
        lacking = missing(equation, states)
        reason = f"not measured: {', '.join(lacking)}" if lacking else ""
        if not known:
            reason = "; ".join(filter(None, [reason, "needs the rotor's masses and shaft"]))
        add(equation, equation.parameters, reason)
    for row, reason in evaluable_rows(states, has_speed):
        why = "the rotor is known: theory gives more" if known and not reason else reason
        add(row, tuple(own.parameter for own in row.own), why)
    return tuple(found)
