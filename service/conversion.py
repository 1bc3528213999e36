"""Turns the monitor's records into the JSON models of `service.schemas`."""

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from models.diagnosis.readings import EquationReading, ParameterReading
from models.machine import Machine
from models.physics.parameters import PARAMETER_TEXT
from service.alarms import Alarm, AlarmEvent, AlarmState
from service.monitor import DataQuality, HealthState, MachineHealth, WindowReport
from service.schemas import Alarm as AlarmJson
from service.schemas import (
    AlarmCloudEvent,
    AlarmEventData,
    AlarmStates,
    Health,
    MachineDescription,
    Quality,
    Report,
    StreamStatus,
)
from service.schemas import Equation as EquationJson
from service.schemas import Parameter as ParameterJson

__all__ = [
    "Identity",
    "alarm_cloud_event",
    "alarm_states",
    "health",
    "machine_description",
    "machine_hash",
    "report",
]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Identity:
    """Who speaks: the machine and the exact files its monitor runs on."""

    site: str
    machine: str
    bundle: str | None
    machine_hash: str


def machine_hash(machine: Machine) -> str:
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
        speed_rad_s=_finite(window.speed_rad_s),
        misfit=_finite(window.misfit),
        parameters=_parameters(window.parameters),
        equations=tuple(_equation(reading) for reading in window.equations),
        reason=window.reason,
        bundle=identity.bundle,
        machine_hash=identity.machine_hash,
    )


def health(
    identity: Identity,
    record: MachineHealth,
    stream: StreamStatus,
    *,
    no_data_reason: str = "",
    queue_dropped_blocks: int = 0,
    link_missed_blocks: int = 0,
    worker_errors: int = 0,
    last_worker_error: str = "",
) -> Health:
    """Convert a machine's health; with a reason for it, the state is no-data, and the alarms stay as they are."""
    latest = record.latest
    window = None if latest is None else report(identity, latest)
    return Health(
        site=identity.site,
        machine=identity.machine,
        state=HealthState.NO_DATA if no_data_reason else record.state,
        reason=no_data_reason or ("" if latest is None else latest.reason),
        filled=record.filled,
        window_start_ns=None if window is None else window.start_ns,
        window_end_ns=None if window is None else window.end_ns,
        speed_rad_s=None if window is None else window.speed_rad_s,
        misfit=None if window is None else window.misfit,
        parameters=() if window is None else window.parameters,
        equations=() if window is None else window.equations,
        alarms=_alarms(record.alarms, include_normal=False),
        quality=_quality(record.quality, queue_dropped_blocks, link_missed_blocks),
        stream=stream,
        worker_errors=worker_errors,
        last_worker_error=last_worker_error,
        bundle=identity.bundle,
        machine_hash=identity.machine_hash,
    )


def alarm_states(identity: Identity, alarms: Iterable[Alarm], *, include_normal: bool = False) -> AlarmStates:
    """Convert the alarms of a machine."""
    return AlarmStates(
        site=identity.site,
        machine=identity.machine,
        alarms=_alarms(alarms, include_normal=include_normal),
        bundle=identity.bundle,
        machine_hash=identity.machine_hash,
    )


def alarm_cloud_event(identity: Identity, event: AlarmEvent) -> AlarmCloudEvent:
    """Convert an alarm event."""
    alarm = event.alarm
    place = f"{identity.site}/{identity.machine}"
    data = AlarmEventData.model_validate(
        {
            "site": identity.site,
            "machine": identity.machine,
            "parameter": alarm.parameter,
            "text": event.text,
            "kind": event.kind,
            "severity": alarm.severity,
            "time_ns": event.time_ns,
            "raised_ns": alarm.raised_ns,
            "occurrence": alarm.occurrence,
            "sequence": event.sequence,
            "relative_change": _finite(alarm.change),
            "standard_error": _finite(alarm.standard_error),
            "bundle": identity.bundle,
            "machine_hash": identity.machine_hash,
        }
    )
    return AlarmCloudEvent(
        specversion="1.0",
        # The data time is part of it because occurrences are counted anew when the monitor restarts.
        id=f"{place}/{alarm.parameter}/{alarm.occurrence}/{event.kind}/{event.time_ns}",
        source=f"/rotorwatch/{place}",
        type=f"org.rotorwatch.alarm.{event.kind}",
        subject=alarm.parameter,
        time=_rfc3339(event.time_ns),
        datacontenttype="application/json",
        sequence=f"{event.sequence:020d}",
        data=data,
    )


def machine_description(identity: Identity, machine: Machine, state: HealthState) -> MachineDescription:
    """Convert a machine file."""
    keys = machine.keys
    names = [name for name, value in vars(type(keys)).items() if isinstance(value, property) and name != "root"]
    return MachineDescription(
        site=identity.site,
        machine=identity.machine,
        description=machine.description,
        state=state,
        speed_rpm=machine.operation.speed_rpm,
        rate_hz=machine.rate_hz,
        channels=machine.sensors,
        window_length_s=machine.window.length_s,
        window_hop_s=machine.window.hop_s,
        keys={name: getattr(keys, name) for name in names},
        bundle=identity.bundle,
        machine_hash=identity.machine_hash,
    )


def _finite(value: float | None) -> float | None:
    """JSON has no infinity and no NaN: both become null."""
    return value if value is not None and math.isfinite(value) else None


def _parameters(readings: Iterable[ParameterReading]) -> tuple[ParameterJson, ...]:
    return tuple(_parameter(reading) for reading in readings)


def _parameter(reading: ParameterReading) -> ParameterJson:
    change, error = _finite(reading.change), _finite(reading.standard_error)
    known = change is not None and error is not None
    return ParameterJson(
        name=reading.name,
        text=PARAMETER_TEXT[reading.name],
        by=reading.by,
        relative_change=change,
        standard_error=error,
        interval_95=reading.interval if known else None,
        z=_finite(reading.z) if known and error else None,
        reason=reading.reason,
    )


def _equation(reading: EquationReading) -> EquationJson:
    return EquationJson(
        equation=reading.equation,
        title=reading.title,
        evaluable=reading.evaluable,
        msd=_finite(reading.msd),
        msd_healthy=_finite(reading.msd_healthy),
        parameters=_parameters(reading.parameters),
        reason=reading.reason,
    )


def _alarms(alarms: Iterable[Alarm], *, include_normal: bool) -> tuple[AlarmJson, ...]:
    return tuple(
        AlarmJson(
            parameter=alarm.parameter,
            text=PARAMETER_TEXT[alarm.parameter],
            state=alarm.state,
            raised=alarm.raised,
            severity=alarm.severity,
            since_ns=alarm.since_ns,
            raised_ns=alarm.raised_ns,
            occurrence=alarm.occurrence,
            relative_change=_finite(alarm.change),
            standard_error=_finite(alarm.standard_error),
        )
        for alarm in alarms
        if include_normal or alarm.state is not AlarmState.NORMAL
    )


def _quality(quality: DataQuality, queue_dropped_blocks: int, link_missed_blocks: int) -> Quality:
    return Quality(
        accepted_blocks=quality.accepted,
        refused_blocks=dict(quality.refused),
        gaps=quality.gaps,
        missing_s=quality.missing_s,
        queue_dropped_blocks=queue_dropped_blocks,
        link_missed_blocks=link_missed_blocks,
        last_refusal=quality.last_refusal,
        last_gap=quality.last_gap,
    )


def _rfc3339(time_ns: int) -> str:
    moment = _EPOCH + timedelta(microseconds=time_ns // 1000)
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")
