"""Jumps and speed changes of a shaft angle; the angle that ``docs/wire.md`` makes is as good as the true one."""

import math
from typing import Any

import numpy as np
import pytest

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.sensors.check import sensor_findings
from models.machine import load_machine
from models.signals import keyphasor
from models.signals.block import FloatArray
from simulator.scenario import Event
from tests.signals.test_wire import page_blocks
from tests.sure import sure
from tests.windows import healthy_samples, statistics

RATE_HZ, N = 2000.0, 15_000
SPEED_RAD_S = 138.2


def angle(speed_rad_s: FloatArray | float) -> FloatArray:
    return np.asarray(np.mod(np.cumsum(np.broadcast_to(speed_rad_s, N)) / RATE_HZ, 2 * np.pi))


def jump_within_a_turn(angle_rad: FloatArray) -> float:
    return keyphasor.jump_within_a_turn((np.diff(angle_rad) + np.pi) % (2 * np.pi) - np.pi)


def pulses_elsewhere(by_rad: float) -> FloatArray:
    """An angle from pulses, one per turn, whose mark has moved: one turn is longer or shorter than the others."""
    pulses_s = np.arange(200) * 2 * np.pi / SPEED_RAD_S
    pulses_s[80:] -= by_rad / SPEED_RAD_S
    return np.asarray(np.mod(2 * np.pi * np.interp(np.arange(N) / RATE_HZ, pulses_s, np.arange(200)), 2 * np.pi))


@pytest.mark.parametrize("by_rad", [0.4, -0.8, 1.57, -3.1])
def test_a_jump_is_seen_between_samples_and_between_pulses(by_rad: float) -> None:
    step = angle(SPEED_RAD_S) + np.where(np.arange(N) < 6000, 0.0, by_rad)
    assert jump_within_a_turn(step) == pytest.approx(by_rad, abs=1e-6)
    assert jump_within_a_turn(np.mod(-step, 2 * np.pi)) == pytest.approx(-by_rad, abs=1e-6)
    assert jump_within_a_turn(pulses_elsewhere(by_rad)) == pytest.approx(by_rad, abs=0.02)


def test_a_changing_speed_is_no_jump() -> None:
    t_s = np.arange(N) / RATE_HZ
    up, down = (np.where(t_s < 3, 1.0, to) for to in (1.2, 0.8))
    for speed in (up, down, 1 + 0.02 * np.sin(2 * np.pi * t_s / 4), t_s / t_s[-1]):
        assert abs(jump_within_a_turn(angle(SPEED_RAD_S * speed))) < 0.1
    assert jump_within_a_turn(np.zeros(N)) == 0
    assert jump_within_a_turn(0.1 * t_s) == 0  # less than a turn


LEVEL_V, PULSE_V, THRESHOLD_V, HYSTERESIS_V = -8.0, 6.0, -5.0, 1.0
PULSE_S = 3e-3


def shaft_angles(volts: FloatArray) -> list[float | None]:
    (code,) = [one for one in page_blocks("python") if "class ShaftAngle" in one]
    names: dict[str, Any] = {}
    exec(code, names)  # noqa: S102  # the page's own code
    made = names["ShaftAngle"](THRESHOLD_V, HYSTERESIS_V)
    return [made.angle(float(one)) for one in volts]


def voltage(theta: FloatArray, rate_hz: float, edge_s: float) -> FloatArray:
    """Voltage of a probe that a notch passes when the angle is 0."""
    turns = np.unwrap(theta) / (2 * np.pi)
    since_s = ((turns + 0.5) % 1 - 0.5) / (np.gradient(turns) * rate_hz)
    return np.asarray(LEVEL_V + PULSE_V * np.clip(since_s / edge_s + 0.5, 0, 1) * (since_s < PULSE_S))


@pytest.mark.parametrize(("edge_s", "most_deg"), [(1e-3, 1.0), pytest.param(1e-5, 6.0, marks=pytest.mark.long)])
def test_an_angle_from_pulses_is_as_good_as_the_true_one(edge_s: float, most_deg: float) -> None:
    machine = load_machine("lab").model_copy(update={"dtype": "float64"})
    wandering = [
        Event(at_s=at, speed_rpm=machine.operation.speed_rpm * (1 + 0.02 * math.sin(at / 10))) for at in range(1, 65)
    ]
    samples = healthy_samples(machine, 66.0, 31_401, *wandering)
    angles = shaft_angles(voltage(samples[:, -1], machine.rate_hz, edge_s))
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
