"""Windows of data drawn at random: training, calibration and evaluation material.

Each window is a run of the simulator in a condition of its own, through the same sensors, number format and sliding
statistics as live data. Its random numbers come from (seed, purpose, equation, number) alone, so that windows can be
made in any order by any number of processes, and no purpose ever shares a realisation with another.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import partial

import numpy as np

from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.physics.response import stochastic_covariance, synchronous_response
from models.physics.rotor import PARAMETERS, STATE_INDEX, changed
from models.signals.channels import Quantity
from models.signals.sensor import Sensor
from simulator.plant import NonlinearPlant, theoretical_rms
from simulator.scenario import Event, NamedSource, Rub, Scenario, Sensors
from simulator.stream import blocks
from simulator.timeline import Condition

_BLOCK_S = 5.0
_REALISATION, _EXCITATION, _ANOMALY = 1, 2, 3


class Purpose(IntEnum):
    """What a window is for; part of its seed."""

    TRAINING = 1
    CALIBRATION = 2
    EVALUATION = 3


class Layout(IntEnum):
    """How the stochastic force reaches the machine."""

    ONE_SOURCE = 0  # one source of random direction over all six degrees of freedom
    INDEPENDENT = 1  # independent sources of random level at bearing and disc, horizontal and vertical


class Excitation(IntEnum):
    """Colour and level of the stochastic force."""

    SECOND_ORDER = 0  # what the likelihood assumes: second-order low-pass, one cutoff for all sources, constant level
    FIRST_ORDER = 1
    FOURTH_ORDER = 2
    OWN_CUTOFFS = 3  # second order, each source with a cutoff of its own; with one source the same as SECOND_ORDER
    HUMP = 4  # a hump at 40 to 120 Hz, damping ratio 0.3 to 0.5, with 30 to 80 % of the variance, common to all sources
    DRIFT = 5  # the level doubles or halves over the window, linearly or in eight equal ratios; drawn at random


class Anomaly(IntEnum):
    """A fault that none of the diagnosed parameters describes; its default size is in parentheses."""

    NONE = 0
    CRACK = 1  # breathing crack (0.3 of the shaft's bending stiffness); halved until the machine is stable at its speed
    RUB = 2
    """Disc touching the casing (0.2 of the shaft's stiffness), clearance 1.5 times the disc's radial rms.

    The disc is then in contact a tenth of the time. Sizes of 1 and more may be unstable on lightly damped machines.
    """
    ADDED_MASS = 3  # even deposit on the disc (0.07 of its mass)
    GAIN_DRIFT = 4
    """One vibration channel reads wrong (by 0.1), from the start or growing over the window; drawn at random."""


_SIZES = {Anomaly.NONE: 0.0, Anomaly.CRACK: 0.3, Anomaly.RUB: 0.2, Anomaly.ADDED_MASS: 0.07, Anomaly.GAIN_DRIFT: 0.1}
_CLEARANCE = 1.5
_DRIFT_STEPS = 8


@dataclass(frozen=True, slots=True)
class Draw:
    """A recipe for windows."""

    machine: Machine
    seed: int  # of the whole training or study
    purpose: Purpose
    stream: int = 0  # distinguishes series of windows of the same purpose (equations, cells of a table)
    kept_nominal: tuple[str, ...] = PARAMETERS  # parameters that do not vary
    spread: float = 0.3  # the others vary uniformly by up to this relative amount
    faults: dict[str, float] = field(default_factory=dict)  # fixed relative changes on top
    layout: Layout | None = None  # None draws one of them at random for each window
    # All windows share the condition drawn for number 0; only the realisation of force and noise differs. Number 0
    # itself has another realisation than with `fixed_condition` false.
    fixed_condition: bool = False
    excitation: Excitation = Excitation.SECOND_ORDER  # another one leaves everything else of the condition as it is
    anomaly: Anomaly = Anomaly.NONE  # the same holds for this
    # As `simulator.scenario.Event.size`, for GAIN_DRIFT the relative change of gain; None is the anomaly's own.
    anomaly_size: float | None = None


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
    rng = _generator(draw, condition_number)
    changes = {
        name: float(rng.uniform(-draw.spread, draw.spread)) for name in PARAMETERS if name not in draw.kept_nominal
    } | draw.faults
    tolerance = machine.operation.speed_tolerance
    speed_rpm = machine.operation.speed_rpm * float(rng.uniform(1 - tolerance, 1 + tolerance))
    cutoff_hz = float(rng.uniform(*condition.cutoff_hz))
    layout = Layout(int(rng.integers(2))) if draw.layout is None else draw.layout
    ratio = float(rng.uniform(*condition.stochastic_to_1x))
    excitation_rng = _generator(draw, condition_number, _EXCITATION)
    coloured = _coloured(_sources(layout, cutoff_hz, machine, rng), draw, excitation_rng)
    sources = scaled(coloured, ratio, machine, changes, speed_rpm)
    corner_hz = None if rng.random() < 0.5 else float(np.exp(rng.uniform(np.log(50), np.log(500))))
    sensors = Sensors(noise_relative=float(rng.uniform(*condition.noise_relative)), noise_corner_hz=corner_hz)
    events = [Event(at_s=0, parameter=name, relative_change=change) for name, change in changes.items()]
    events.append(Event(at_s=0, speed_rpm=speed_rpm))
    plan = plan_for(machine)
    realisation = _generator(draw, number, _REALISATION) if draw.fixed_condition else rng
    duration_s = (plan.preamble + plan.hops * plan.stride) / machine.rate_hz
    if draw.excitation is Excitation.DRIFT:
        sources, drift = _drifting(sources, duration_s, excitation_rng)
        events += drift
    rub, anomaly = _anomaly(draw, sources, changes, speed_rpm, duration_s, _generator(draw, condition_number, _ANOMALY))
    events += anomaly
    return Scenario(
        name=f"draw {draw.purpose.name.lower()} {draw.stream}.{number}",
        machine=machine.name,
        seed=int(realisation.integers(2**62)),
        duration_s=duration_s,
        sources=sources,
        sensors=sensors,
        rub=rub,
        events=tuple(events),
    )


def _generator(draw: Draw, number: int, *topic: int) -> np.random.Generator:
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


def _coloured(sources: tuple[NamedSource, ...], draw: Draw, rng: np.random.Generator) -> tuple[NamedSource, ...]:
    """Give the sources the colour of the draw's excitation."""
    match draw.excitation:
        case Excitation.FIRST_ORDER:
            colours: list[dict[str, float]] = [{"order": 1}] * len(sources)
        case Excitation.FOURTH_ORDER:
            colours = [{"order": 4}] * len(sources)
        case Excitation.OWN_CUTOFFS if len(sources) > 1:
            colours = [{"cutoff_hz": float(rng.uniform(*draw.machine.condition.cutoff_hz))} for _ in sources]
        case Excitation.HUMP:
            names = ("hump_share", "hump_hz", "hump_damping")
            values = (float(rng.uniform(*limits)) for limits in ((0.3, 0.8), (40.0, 120.0), (0.3, 0.5)))
            colours = [dict(zip(names, values, strict=True))] * len(sources)
        case _:
            return sources
    return tuple(source.model_copy(update=colour) for source, colour in zip(sources, colours, strict=True))


def _drifting(
    sources: tuple[NamedSource, ...], duration_s: float, rng: np.random.Generator
) -> tuple[tuple[NamedSource, ...], list[Event]]:
    """Let the level double or halve from start to end, the drawn level being the geometric middle."""
    end = 2.0 if rng.random() < 0.5 else 0.5
    sources = tuple(source.model_copy(update={"force_rms_N": source.force_rms_N / end**0.5}) for source in sources)
    if rng.random() < 0.5:
        return sources, [Event(at_s=0, ramp_s=duration_s, excitation_level=end)]
    return sources, [
        Event(at_s=duration_s * step / (_DRIFT_STEPS + 1), excitation_level=end ** (step / _DRIFT_STEPS))
        for step in range(1, _DRIFT_STEPS + 1)
    ]


def _anomaly(
    draw: Draw,
    sources: tuple[NamedSource, ...],
    changes: dict[str, float],
    speed_rpm: float,
    duration_s: float,
    rng: np.random.Generator,
) -> tuple[Rub | None, list[Event]]:
    """Rub settings and events of a scenario with the draw's anomaly."""
    size = _SIZES[draw.anomaly] if draw.anomaly_size is None else draw.anomaly_size
    match draw.anomaly:
        case Anomaly.NONE:
            return None, []
        case Anomaly.GAIN_DRIFT:
            channels = [channel.name for channel in draw.machine.sensors if channel.quantity != Quantity.SHAFT_ANGLE]
            channel = channels[int(rng.integers(len(channels)))]
            ramp_s = duration_s if rng.random() < 0.5 else 0.0
            return None, [Event(at_s=0, ramp_s=ramp_s, sensor=channel, sensor_fault="gain", value_SI=1 + size)]
        case Anomaly.RUB:
            rms = theoretical_rms(draw.machine, Condition(changes, speed_rpm, sources))
            clearance_m = _CLEARANCE * float(np.hypot(rms[STATE_INDEX["y2"]], rms[STATE_INDEX["z2"]]))
            return Rub(clearance_m=clearance_m), [Event(at_s=0, anomaly="rub", size=size)]
        case Anomaly.CRACK:
            size = _stable_crack(size, draw.machine, Condition(changes, speed_rpm, ()))
            return None, [Event(at_s=0, anomaly="crack", size=size)]
        case Anomaly.ADDED_MASS:
            return None, [Event(at_s=0, anomaly="added_mass", size=size)]


def _stable_crack(size: float, machine: Machine, condition: Condition) -> float:
    """Halve a crack until the machine can be run: a lightly damped one has speeds at which a deep crack is unstable."""
    plant = NonlinearPlant(machine, condition, np.random.default_rng(0))
    while True:
        try:
            plant.change(replace(condition, anomalies={"crack": size}))
        except EstimationError:
            size /= 2
        else:
            return size


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
    """Simulate windows over worker processes, in order; with one, in this process."""
    make = partial(simulate_window, draw)
    if processes == 1:
        for number in numbers:
            yield make(number)
            progress(1)
        return
    with ProcessPoolExecutor(processes) as pool:
        for statistics in pool.map(make, numbers, chunksize=2):
            yield statistics
            progress(1)
