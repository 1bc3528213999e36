"""Windows of data drawn at random: training, calibration and evaluation material.

Each window is a run of the simulator in a condition of its own, through the same sensors, number format and sliding
statistics as live data. Its random numbers come from (seed, purpose, equation, number) alone, so that windows can be
made in any order by any number of processes, and no purpose ever shares a realisation with another.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from typing import TypeVar

import numpy as np

from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine
from models.physics.response import stochastic_covariance, synchronous_response
from models.physics.rotor import PARAMETERS, STATE_INDEX, changed
from models.signals.channels import Sensor
from simulator.scenario import Event, NamedSource, Scenario, Sensors
from simulator.stream import blocks

_BLOCK_S = 5.0
_REALISATION = 1
_SPREAD = 0.3  # largest relative change of a parameter that varies, either way


class Purpose(IntEnum):
    """What a window is for; part of its seed."""

    TRAINING = 1
    CALIBRATION = 2
    EVALUATION = 3


class Layout(IntEnum):
    """How the stochastic force reaches the machine."""

    ONE_SOURCE = 0  # one source of random direction over all six degrees of freedom
    INDEPENDENT = 1  # independent sources of random level at bearing and disc, horizontal and vertical


@dataclass(frozen=True, slots=True)
class Draw:
    """A recipe for windows."""

    machine: Machine
    seed: int  # of the whole training or study
    purpose: Purpose
    stream: int = 0  # distinguishes series of windows of the same purpose (equations, cells of a table)
    kept_nominal: tuple[str, ...] = PARAMETERS  # parameters that do not vary; the others do, uniformly
    faults: dict[str, float] = field(default_factory=dict)  # fixed relative changes on top
    layout: Layout | None = None  # None draws one of them at random for each window
    # All windows share the condition drawn for number 0; only the realisation of force and noise differs. Number 0
    # itself has another realisation than with `fixed_condition` false.
    fixed_condition: bool = False

    def coloured(self, sources: tuple[NamedSource, ...], _number: int) -> tuple[NamedSource, ...]:
        """Sources of a condition with the colour of this recipe's excitation, before they are scaled."""
        return sources

    def finished(self, scenario: Scenario, _number: int) -> Scenario:
        """A condition with what else happens in it; here, nothing does."""
        return scenario


def with_tilt(machine: Machine) -> Machine:
    """Return the machine with tilt and tilt-rate sensors added where it has none."""
    present = set(machine.descriptor.states)
    added = [
        Sensor.model_validate(
            {"name": name, "quantity": quantity, "location": "disc", "direction": direction, "unit": unit}
        )
        for name, quantity, direction, unit in (
            ("psi", "tilt", "y", "rad"),
            ("phi", "tilt", "z", "rad"),
            ("psi_dot", "tilt_rate", "y", "rad/s"),
            ("phi_dot", "tilt_rate", "z", "rad/s"),
        )
        if name not in present
    ]
    return machine.model_copy(update={"sensors": (*machine.sensors, *added)})


def draw_condition(draw: Draw, number: int) -> Scenario:
    """Draw the operating condition of one window: cutoff, layout, levels, speed, noise, and varying parameters."""
    machine, condition = draw.machine, draw.machine.condition
    condition_number = 0 if draw.fixed_condition else number
    rng = generator(draw, condition_number)
    varied = [name for name in PARAMETERS if name not in draw.kept_nominal]
    changes = {name: float(rng.uniform(-_SPREAD, _SPREAD)) for name in varied} | draw.faults
    tolerance = machine.operation.speed_tolerance
    speed_rpm = machine.operation.speed_rpm * float(rng.uniform(1 - tolerance, 1 + tolerance))
    cutoff_hz = float(rng.uniform(*condition.cutoff_hz))
    layout = Layout(int(rng.integers(2))) if draw.layout is None else draw.layout
    ratio = float(rng.uniform(*condition.stochastic_to_1x))
    coloured = draw.coloured(_sources(layout, cutoff_hz, machine, rng), condition_number)
    corner_hz = None if rng.random() < 0.5 else float(np.exp(rng.uniform(np.log(50), np.log(500))))
    sensors = Sensors(noise_relative=float(rng.uniform(*condition.noise_relative)), noise_corner_hz=corner_hz)
    events = [Event(at_s=0, parameter=name, relative_change=change) for name, change in changes.items()]
    events.append(Event(at_s=0, speed_rpm=speed_rpm))
    plan = plan_for(machine)
    realisation = generator(draw, number, _REALISATION) if draw.fixed_condition else rng
    scenario = Scenario(
        name=f"draw {draw.purpose.name.lower()} {draw.stream}.{number}",
        machine=machine.name,
        seed=int(realisation.integers(2**62)),
        duration_s=(plan.preamble + plan.hops * plan.stride) / machine.rate_hz,
        sources=scaled(coloured, ratio, machine, changes, speed_rpm),
        sensors=sensors,
        events=tuple(events),
    )
    return draw.finished(scenario, condition_number)


def generator(draw: Draw, number: int, *topic: int) -> np.random.Generator:
    """Random numbers of one window; a topic has numbers of its own, so that a new topic does not change the others."""
    return np.random.default_rng([draw.seed, draw.purpose, draw.stream, number, *topic])


def _sources(layout: Layout, cutoff_hz: float, machine: Machine, rng: np.random.Generator) -> tuple[NamedSource, ...]:
    if layout is Layout.ONE_SOURCE:
        lever = machine.rotor.shaft_length_m / 3
        direction = rng.standard_normal(6) * np.array([1, 1, lever, 1, 1, lever])
        parts = [(direction / np.linalg.norm(direction), 1.0)]
    else:
        parts = [(np.eye(6)[dof], float(rng.uniform(0.3, 1.0))) for dof in (0, 1, 3, 4)]
    return tuple(
        NamedSource.model_validate(
            {"name": f"source{n}", "cutoff_hz": cutoff_hz, "direction": tuple(direction), "force_rms_N": level}
        )
        for n, (direction, level) in enumerate(parts)
    )


def scaled(
    sources: tuple[NamedSource, ...], ratio: float, machine: Machine, changes: dict[str, float], speed_rpm: float
) -> tuple[NamedSource, ...]:
    """Scale the forces so that the stochastic displacement at the disc is `ratio` times its 1x amplitude, both rms."""
    rotor, speed_rad_s = changed(machine.rotor, changes), speed_rpm * 2 * np.pi / 60
    variance = np.diag(stochastic_covariance(rotor, speed_rad_s, sources))
    q1, q2 = synchronous_response(rotor, speed_rad_s)
    disc = [STATE_INDEX["y2"], STATE_INDEX["z2"]]
    factor = ratio * float(np.sqrt(np.sum(q1[disc] ** 2 + q2[disc] ** 2) / 2 / np.sum(variance[disc])))
    return tuple(source.model_copy(update={"force_rms_N": source.force_rms_N * factor}) for source in sources)


def simulate_window(draw: Draw, number: int) -> WindowStatistics:
    """Simulate one window and return its statistics."""
    return simulate_scenario(draw_condition(draw, number), draw.machine)


def simulate_scenario(scenario: Scenario, machine: Machine) -> WindowStatistics:
    """Simulate a scenario that lasts one window and return its statistics."""
    plan = plan_for(machine)
    window = SlidingWindow(plan)
    for block, _ in blocks(scenario, machine, block_s=_BLOCK_S):
        for _ in window.feed(plan.to_si(block.samples), block.start_ns):
            pass
    statistics = window.statistics()
    if statistics is None:
        raise AssertionError("the drawn scenario lasts one window by construction")
    return statistics


def windows(
    draw: Draw, numbers: Sequence[int], processes: int, progress: Callable[[int], None] = lambda _: None
) -> Iterator[WindowStatistics]:
    """Simulate windows, see `made_by`."""
    for statistics in made_by(processes, partial(simulate_window, draw), numbers):
        yield statistics
        progress(1)


_Made = TypeVar("_Made")


def made_by(processes: int, make: Callable[[int], _Made], numbers: Iterable[int]) -> Iterator[_Made]:
    """Make something of each number, in order, in worker processes a few ahead of their use; with one, in this one."""
    if processes == 1:
        yield from map(make, numbers)
        return
    with ProcessPoolExecutor(processes) as pool:
        waiting: deque[Future[_Made]] = deque()
        for number in numbers:
            waiting.append(pool.submit(make, number))
            if len(waiting) > 2 * processes:
                yield waiting.popleft().result()
        for made in waiting:
            yield made.result()
