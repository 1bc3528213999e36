"""Healthy recordings, cut into hops as the monitor would cut them live, and lines in them that are not the rotation.

A line has the same strength in every segment, noise has not: of a steady line the mean fourth power of the Fourier
coefficient is the square of the mean second power, of noise twice that.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy  # its sub-packages are loaded when they are first used

from models.diagnosis.moments import HopMoments, Plan, plan_for
from models.diagnosis.window import SlidingWindow, WindowStatistics, window_statistics
from models.errors import RecordingError, WireError
from models.ingest import Gate
from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.recording import read_recording, summarize_recording
from models.signals.wire import decode_block


@dataclass(frozen=True, slots=True)
class HealthyRecording:
    """What a recording gave."""

    name: str  # of the file
    plan: Plan  # sizes of its hops
    stretches: tuple[tuple[HopMoments, ...], ...]  # hops without an interruption between them
    gaps: int = 0  # interruptions
    missing_s: float = 0.0  # data that they cost
    refused: tuple[tuple[str, int], ...] = ()  # blocks that could not be used, by reason
    last_refusal: str = ""  # the latest such reason in a sentence

    @property
    def hops(self) -> tuple[HopMoments, ...]:
        """All of them, oldest first."""
        return tuple(hop for stretch in self.stretches for hop in stretch)

    @property
    def duration_s(self) -> float:
        """Usable data, s."""
        return len(self.hops) * self.plan.fresh / self.plan.rate_hz

    def windows(self, hops: int | None = None) -> tuple[WindowStatistics, ...]:
        """Windows that do not overlap, gaps left out.

        Parameters
        ----------
        hops : int, optional
            Length of each; a full window without it.
        """
        length = self.plan.hops if hops is None else hops
        return tuple(
            window_statistics(self.plan, stretch[start : start + length])
            for stretch in self.stretches
            for start in range(0, len(stretch) - length + 1, length)
        )


def healthy_from_blocks(
    name: str, machine: MachineFile, blocks: Iterable[tuple[SampleBlock, str]], until_s: float | None = None
) -> HealthyRecording:
    """Cut a stream into hops.

    Parameters
    ----------
    blocks : iterable of (SampleBlock, str)
        Blocks in their order, each with the hash of the channel descriptor that its sender named, or "".
    until_s : float, optional
        Use only data from before this time after the first sample.
    """
    plan = plan_for(machine, levels=True)
    gate, window = Gate(machine), SlidingWindow(replace(plan, hops=1))
    stretches: list[list[HopMoments]] = [[]]
    refused: Counter[str] = Counter()
    gaps, missing_s, last_refusal = 0, 0.0, ""
    first_ns: int | None = None
    for block, schema_hash in blocks:
        first_ns = block.start_ns if first_ns is None else first_ns
        if until_s is not None and block.end_ns - first_ns > round(until_s * 1e9):
            break
        verdict = gate.judge(block, schema_hash)
        if not verdict.accepted:
            refused[str(verdict.reason)] += 1
            last_refusal = verdict.text
            continue
        if not verdict.continuous:
            gaps, missing_s = gaps + 1, missing_s + verdict.gap_s
            stretches.append([])
        if not verdict.continuous or verdict.new_snapshot:
            window.gap()
        for _ in window.feed(plan.to_si(block.samples), block.start_ns):
            hop = window.latest_hop
            if hop is not None:
                stretches[-1].append(hop)
    return HealthyRecording(
        name,
        plan,
        tuple(tuple(stretch) for stretch in stretches if stretch),
        gaps,
        missing_s,
        tuple(sorted(refused.items())),
        last_refusal,
    )


def read_healthy(path: Path, machine: MachineFile, until_s: float | None = None) -> HealthyRecording:
    """Read a recording of the machine.

    Parameters
    ----------
    path : Path
        Recording (MCAP); of several machines in it, the one with the machine file's site and name is taken.
    until_s : float, optional
        Use only data from before this time after the first sample.

    Raises
    ------
    RecordingError
        If it cannot be read, or holds no stream of this machine; the message names what it holds.
    """
    found = healthy_from_blocks(path.name, machine, _blocks(path, machine), until_s)
    if not found.hops and not found.refused:
        raise RecordingError(
            f"{path}: no hop of {machine.hop_data_s:g} s of {machine.site}/{machine.name} in it; it holds "
            f"{', '.join(_streams(path)) or 'no stream'}"
        )
    return found


def _blocks(path: Path, machine: MachineFile) -> Iterator[tuple[SampleBlock, str]]:
    for message in read_recording(path, keys={machine.keys.stream}):
        try:
            yield decode_block(message.payload, message.attachment, message.encoding)
        except WireError as error:
            raise RecordingError(f"{path}: a message of {message.key} cannot be decoded: {error}") from error


def _streams(path: Path) -> list[str]:
    return [key for key in summarize_recording(path).messages if key.endswith("/stream")]


_STEADY = 1.35  # fourth power over the square of the second: 2 for noise, 1 for a line; between them with little data
_STANDS_OUT = 8.0
_NEIGHBOURHOOD_HZ = 4.0
_LOBE = 2  # a Hann window spreads a line over two bins on either side
_FEWEST_SEGMENTS = 6
_HARMONICS = 12


@dataclass(frozen=True, slots=True)
class Line:
    """A line."""

    state: str  # where it is strongest
    frequency_hz: float
    share: float  # of the power of that channel's random part


def foreign_lines(recording: HealthyRecording) -> tuple[Line, ...]:
    """Lines that are neither noise nor a multiple of the speed, strongest first."""
    hops = recording.hops
    segments = np.concatenate([hop.segments for hop in hops]) if hops else np.empty((0, 0, 0))
    if segments.shape[0] < _FEWEST_SEGMENTS:
        return ()
    states = recording.plan.mounted
    power = np.abs(segments[:, :, : len(states)]) ** 2
    mean = power.mean(axis=0)
    steadiness = (power**2).mean(axis=0) / np.maximum(mean**2, np.finfo(float).tiny)
    frequencies_hz = recording.plan.frequencies_hz
    step_hz = float(frequencies_hz[1] - frequencies_hz[0])
    size = max(5, 2 * round(_NEIGHBOURHOOD_HZ / step_hz / 2) + 1)
    floor = scipy.ndimage.median_filter(mean, size=(size, 1), mode="nearest")
    window = window_statistics(recording.plan, hops, lagged=False).as_mounted
    total = np.maximum(np.diag(window.correlation[0]), np.finfo(float).tiny)
    speed_hz = window.speed_rad_s / (2 * np.pi)
    rotation = _near_rotation(frequencies_hz, speed_hz, step_hz)
    found: dict[int, Line] = {}
    candidates = np.argwhere((mean > _STANDS_OUT * floor) & (steadiness < _STEADY) & ~rotation[:, None])
    for at, column in candidates:
        lobe = slice(max(0, at - _LOBE), at + _LOBE + 1)
        if mean[at, column] < mean[lobe, column].max():
            continue
        share = float(2 * step_hz * mean[lobe, column].sum() / total[column])
        if at not in found or share > found[at].share:
            found[at] = Line(states[column], float(frequencies_hz[at]), min(1.0, share))
    return tuple(sorted(found.values(), key=lambda line: -line.share))


def _near_rotation(
    frequencies_hz: "np.ndarray[tuple[int], np.dtype[np.float64]]", speed_hz: float, step_hz: float
) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    if not np.isfinite(speed_hz):
        return np.zeros(frequencies_hz.size, dtype=np.bool_)
    multiples = speed_hz * np.arange(1, _HARMONICS + 1)
    return np.asarray(np.min(np.abs(frequencies_hz[:, None] - multiples), axis=1) <= (_LOBE + 1) * step_hz)
