"""A monitor fed without a network, and its output."""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, TypeVar

from models.commissioning.commissioned import Installed
from models.machine import MachineFile
from models.signals.block import SampleBlock
from rotorwatch.records.health import Report
from service.monitor.alarms.alarm import AlarmEvent
from service.monitor.monitor import MachineMonitor


def feed(target: MachineMonitor, stream: Iterable[SampleBlock]) -> tuple[list[Report], list[AlarmEvent]]:
    windows: list[Report] = []
    events: list[AlarmEvent] = []
    for block in stream:
        report = target.step(block)
        windows += report.windows
        events += report.events
    return windows, events


def held(
    stream: Iterable[SampleBlock], columns: int | list[int], value: float, from_s: float = 0.0, to_s: float = math.inf
) -> list[SampleBlock]:
    """The stream with channels held at a value, or missing as NaN, for a time in seconds from its beginning."""
    found: list[SampleBlock] = []
    for block in stream:
        samples = block.samples.copy()
        if from_s <= (block.start_ns - (found or [block])[0].start_ns) / 1e9 < to_s:
            samples[:, columns] = value
        found.append(replace(block, samples=samples))
    return found


M = TypeVar("M", bound=MachineFile)


def at_once(machine: M) -> M:
    """The machine with alarms that wait for no further window."""
    return machine.model_copy(update={"alarms": machine.alarms.model_copy(update={"on_delay_s": 0.0})})


def named(events: Iterable[AlarmEvent]) -> list[tuple[str, str]]:
    return [(event.kind.value, event.alarm.name) for event in events]


def raised(monitor: MachineMonitor) -> set[str]:
    return {alarm.name for alarm in monitor.health().alarms if alarm.raised}


def resumed(monitor: MachineMonitor, installed: Installed, *, whole: bool = True, **how: Any) -> MachineMonitor:
    """A second monitor restored from the state of the first, with its window or without."""
    state, again = monitor.state(whole=whole), MachineMonitor(installed, **how)
    again.restore(state.state, [data for _, data in state.new_parts])
    again.restore_alarms(state.alarms)
    return again
