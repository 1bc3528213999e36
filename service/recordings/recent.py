"""What was recorded before a monitor ended: from it the next one makes its window again."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from models.errors import RecordingError
from models.signals.recording import RecordedMessage, read_recording
from models.signals.salvage import salvaged_messages
from models.signals.wire import REPLAY_MARK
from service.recordings.catalogue import PART, SUFFIX
from service.terminal.logs import logger

_log = logger(part="recordings")


def recorded_files(folder: Path) -> tuple[Path, ...]:
    """Recordings of one machine, complete or left by a crash, oldest first."""
    return tuple(sorted((*folder.glob(f"*{SUFFIX}"), *folder.glob(f"*{SUFFIX}{PART}"))))


def recent_messages(files: Sequence[Path], key: str, since_ns: int) -> Iterator[RecordedMessage]:
    """Messages on a key, replays left out, in the order in which they came.

    Parameters
    ----------
    files : sequence of Path
        Oldest first. What a crash left may be completed, and so get another name, at the same time.
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
