"""Turns the monitor's records into the records of `rotorwatch`."""

import json
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

from models.alarm_names import alarm_kind
from models.diagnosis.readings import interval_95
from models.diagnosis.verdict.calibration import length_to_find
from models.machine import MachineFile
from models.physics.rotor import PARAMETER_TEXT
from models.signals.keys import Key
from rotorwatch import __version__
from rotorwatch.records.alarms import Alarm as AlarmJson
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmEventData
from rotorwatch.records.fields import Record, finite
from rotorwatch.records.health import Health, HealthState, StreamStatus
from rotorwatch.records.machines import Channel, DetectableChanges, DetectableParameter, MachineDescription
from service.monitor.alarms.alarm import Alarm, AlarmEvent
from service.monitor.reports import Identity, MachineHealth

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_REPLAYED = "a replay is announced on this machine's own keys: replayed data are not evaluated"


def alarm_entries(alarms: Iterable[Alarm], *, include_normal: bool = False) -> tuple[AlarmJson, ...]:
    """Alarms as they are now; normal ones without a running on-delay only if asked for."""
    return tuple(
        AlarmJson(
            **_of_alarm(AlarmJson, alarm),
            text=alarm_kind(alarm.name).text,
            pending=alarm.beyond_ns is not None,
            clearing=alarm.small_ns is not None,
        )
        for alarm in alarms
        if include_normal or alarm.open
    )


def alarm_log_page(identity: Identity, texts: Sequence[str], latest: int) -> str:
    """Join events, each the exact JSON text that was published, into the JSON of an `AlarmLogPage`."""
    begin = json.dumps({"site": identity["site"], "machine": identity["machine"]})
    return f'{begin[:-1]}, "events": [{",".join(texts)}], "latest": {latest}}}'


def alarm_cloud_event(identity: Identity, event: AlarmEvent) -> AlarmCloudEvent:
    """Convert an alarm event."""
    alarm = event.alarm
    place = f"{identity['site']}/{identity['machine']}"
    data = AlarmEventData(
        **identity,
        **_of_alarm(AlarmEventData, alarm),
        **_shared(AlarmEventData, event),
        annunciated=alarm.state.annunciated,
        program_version=__version__,
    )
    return AlarmCloudEvent(
        specversion="1.0",
        id=f"{place}/{event.sequence}/{alarm.name}/{event.kind}",
        source=f"/rotorwatch/{place}",
        type=f"org.rotorwatch.alarm.{event.kind}",
        subject=alarm.name,
        time=rfc3339(event.time_ns),
        datacontenttype="application/json",
        sequence=f"{event.sequence:020d}",
        data=data,
    )


def _of_alarm(record: type[Record], alarm: Alarm) -> dict[str, Any]:
    """Fields of a record that an alarm has under the same name, with its change and the interval of that."""
    change, error = finite(alarm.change), finite(alarm.standard_error)
    interval = None if change is None or error is None else interval_95(change, error, least=-1.0)
    return _shared(record, alarm) | {"relative_change": alarm.change, "interval_95": interval}


def _shared(record: type[Record], known: Alarm | AlarmEvent) -> dict[str, Any]:
    """Fields of a record that an alarm or event has under the same name."""
    return {name: getattr(known, name) for name in record.model_fields if hasattr(known, name)}


def rfc3339(time_ns: int) -> str:
    """A time in text (RFC 3339), UTC, with microseconds."""
    moment = _EPOCH + timedelta(microseconds=time_ns // 1000)
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")


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
    since_ns = stream.silent_since_ns
    since = "the monitor started" if since_ns is None else f"{rfc3339(since_ns)[:19]}Z"
    silence, quality = f"no data since {since}" if stream.silent else "", record.quality
    if silence and record.refused:
        silence += f", blocks are refused: {quality.last_refusal}"
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
    return MachineDescription(
        **identity,
        description=machine.description,
        state=state,
        speed_rpm=None if machine.operation is None else machine.operation.speed_rpm,
        rate_hz=machine.rate_hz,
        channels=tuple(Channel.model_validate(channel.model_dump(mode="json")) for channel in machine.sensors),
        window_length_s=machine.window.length_s,
        window_hop_s=machine.window.hop_s,
        keys={name: getattr(keys, name) for name, value in vars(type(keys)).items() if isinstance(value, Key)},
    )


def detectable_changes(
    identity: Identity, machine: MachineFile, record: MachineHealth, change: float | None
) -> DetectableChanges:
    """State the smallest changes that the latest window would have shown, and how much data finding `change` takes."""
    latest = record.latest
    found, reason = ((), "") if latest is None else (latest.detectable, latest.reason)
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
        reason="" if found else reason or f"window {record.filled:.0%} full",
    )
