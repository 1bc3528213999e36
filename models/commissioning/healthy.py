"""Healthy recordings, cut into hops as the monitor would cut them live."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from models.diagnosis.moments import HopMoments, Plan, plan_for
from models.diagnosis.window import SlidingWindow, WindowStatistics, window_statistics
from models.errors import RecordingError, WireError
from models.ingest import Gate
from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.recording import read_recording, summarize_recording
from models.signals.wire import decode_block

__all__ = ["HealthyRecording", "healthy_from_blocks", "read_healthy"]


@dataclass(frozen=True, slots=True)
class HealthyRecording:
    """What a recording gave.

    Attributes
    ----------
    name : str
        Of the file.
    plan : Plan
        Sizes of its hops.
    stretches : tuple of tuple of HopMoments
        Hops without an interruption between them.
    gaps : int
        Interruptions.
    missing_s : float
        Data that they cost.
    refused : mapping of str to int
        Blocks that could not be used, by reason.
    last_refusal : str
        The latest such reason in a sentence.
    """

    name: str
    plan: Plan
    stretches: tuple[tuple[HopMoments, ...], ...]
    gaps: int = 0
    missing_s: float = 0.0
    refused: tuple[tuple[str, int], ...] = ()
    last_refusal: str = ""

    @property
    def hops(self) -> tuple[HopMoments, ...]:
        """All of them, oldest first."""
        return tuple(hop for stretch in self.stretches for hop in stretch)

    @property
    def duration_s(self) -> float:
        """Usable data, s."""
        return len(self.hops) * self.plan.hop / self.plan.rate_hz

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
    name : str
        What the recording is called.
    blocks : iterable of (SampleBlock, str)
        Blocks in their order, each with the hash of the channel descriptor that its sender named, or "".
    until_s : float, optional
        Use only data from before this time after the first sample.
    """
    plan = plan_for(machine)
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
            window.gap()
            stretches.append([])
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
            f"{path}: no hop of {machine.window.hop_s:g} s of {machine.site}/{machine.name} in it; it holds "
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
