"""The shaft angle that ``docs/wire.md`` makes from a keyphasor serves as well as the true one."""

import math
from typing import Any

import numpy as np
import pytest

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.sensors.check import sensor_findings
from models.machine import load_machine
from models.signals.block import FloatArray
from simulator.scenario import Event, load_scenario
from simulator.stream import blocks
from tests.signals.test_wire import page_blocks
from tests.sure import sure
from tests.windows import statistics

LEVEL_V, PULSE_V, THRESHOLD_V, HYSTERESIS_V = -8.0, 6.0, -5.0, 1.0
PULSE_S = 3e-3


def shaft_angles(volts: FloatArray) -> list[float | None]:
    (code,) = [one for one in page_blocks("python") if "class ShaftAngle" in one]
    names: dict[str, Any] = {}
    exec(code, names)  # noqa: S102  # the page's own code
    made = names["ShaftAngle"](THRESHOLD_V, HYSTERESIS_V)
    return [made.angle(float(one)) for one in volts]


def keyphasor(theta: FloatArray, rate_hz: float, edge_s: float) -> FloatArray:
    """Voltage of a probe that a notch passes when the angle is 0."""
    turns = np.unwrap(theta) / (2 * np.pi)
    since_s = ((turns + 0.5) % 1 - 0.5) / (np.gradient(turns) * rate_hz)
    return np.asarray(LEVEL_V + PULSE_V * np.clip(since_s / edge_s + 0.5, 0, 1) * (since_s < PULSE_S))


@pytest.mark.parametrize(("edge_s", "most_deg"), [(1e-3, 1.0), (1e-5, 6.0)])
def test_an_angle_from_pulses_serves_as_the_true_one(edge_s: float, most_deg: float) -> None:
    machine = load_machine("lab").model_copy(update={"dtype": "float64"})
    wandering = [
        Event(at_s=at, speed_rpm=machine.operation.speed_rpm * (1 + 0.02 * math.sin(at / 10))) for at in range(1, 65)
    ]
    scenario, _ = load_scenario("healthy")
    scenario = scenario.overridden(duration_s=66.0, seed=31_401, faults=wandering)
    samples = np.concatenate([block.samples for block, _ in blocks(scenario, machine, 1.0)])
    angles = shaft_angles(keyphasor(samples[:, -1], machine.rate_hz, edge_s))
    begin = next(number for number, angle in enumerate(angles) if angle is not None)
    assert begin < 2 * machine.rate_hz / (machine.operation.speed_rpm / 60) + 10  # two revolutions
    true, made = samples[begin:], samples[begin:].copy()
    made[:, -1] = angles[begin:]
    off = np.angle(np.exp(1j * (made[:, -1] - true[:, -1])))
    assert np.degrees(np.abs(off).max()) < most_deg
    windows = [statistics(machine, one) for one in (true, made)]
    assert sensor_findings(windows[1], None, machine.sensors) == ()
    expected, found = (LikelihoodFit(machine).diagnose(one).parameters for one in windows)
    for one, other in zip(expected, found, strict=True):
        assert abs(sure(one.relative_change) - sure(other.relative_change)) < 0.2 * sure(one.standard_error)
