"""Which recordings of a machine are kept, for how long, and because of which alarm.

Whole files are kept or dropped, the oldest first. A file that reaches into the time around an alarm event falls under
the limits for alarms, every other one under the ordinary limits. Times are log times: the computer's clock when a
message arrived, or when the monitor recorded an event. Only events that a monitor committed to its history count, as
anybody may send one over the network. A file once kept for an alarm stays so, even if the history is lost.

Only files named as the recorder names them are ever dropped; one that is renamed stays.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from models.signals.recording import writing
from service.history.records import StoredEvent
from service.recordings.catalogue import KEPT, Recording, start_of
from service.settings.service import RecordingSettings

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class AlarmMark:
    """An alarm event that a monitor committed."""

    time_ns: int  # when it was recorded, by the computer's clock
    text: str  # what it was, for people


@dataclass(frozen=True, slots=True)
class Decision:
    """What retention decided."""

    kept: dict[str, str]  # files that an alarm keeps, by name, with the alarm
    dropped: tuple[tuple[Recording, str], ...]  # files to be deleted, with the limit they exceed


def decide(
    recordings: Iterable[Recording], marks: Sequence[AlarmMark], settings: RecordingSettings, now_ns: int
) -> Decision:
    """Decide which recordings of one machine are kept.

    Incomplete ones are left alone, and so are those that are not named as the recorder names them.
    """
    own = [one for one in recordings if one.complete and start_of(one.path.name) is not None]
    reasons = {one.id: reason for one in own if (reason := _reason(one, marks, settings) or one.kept_because)}
    ordinary = [one for one in own if one.id not in reasons]
    alarmed = [one for one in own if one.id in reasons]
    dropped = [
        *_beyond(ordinary, settings.keep_gb, settings.keep_days, "keep", now_ns),
        *_beyond(alarmed, settings.alarm_keep_gb, settings.alarm_keep_days, "alarm_keep", now_ns),
    ]
    gone = {one.id for one, _ in dropped}
    return Decision({one.path.name: reasons[one.id] for one in alarmed if one.id not in gone}, tuple(dropped))


def alarm_mark(event: StoredEvent) -> AlarmMark:
    """Mark of an alarm event; one whose text cannot be read counts all the same."""
    try:
        said = json.loads(event.text)["data"]["text"]
    except (ValueError, KeyError, TypeError):
        said = event.alarm
    return AlarmMark(event.recorded_ns, f"{event.kind}: {said}")


def write_kept(folder: Path, kept: dict[str, str], settings: RecordingSettings) -> None:
    """State in the folder which files an alarm keeps.

    Raises
    ------
    RecordingError
        If it cannot be written.
    """
    stated = {"alarm_before_s": settings.alarm_before_s, "alarm_after_s": settings.alarm_after_s, "kept": kept}
    path, draft = folder / KEPT, folder / (KEPT + ".new")
    with writing(path):
        draft.write_text(json.dumps(stated, indent=2, sort_keys=True, ensure_ascii=False) + "\n", encoding="utf-8")
        draft.replace(path)


def _reason(recording: Recording, marks: Sequence[AlarmMark], settings: RecordingSettings) -> str:
    before_ns, after_ns = round(settings.alarm_before_s * _NS), round(settings.alarm_after_s * _NS)
    near = [
        mark
        for mark in marks
        if recording.end_ns >= mark.time_ns - before_ns and recording.start_ns <= mark.time_ns + after_ns
    ]
    if not near:
        return ""
    first = min(near, key=lambda mark: mark.time_ns)
    time = datetime.fromtimestamp(first.time_ns // _NS, UTC)
    more = f" (and {len(near) - 1} more)" if len(near) > 1 else ""
    return f"{time:%Y-%m-%d %H:%M:%S} UTC {first.text}{more}"


def _beyond(
    recordings: Sequence[Recording], limit_gb: float, limit_days: float, field: str, now_ns: int
) -> list[tuple[Recording, str]]:
    """Recordings beyond the limits, oldest first."""
    found: list[tuple[Recording, str]] = []
    total = 0
    for recording in sorted(recordings, key=lambda one: (one.end_ns, one.id), reverse=True):
        total += recording.size_bytes
        if now_ns - recording.end_ns > limit_days * 86_400 * _NS:
            found.append((recording, f"older than {field}_days = {limit_days:g}"))
        elif total > limit_gb * 1e9:
            found.append((recording, f"beyond {field}_gb = {limit_gb:g}"))
    return found[::-1]
