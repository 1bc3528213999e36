"""Commissions a machine on healthy streams, and collects the alarms that the monitor raises on a stream."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from models.commissioning.commission import commission
from models.commissioning.commissioned import HealthyEntry, Installed
from models.commissioning.healthy import healthy_from_blocks
from models.machine import MachineFile
from models.signals.block import SampleBlock
from rotorwatch.records.alarms import EventKind
from service.monitor.monitor import MachineMonitor


@dataclass(frozen=True, slots=True)
class Raised:
    """An alarm that was raised, with its time since the first sample."""

    name: str
    at_s: float
    low_confidence: bool
    note: str


def raised(monitor: MachineMonitor, stream: Iterable[SampleBlock]) -> Iterator[Raised]:
    """Feed a stream to the monitor, and yield alarms as they are raised."""
    first_ns: int | None = None
    for block in stream:
        first_ns = block.start_ns if first_ns is None else first_ns
        report = monitor.step(block)
        if not report.verdict.accepted or report.fault is not None:
            raise report.fault or ValueError(report.verdict.text)
        for event in report.events:
            if event.kind is EventKind.RAISED:
                alarm = event.alarm
                yield Raised(alarm.name, (event.time_ns - first_ns) / 1e9, alarm.low_confidence, alarm.note)


def commissioned(file: MachineFile, *streams: Iterable[SampleBlock]) -> Installed | str:
    """Commission a machine on healthy streams of one condition each; returns a text if it is refused."""
    recordings, entries = [], []
    for number, stream in enumerate(streams, start=1):
        healthy, name = list(stream), f"healthy {number}"
        recordings.append(healthy_from_blocks(name, file, healthy))
        entries.append(
            HealthyEntry(
                name=name, sha256=f"{number:064d}", start_ns=healthy[0].start_ns, end_ns=healthy[-1].end_ns,
                used_s=recordings[-1].duration_s, gaps=0,
            )
        )  # fmt: skip
    made = commission(file, recordings, entries)
    return made.report.summary if made.commissioned is None else Installed(file, None, made.commissioned)
