"""Healthy recordings, cut into hops as the monitor would cut them live, and lines in them that are not the rotation."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

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
"""Part of the usual speed that is missing while a machine still runs up, or runs down already."""


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
    stopped_s: float = 0.0  # data left out in which the machine stood, ran up or ran down

    @property
    def hops(self) -> tuple[HopMoments, ...]:
        """All of them, oldest first."""
        return tuple(hop for stretch in self.stretches for hop in stretch)

    @property
    def duration_s(self) -> float:
        """Usable data, s."""
        return len(self.hops) * self.plan.fresh / self.plan.rate_hz


def healthy_from_blocks(
    name: str, machine: MachineFile, blocks: Iterable[tuple[SampleBlock, str]], until_s: float | None = None
) -> HealthyRecording:
    """Cut a stream into hops, up to so long after its first sample.

    Each block comes with the hash of the channel descriptor that its sender named, or "".
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
    running = [part for stretch in stretches for part in _without_stops(plan, stretch)]
    stopped = sum(map(len, stretches)) - sum(map(len, running))
    return HealthyRecording(
        name,
        plan,
        tuple(tuple(part) for part in running if part),
        gaps,
        missing_s,
        tuple(sorted(refused.items())),
        last_refusal,
        stopped * plan.fresh / plan.rate_hz,
    )


def _without_stops(plan: Plan, stretch: list[HopMoments]) -> list[list[HopMoments]]:
    """The stretches between its stops, each up to where the machine has its usual speed.

    A machine that stands all the time is recorded so on purpose; of one of which levels alone are watched those at
    standstill are levels, too.
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
            # Of the hop after a run-up, and of the one before a run-down, a part may have been below the usual speed.
            begin = at_speed[0] + (first > 0)
            parts.append(stretch[begin : at_speed[-1] + (last == len(stretch))])
    return parts


def read_healthy(path: Path, machine: MachineFile, until_s: float | None = None) -> HealthyRecording:
    """Read a recording (MCAP) of the machine, up to so long after its first sample; there may be others in it.

    Raises
    ------
    RecordingError
        If it cannot be read, or holds no stream of this machine; the message names what it holds.
    """
    found = healthy_from_blocks(path.name, machine, _blocks(path, machine), until_s)
    if not found.hops and not found.refused:
        streams = [key for key in summarize_recording(path).messages if key.endswith("/stream")]
        raise RecordingError(
            f"{path}: no hop of {machine.hop_data_s:g} s of {machine.title} in it; it holds "
            f"{', '.join(streams) or 'no stream'}"
        )
    return found


def _blocks(path: Path, machine: MachineFile) -> Iterator[tuple[SampleBlock, str]]:
    for message in read_recording(path, keys={machine.keys.stream}):
        try:
            yield decode_block(message.payload, message.attachment, message.encoding)
        except WireError as error:
            raise RecordingError(f"{path}: a message of {message.key} cannot be decoded: {error}") from error


def foreign_lines(recording: HealthyRecording) -> tuple[Line, ...]:
    """Lines that are neither noise nor a multiple of the speed, strongest first."""
    plan, hops = recording.plan, recording.hops
    return steady_lines(plan, hops, window_statistics(plan, hops, lagged=False)) if hops else ()


def known_lines(recordings: Iterable[HealthyRecording]) -> tuple[KnownLine, ...] | None:
    """Those of all recordings and of each window in them; None where the speed is not known."""
    found = set[KnownLine]()
    for one in recordings:
        cuts = [one.hops[first : first + one.plan.hops] for first in range(0, len(one.hops), one.plan.hops)]
        for hops in filter(None, (one.hops, *cuts)):
            window = window_statistics(one.plan, hops, lagged=False)
            if not math.isfinite(window.speed_rad_s) or not window.speed_rad_s:
                return None
            found |= {line.known(window.speed_rad_s) for line in steady_lines(one.plan, hops, window)}
    return tuple(sorted(found))
