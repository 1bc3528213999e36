"""The shaft angle of an imported file: from a keyphasor's pulses, or from a column of angles."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from models.machine import MachineFile
from models.signals.block import FloatArray
from models.signals.channels import Quantity, time_unit_ns
from models.signals.keyphasor import EdgeDetector, PulseTrain, pulse_train, pulses_in_turn, shaft_angle
from service.interchange.clock import Clock
from service.interchange.mapping import Keyphasor, Mapping
from service.interchange.samples import Piece, Read, Signal, pieces
from service.interchange.source import Reference, Source, SourceError

_TURN = 2 * np.pi


def pulse_times(source: Source, keyphasor: Keyphasor, clock: Clock, mapping: Mapping) -> FloatArray:
    """Read the times of a file's keyphasor pulses; a sampled signal is read through once for this purpose.

    Returns
    -------
    ndarray, shape (n_pulses,)
        Nanoseconds since the first row of the file.

    Raises
    ------
    SourceError
        If the array does not hold times.
    """
    if keyphasor.pulse_times is not None:
        what = keyphasor.pulse_times
        entries = source.values(what)
        if entries.dtype.kind not in "fiu":
            raise SourceError(f"{source.path}: {what} holds {entries.dtype}, expected times of pulses")
        return clock.pulse_times(entries, time_unit_ns(keyphasor.unit))
    signal = Signal(Reference(keyphasor.column or "", keyphasor.index), 1.0, 0.0, 0, False)
    detector = EdgeDetector(keyphasor.threshold or 0.0, keyphasor.hysteresis, rising=keyphasor.edge == "rising")
    found = [np.empty(0)]
    for piece in pieces(source, [signal], clock, mapping, Read()):
        if piece.begins:
            detector.interrupt()
        found.append(detector.feed(piece.time_ns, piece.samples[:, 0]))
    return np.concatenate(found)


def read_pulses(path: Path, runs: Sequence[FloatArray], keyphasor: Keyphasor) -> PulseTrain:
    """Build the pulse train of a file or folder from `runs`, pulse times without gaps; each run is checked on its own.

    Raises
    ------
    SourceError
        If no run has two pulses, or their times do not ascend.
    """
    try:
        longest = [max(runs, key=len)] if all(run.size < 2 for run in runs) else [run for run in runs if run.size > 1]
        return pulses_in_turn([pulse_train(run, keyphasor.pulses_per_revolution) for run in longest])
    except ValueError as error:
        what = keyphasor.pulse_times or f"column {keyphasor.column}"
        raise SourceError(f"{path}: keyphasor {what}: {error}") from error


@dataclass(slots=True)
class AngleColumn:
    """Inserts the shaft angle at its column in the machine file, and wraps angles to [0, 2π).

    Rows with unknown angle are left out and leave a gap; if channels may be missing, the angle is NaN there instead.
    """

    machine: MachineFile
    pulses: PulseTrain | None
    reverse: bool  # whether the shaft turns from z to y
    partial: bool = False  # whether channels may be missing
    unknown: int = 0  # rows with unknown angle
    # Total rotation in a column of angles, rad, and its duration, ns.
    turned: float = 0.0
    passed_ns: float = 0.0

    @property
    def speed_rpm(self) -> float | None:
        """Mean speed from a column of angles, negative from z to y; None without such a column."""
        return 60e9 * self.turned / (_TURN * self.passed_ns) if self.passed_ns else None

    def feed(self, parts: Iterator[Piece]) -> Iterator[Piece]:
        """Add the shaft angle to a file's pieces."""
        column = next((n for n, c in enumerate(self.machine.sensors) if c.quantity is Quantity.SHAFT_ANGLE), None)
        pending = False
        for piece in parts:
            pending = pending or piece.begins
            if column is None:
                yield piece
                continue
            if self.pulses is None:
                samples = piece.samples.copy()
                samples[:, column] = np.mod(samples[:, column], _TURN)
                steps = np.mod(np.diff(samples[:, column]) + np.pi, _TURN) - np.pi
                self.turned += float(np.nansum(steps))
                self.passed_ns += float(np.diff(piece.time_ns)[np.isfinite(steps)].sum())
                yield Piece(piece.begins, piece.time_ns, samples)
                continue
            angle = shaft_angle(self.pulses, piece.time_ns, reverse=self.reverse)
            samples = np.insert(piece.samples, column, angle, axis=1)
            known = np.isfinite(angle)
            self.unknown += int(np.count_nonzero(~known))
            if self.partial:
                yield Piece(piece.begins, piece.time_ns, samples)
                continue
            edges = np.flatnonzero(np.diff(known)) + 1
            for rows in np.split(np.arange(angle.size), edges):
                if known[rows[0]]:
                    yield Piece(pending, piece.time_ns[rows], samples[rows])
                pending = not known[rows[0]]
