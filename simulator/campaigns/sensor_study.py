"""Sensors at fault on a healthy machine: found, named, or taken for a fault of bearing or unbalance.

Every window is an independent realisation in a condition of its own, with one fault on a channel and of a size drawn at
random. The fault is there from the start or comes within the window.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from pydantic import BaseModel, ConfigDict

from models.commissioning.knowledge import KnowledgeLevel
from models.diagnosis.readings import Diagnostician
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.reference import SensorReference, learn_sensor_reference
from models.diagnosis.verdict.isolation import isolate_window
from models.errors import EstimationError
from models.machine import Machine
from models.physics.matrices import STATE_INDEX
from models.signals.channels import Channel, Quantity, state_name
from simulator.campaigns.pool import done_in
from simulator.campaigns.rates import Rate
from simulator.campaigns.unknown_study import commissioned
from simulator.campaigns.unknown_subjects import subject_named
from simulator.integrator import theoretical_rms
from simulator.scenario import Event, Scenario
from simulator.timeline import compile_timeline
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_scenario

__all__ = ["FAULTS", "SensorCell", "SensorPlan", "SensorRecord", "run_sensors", "sensor_cells"]

FAULTS = ("healthy", "gain", "drift", "offset", "stuck", "clip", "delay", "swapped")
"""What is wrong with one channel; ``drift`` is a gain that moves over the whole window."""

_EXPECTED = {
    "gain": ("gain",),
    "drift": ("gain",),
    "offset": ("offset",),
    "stuck": ("stuck",),
    "clip": ("clipped",),
    "delay": ("delay",),
    "swapped": ("swapped",),
}
"""Names under which the checks know it."""
_CHUNK = 4


@dataclass(frozen=True, slots=True)
class SensorPlan:
    """What is run.

    Attributes
    ----------
    machines : tuple of str
        Shipped machines.
    levels : tuple of KnowledgeLevel
    seed : int
    windows : int
        Per machine, level and fault.
    healthy : int
        Windows of the commissioning; it has one source, one cutoff and one level.
    rate : float
        Declared false alarms per window of the diagnosis.
    """

    machines: tuple[str, ...]
    levels: tuple[KnowledgeLevel, ...]
    seed: int
    windows: int
    healthy: int = 6
    rate: float = 0.01


class SensorRecord(BaseModel):
    """One window."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    machine: str
    level: KnowledgeLevel
    fault: str
    number: int
    state: str
    size: float
    found: tuple[str, ...]
    named: bool
    claimed: tuple[str, ...] = ()
    outside: bool = False


class SensorCell(BaseModel):
    """All windows of one fault."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    machine: str
    level: KnowledgeLevel
    fault: str
    named: Rate
    data_health: Rate
    claimed: Rate
    outside: Rate


def run_sensors(
    plan: SensorPlan, processes: int, progress: Callable[[str, int, int], None]
) -> tuple[SensorRecord, ...]:
    """Simulate and check every window."""
    records: list[SensorRecord] = []
    with ProcessPoolExecutor(processes) as pool:
        for machine in plan.machines:
            for level in plan.levels:
                tasks = [(fault, number) for fault in FAULTS for number in range(plan.windows)]
                label = f"{machine}, {level}"
                records += done_in(
                    pool, partial(_window, plan, machine, level), tasks, partial(progress, label), _CHUNK
                )
    return tuple(records)


def sensor_cells(records: Sequence[SensorRecord]) -> tuple[SensorCell, ...]:
    """Rates of every machine, level and fault."""
    keys = dict.fromkeys((one.machine, one.level, one.fault) for one in records)
    cells = []
    for machine, level, fault in keys:
        own = [one for one in records if (one.machine, one.level, one.fault) == (machine, level, fault)]
        cells.append(
            SensorCell(
                machine=machine,
                level=level,
                fault=fault,
                named=Rate.of_counts(sum(one.named for one in own), len(own)),
                data_health=Rate.of_counts(sum(bool(one.found) for one in own), len(own)),
                claimed=Rate.of_counts(sum(bool(one.claimed) for one in own), len(own)),
                outside=Rate.of_counts(sum(one.outside for one in own), len(own)),
            )
        )
    return tuple(cells)


@lru_cache(maxsize=2)
def _learned(name: str, level: KnowledgeLevel, seed: int, healthy: int) -> tuple[Diagnostician, SensorReference]:
    subject = subject_named(name)
    file = subject.file(level)
    windows = subject.healthy(seed, 0, healthy)
    if file is None:
        raise AssertionError("a shipped machine has a file at every level")
    return commissioned(level, file, windows), learn_sensor_reference(windows)


def _window(plan: SensorPlan, name: str, level: KnowledgeLevel, task: tuple[str, int]) -> SensorRecord:
    fault, number = task
    diagnostician, reference = _learned(name, level, plan.seed, plan.healthy)
    file = subject_named(name).file(KnowledgeLevel.FULL)
    if not isinstance(file, Machine):
        raise AssertionError("a shipped machine is known")
    draw = Draw(file, plan.seed, Purpose.EVALUATION, stream=900 + FAULTS.index(fault), layout=Layout(number % 2))
    scenario = draw_condition(draw, number)
    rng = np.random.default_rng([plan.seed, FAULTS.index(fault), number])
    event, channel, size = _event(fault, file, scenario, rng)
    if event is not None:
        scenario = scenario.model_copy(update={"events": (*scenario.events, event)})
    window = simulate_scenario(scenario, file)
    findings = sensor_findings(window, reference, file.sensors)
    state = "" if channel is None else state_name(channel)
    known = {"machine": name, "level": level, "fault": fault, "number": number, "state": state, "size": size}
    named = any(found.kind in _EXPECTED.get(fault, ()) and state in found.states for found in findings)
    record = SensorRecord.model_validate(
        known | {"found": tuple(dict.fromkeys(found.kind for found in findings)), "named": named}
    )
    if findings:
        return record
    try:
        verdict = isolate_window(diagnostician.diagnose(window), plan.rate)
    except (EstimationError, np.linalg.LinAlgError):
        return record
    # A name beside "outside the model" is given with reserve and claims nothing.
    claimed = () if verdict.outside else verdict.changed
    return record.model_copy(update={"claimed": claimed, "outside": verdict.outside})


def _event(
    fault: str, machine: Machine, scenario: Scenario, rng: np.random.Generator
) -> tuple[Event | None, Channel | None, float]:
    """The event of a fault, its channel and its size."""
    if fault == "healthy":
        return None, None, 0.0
    channels = [channel for channel in machine.sensors if channel.quantity is not Quantity.SHAFT_ANGLE]
    channel = channels[int(rng.integers(len(channels)))]
    at_s = 0.0 if rng.random() < 0.5 else float(rng.uniform(0.1, 0.6)) * scenario.duration_s
    sign = 1.0 if rng.random() < 0.5 else -1.0
    condition = compile_timeline(scenario, machine).conditions[-1][1]
    rms = float(theoretical_rms(machine, condition)[STATE_INDEX[state_name(channel)]])
    fields: dict[str, object] = {"at_s": at_s, "sensor": channel.name, "sensor_fault": fault}
    match fault:
        case "gain":
            size = sign * float(rng.uniform(0.1, 0.3))
            fields["value_SI"] = 1 + size
        case "drift":
            size = sign * float(rng.uniform(0.1, 0.3))
            fields |= {"at_s": 0.0, "ramp_s": scenario.duration_s, "sensor_fault": "gain", "value_SI": 1 + size}
        case "offset":
            size = sign * float(rng.uniform(3.0, 10.0))
            fields["value_SI"] = size * rms
        case "clip":
            size = float(rng.uniform(1.0, 2.0))
            fields["value_SI"] = size * rms
        case "delay":
            size = float(rng.uniform(0.001, 0.005))
            fields["value_SI"] = size
        case "swapped":
            size = 0.0
            others = [one for one in channels if (one.quantity, one.unit) == (channel.quantity, channel.unit)]
            others.remove(channel)
            fields["swapped_with"] = others[int(rng.integers(len(others)))].name
        case _:
            size = 0.0
    return Event.model_validate(fields), channel, size
