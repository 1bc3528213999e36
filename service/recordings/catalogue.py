"""What recordings a directory holds, finding one of them by its id, and which of a machine's are kept.

::

    <directory>/<site>/<machine>/20261121T142530Z.mcap         complete
    <directory>/<site>/<machine>/20261121T143030Z.mcap.part    being written, or left by a crash
    <directory>/<site>/<machine>/kept.json                     which files an alarm keeps, and which alarm

Names sort by time. The files' own indexes say everything else, so that files may be copied in and out by hand.

Whole files are kept or dropped, the oldest first. A file that reaches into the time around an alarm event falls under
the limits for alarms, every other one under the ordinary limits. Times are log times: the computer's clock when a
message arrived, or when the monitor recorded an event. Only events that a monitor committed to its history count, as
anybody may send one over the network. A file once kept for an alarm stays so, even if the history is lost. Only files
named as the recorder names them are ever dropped; one that is renamed stays.
"""

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pydantic import Field

from models.errors import RecordingError
from models.signals.keys import NAME_PATTERN
from models.signals.recording import RecordedMessage, read_recording, salvaged_messages, summarize_recording, writing
from models.signals.wire import REPLAY_MARK
from rotorwatch.records.recordings import RecordingEntry
from service.history.records import StoredEvent
from service.settings.service import RecordingSettings
from service.terminal.logs import logger

_log = logger(part="recordings")
SUFFIX = ".mcap"
PART = ".part"
KEPT = "kept.json"
_NS = 1_000_000_000
_FILE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}\.mcap(\.part)?")
_ID = re.compile(rf"(?P<site>{NAME_PATTERN})/(?P<machine>{NAME_PATTERN})/(?P<file>{_FILE.pattern})")
_STAMP = re.compile(r"(\d{8}T\d{6}Z)")
_STAMP_FORMAT = "%Y%m%dT%H%M%SZ"


class Recording(RecordingEntry):
    """One recording of a directory.

    For an incomplete file, the start that its name states and the time of its last write stand in for log times.
    """

    path: Path = Field(exclude=True)


@dataclass(frozen=True, slots=True)
class AlarmMark:
    """An alarm event that a monitor committed."""

    time_ns: int  # when it was recorded, by the computer's clock
    text: str  # what it was, for people


class Catalogue:
    """Recordings below a directory, which need not exist yet.

    A file's index is read once and remembered until the file changes. May be used from several threads.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._read: dict[Path, tuple[int, int, Recording]] = {}

    def recordings(self, site: str | None = None, machine: str | None = None) -> tuple[Recording, ...]:
        """List recordings, sorted by site, machine and file name, which is by time."""
        found: list[Recording] = []
        for folder in (one for upper in _subfolders(self.directory, site) for one in _subfolders(upper, machine)):
            kept = kept_reasons(folder)
            for path in _entries(folder):
                recording = self._recording(path) if _FILE.fullmatch(path.name) else None
                if recording is not None:
                    found.append(recording.model_copy(update={"kept_because": kept.get(path.name, "")}))
        return tuple(found)

    def find(self, recording_id: str) -> Recording | None:
        """Find a recording by its id; None if there is none, or if the id does not name a file of this directory.

        Only names made of letters, digits, ``_``, ``-`` and ``.`` are looked up, and symbolic links are not followed,
        so that no id reaches a file outside the directory.
        """
        match = _ID.fullmatch(recording_id)
        if match is None:
            return None
        folder = self.directory / match["site"] / match["machine"]
        recording = self._recording(folder / match["file"])
        if recording is None:
            return None
        return recording.model_copy(update={"kept_because": kept_reasons(folder).get(match["file"], "")})

    def _recording(self, path: Path) -> Recording | None:
        """Describe a file; None if it does not lie in this directory, or is gone."""
        machine, site = path.parent.name, path.parent.parent.name
        try:
            if path.resolve() != self.directory.resolve() / site / machine / path.name or not path.is_file():
                return None
            stat = path.stat()
        except OSError:  # dropped between listing and looking
            self._read.pop(path, None)
            return None
        known = self._read.get(path)
        if known is not None and known[:2] == (stat.st_mtime_ns, stat.st_size):
            return known[2]
        named_ns, end_ns = start_of(path.name), stat.st_mtime_ns
        start_ns = end_ns if named_ns is None else named_ns
        messages: int | None = None
        complete, problem = path.suffix == SUFFIX, ""
        if complete:
            try:
                summary = summarize_recording(path)
                if messages := sum(summary.messages.values()):
                    start_ns, end_ns = summary.start_ns, summary.end_ns
            except RecordingError as error:
                problem = str(error)
        recording = Recording(
            id=f"{site}/{machine}/{path.name}",
            site=site,
            machine=machine,
            path=path,
            start_ns=start_ns,
            end_ns=end_ns,
            messages=messages,
            size_bytes=stat.st_size,
            complete=complete,
            kept_because="",
            problem=problem,
        )
        self._read[path] = (stat.st_mtime_ns, stat.st_size, recording)
        return recording


def name_of(start_ns: int, number: int = 1) -> str:
    """File name for a recording that starts at a time, UTC to the second.

    Further files of the same second have numbers from 2 on; the names still sort in the order of writing.

    Examples
    --------
    >>> name_of(1_767_225_600_000_000_000), name_of(1_767_225_600_000_000_000, 2)
    ('20260101T000000Z.mcap', '20260101T000000Z_002.mcap')
    """
    stamp = datetime.fromtimestamp(start_ns // _NS, UTC).strftime(_STAMP_FORMAT)
    return stamp + (f"_{number:03d}" if number > 1 else "") + SUFFIX


def start_of(name: str) -> int | None:
    """Start that a file name states, nanoseconds since 1970-01-01 UTC, or None if it states none.

    Examples
    --------
    >>> start_of("20260101T000000Z_002.mcap.part"), start_of("import.mcap")
    (1767225600000000000, None)
    """
    match = _STAMP.match(name)
    if match is None:
        return None
    try:
        stamp = datetime.strptime(match[1], _STAMP_FORMAT).replace(tzinfo=UTC)
    except ValueError:
        return None
    return int(stamp.timestamp()) * _NS


def kept_reasons(folder: Path) -> dict[str, str]:
    """File names that an alarm keeps, with the reason; empty if the folder's ``kept.json`` is missing or unreadable."""
    try:
        kept = json.loads((folder / KEPT).read_text(encoding="utf-8"))["kept"]
        return {str(name): str(reason) for name, reason in kept.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _subfolders(folder: Path, name: str | None) -> list[Path]:
    """Folders that may be a site or a machine, sorted, without symbolic links."""
    entries = [folder / name] if name is not None and re.fullmatch(NAME_PATTERN, name) else []
    if name is None:
        entries = _entries(folder)
    return [e for e in entries if re.fullmatch(NAME_PATTERN, e.name) and e.is_dir() and not e.is_symlink()]


def _entries(folder: Path) -> list[Path]:
    """Entries of a folder, sorted; none if it is gone or cannot be read."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def recorded_files(folder: Path) -> tuple[Path, ...]:
    """Recordings of one machine, complete or left by a crash, oldest first."""
    return tuple(sorted((*folder.glob(f"*{SUFFIX}"), *folder.glob(f"*{SUFFIX}{PART}"))))


def recent_messages(files: Sequence[Path], key: str, since_ns: int) -> Iterator[RecordedMessage]:
    """Messages on a key from files in this order, without replayed ones, in the order in which they came.

    A file that a crash left may be completed meanwhile, and so get another name.
    """
    for path in files:
        try:
            for message in _messages(path, key, since_ns):
                mine = message.key == key and not message.encoding.endswith(REPLAY_MARK)
                if mine and message.log_time_ns >= since_ns:
                    yield message
        except RecordingError as error:
            _log.warning("the window cannot be made again from a recording", why=str(error))


def _messages(path: Path, key: str, since_ns: int) -> Iterator[RecordedMessage]:
    complete = path.with_name(path.name.removesuffix(PART))
    if path != complete:
        try:
            yield from salvaged_messages(path)
            return
        except RecordingError:
            if path.exists():
                raise
    if complete.exists() and complete.stat().st_mtime_ns >= since_ns:
        yield from read_recording(complete, keys={key}, from_ns=since_ns)


def decide(
    recordings: Iterable[Recording], marks: Sequence[AlarmMark], settings: RecordingSettings, now_ns: int
) -> tuple[dict[str, str], list[tuple[Recording, str]]]:
    """Files of a machine that an alarm keeps, by name, with the alarm; and those to delete, with the limit exceeded.

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
    return {one.path.name: reasons[one.id] for one in alarmed if one.id not in gone}, dropped


def alarm_mark(event: StoredEvent) -> AlarmMark:
    """Mark of an alarm event; one whose text cannot be read counts all the same."""
    try:
        said = json.loads(event.text)["data"]["text"]
    except (ValueError, KeyError, TypeError):
        said = event.alarm
    return AlarmMark(event.recorded_ns, f"{event.kind}: {said}")


def write_kept(folder: Path, kept: dict[str, str], settings: RecordingSettings) -> None:
    """State in the folder which files an alarm keeps; raises `RecordingError` if it cannot be written."""
    stated = {"alarm_before_s": settings.alarm_before_s, "alarm_after_s": settings.alarm_after_s, "kept": kept}
    path, draft = folder / KEPT, folder / (KEPT + ".new")
    with writing(path):
        draft.write_text(json.dumps(stated, indent=2, sort_keys=True, ensure_ascii=False) + "\n", encoding="utf-8")
        draft.replace(path)


def _reason(recording: Recording, marks: Sequence[AlarmMark], settings: RecordingSettings) -> str:
    before_ns, after_ns = round(settings.alarm_before_s * _NS), round(settings.alarm_after_s * _NS)
    begin_ns, end_ns = recording.start_ns - after_ns, recording.end_ns + before_ns
    near = [mark for mark in marks if begin_ns <= mark.time_ns <= end_ns]
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
