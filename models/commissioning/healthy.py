"""Healthy recordings, cut into hops as the monitor does live, and the lines in them that are not the rotation's."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from models.descriptor import descriptor_mismatch
from models.diagnosis.window.excluded import KnownLine
from models.diagnosis.window.lines import Line, steady_lines
from models.diagnosis.window.moments import HopMoments, Plan, plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import window_statistics
from models.errors import RecordingError, WireError
from models.ingest import Gate
from models.levels.measures import STANDS_RAD_S
from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.recording import read_recording, summarize_recording
from models.signals.wire import decode_block

_RUN_UP = 0.03
"""Part of the usual speed by which a hop may be slower; a slower one belongs to a run-up or run-down."""


@dataclass(frozen=True, slots=True)
class HealthyRecording:
    """The usable hops of one recording, and what could not be used."""

    name: str  # of the file
    plan: Plan  # sizes of its hops
    stretches: tuple[tuple[HopMoments, ...], ...]  # runs of hops without an interruption
    gaps: int = 0  # number of interruptions
    missing_s: float = 0.0  # length of the data missing in them
    refused: tuple[tuple[str, int], ...] = ()  # number of blocks that could not be used, by reason
    last_refusal: str = ""  # reason for the latest refused block, in a sentence
    stopped_s: float = 0.0  # length of the data left out because the machine stood, ran up or ran down

    @property
    def hops(self) -> tuple[HopMoments, ...]:
        """All hops, oldest first."""
        return tuple(hop for stretch in self.stretches for hop in stretch)

    @property
    def duration_s(self) -> float:
        """Length of the usable data, s."""
        return len(self.hops) * self.plan.fresh / self.plan.rate_hz


def healthy_from_blocks(
    name: str, machine: MachineFile, blocks: Iterable[SampleBlock], until_s: float | None = None
) -> HealthyRecording:
    """Cut a stream into hops, up to `until_s` after its first sample."""
    plan = plan_for(machine, levels=True)
    gate, window = Gate(machine), SlidingWindow(replace(plan, hops=1))
    stretches: list[list[HopMoments]] = [[]]
    refused: Counter[str] = Counter()
    gaps, missing_s, last_refusal = 0, 0.0, ""
    first_ns: int | None = None
    for block in blocks:
        first_ns = block.start_ns if first_ns is None else first_ns
        if until_s is not None and block.end_ns - first_ns > round(until_s * 1e9):
            break
        verdict = gate.judge(block)
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
            stretches[-1].append(window.hops[-1])
    running = [part for stretch in stretches for part in _without_stops(plan, stretch)]
    kept, counts = tuple(tuple(part) for part in running if part), tuple(sorted(refused.items()))
    stopped_s = (sum(map(len, stretches)) - sum(map(len, running))) * plan.fresh / plan.rate_hz
    return HealthyRecording(name, plan, kept, gaps, missing_s, counts, last_refusal, stopped_s)


def _without_stops(plan: Plan, stretch: list[HopMoments]) -> list[list[HopMoments]]:
    """The parts of a stretch between stops in which the machine has its usual speed.

    The whole stretch is returned if the machine stands all the time, as that is intended, or if only levels are
    watched, as levels at standstill are valid, too.
    """
    speeds = np.abs([hop.turned_rad for hop in stretch]) * plan.rate_hz / plan.hop
    turns = speeds > STANDS_RAD_S
    if plan.angle_column is None or not plan.states or turns.all() or not turns.any():
        return [stretch]
    usual = speeds >= (1 - _RUN_UP) * np.median(speeds[turns])
    edges = np.flatnonzero(np.diff(turns, prepend=False, append=False)).reshape(-1, 2)  # of the stretches between stops
    parts = []
    for first, last in edges.tolist():
        at_speed = first + np.flatnonzero(usual[first:last])
        if at_speed.size:
            # Part of the hop after a run-up, and of the one before a run-down, may be below the usual speed.
            begin = at_speed[0] + (first > 0)
            parts.append(stretch[begin : at_speed[-1] + (last == len(stretch))])
    return parts


def read_healthy(path: Path, machine: MachineFile, until_s: float | None = None) -> HealthyRecording:
    """Read a recording (MCAP) of the machine, up to `until_s` after its first sample; other streams are ignored.

    Raises
    ------
    RecordingError
        If it cannot be read, or holds no stream of this machine; the message names the streams that it holds.
    """
    found = healthy_from_blocks(path.name, machine, _blocks(path, machine), until_s)
    if found.refused and (announced := next(read_recording(path, keys={machine.keys.descriptor}), None)):
        differs = "; ".join(descriptor_mismatch(announced.payload, machine))
        found = replace(found, last_refusal=differs or found.last_refusal)
    if not found.hops and not found.refused:
        streams = [key for key in summarize_recording(path).messages if key.endswith("/stream")]
        held = ", ".join(streams) or "no stream"
        told = f"{path}: no hop of {machine.hop_data_s:g} s of {machine.title} in it; it holds {held}"
        if streams and machine.keys.stream not in streams:
            told += "; expected the site and name of such a stream in the machine file"
        raise RecordingError(told)
    return found


def _blocks(path: Path, machine: MachineFile) -> Iterator[SampleBlock]:
    for message in read_recording(path, keys={machine.keys.stream}):
        try:
            yield decode_block(message.payload, message.attachment, message.encoding)
        except WireError as error:
            raise RecordingError(f"{path}: a message of {message.key} cannot be decoded: {error}") from error


def foreign_lines(recording: HealthyRecording) -> tuple[Line, ...]:
    """Steady lines that are not at a multiple of the speed, strongest first."""
    plan, hops = recording.plan, recording.hops
    return steady_lines(plan, hops, window_statistics(plan, hops, lagged=False)) if hops else ()


def known_lines(recordings: Iterable[HealthyRecording]) -> tuple[KnownLine, ...] | None:
    """Steady lines of all recordings as a whole and of each window in them; None if a speed is not known."""
    found = set[KnownLine]()
    for one in recordings:
        cuts = [one.hops[first : first + one.plan.hops] for first in range(0, len(one.hops), one.plan.hops)]
        for hops in filter(None, (one.hops, *cuts)):
            window = window_statistics(one.plan, hops, lagged=False)
            if not math.isfinite(window.speed_rad_s) or not window.speed_rad_s:
                return None
            found |= {line.known(window.speed_rad_s) for line in steady_lines(one.plan, hops, window)}
    return tuple(sorted(found))
