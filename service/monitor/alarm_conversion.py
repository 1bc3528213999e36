"""Turns alarms and what happened to them into the records of `rotorwatch`."""

import json
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

from models.alarm_names import alarm_kind
from models.diagnosis.readings import interval_95
from rotorwatch import __version__
from rotorwatch.records.alarms import Alarm as AlarmJson
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmEventData, AlarmStates
from rotorwatch.records.fields import Record, finite
from service.monitor.alarms.alarm import Alarm, AlarmEvent
from service.monitor.reports import Identity

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def alarm_entries(alarms: Iterable[Alarm], *, include_normal: bool = False) -> tuple[AlarmJson, ...]:
    """Alarms as they are now; normal ones without a running on-delay only if asked for."""
    return tuple(_alarm(alarm) for alarm in alarms if include_normal or alarm.open)


def alarm_states(
    identity: Identity, alarms: Iterable[Alarm], sequence: int, *, include_normal: bool = False
) -> AlarmStates:
    """Convert the alarms of a machine; `sequence` is that of its latest event."""
    return AlarmStates(**identity, alarms=alarm_entries(alarms, include_normal=include_normal), sequence=sequence)


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
        **_shared(AlarmEventData, alarm),
        **_shared(AlarmEventData, event),
        annunciated=alarm.state.annunciated,
        relative_change=alarm.change,
        interval_95=_interval(alarm),
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


def _alarm(alarm: Alarm) -> AlarmJson:
    return AlarmJson(
        **_shared(AlarmJson, alarm),
        text=alarm_kind(alarm.name).text,
        pending=alarm.beyond_ns is not None,
        clearing=alarm.small_ns is not None,
        relative_change=alarm.change,
        interval_95=_interval(alarm),
    )


def _shared(record: type[Record], known: Alarm | AlarmEvent) -> dict[str, Any]:
    """Fields of a record that an alarm or event has under the same name."""
    return {name: getattr(known, name) for name in record.model_fields if hasattr(known, name)}


def _interval(alarm: Alarm) -> tuple[float, float] | None:
    change, error = finite(alarm.change), finite(alarm.standard_error)
    return None if change is None or error is None else interval_95(change, error, least=-1.0)


def rfc3339(time_ns: int) -> str:
    """A time in text (RFC 3339), UTC, with microseconds."""
    moment = _EPOCH + timedelta(microseconds=time_ns // 1000)
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")
