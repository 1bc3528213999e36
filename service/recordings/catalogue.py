"""What recordings a directory holds, and finding one of them by its id.

::

    <directory>/<site>/<machine>/20261121T142530Z.mcap         complete
    <directory>/<site>/<machine>/20261121T143030Z.mcap.part    being written, or left by a crash
    <directory>/<site>/<machine>/kept.json                     which files an alarm keeps, and which alarm

Names sort by time. The files' own indexes say everything else, so that files may be copied in and out by hand.
"""

import json
import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

from pydantic import Field

from models.errors import RecordingError
from models.signals.recording import RecordedMessage, read_recording, summarize_recording
from models.signals.salvage import salvaged_messages
from models.signals.wire import REPLAY_MARK
from rotorwatch.records.recordings import RecordingEntry
from service.terminal.logs import logger

_log = logger(part="recordings")
SUFFIX = ".mcap"
PART = ".part"
KEPT = "kept.json"
_PLACE = r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}"
_PLACE_ONLY = re.compile(_PLACE)
_FILE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}\.mcap(\.part)?")
_ID = re.compile(rf"(?P<site>{_PLACE})/(?P<machine>{_PLACE})/(?P<file>{_FILE.pattern})")
_STAMP = re.compile(r"(\d{8}T\d{6}Z)")
_STAMP_FORMAT = "%Y%m%dT%H%M%SZ"


class Recording(RecordingEntry):
    """One recording of a directory.

    For an incomplete file, the start that its name states and the time of its last write stand in for log times.
    """

    path: Path = Field(exclude=True)


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
        start_ns = start_of(path.name)
        recording = Recording(
            id=f"{site}/{machine}/{path.name}",
            site=site,
            machine=machine,
            path=path,
            start_ns=stat.st_mtime_ns if start_ns is None else start_ns,
            end_ns=stat.st_mtime_ns,
            messages=None,
            size_bytes=stat.st_size,
            complete=path.suffix == SUFFIX,
            kept_because="",
            problem="",
        )
        if recording.complete:
            try:
                summary = summarize_recording(path)
            except RecordingError as error:
                recording = recording.model_copy(update={"problem": str(error)})
            else:
                count = sum(summary.messages.values())
                times = {"start_ns": summary.start_ns, "end_ns": summary.end_ns} if count else {}
                recording = recording.model_copy(update={"messages": count, **times})
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
    stamp = datetime.fromtimestamp(start_ns // 1_000_000_000, UTC).strftime(_STAMP_FORMAT)
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
    return int(stamp.timestamp()) * 1_000_000_000


def kept_reasons(folder: Path) -> dict[str, str]:
    """File names that an alarm keeps, with the reason; empty if the folder's ``kept.json`` is missing or unreadable."""
    try:
        kept = json.loads((folder / KEPT).read_text(encoding="utf-8"))["kept"]
        return {str(name): str(reason) for name, reason in kept.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _subfolders(folder: Path, name: str | None) -> list[Path]:
    """Folders that may be a site or a machine, sorted, without symbolic links."""
    entries = [folder / name] if name is not None and _PLACE_ONLY.fullmatch(name) else []
    if name is None:
        entries = _entries(folder)
    return [e for e in entries if _PLACE_ONLY.fullmatch(e.name) and e.is_dir() and not e.is_symlink()]


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
