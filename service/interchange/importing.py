"""Import: a file from another program becomes a recording.

::

    Source ─> pieces ──────> Integration ─> Resampling ──> AngleColumn ─> BlockMaker ─> RecordingWriter
    (format)  (units, time,  (accelerometers) (other rate)  (keyphasor)    (0.1 s)
               gaps)
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from models.machine import MachineFile
from models.signals.keyphasor import PulseTrain
from models.signals.recording import RecordingWriter
from service.interchange.angle import AngleColumn, pulse_times, read_pulses
from service.interchange.blocks import BlockMaker, Written
from service.interchange.clock import Clock, clock_for
from service.interchange.folder import SnapshotFile, joined, runs_of_pulses, snapshot_files
from service.interchange.formats import open_source
from service.interchange.mapping import Mapping
from service.interchange.overlap import Integration, Overlap, Resampling
from service.interchange.samples import Piece, Read, pieces, signals_of
from service.interchange.source import Reference, SourceError


@dataclass(frozen=True, slots=True)
class Imported:
    """What an import did."""

    source: Path
    recording: Path
    machine: MachineFile
    mapping: Mapping
    clock: Clock
    read: Read  # what was met in the file
    written: Written  # what went into the recording
    pulses: PulseTrain | None
    cut_rows: int  # rows at the ends of stretches where filters are not settled
    unknown_angle: int  # rows left out because the shaft angle is not known


def import_file(
    path: Path, mapping: Mapping, machine: MachineFile, recording: Path, *, overwrite: bool = False
) -> Imported:
    """Import a file, or a folder of files that follow each other.

    Parameters
    ----------
    path : Path
        CSV, Parquet, .npz, .mat, WAV, UFF 58, TDMS or MF4; or a folder of such files.
    recording : Path
        What is written; nothing is left of it if the import fails.

    Raises
    ------
    SourceError
        If the file cannot be used, naming row and column where it is about one.
    RecordingError
        If the recording cannot be written.
    """
    files = snapshot_files(path, mapping, machine) if path.is_dir() else (SnapshotFile(path, None),)
    with open_source(files[0].path, mapping) as source:
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
            pulses = read_pulses(path, runs, keyphasor)
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
        angle = AngleColumn(machine, pulses, keyphasor is not None and keyphasor.direction == "reverse")
        maker = BlockMaker(machine, clock.origin_ns)
        writer = RecordingWriter(recording, overwrite=overwrite)
        try:
            with writer:
                for message in maker.feed(angle.feed(parts)):
                    writer.write(message)
                if maker.written.blocks == 0:
                    raise SourceError(_nothing(path, machine, read, sum(overlap.cut_rows for overlap in overlaps)))
        except BaseException:
            writer.part.unlink(missing_ok=True)
            raise
    cut_rows = sum(overlap.cut_rows for overlap in overlaps)
    return Imported(path, recording, machine, mapping, clock, read, maker.written, pulses, cut_rows, angle.unknown)


def _nothing(path: Path, machine: MachineFile, read: Read, cut_rows: int) -> str:
    ends = f", {cut_rows} of them at the ends where filters settle" if cut_rows else ""
    return (
        f"{path}: {read.rows} rows, {len(read.gaps)} gaps: no stretch is long enough{ends}; expected at least "
        f"{machine.ingest.block_from_s:g} s of the machine's samples"
    )
