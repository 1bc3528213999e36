"""Import of a folder of files, snapshots or parts of a longer stretch, in order of time, as if they were one file."""

import re
from collections import deque
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from itertools import pairwise
from math import gcd
from pathlib import Path
from statistics import median

import numpy as np

from models.ingest import lasting
from models.machine import MachineFile
from models.signals.block import FloatArray
from service.interchange.blocks import pulse_times
from service.interchange.clock import Clock, clock_for
from service.interchange.mapping import Keyphasor, Mapping
from service.interchange.samples import Gap, Piece, Read, Signal, pieces, signals_of
from service.interchange.source import Source, SourceError

_DATE = re.compile(
    r"(?<!\d)(\d{4})[-_. ]?(\d{2})[-_. ]?(\d{2})"  # day
    r"[-_. T]*(\d{2})[-_.:h ]?(\d{2})(?:[-_.:m ]?(\d{2})(?:[.,_-](\d{1,9}))?)?(?!\d)"  # time of day
)
_UNIX = re.compile(r"(?<!\d)(1\d{9})(\d{3}|\d{6}|\d{9})?(?!\d)")  # from 2001 to 2033


@dataclass(frozen=True, slots=True)
class SnapshotFile:
    """A file of a folder."""

    path: Path
    # Time of its first row, nanoseconds since 1970-01-01 UTC, from its name or its place among the others; None if the
    # file itself states it.
    start_ns: int | None


def time_in_name(name: str, zone: tzinfo = UTC, shared: Container[str] = ()) -> int | None:
    """Time in a file name, ns since 1970: a date with time of day, or a count of s, ms, µs or ns since 1970.

    For an hour that occurs twice (end of daylight saving time), the first is taken. Numbers that all file names of a
    folder share (`shared`), such as a device number, are not taken for times.

    Examples
    --------
    >>> time_in_name("2003.10.22.12.06.24")
    1066824384000000000
    >>> time_in_name("pump7_20260131T120000.250.csv")
    1769860800250000000
    >>> time_in_name("acc_00017.csv") is None, time_in_name("4021557791.csv") is None
    (True, True)
    """
    found = _DATE.search(name)
    if found is not None:
        fields = [int(part) for part in found.groups("0")[:6]]
        try:
            seconds = int(datetime(*fields, tzinfo=zone).timestamp())  # type: ignore[arg-type, misc]  # six of them
        except ValueError:  # digits that form no date
            return None
        return seconds * 10**9 + int((found.group(7) or "0").ljust(9, "0"))
    since = next((found for found in _UNIX.finditer(name) if found.group() not in shared), None)
    if since is None:
        return None
    return int(since.group(1)) * 10**9 + int((since.group(2) or "0").ljust(9, "0"))


def snapshot_files(folder: Path, mapping: Mapping, machine: MachineFile) -> tuple[SnapshotFile, ...]:
    """Files of a folder in order of their times, or of the numbers in their names.

    Times are those in the files, or are counted from the mapping's ``time.start`` by the machine's schedule, or are
    those in the names. Files of unknown formats are left out, unless the mapping states the format.

    Raises
    ------
    SourceError
        If there is no usable file, or the mapping gives a start but the machine has no schedule.
    """
    paths = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    paths = sorted((path for path in paths if mapping.format_of(path) is not None), key=_natural)
    if not paths:
        raise SourceError(f"{folder}: no file of a known format in it; say format = ... in the mapping")
    base, schedule = mapping.time, machine.schedule
    # The time column may continue from one file to the next.
    runs_on = base.start is not None and base.column is not None and schedule is None
    dated = base.start is None and any(kind.dated for kind in map(mapping.format_of, paths) if kind)
    counted = isinstance(base.start, str)  # from a known zero
    if base.is_datetime or counted or runs_on or dated:
        return _by_their_own_times(paths, mapping, machine)
    if base.start_ns is not None:
        if schedule is None:
            raise SourceError(
                f"{folder}: time.start is that of the first file; expected [schedule] every_s in the machine file, "
                f"from which the times of the others follow{_or_named(paths, mapping)}"
            )
        period_ns = round(schedule.every_s * 1e9)
        return tuple(
            SnapshotFile(path, base.start_ns + place * period_ns)
            for place, path in zip(_places(paths), paths, strict=True)
        )
    files = [SnapshotFile(path, start_ns) for path, start_ns in zip(paths, _named(paths, mapping), strict=True)]
    return tuple(sorted(files, key=lambda one: one.start_ns or 0))  # those without a time keep their order


def _or_named(paths: Sequence[Path], mapping: Mapping) -> str:
    """Advice for the error message if a start is given although all names have times."""
    named = isinstance(mapping.time.start, datetime) and None not in _named(paths, mapping)
    return "; or leave out time.start, and the times in their names count" if named else ""


def _named(paths: Sequence[Path], mapping: Mapping) -> list[int | None]:
    """Times in the names of files."""
    numbers = [set(re.findall(r"\d+", path.name)) for path in paths]
    shared = set.intersection(*numbers) if len(paths) > 1 else set()
    return [time_in_name(path.name, mapping.time.time_zone, shared) for path in paths]


def _by_their_own_times(paths: Sequence[Path], mapping: Mapping, machine: MachineFile) -> tuple[SnapshotFile, ...]:
    """Files ordered by the start times that they state themselves, or else by those in their names.

    Unreadable files come first, so that their error is raised when the files are read.
    """
    begun, base = [], mapping.time
    for path, told_ns in zip(paths, _named(paths, mapping), strict=True):
        begin_ns, named_ns = -1, None
        with suppress(SourceError), mapping.open(path) as source:
            columns = [one.reference for one in signals_of(source, mapping, machine)]
            if not base.is_datetime and base.start is None and source.timing(columns).start_ns is None:
                named_ns = told_ns
            begin_ns = clock_for(source, columns, base, machine, named_ns).origin_ns
        begun.append((begin_ns, SnapshotFile(path, named_ns)))
    return tuple(file for _, file in sorted(begun, key=lambda one: one[0]))


def _places(paths: Sequence[Path]) -> list[int]:
    """Places of files in a schedule, from 0: a number missing from the sequence in their names leaves a place empty.

    If the names do not differ in exactly one number that counts in equal steps, the files have consecutive places.
    """
    parts = [re.split(r"(\d+)", path.name) for path in paths]
    columns = list(zip(*parts, strict=False))
    differing = [place for place, column in enumerate(columns) if len(set(column)) > 1]
    places = list(range(len(paths)))
    if len(differing) == 1 and differing[0] % 2 and len({len(row) for row in parts}) == 1:
        found = filter(None, map(_steps, _number_meanings(columns[differing[0]])))
        places = min(found, key=lambda steps: steps[-1], default=places)
    return places


def _number_meanings(texts: Sequence[str]) -> Iterator[list[int]]:
    """Interpretations of the numbers in names: plain numbers, and times of day or dates in seconds."""
    yield [int(text) for text in texts]
    for form, length in (("%H%M", 4), ("%H%M%S", 6), ("%Y%m%d", 8)):
        with suppress(ValueError):
            if {len(text) for text in texts} == {length}:
                times = [datetime.strptime(text, form).replace(tzinfo=UTC) for text in texts]
                yield [int((time - times[0]).total_seconds()) for time in times]


def _steps(numbers: Sequence[int]) -> list[int] | None:
    """Places of numbers that count in equal steps, some possibly missing; None if they do not."""
    steps = [after - before for before, after in pairwise(numbers)]
    step = gcd(*steps)
    return [(number - numbers[0]) // step for number in numbers] if step and median(steps) == step else None


def _natural(path: Path) -> list[tuple[int, str]]:
    """Key that sorts 2 before 10."""
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", path.name)]


def unusable(files: Sequence[SnapshotFile], mapping: Mapping, machine: MachineFile) -> dict[Path, SourceError]:
    """Files that cannot be read to their end when opened individually, and the error of each.

    Raises
    ------
    SourceError
        If the others' times depend on such a file: places in a schedule are counted, and its name does not show whether
        it occupies one.
    """
    faults: dict[Path, SourceError] = {}
    for file in files:
        try:
            with _opened(file, mapping, machine) as (source, signals, clock):
                deque(pieces(source, signals, clock, mapping, Read()), maxlen=0)
                if mapping.keyphasor is not None:
                    pulse_times(source, mapping.keyphasor, clock, mapping)
        except SourceError as error:
            faults[file.path] = error
    if machine.schedule is not None and isinstance(mapping.time.start, datetime):
        forms = {_form(file.path) for file in files if file.path not in faults}
        for path, fault in faults.items():
            if forms and _form(path) not in forms:
                raise SourceError(
                    f"{fault}; whether it counts among the others its name does not say: move it out of the folder"
                )
    return faults


def _form(path: Path) -> str:
    """A file's name, the same for all numbers in it."""
    return re.sub(r"\d+", "0", path.name)


def runs_of_pulses(
    begun: FloatArray,
    files: Sequence[SnapshotFile],
    first: Clock,
    mapping: Mapping,
    machine: MachineFile,
    keyphasor: Keyphasor,
) -> list[FloatArray]:
    """Pulse times of all files, `begun` those of the first, on its clock; contiguous files share a run."""
    runs = [begun]
    for file in files:
        with _opened(file, mapping, machine, first) as (source, _, clock):
            own = pulse_times(source, keyphasor, clock, mapping) + float(clock.origin_ns - first.origin_ns)
        before = runs[-1]
        if before.size > 1 and own.size and own[0] - before[-1] < 1.5 * float(np.median(np.diff(before[-9:]))):
            runs[-1] = np.concatenate([before, own])
        else:
            runs.append(own)
    return runs


@contextmanager
def _opened(
    file: SnapshotFile, mapping: Mapping, machine: MachineFile, first: Clock | None = None
) -> Iterator[tuple[Source, list[Signal], Clock]]:
    with mapping.open(file.path) as source:
        signals = signals_of(source, mapping, machine)
        clock = clock_for(source, [one.reference for one in signals], mapping.time, machine, file.start_ns)
        yield source, signals, clock if first is None or file.start_ns is None else clock.after(first)


def joined(
    begun: Iterator[Piece],
    files: Sequence[SnapshotFile],
    first: Clock,
    mapping: Mapping,
    machine: MachineFile,
    read: Read,
) -> Iterator[Piece]:
    """Pieces of the first file (`begun`) and of the others, on the first file's clock; `read` sums up all files.

    Raises
    ------
    SourceError
        If a file cannot be used, has another rate, or begins before the one before it has ended.
    """
    end_ns, before, step_ns = 0.0, first.path, 1e9 / first.rate_hz
    for piece in begun:
        end_ns = float(piece.time_ns[-1]) + step_ns
        yield piece
    read.shortest = read.longest = read.rows
    for file in files:
        own = Read()
        with _opened(file, mapping, machine, first) as (source, signals, clock):
            if clock.ratio != first.ratio:
                raise SourceError(
                    f"{file.path}: has {clock.rate_hz:.9g} samples per second, {first.path.name} has "
                    f"{first.rate_hz:.9g}; expected the same in all files of a folder"
                )
            offset_ns = float(clock.origin_ns - first.origin_ns)
            if offset_ns < end_ns - step_ns / 2:
                raise SourceError(
                    f"{file.path}: begins {lasting((end_ns - offset_ns) / 1e9)} before the end of {before.name}, "
                    f"expected the files of a folder one after the other{_or_named([file.path], mapping)}"
                )
            if offset_ns > end_ns + step_ns / 2:
                read.gaps.append(Gap(end_ns, offset_ns, 0, file.path.name))
            for piece in pieces(source, signals, clock, mapping, own):
                time_ns = piece.time_ns + offset_ns
                goes_on = abs(time_ns[0] - end_ns) <= step_ns / 2
                end_ns = float(time_ns[-1]) + step_ns
                yield replace(piece, time_ns=time_ns, begins=piece.begins and not goes_on)
        before = file.path
        read.files += 1
        read.rows += own.rows
        read.shortest, read.longest = min(read.shortest, own.rows), max(read.longest, own.rows)
        read.filled += own.filled
        read.left_out += own.left_out
        read.cut += own.cut
        read.gaps += [replace(gap, from_ns=gap.from_ns + offset_ns, to_ns=gap.to_ns + offset_ns) for gap in own.gaps]
