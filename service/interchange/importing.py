"""Import of a file from another program into a recording, with a summary in sentences.

::

    Source ─> pieces ──────> Integration ─> Resampling ──> AngleColumn ─> BlockMaker ─> RecordingWriter
    (format)  (units, time,  (accelerometers) (other rate)  (keyphasor)    (0.1 s)
               gaps)
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import floor
from pathlib import Path

import numpy as np

from models.ingest import lasting
from models.machine import MachineFile
from models.signals.block import lowest_valid_hz, settling_s
from models.signals.channels import Quantity, unit_in_text
from models.signals.keyphasor import PulseTrain
from models.signals.recording import RecordingWriter
from service.interchange.blocks import AngleColumn, BlockMaker, Written, pulse_times, read_pulses, without_pulses
from service.interchange.clock import Clock, clock_for
from service.interchange.folder import SnapshotFile, joined, runs_of_pulses, snapshot_files, unusable
from service.interchange.mapping import Mapping
from service.interchange.overlap import Integration, Overlap, Resampling
from service.interchange.samples import Piece, Read, check_one_rate, pieces, signals_of
from service.interchange.source import Reference, SourceError
from service.monitor.conversion import rfc3339

_YEAR_NS = 31_556_952 * 10**9
_NOTED = 0.01  # fraction of rows lost from which a note is given
_LISTED = 10
_NAMED = 5
_VARIED = 1.1  # ratio of highest to lowest speed from which both are stated
# Least and greatest rms that a machine's vibration may well have, SI; samples in a wrong unit are mostly beyond.
_PLAUSIBLE = {Quantity.DISPLACEMENT: (1e-9, 5e-3), Quantity.VELOCITY: (1e-7, 1.0), Quantity.ACCELERATION: (1e-5, 1e4)}
_FEW_SAMPLES = 4.0  # samples per keyphasor pulse below which the true pulse rate may be higher (aliasing)


@dataclass(frozen=True, slots=True)
class Imported:
    """Result of an import."""

    source: Path
    recording: Path
    machine: MachineFile
    mapping: Mapping
    clock: Clock
    read: Read  # summary of what was read
    written: Written  # summary of what was written
    angle: AngleColumn
    cut_rows: int  # rows at the ends of stretches where filters are not settled
    left_out: list[str]  # names in a folder that were not read: other formats, folders, broken links
    unusable: list[SourceError]  # errors of the folder's files that were left out as unreadable
    by_name: bool  # whether times were taken from file names
    doubts: list[str]  # notes on units in the file that are not understood


def import_file(
    path: Path, mapping: Mapping, machine: MachineFile, recording: Path, *, overwrite: bool = False
) -> Imported:
    """Import a file, or a folder of consecutive files without those that cannot be read.

    If the import fails, the incomplete recording is removed.

    Raises
    ------
    SourceError
        If the file, or every file of the folder, cannot be used; names row and column where applicable.
    RecordingError
        If the recording cannot be written.
    """
    if not path.is_dir():
        return _imported(path, (SnapshotFile(path, None),), mapping, machine, recording, overwrite=overwrite)
    files = snapshot_files(path, mapping, machine)
    try:
        return _imported(path, files, mapping, machine, recording, overwrite=overwrite)
    except SourceError:
        # Reading every file individually takes as long as the import, so it is only done after a failure.
        faults = unusable(files, mapping, machine)
        if not faults or len(faults) == len(files):
            raise
        rest = tuple(file for file in files if file.path not in faults)
        done = _imported(path, rest, mapping, machine, recording, overwrite=overwrite)
        left_out = [name for name in done.left_out if path / name not in faults]
        return replace(done, left_out=left_out, unusable=list(faults.values()))


def _imported(
    path: Path,
    files: tuple[SnapshotFile, ...],
    mapping: Mapping,
    machine: MachineFile,
    recording: Path,
    *,
    overwrite: bool,
) -> Imported:
    if any(recording.exists() and file.path.exists() and recording.samefile(file.path) for file in files):
        raise SourceError(f"{recording}: is what is imported, expected another name for the recording")
    with mapping.open(files[0].path) as source:
        signals = signals_of(source, mapping, machine)
        columns = [signal.reference for signal in signals]
        keyphasor = mapping.keyphasor
        if keyphasor is not None and keyphasor.column is not None:
            pulses_in = Reference(keyphasor.column, keyphasor.index)
            columns += [] if pulses_in in columns else [pulses_in]
        clock = clock_for(source, columns, mapping.time, machine, files[0].start_ns)
        pulses = None
        if keyphasor is not None:
            begun = pulse_times(source, keyphasor, clock, mapping)
            runs = runs_of_pulses(begun, files[1:], clock, mapping, machine, keyphasor)
            try:
                pulses = read_pulses(path, runs, keyphasor)
            except SourceError as error:
                raise SourceError(f"{error}{without_pulses(source, keyphasor, clock, mapping)}") from error
        read = Read()
        parts: Iterator[Piece] = pieces(source, signals, clock, mapping, read)
        if len(files) > 1:
            parts = joined(parts, files[1:], clock, mapping, machine, read)
        overlaps = []
        if mapping.acceleration is not None:
            overlaps.append(Overlap(Integration(signals, clock.rate_hz, mapping.acceleration.high_pass_hz)))
        if clock.ratio != 1:
            angles = [number for number, signal in enumerate(signals) if signal.is_angle]
            overlaps.append(Overlap(Resampling(clock.ratio, angles)))
        for overlap in overlaps:
            parts = overlap.feed(parts)
        reverse = keyphasor is not None and keyphasor.direction == "reverse"
        angle = AngleColumn(machine, pulses, reverse, partial=mapping.time.not_finite == "missing")
        maker = BlockMaker(machine, clock.origin_ns)
        writer = RecordingWriter(recording, overwrite=overwrite)
        try:
            with writer:
                for message in maker.feed(angle.feed(parts)):
                    writer.write(message)
                cut_rows = sum(overlap.cut_rows for overlap in overlaps)
                if maker.written.blocks == 0:
                    raise SourceError(_nothing(path, machine, read, maker.written, cut_rows))
                check_one_rate(path, clock, read)
        except BaseException:
            writer.part.unlink(missing_ok=True)
            raise
    others = set(path.iterdir()) - {one.path for one in files} if path.is_dir() else set()
    left_out = sorted(one.name for one in others if not one.name.startswith("."))
    by_name = path.is_dir() and mapping.time.start is None and files[0].start_ns is not None
    doubts = [signal.doubt for signal in signals if signal.doubt]
    return Imported(
        path, recording, machine, mapping, clock, read, maker.written, angle, cut_rows, left_out, [], by_name, doubts
    )


def _nothing(path: Path, machine: MachineFile, read: Read, written: Written, cut_rows: int) -> str:
    without = f", {read.left_out} of them without numbers" if read.left_out else ""
    if written.none_whole:  # counted at the machine's rate
        without += f", {written.none_whole} samples in blocks in which every channel lacks numbers"
    ends = f", {cut_rows} of them at the ends where filters settle" if cut_rows else ""
    return (
        f"{path}: {read.rows} rows{without}, {len(read.gaps)} gaps: no stretch is long enough{ends}; expected at least "
        f"{machine.ingest.block_from_s:g} s of the machine's samples"
    )


def summary_lines(done: Imported) -> Iterator[str]:
    """Describe an import in sentences, with every gap, filled row, cut end and limit of validity."""
    machine, read, written = done.machine, done.read, done.written
    several = f"{read.files} files, " if read.files > 1 else ""
    if read.shortest < read.longest:
        several = f"{read.files} files of {read.shortest} to {read.longest} rows, "
    yield (
        f"{done.source}: {several}{read.rows} rows at {done.clock.rate_hz:.9g} Hz, "
        f"{len(machine.sensors)} channels of {machine.title}"
    )
    yield (
        f"{done.recording}: {written.samples} samples in {written.blocks} blocks, {rfc3339(written.start_ns)} to "
        f"{rfc3339(written.end_ns)}"
    )
    if written.end_ns > time.time_ns() + _YEAR_NS:
        yield 'note: these times are still to come; where a time column counts from 1970, give time.start = "unix"'
    yield from done.doubts
    for name in read.cut:
        yield f"note: {name} was not finished by its writer, or is truncated; what should follow is missing"
    yield from _folder_lines(done)
    yield from _gap_lines(done)
    yield from _filter_lines(done)
    yield from _angle_lines(done)
    yield from _level_lines(machine, written)
    if read.left_out:
        every = " in every channel" if done.mapping.time.not_finite == "missing" else ""
        yield f"rows left out for an empty cell, NaN, infinity or a number beyond the dtype{every}: {read.left_out}"
    never = []
    for name, times in written.missing.items():
        lost_s = sum(end_ns - from_ns for from_ns, end_ns in times) / 1e9
        stretches = f" in {len(times)} stretches" if len(times) > 1 else ""
        yield (
            f"missing, in whole blocks: {name}, {lasting(lost_s)}{stretches} from {rfc3339(times[0][0])} to "
            f"{rfc3339(times[-1][1])}"
        )
        if round(lost_s * machine.rate_hz) >= written.samples:
            never.append(name)
    if never:
        yield (
            f"note: no block without missing numbers: {', '.join(never)}; a column that has them in some rows only, "
            "such as one of a lower rate, has to be filled up in the file, or left out of the mapping and of the "
            "machine file"
        )
    if written.none_whole:
        yield f"samples left out in blocks in which every channel lacks numbers: {written.none_whole}"
    if written.too_short:
        yield f"samples left out in stretches shorter than a block: {written.too_short}"
    yield from _snapshot_lines(machine, written)
    length_s = written.samples / machine.rate_hz
    if length_s < machine.window_data_s:
        yield (
            f"note: {length_s:.6g} s of data do not fill one window of {machine.window.length_s:g} s; reports will be "
            "few or none"
        )


def _level_lines(machine: MachineFile, written: Written) -> Iterator[str]:
    """Size of each channel's samples, by which a wrong unit, scale or column is noticed."""
    count, total, squares = written.sums
    for at, channel in enumerate(machine.sensors):
        if channel.quantity is Quantity.SHAFT_ANGLE or not count[at]:
            continue
        mean, (least, greatest) = total[at] / count[at], written.reach[:, at]
        rms = max(0.0, squares[at] / count[at] - mean**2) ** 0.5 if least < greatest else 0.0
        unit = unit_in_text(channel.unit)
        low, high = (bound / channel.to_si for bound in _PLAUSIBLE.get(channel.quantity, (0.0, np.inf)))
        doubt = (
            "" if low <= rms <= high else f"; note: expected {low:g} to {high:g} rms, are column, unit and scale right?"
        )
        yield f"{channel.name}: {rms:.5g} {unit} rms about {mean:.4g}, from {least:.5g} to {greatest:.5g}{doubt}"


def _folder_lines(done: Imported) -> Iterator[str]:
    names = done.left_out
    if done.by_name:
        zone = done.mapping.time.zone or "UTC (if they are local time, say time.zone in the mapping)"
        yield f"times: those in the file names, in {zone}"
    if names:
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        yield f"not read in the folder, as no files of a known format: {', '.join(names[:_NAMED])}{more}"


def _gap_lines(done: Imported) -> Iterator[str]:
    schedule = done.machine.schedule
    gaps = done.read.gaps
    if schedule is not None:
        gaps = [gap for gap in gaps if not schedule.is_silence((gap.to_ns - gap.from_ns) / 1e9)]
    total_s = sum(gap.to_ns - gap.from_ns for gap in gaps) / 1e9
    yield f"gaps: {len(gaps)}, {lasting(total_s)} in all, kept as gaps" if gaps else "gaps: none"
    for gap in gaps[:_LISTED]:
        file = f" of {gap.file}" if done.read.files > 1 else ""
        begin_ns = done.clock.origin_ns + round(gap.from_ns)
        yield f"  before row {gap.row + 1}{file}: {lasting((gap.to_ns - gap.from_ns) / 1e9)} from {rfc3339(begin_ns)}"
    if len(gaps) > _LISTED:
        yield f"  and {len(gaps) - _LISTED} more"
    if done.read.filled:
        yield (
            f"rows put into gaps of up to {done.mapping.time.fill_gaps_up_to_s:g} s by straight lines: "
            f"{done.read.filled}"
        )


def _snapshot_lines(machine: MachineFile, written: Written) -> Iterator[str]:
    """Note on snapshots that are too short for the monitor, in the file or after the filters."""
    least = floor(machine.hop_data_s * machine.rate_hz + 1e-6)
    short = [length for length in written.lengths if length < least]
    if machine.schedule is not None and short:
        yield (
            f"note: {len(short)} of {len(written.lengths)} snapshots are shorter than [schedule] on_s = "
            f"{machine.schedule.on_s:g} in the machine file and will not be evaluated; the shortest has "
            f"{min(short) / machine.rate_hz:.6g} s, the longest of them {max(short) / machine.rate_hz:.6g} s"
        )


def _filter_lines(done: Imported) -> Iterator[str]:
    acceleration, machine = done.mapping.acceleration, done.machine
    if acceleration is not None:
        corner_hz = acceleration.high_pass_hz
        lowest_hz = lowest_valid_hz(corner_hz)
        yield (
            f"integrated from acceleration: {', '.join(acceleration.channels)}; high-pass at {corner_hz:g} Hz, valid "
            f"from {lowest_hz:g} Hz, not below; the first and last {settling_s(corner_hz):.6g} s of each stretch are "
            "left out"
        )
        if lowest_hz > machine.window.band_hz[0]:
            yield (
                f"note: the machine file evaluates from window.band_hz = {machine.window.band_hz[0]:g} Hz on, which is "
                f"below {lowest_hz:g} Hz"
            )
    if done.clock.ratio != 1:
        ratio = done.clock.ratio
        highest_hz, held_hz = 0.42 * min(machine.rate_hz, done.clock.rate_hz), 0.42 * done.clock.rate_hz
        yield (
            f"resampled from {done.clock.rate_hz:.9g} to {machine.rate_hz:.9g} Hz by {ratio.numerator}/"
            f"{ratio.denominator} (polyphase); flat up to {highest_hz:.4g} Hz"
        )
        if held_hz < machine.window.band_hz[1]:
            yield (
                f"note: the machine file evaluates up to window.band_hz = {machine.window.band_hz[1]:g} Hz, and the "
                f"file holds nothing above {held_hz:.4g} Hz: is its rate right?"
            )
    if done.cut_rows:
        yield f"rows left out at the ends of stretches, where filters settle: {done.cut_rows}"


def _angle_lines(done: Imported) -> Iterator[str]:
    if done.angle.pulses is not None:
        lines, speeds_rpm = _pulse_lines(done, done.angle.pulses)
        yield from lines
    elif (mean_rpm := done.angle.speed_rpm) is not None:
        speeds_rpm = (abs(mean_rpm), abs(mean_rpm))
        way = ", from z to y" if mean_rpm < 0 else ""
        yield f"shaft angle: {abs(mean_rpm):.6g} rpm on average{way}"
    else:
        return
    operation = done.machine.operation
    nearest_rpm = np.clip(operation.speed_rpm, *speeds_rpm) if operation is not None else np.nan
    if operation is not None and abs(nearest_rpm / operation.speed_rpm - 1) > operation.speed_tolerance:
        yield f"note: the machine file says speed_rpm = {operation.speed_rpm:g}; at this speed nothing is diagnosed"


def _pulse_lines(done: Imported, train: PulseTrain) -> tuple[list[str], tuple[float, float]]:
    """Describe the pulses; also return the least and the greatest speed, the mean twice where it varies little."""
    took_ns = np.diff(train.times)[train.known]
    turned = np.diff(train.counts)[train.known] / train.pulses_per_turn
    passed_ns, turns = float(took_ns.sum()), float(turned.sum())
    speed_rpm = turns / passed_ns * 60e9 if turns else float("nan")
    # For several files or a run-up, the mean alone may be a speed at which the machine never ran. Speeds are computed
    # per revolution, because with many pulses per revolution a single interval is only a few samples long.
    marks = np.arange(0, took_ns.size - train.pulses_per_turn + 1, train.pulses_per_turn)
    each_rpm = (
        np.add.reduceat(turned, marks) / np.add.reduceat(took_ns, marks) * 60e9 if marks.size else np.full(1, speed_rpm)
    )
    least_rpm, most_rpm = np.percentile(each_rpm, [1, 99])
    between = f" mostly {least_rpm:.0f} to {most_rpm:.0f}," if most_rpm > _VARIED * least_rpm else ""
    lines = [
        f"keyphasor: {train.times.size} pulses, {speed_rpm:.6g} rpm on average,{between} {train.missing} missing ones "
        f"bridged, {train.extra} extra ones left out, {train.interruptions} interruptions"
    ]
    if done.angle.unknown:
        without = "without it" if done.angle.partial else "left out"
        lines.append(f"rows {without} because the shaft angle is not known: {done.angle.unknown}")
        standing = (
            "" if done.angle.partial else '; where the shaft stands still, time.not_finite = "missing" keeps the rest'
        )
        share = done.angle.unknown / max(1, done.read.rows)
        if share > _NOTED:
            lines.append(
                f"note: that is {share:.0%} of the file, in which the keyphasor gives no pulses or uneven ones; look "
                f"at its signal and threshold, or leave the shaft angle out of the machine file{standing}"
            )
    if train.interruptions and train.pulses_per_turn > 1:
        lines.append(
            f"note: after each interruption another of the {train.pulses_per_turn} pulses may count as angle 0: phases "
            "before and after it cannot be compared"
        )
    keyphasor = done.mapping.keyphasor
    samples = done.clock.rate_hz * passed_ns / 1e9 / (turns * train.pulses_per_turn) if turns else np.inf
    if keyphasor is not None and keyphasor.column is not None and samples < _FEW_SAMPLES:
        lines.append(
            f"note: {samples:.3g} samples for each pulse; pulses that come faster than half the samples look like "
            "slower ones: is this speed right?"
        )
    end_ns = done.written.end_ns - done.clock.origin_ns
    outside = int(np.count_nonzero((train.times < 0) | (train.times > end_ns)))
    if outside > train.times.size / 2:
        lines.append(
            f"note: {outside} of {train.times.size} pulses are outside of the {lasting(end_ns / 1e9)} of the rows; are "
            "they on the time base of the rows, in keyphasor.unit?"
        )
    return lines, (least_rpm, most_rpm) if between else (speed_rpm, speed_rpm)
