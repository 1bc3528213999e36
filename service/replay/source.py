"""Recordings as one stream of messages: several files in time order, one machine, a stretch of time."""

import heapq
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from models.errors import MachineFileError, RecordingError
from models.signals.keys import PREFIX, MachineKeys
from models.signals.recording import RecordedMessage, RecordingSummary, read_recording, summarize_recording

__all__ = ["RecordingSource", "clock", "parse_moment"]

_NANOSECONDS = re.compile(r"\d{1,19}ns")
_SECONDS = re.compile(r"\+?(\d+(\.\d*)?|\.\d+)s?")


@dataclass(frozen=True, slots=True)
class _File:
    path: Path
    summary: RecordingSummary


class RecordingSource:
    """The messages of one or several recordings, in the order in which they were recorded.

    Files may come in any order and may overlap, as a capture around an alarm overlaps the files it was taken from: a
    message that is in both is read once.

    Parameters
    ----------
    paths : sequence of Path
        Complete recordings.

    Raises
    ------
    RecordingError
        If a file is missing, not a recording, incomplete or damaged, or if none holds a message.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        distinct = dict.fromkeys(path.resolve() for path in paths)
        files = [_File(path, summarize_recording(path)) for path in distinct]
        filled = [file for file in files if file.summary.messages]
        if not filled:
            raise RecordingError(f"{', '.join(str(path) for path in paths)}: no message in there")
        self._files = sorted(filled, key=lambda file: (file.summary.start_ns, file.summary.end_ns))
        self.start_ns = self._files[0].summary.start_ns
        self.end_ns = max(file.summary.end_ns for file in self._files)

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files in time order."""
        return tuple(file.path for file in self._files)

    @property
    def keys(self) -> frozenset[str]:
        """Every key that occurs."""
        return frozenset(key for file in self._files for key in file.summary.messages)

    @property
    def machines(self) -> tuple[MachineKeys, ...]:
        """Machines of which there are sample blocks."""
        found = []
        for key in sorted(self.keys):
            parts = key.split("/")
            if len(parts) == 4 and parts[0] == PREFIX and parts[3] == "stream":
                found.append(MachineKeys(parts[1], parts[2]))
        return tuple(found)

    def machine(self, wanted: str | None = None) -> MachineKeys:
        """Keys of the machine to replay.

        Parameters
        ----------
        wanted : str, optional
            ``SITE/MACHINE``; may be left out if the recordings hold one machine.

        Raises
        ------
        MachineFileError
            If it is not in the recordings, or several are and none was named; the message lists them.
        """
        there = {f"{keys.site}/{keys.machine}": keys for keys in self.machines}
        listed = ", ".join(there) or "none"
        place = ", ".join(path.name for path in self.paths)
        if wanted is None:
            if len(there) != 1:
                raise MachineFileError(
                    f"{place}: machines with sample blocks: {listed}; name one, as --key SITE/MACHINE"
                )
            return next(iter(there.values()))
        name = wanted.removeprefix(f"{PREFIX}/").removesuffix("/stream")
        if name not in there:
            raise MachineFileError(f"{place}: no sample blocks of {wanted}; machines with sample blocks: {listed}")
        return there[name]

    def descriptor(self, keys: MachineKeys, before_ns: int | None = None) -> RecordedMessage | None:
        """Latest channel descriptor recorded up to a time; without a time, or if there was none by then, the first."""
        first: RecordedMessage | None = None
        latest: RecordedMessage | None = None
        for message in self.messages({keys.descriptor}):
            first = first or message
            if before_ns is None or message.log_time_ns > before_ns:
                break
            latest = message
        return latest or first

    def messages(
        self, keys: Collection[str] | None = None, *, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[RecordedMessage]:
        """Read messages.

        Parameters
        ----------
        keys : collection of str, optional
            Only these.
        from_ns, to_ns : int, optional
            Only those recorded from `from_ns` up to, and without, `to_ns`.

        Raises
        ------
        RecordingError
            Where damage is met.
        """
        wanted = None if keys is None else frozenset(keys)
        for group in self._overlapping():
            inside = [file for file in group if _touches(file, wanted, from_ns, to_ns)]
            streams = [read_recording(file.path, keys=wanted, from_ns=from_ns, to_ns=to_ns) for file in inside]
            if len(streams) == 1:
                yield from streams[0]
            else:
                yield from _once(heapq.merge(*streams, key=lambda message: message.log_time_ns))

    def _overlapping(self) -> Iterator[list[_File]]:
        """Files in groups that share no stretch of time with each other; few are open at a time."""
        group: list[_File] = []
        end_ns = 0
        for file in self._files:
            # Files of a rotating recorder may meet in one nanosecond; order of reading is then order of starting.
            if group and file.summary.start_ns >= end_ns:
                yield group
                group = []
            group.append(file)
            end_ns = max(end_ns, file.summary.end_ns)
        yield group


def _touches(file: _File, keys: frozenset[str] | None, from_ns: int | None, to_ns: int | None) -> bool:
    summary = file.summary
    if keys is not None and not keys & summary.messages.keys():
        return False
    return (from_ns is None or summary.end_ns >= from_ns) and (to_ns is None or summary.start_ns < to_ns)


def _once(messages: Iterator[RecordedMessage]) -> Iterator[RecordedMessage]:
    """Leave out repetitions; they have the same time of recording and come one after the other."""
    now_ns: int | None = None
    seen: set[RecordedMessage] = set()
    for message in messages:
        if message.log_time_ns != now_ns:
            now_ns = message.log_time_ns
            seen.clear()
        if message not in seen:
            seen.add(message)
            yield message


def parse_moment(text: str, start_ns: int, option: str) -> int:
    """Time that an option names: seconds after the start of the recording, or a date and time.

    Parameters
    ----------
    text : str
        ``90``, ``+90`` or ``90s``; or ``2026-01-01T00:02:30Z`` (UTC if it has no zone); or nanoseconds since 1970 as
        ``1767225750000000000ns``.
    start_ns : int
        Start of the recording.
    option : str
        Name of the option, for the message.

    Raises
    ------
    MachineFileError
        If it is neither.

    Examples
    --------
    >>> parse_moment("1.5", 10_000_000_000, "--from")
    11500000000
    >>> parse_moment("1970-01-01T00:00:10Z", 0, "--from")
    10000000000
    """
    if _NANOSECONDS.fullmatch(text):
        return int(text[:-2])
    if _SECONDS.fullmatch(text):
        return start_ns + round(float(text.strip("+s")) * 1e9)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise MachineFileError(
            f"{option} is {text!r}, expected seconds after the start of the recording, such as 90, "
            "or a time such as 2026-01-01T00:02:30Z"
        ) from error
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    since = moment - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


def clock(time_ns: int) -> str:
    """Date and time, UTC, to the tenth of a second.

    Examples
    --------
    >>> clock(1_767_225_600_250_000_000)
    '2026-01-01 00:00:00.2'
    """
    moment = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{time_ns % 10**9 // 10**8}"
