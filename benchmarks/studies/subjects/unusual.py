"""Windows that depart from what the diagnosis assumes: another excitation, or a fault that no parameter describes."""

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from models.errors import EstimationError
from models.machine import Machine
from models.physics.rotor import STATE_INDEX
from models.signals.channels import Quantity
from simulator.plant import NonlinearPlant, theoretical_moments
from simulator.scenario import Event, NamedSource, Rub, Scenario
from simulator.timeline import Condition
from simulator.training.draws import Draw, generator

_EXCITATION, _ANOMALY = 2, 3


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
class UnusualDraw(Draw):
    """A recipe for windows with another excitation or an anomaly; everything else of the condition stays as it is."""

    excitation: Excitation = Excitation.SECOND_ORDER
    anomaly: Anomaly = Anomaly.NONE
    # As `simulator.scenario.Event.size`, for GAIN_DRIFT the relative change of gain; None is the anomaly's own.
    anomaly_size: float | None = None

    def coloured(self, sources: tuple[NamedSource, ...], number: int) -> tuple[NamedSource, ...]:
        """Give the sources the colour of the excitation."""
        rng = generator(self, number, _EXCITATION)
        match self.excitation:
            case Excitation.FIRST_ORDER:
                colours: list[dict[str, float]] = [{"order": 1}] * len(sources)
            case Excitation.FOURTH_ORDER:
                colours = [{"order": 4}] * len(sources)
            case Excitation.OWN_CUTOFFS if len(sources) > 1:
                colours = [{"cutoff_hz": float(rng.uniform(*self.machine.condition.cutoff_hz))} for _ in sources]
            case Excitation.HUMP:
                names = ("hump_share", "hump_hz", "hump_damping")
                values = (float(rng.uniform(*limits)) for limits in ((0.3, 0.8), (40.0, 120.0), (0.3, 0.5)))
                colours = [dict(zip(names, values, strict=True))] * len(sources)
            case _:
                return sources
        return tuple(source.model_copy(update=colour) for source, colour in zip(sources, colours, strict=True))

    def finished(self, scenario: Scenario, number: int) -> Scenario:
        """Let the level drift, and the anomaly happen."""
        if self.excitation is Excitation.DRIFT:
            scenario = _drifting(scenario, generator(self, number, _EXCITATION))
        return _with_anomaly(self, scenario, generator(self, number, _ANOMALY))


def _drifting(scenario: Scenario, rng: np.random.Generator) -> Scenario:
    """Let the level double or halve from start to end, the drawn level being the geometric middle."""
    end, duration_s = 2.0 if rng.random() < 0.5 else 0.5, scenario.duration_s
    sources = tuple(one.model_copy(update={"force_rms_N": one.force_rms_N / end**0.5}) for one in scenario.sources)
    drift = [Event(at_s=0, ramp_s=duration_s, excitation_level=end)]
    if rng.random() >= 0.5:
        drift = [
            Event(at_s=duration_s * step / (_DRIFT_STEPS + 1), excitation_level=end ** (step / _DRIFT_STEPS))
            for step in range(1, _DRIFT_STEPS + 1)
        ]
    return scenario.model_copy(update={"sources": sources, "events": (*scenario.events, *drift)})


def _with_anomaly(draw: UnusualDraw, scenario: Scenario, rng: np.random.Generator) -> Scenario:
    size = _SIZES[draw.anomaly] if draw.anomaly_size is None else draw.anomaly_size
    drawn = [(one.parameter, one.relative_change) for one in scenario.events]
    changes = {name: change for name, change in drawn if name is not None and change is not None}
    speed_rpm = next(one.speed_rpm for one in scenario.events if one.speed_rpm is not None)
    rub = None
    match draw.anomaly:
        case Anomaly.NONE:
            return scenario
        case Anomaly.GAIN_DRIFT:
            channels = [channel.name for channel in draw.machine.sensors if channel.quantity != Quantity.SHAFT_ANGLE]
            channel = channels[int(rng.integers(len(channels)))]
            ramp_s = scenario.duration_s if rng.random() < 0.5 else 0.0
            event = Event(at_s=0, ramp_s=ramp_s, sensor=channel, sensor_fault="gain", value_SI=1 + size)
        case Anomaly.RUB:
            condition = Condition(changes, speed_rpm, scenario.sources)
            rms = np.sqrt(np.diag(theoretical_moments(draw.machine, condition)))
            rub = Rub(clearance_m=_CLEARANCE * float(np.hypot(rms[STATE_INDEX["y2"]], rms[STATE_INDEX["z2"]])))
            event = Event(at_s=0, anomaly="rub", size=size)
        case Anomaly.CRACK:
            stable = _stable_crack(size, draw.machine, Condition(changes, speed_rpm, ()))
            event = Event(at_s=0, anomaly="crack", size=stable)
        case Anomaly.ADDED_MASS:
            event = Event(at_s=0, anomaly="added_mass", size=size)
    return scenario.model_copy(update={"rub": rub, "events": (*scenario.events, event)})


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
