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
from service.recordings.replay.data_time import DataSpan, clock_key, data_start_ns, place_of, span_of

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

    Times are those of the data, see `service.recordings.replay.data_time`, whenever and however fast these were
    recorded. For a machine without blocks or reports that can be read, the time of recording stands in.

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
            raise RecordingError(f"{', '.join(str(path) for path in paths)}: contains no messages")
        self._files = sorted(filled, key=lambda file: (file.summary.start_ns, file.summary.end_ns))
        self._spans: dict[tuple[Path, str], DataSpan | None] = {}

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files in time order."""
        return tuple(file.path for file in self._files)

    def paths_between(
        self, from_ns: int | None, to_ns: int | None, keys: frozenset[str] | None = None
    ) -> tuple[Path, ...]:
        """Files that have data between two times, under some keys if they are given, in time order."""
        return tuple(file.path for file in self._files if self._touches(file, keys, from_ns, to_ns))

    @property
    def keys(self) -> frozenset[str]:
        """Every key that occurs."""
        return frozenset(key for file in self._files for key in file.summary.messages)

    @property
    def machines(self) -> tuple[MachineKeys, ...]:
        """Machines of which there are sample blocks."""
        return self._machines("stream")

    def _machines(self, *leaves: str) -> tuple[MachineKeys, ...]:
        """Machines with any of these keys."""
        parts = [key.split("/") for key in sorted(self.keys)]
        found = [MachineKeys(*one[1:3]) for one in parts if len(one) == 4 and one[0] == PREFIX and one[3] in leaves]
        return tuple(dict.fromkeys(found))

    def machine(self, wanted: str | None = None, *, reports: bool = False) -> MachineKeys:
        """Keys of the machine ``SITE/MACHINE``, which may be left out if the recordings hold one machine.

        With `reports`, a machine with reports counts too, even if its samples were not kept.

        Raises
        ------
        MachineFileError
            If it is not in the recordings, or several are and none was named; the message lists them.
        """
        found = self._machines("report", "stream") if reports else self.machines
        there = {f"{keys.site}/{keys.machine}": keys for keys in found}
        listed = ", ".join(there) or "none"
        what = "reports or sample blocks" if reports else "sample blocks"
        place = ", ".join(path.name for path in self.paths)
        if wanted is None:
            if not there:
                raise MachineFileError(f"{place}: contains no {what}")
            if len(there) != 1:
                raise MachineFileError(f"{place}: machines with {what}: {listed}; name one, as --key SITE/MACHINE")
            return next(iter(there.values()))
        name = wanted.removeprefix(f"{PREFIX}/").removesuffix("/stream")
        if name not in there:
            raise MachineFileError(f"{place}: no {what} of {wanted}; machines with {what}: {listed}")
        return there[name]

    def span(self, *machines: MachineKeys) -> DataSpan:
        """Time span of the data of some machines; of all if none is given.

        Raises
        ------
        RecordingError
            Where damage is met.
        """
        places = {place_of(keys.stream) for keys in machines} or {place_of(key) for key in self.keys}
        found = [span for file in self._files for place in sorted(places) if (span := self._span(file, place))]
        found = found or [_recorded(file) for file in self._files]
        return DataSpan(
            min(span.start_ns for span in found),
            max(span.end_ns for span in found),
            found[0].first_ns,
            found[-1].newest_ns,
        )

    def between(self, from_: str | None, to: str | None, *machines: MachineKeys) -> tuple[int, int]:
        """Start, and end (exclusive), of the data that ``--from`` and ``--to`` ask for, of these machines or of all.

        Raises
        ------
        MachineFileError
            If a time cannot be read, or there are no data in between.
        """
        span = self.span(*machines)
        from_ns = span.start_ns if from_ is None else parse_moment(from_, span.start_ns, "--from")
        to_ns = span.end_ns + 1 if to is None else parse_moment(to, span.start_ns, "--to")
        if from_ns >= to_ns or from_ns > span.end_ns or to_ns <= span.start_ns:
            raise MachineFileError(
                f"--from {from_ or 0} --to {to or 'the end'}: nothing was recorded in between; the data are of "
                f"{clock(span.start_ns)} to {clock(span.end_ns)} UTC"
            )
        return max(from_ns, span.start_ns), min(to_ns, span.end_ns + 1)

    def descriptor(self, keys: MachineKeys, before_ns: int | None = None) -> RecordedMessage | None:
        """Channel descriptor that held at a time; without a time, or if there was none by then, the first."""
        first: RecordedMessage | None = None
        latest: RecordedMessage | None = None
        for message in self.messages({keys.descriptor}):
            first = first or message
            if before_ns is None:
                break
            if self._following_ns(keys, message) <= before_ns:
                latest = message
        return latest or first

    def messages(
        self, keys: Collection[str] | None = None, *, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[RecordedMessage]:
        """Read messages, as `timed` does."""
        if from_ns is None and to_ns is None:
            for group in self._overlapping():
                yield from _read(group, None if keys is None else frozenset(keys))
            return
        for _, message in self.timed(keys, from_ns=from_ns, to_ns=to_ns):
            yield message

    def timed(
        self, keys: Collection[str] | None = None, *, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[tuple[int, RecordedMessage]]:
        """Read messages from `from_ns` up to, and without, `to_ns`, each with the data time that had been reached.

        A block has the time of its first sample; messages between two blocks of a machine have that of the earlier one.

        Raises
        ------
        RecordingError
            Where damage is met.
        """
        wanted = None if keys is None else frozenset(keys)
        for group in self._overlapping():
            inside = [file for file in group if self._touches(file, wanted, from_ns, to_ns)]
            reached: dict[str, int] = {}
            clocks: set[str] = set()
            for file in inside:
                for place in _places(file, wanted):
                    if span := self._span(file, place):
                        reached.setdefault(place, span.first_ns)
                        clocks |= {key for key in (clock_key(file.summary.messages, place),) if key}
            for message in _read(inside, None if wanted is None else wanted | clocks):
                place = place_of(message.key)
                if message.key in clocks:
                    start_ns = data_start_ns(message)
                    reached[place] = reached[place] if start_ns is None else start_ns
                time_ns = reached.get(place, message.log_time_ns)
                if (
                    (wanted is None or message.key in wanted)
                    and (from_ns is None or time_ns >= from_ns)
                    and (to_ns is None or time_ns < to_ns)
                ):
                    yield time_ns, message

    def _span(self, file: _File, place: str) -> DataSpan | None:
        """Data of a machine in one file, read once."""
        known = (file.path, place)
        if known not in self._spans:
            key = clock_key(file.summary.messages, place)
            self._spans[known] = None if key is None else span_of(file.path, file.summary, key)
        return self._spans[known]

    def _touches(self, file: _File, keys: frozenset[str] | None, from_ns: int | None, to_ns: int | None) -> bool:
        """Whether a file has messages of these keys between two times."""
        spans = [self._span(file, place) or _recorded(file) for place in _places(file, keys)]
        return any(
            (from_ns is None or span.end_ns >= from_ns) and (to_ns is None or span.start_ns < to_ns) for span in spans
        )

    def _following_ns(self, keys: MachineKeys, message: RecordedMessage) -> int:
        """Time of the first data that were recorded after a message."""
        since_ns = message.log_time_ns
        for file in self._files:
            if file.summary.end_ns >= since_ns and keys.stream in file.summary.messages:
                for block in read_recording(file.path, keys={keys.stream}, from_ns=since_ns):
                    if (start_ns := data_start_ns(block)) is not None:
                        return start_ns
        return since_ns

    def _overlapping(self) -> Iterator[list[_File]]:
        """Groups of files that do not overlap in time with other groups, so that few files are open at a time."""
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


def _places(file: _File, keys: frozenset[str] | None) -> set[str]:
    """Machines of which a file has messages of these keys."""
    return {place_of(key) for key in file.summary.messages if keys is None or key in keys}


def _recorded(file: _File) -> DataSpan:
    """Times of recording, for files whose data give no time."""
    start_ns, end_ns = file.summary.start_ns, file.summary.end_ns
    return DataSpan(start_ns, end_ns, start_ns, end_ns)


def _read(files: Sequence[_File], keys: frozenset[str] | None) -> Iterator[RecordedMessage]:
    """Messages of files that may overlap, in the order of recording."""
    inside = [file for file in files if keys is None or keys & file.summary.messages.keys()]
    if len(inside) == 1:
        yield from read_recording(inside[0].path, keys=keys)
    else:
        streams = [read_recording(file.path, keys=keys) for file in inside]
        yield from _without_repeats(heapq.merge(*streams, key=lambda message: message.log_time_ns))


def _without_repeats(messages: Iterator[RecordedMessage]) -> Iterator[RecordedMessage]:
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
    """Time that an option names: seconds after the start of the data, or a date and time.

    That is ``90``, ``+90`` or ``90s``; or ``2026-01-01T00:02:30Z`` (UTC if it has no zone); or nanoseconds since 1970
    as ``1767225750000000000ns``.

    Raises
    ------
    MachineFileError
        If it is none of these.

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
            f"{option} is {text!r}, expected seconds after the start of the data, such as 90, "
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
