"""Recordings as one stream of messages: several files in time order, one machine, a stretch of time.

When data were taken is not when they were recorded: a stream that comes faster than real time is recorded in less time
than it lasts, and a recording that is imported was taken long before. A person who asks for an hour, or for the latest
20 s, means the time of the data: that of the blocks or, where the samples were not kept, of the window reports.
"""

import heapq
import json
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from models.errors import MachineFileError, RecordingError, WireError
from models.signals.block import nanoseconds
from models.signals.keys import PREFIX, MachineKeys
from models.signals.recording import RecordedMessage, RecordingSummary, read_recording, summarize_recording
from models.signals.wire import decode_block

_NANOSECONDS = re.compile(r"\d{1,19}ns")
_SECONDS = re.compile(r"\+?(\d+(\.\d*)?|\.\d+)s?")
_BACK_NS = 5 * 10**9
_STEADY_NS = 10**9
_LATEST_NS = 2**63


@dataclass(frozen=True, slots=True)
class DataSpan:
    """Data of a machine in a recording."""

    # Beginning of the earliest and end of the latest data.
    start_ns: int
    end_ns: int
    # Beginning of the data recorded first, and end of those recorded last; they differ from the above if the publisher
    # was started again at an earlier time, or its clock was set.
    first_ns: int
    newest_ns: int


@dataclass(frozen=True, slots=True)
class _Taken:
    """When one message's data were taken; sequence and run are None for a report."""

    start_ns: int
    end_ns: int
    sequence: int | None = None
    run: int | None = None


def place_of(key: str) -> str:
    """Common beginning of the keys of a machine; empty for a key that belongs to none.

    Examples
    --------
    >>> place_of("rotorwatch/demo/lab/alarm/event"), place_of("weather")
    ('rotorwatch/demo/lab', '')
    """
    parts = key.split("/")
    return "/".join(parts[:3]) if len(parts) > 3 and parts[0] == PREFIX else ""


def clock_key(keys: Collection[str], place: str) -> str | None:
    """The one of these keys whose messages say when a machine's data were taken; None if there is none."""
    return next((key for key in (f"{place}/stream", f"{place}/report") if place and key in keys), None)


def data_start_ns(message: RecordedMessage) -> int | None:
    """Time of a block's first sample, or of the last one in a report; None if the message cannot be read."""
    taken = _taken(message)
    return None if taken is None else taken.start_ns


def span_of(file: RecordingSummary, key: str) -> DataSpan | None:
    """Time span of the data in the messages of a key; None if none can be read.

    If one run went on without a gap, only the two ends are read.

    Raises
    ------
    RecordingError
        Where damage is met.
    """
    first = next(_all_taken(file.path, key), None)
    if first is None:
        return None
    last = first
    for last in _all_taken(file.path, key, from_ns=file.end_ns - _BACK_NS):  # noqa: B007  # the last one is wanted
        pass
    blocks = 0 if last.sequence is None or first.sequence is None else last.sequence - first.sequence
    expected_ns = blocks * (first.end_ns - first.start_ns)
    steady = last.run == first.run is not None and abs(last.start_ns - first.start_ns - expected_ns) < _STEADY_NS
    if steady and blocks > 0:
        return DataSpan(first.start_ns, last.end_ns, first.start_ns, last.end_ns)
    start_ns, end_ns = first.start_ns, first.end_ns
    for last in _all_taken(file.path, key):
        start_ns, end_ns = min(start_ns, last.start_ns), max(end_ns, last.end_ns)
    return DataSpan(start_ns, end_ns, first.start_ns, last.end_ns)


def _all_taken(path: Path, key: str, from_ns: int | None = None) -> Iterator[_Taken]:
    found = (_taken(message) for message in read_recording(path, keys={key}, from_ns=from_ns))
    return (taken for taken in found if taken is not None)


def _taken(message: RecordedMessage) -> _Taken | None:
    if message.key.endswith("/report"):
        try:
            end_ns = int(json.loads(message.payload)["end_ns"])
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return None
        return _Taken(end_ns - 1, end_ns) if 0 < end_ns < _LATEST_NS else None
    try:
        block = decode_block(message.payload, message.attachment, message.encoding)
    except WireError:
        return None
    return _Taken(block.start_ns, block.end_ns, block.sequence, block.run)


class RecordingSource:
    """The messages of one or several recordings, in the order in which they were recorded.

    Files may come in any order and may overlap, as a capture around an alarm overlaps the files it was taken from: a
    message that is in both is read once.

    Times are those of the data, whenever and however fast these were recorded. For a machine without blocks or reports
    that can be read, the time of recording stands in. Raises `RecordingError` if a file is missing, not a recording,
    incomplete or damaged, or if none holds a message.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        distinct = {path.resolve(): path for path in paths}
        filled = [file for file in map(summarize_recording, distinct.values()) if file.messages]
        if not filled:
            raise RecordingError(f"{', '.join(str(path) for path in paths)}: contains no messages")
        self._files = sorted(filled, key=lambda file: (file.start_ns, file.end_ns))
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
        return frozenset(key for file in self._files for key in file.messages)

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
        start_ns, end_ns = min(span.start_ns for span in found), max(span.end_ns for span in found)
        return DataSpan(start_ns, end_ns, found[0].first_ns, found[-1].newest_ns)

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
        messages = self.messages({keys.descriptor})
        found = next(messages, None)
        if before_ns is not None:
            for message in messages:
                if self._following_ns(keys, message) <= before_ns:
                    found = message
        return found

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
                        clocks |= {key for key in (clock_key(file.messages, place),) if key}
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

    def _span(self, file: RecordingSummary, place: str) -> DataSpan | None:
        """Data of a machine in one file, read once."""
        known = (file.path, place)
        if known not in self._spans:
            key = clock_key(file.messages, place)
            self._spans[known] = None if key is None else span_of(file, key)
        return self._spans[known]

    def _touches(
        self, file: RecordingSummary, keys: frozenset[str] | None, from_ns: int | None, to_ns: int | None
    ) -> bool:
        """Whether a file has messages of these keys between two times."""
        spans = [self._span(file, place) or _recorded(file) for place in _places(file, keys)]
        return any(
            (from_ns is None or span.end_ns >= from_ns) and (to_ns is None or span.start_ns < to_ns) for span in spans
        )

    def _following_ns(self, keys: MachineKeys, message: RecordedMessage) -> int:
        """Time of the first data that were recorded after a message."""
        since_ns = message.log_time_ns
        for file in self._files:
            if file.end_ns >= since_ns and keys.stream in file.messages:
                for block in read_recording(file.path, keys={keys.stream}, from_ns=since_ns):
                    if (start_ns := data_start_ns(block)) is not None:
                        return start_ns
        return since_ns

    def _overlapping(self) -> Iterator[list[RecordingSummary]]:
        """Groups of files that do not overlap in time with other groups, so that few files are open at a time."""
        group: list[RecordingSummary] = []
        end_ns = 0
        for file in self._files:
            # Files of a rotating recorder may meet in one nanosecond; order of reading is then order of starting.
            if group and file.start_ns >= end_ns:
                yield group
                group = []
            group.append(file)
            end_ns = max(end_ns, file.end_ns)
        yield group


def _places(file: RecordingSummary, keys: frozenset[str] | None) -> set[str]:
    """Machines of which a file has messages of these keys."""
    return {place_of(key) for key in file.messages if keys is None or key in keys}


def _recorded(file: RecordingSummary) -> DataSpan:
    """Times of recording, for files whose data give no time."""
    return DataSpan(file.start_ns, file.end_ns, file.start_ns, file.end_ns)


def _read(files: Sequence[RecordingSummary], keys: frozenset[str] | None) -> Iterator[RecordedMessage]:
    """Messages of files that may overlap, in the order of recording."""
    inside = [file for file in files if keys is None or keys & file.messages.keys()]
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
        return nanoseconds(datetime.fromisoformat(text))
    except ValueError as error:
        raise MachineFileError(
            f"{option} is {text!r}, expected seconds after the start of the data, such as 90, "
            "or a time such as 2026-01-01T00:02:30Z"
        ) from error


def clock(time_ns: int) -> str:
    """Date and time, UTC, to the tenth of a second.

    Examples
    --------
    >>> clock(1_767_225_600_250_000_000)
    '2026-01-01 00:00:00.2'
    """
    moment = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{time_ns % 10**9 // 10**8}"
