"""Turns the monitor's records into the records of `rotorwatch`."""

import hashlib
import json
from collections.abc import Iterable

from models.diagnosis.fallback.shape import ChannelShape
from models.diagnosis.readings import EquationReading, ParameterReading, interval_95
from models.diagnosis.sensors.finding import SensorFinding
from models.diagnosis.unbalance_vector import UnbalanceVector
from models.diagnosis.verdict.detectable import DetectableChange, length_to_find
from models.diagnosis.verdict.sequential import SequentialVerdict
from models.machine import MachineFile
from models.physics.parameters import PARAMETER_TEXT
from rotorwatch.records.health import Health, HealthState, Quality, Report, StreamStatus
from rotorwatch.records.machines import Channel, DetectableChanges, DetectableParameter, MachineDescription
from rotorwatch.records.windows import Agreement as AgreementJson
from rotorwatch.records.windows import Detectable, Finding, SensorFault, Shape, Verdict
from rotorwatch.records.windows import Equation as EquationJson
from rotorwatch.records.windows import Opinion as OpinionJson
from rotorwatch.records.windows import Parameter as ParameterJson
from rotorwatch.records.windows import UnbalanceVector as VectorJson
from service.monitor.alarm_conversion import Identity, alarm_entries, finite, rfc3339
from service.monitor.evaluation import Opinion
from service.monitor.reports import DataQuality, MachineHealth, WindowReport

__all__ = ["detectable_changes", "health", "machine_description", "machine_hash", "report"]


_REPLAYED = "a replay is announced on this machine's own keys: what is replayed is not evaluated"


def machine_hash(machine: MachineFile) -> str:
    """Twelve hexadecimal digits that change with anything in the machine file but comments and layout."""
    text = json.dumps(machine.model_dump(mode="json"), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def report(identity: Identity, window: WindowReport) -> Report:
    """Convert one evaluation of the window."""
    return Report(
        site=identity.site,
        machine=identity.machine,
        start_ns=window.start_ns,
        end_ns=window.end_ns,
        state=window.state,
        filled=window.filled,
        speed_rad_s=finite(window.speed_rad_s),
        misfit_z=finite(window.misfit_z),
        suspect=window.suspect,
        verdict=None if window.verdict is None else _verdict(window.verdict),
        parameters=_parameters(window.parameters),
        opinions=tuple(_opinion(opinion) for opinion in window.opinions),
        equations=tuple(_equation(reading) for reading in window.equations),
        detectable=tuple(_detectable(found) for found in window.detectable),
        sensors=_sensors(window.sensors),
        shapes=_shapes(window.shapes),
        reason=window.reason,
        bundle=identity.bundle,
        machine_hash=identity.machine_hash,
    )


def health(
    identity: Identity,
    record: MachineHealth,
    stream: StreamStatus,
    *,
    queue_dropped_blocks: int = 0,
    unread_messages: int = 0,
    link_missed_blocks: int = 0,
    worker_errors: int = 0,
    last_worker_error: str = "",
    restart: str = "",
) -> Health:
    """Convert a machine's health; silence is the state of a machine without a raised alarm, and is said of any."""
    latest = record.latest
    silence = ""
    if stream.silent:
        since_ns = stream.silent_since_ns
        silence = f"no data since {'the monitor started' if since_ns is None else rfc3339(since_ns)[:19] + 'Z'}"
    window = None if latest is None else report(identity, latest)
    return Health(
        site=identity.site,
        machine=identity.machine,
        state=HealthState.NO_DATA if stream.silent and not record.state.alarmed else record.state,
        reason="; ".join(filter(None, (_REPLAYED if stream.replay_announced else "", silence, record.reason))),
        filled=record.filled,
        window_start_ns=None if window is None else window.start_ns,
        window_end_ns=None if window is None else window.end_ns,
        speed_rad_s=None if window is None else window.speed_rad_s,
        misfit_z=None if window is None else window.misfit_z,
        suspect="" if window is None else window.suspect,
        verdict=None if window is None else window.verdict,
        parameters=() if window is None else window.parameters,
        opinions=() if window is None else window.opinions,
        equations=() if window is None else window.equations,
        detectable=() if window is None else window.detectable,
        sensors=() if window is None else window.sensors,
        shapes=() if window is None else window.shapes,
        alarms=alarm_entries(record.alarms),
        quality=_quality(record.quality, queue_dropped_blocks, link_missed_blocks, unread_messages),
        stream=stream,
        restart=restart,
        worker_errors=worker_errors,
        last_worker_error=last_worker_error,
        bundle=identity.bundle,
        machine_hash=identity.machine_hash,
    )


def machine_description(identity: Identity, machine: MachineFile, state: HealthState) -> MachineDescription:
    """Convert a machine file."""
    keys = machine.keys
    names = [name for name, value in vars(type(keys)).items() if isinstance(value, property) and name != "root"]
    return MachineDescription(
        site=identity.site,
        machine=identity.machine,
        description=machine.description,
        state=state,
        speed_rpm=None if machine.operation is None else machine.operation.speed_rpm,
        rate_hz=machine.rate_hz,
        channels=tuple(Channel.model_validate(channel.model_dump(mode="json")) for channel in machine.sensors),
        window_length_s=machine.window.length_s,
        window_hop_s=machine.window.hop_s,
        keys={name: getattr(keys, name) for name in names},
        bundle=identity.bundle,
        machine_hash=identity.machine_hash,
    )


def detectable_changes(
    identity: Identity, machine: MachineFile, record: MachineHealth, change: float | None
) -> DetectableChanges:
    """Say what the latest window would have shown, and how much data a wished change takes."""
    latest = record.latest
    found = () if latest is None else latest.detectable
    reason = ""
    if not found:
        reason = f"window {record.filled:.0%} full" if latest is None or not latest.reason else latest.reason
    return DetectableChanges(
        site=identity.site,
        machine=identity.machine,
        window_end_ns=None if latest is None else latest.end_ns,
        window_length_s=machine.window.length_s,
        false_alarms_per_month=machine.alarms.false_alarms_per_month,
        change=change,
        parameters=tuple(
            DetectableParameter(
                name=one.name,
                text=PARAMETER_TEXT[one.name],
                loss=one.loss,
                gain=one.gain,
                length_s=None if change is None else length_to_find(one, change),
            )
            for one in found
        ),
        reason=reason,
        bundle=identity.bundle,
        machine_hash=identity.machine_hash,
    )


def _parameters(readings: Iterable[ParameterReading]) -> tuple[ParameterJson, ...]:
    return tuple(_parameter(reading) for reading in readings)


def _parameter(reading: ParameterReading) -> ParameterJson:
    change, error = finite(reading.change), finite(reading.standard_error)
    known = change is not None and error is not None
    return ParameterJson(
        name=reading.name,
        text=PARAMETER_TEXT[reading.name],
        by=reading.by,
        relative_change=change,
        standard_error=error,
        interval_95=reading.interval if known else None,
        z=finite(reading.z) if known and error else None,
        reason=reading.reason,
        vector=None if reading.vector is None else _vector(reading.vector),
    )


def _vector(vector: UnbalanceVector) -> VectorJson:
    turned, turned_error = vector.turned_deg, vector.turned_error_deg
    return VectorJson(
        magnitude_change=vector.magnitude_change,
        magnitude_interval_95=interval_95(vector.magnitude_change, vector.magnitude_error, least=-1.0),
        turned_deg=turned,
        turned_interval_95_deg=None if turned is None or turned_error is None else interval_95(turned, turned_error),
        change=vector.change,
        change_interval_95=interval_95(vector.change, vector.change_error, least=0.0),
        change_angle_deg=vector.change_angle_deg,
        text=vector.sentence,
    )


def _verdict(verdict: SequentialVerdict) -> Verdict:
    isolation = verdict.isolation
    return Verdict(
        changed=tuple(
            Finding(
                name=finding.name,
                text=PARAMETER_TEXT[finding.name],
                since_ns=finding.since_ns,
                found_ns=finding.found_ns,
                stretch_s=finding.stretch_s,
            )
            for finding in verdict.findings
        ),
        text=_verdict_text(verdict),
        detected=verdict.detected,
        confidence=isolation.confidence,
        low_confidence=isolation.low_confidence,
        outside_model=isolation.outside,
        outside_confidence=finite(isolation.outside_confidence),
        decided_s=verdict.decided_s,
        settled=verdict.settled,
        current=_parameters(verdict.current),
    )


def _verdict_text(verdict: SequentialVerdict) -> str:
    isolation = verdict.isolation
    if verdict.findings:
        found = ", ".join(
            f"{PARAMETER_TEXT[one.name]} ({one.name}) since {_clock(one.since_ns)}, found {_clock(one.found_ns)} in "
            f"{one.stretch_s:.0f} s of data"
            for one in verdict.findings
        )
        # Never more sure than can be.
        sure = "above 99.9 %" if isolation.confidence > 0.9995 else f"{100 * isolation.confidence:.1f} %"
        text = f"changed: {found}; confidence {sure}"
    elif verdict.detected:
        text = "something has changed; too little data yet to say what"
    else:
        text = "nothing has changed" if verdict.current else "no parameter could be read"
    if isolation.outside:
        text += "; outside the model: something has changed that no parameter describes, or a sensor is at fault"
    return text


def _clock(time_ns: int) -> str:
    return rfc3339(time_ns)[11:19]


def _opinion(opinion: Opinion) -> OpinionJson:
    return OpinionJson(
        by=opinion.by,
        parameters=_parameters(opinion.parameters),
        agreement=tuple(
            AgreementJson(
                name=one.name, between=one.between, verdict=one.verdict, difference_z=finite(one.difference_z)
            )
            for one in opinion.agreement
        ),
        reason=opinion.reason,
    )


def _detectable(found: DetectableChange) -> Detectable:
    return Detectable(name=found.name, loss=found.loss, gain=found.gain, length_s=found.length_s)


def _equation(reading: EquationReading) -> EquationJson:
    return EquationJson(
        equation=reading.equation,
        title=reading.title,
        evaluable=reading.evaluable,
        msd=finite(reading.msd),
        msd_healthy=finite(reading.msd_healthy),
        parameters=_parameters(reading.parameters),
        reason=reading.reason,
    )


def _sensors(findings: Iterable[SensorFinding]) -> tuple[SensorFault, ...]:
    return tuple(
        SensorFault(states=found.states, kind=found.kind, text=found.text, value=finite(found.value), z=finite(found.z))
        for found in findings
    )


def _shapes(shapes: Iterable[ChannelShape]) -> tuple[Shape, ...]:
    return tuple(
        Shape(state=one.channel, verdict=one.state, z=finite(one.z), limit=one.limit, text=one.sentence)
        for one in shapes
    )


def _quality(quality: DataQuality, queue_dropped_blocks: int, link_missed_blocks: int, unread_messages: int) -> Quality:
    unread = {"unread": unread_messages} if unread_messages else {}
    return Quality(
        accepted_blocks=quality.accepted,
        refused_blocks=dict(quality.refused) | unread,
        gaps=quality.gaps,
        missing_s=quality.missing_s,
        queue_dropped_blocks=queue_dropped_blocks,
        link_missed_blocks=link_missed_blocks,
        last_refusal=quality.last_refusal,
        last_gap=quality.last_gap,
    )
