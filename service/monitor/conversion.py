"""Turns the monitor's records into the records of `rotorwatch`."""

from models.diagnosis.verdict.calibration import length_to_find
from models.machine import MachineFile
from models.physics.rotor import PARAMETER_TEXT
from models.signals.keys import Key
from rotorwatch.records.health import Health, HealthState, StreamStatus
from rotorwatch.records.machines import Channel, DetectableChanges, DetectableParameter, MachineDescription
from service.monitor.alarm_conversion import alarm_entries, rfc3339
from service.monitor.reports import Identity, MachineHealth

_REPLAYED = "a replay is announced on this machine's own keys: replayed data are not evaluated"


def health(  # noqa: PLR0913  # what the worker counts
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
    """Convert a machine's health; silence decides the state only if no alarm is raised, but is always stated."""
    silence = ""
    if stream.silent:
        since_ns = stream.silent_since_ns
        silence = f"no data since {'the monitor started' if since_ns is None else rfc3339(since_ns)[:19] + 'Z'}"
    quality = record.quality
    if unread_messages:
        refused = quality.refused_blocks | {"unread": unread_messages}
        quality = quality.model_copy(update={"refused_blocks": refused})
    lost = {"queue_dropped_blocks": queue_dropped_blocks, "link_missed_blocks": link_missed_blocks}
    return Health(
        **identity,
        state=HealthState.NO_DATA if stream.silent and not record.state.alarmed else record.state,
        reason="; ".join(filter(None, (_REPLAYED if stream.replay_announced else "", silence, record.reason))),
        filled=record.filled,
        report=record.latest,
        alarms=alarm_entries(record.alarms),
        sequence=record.sequence,
        quality=quality.model_copy(update=lost),
        stream=stream,
        restart=restart,
        worker_errors=worker_errors,
        last_worker_error=last_worker_error,
    )


def machine_description(identity: Identity, machine: MachineFile, state: HealthState) -> MachineDescription:
    """Convert a machine file."""
    keys = machine.keys
    names = [name for name, value in vars(type(keys)).items() if isinstance(value, Key)]
    return MachineDescription(
        **identity,
        description=machine.description,
        state=state,
        speed_rpm=None if machine.operation is None else machine.operation.speed_rpm,
        rate_hz=machine.rate_hz,
        channels=tuple(Channel.model_validate(channel.model_dump(mode="json")) for channel in machine.sensors),
        window_length_s=machine.window.length_s,
        window_hop_s=machine.window.hop_s,
        keys={name: getattr(keys, name) for name in names},
    )


def detectable_changes(
    identity: Identity, machine: MachineFile, record: MachineHealth, change: float | None
) -> DetectableChanges:
    """State the smallest changes that the latest window would have shown, and how much data finding `change` takes."""
    latest = record.latest
    found = () if latest is None else latest.detectable
    reason = ""
    if not found:
        reason = f"window {record.filled:.0%} full" if latest is None or not latest.reason else latest.reason
    return DetectableChanges(
        **identity,
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
    )
