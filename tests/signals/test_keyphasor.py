"""A shaft angle that jumps is told from one whose shaft changes its speed."""

import numpy as np
import pytest

from models.signals import keyphasor
from models.signals.block import FloatArray

RATE_HZ, N = 2000.0, 15_000
SPEED_RAD_S = 138.2


def angle(speed_rad_s: FloatArray | float) -> FloatArray:
    return np.asarray(np.mod(np.cumsum(np.broadcast_to(speed_rad_s, N)) / RATE_HZ, 2 * np.pi))


def jump_within_a_turn(angle_rad: FloatArray) -> float:
    return keyphasor.jump_within_a_turn((np.diff(angle_rad) + np.pi) % (2 * np.pi) - np.pi)


def pulses_elsewhere(by_rad: float) -> FloatArray:
    """An angle between pulses, one a turn, whose mark has moved: one turn is longer or shorter than the others."""
    pulses_s = np.arange(200) * 2 * np.pi / SPEED_RAD_S
    pulses_s[80:] -= by_rad / SPEED_RAD_S
    return np.asarray(np.mod(2 * np.pi * np.interp(np.arange(N) / RATE_HZ, pulses_s, np.arange(200)), 2 * np.pi))


@pytest.mark.parametrize("by_rad", [0.4, -0.8, 1.57, -3.1])
def test_a_jump_is_seen_between_samples_and_between_pulses(by_rad: float) -> None:
    step = angle(SPEED_RAD_S) + np.where(np.arange(N) < 6000, 0.0, by_rad)
    assert jump_within_a_turn(step) == pytest.approx(by_rad, abs=1e-6)
    assert jump_within_a_turn(np.mod(-step, 2 * np.pi)) == pytest.approx(-by_rad, abs=1e-6)
    assert jump_within_a_turn(pulses_elsewhere(by_rad)) == pytest.approx(by_rad, abs=0.02)


def test_no_speed_makes_a_jump() -> None:
    t_s = np.arange(N) / RATE_HZ
    for speed in (
        np.where(t_s < 3, 1.0, 1.2),
        np.where(t_s < 3, 1.0, 0.8),
        1 + 0.02 * np.sin(2 * np.pi * t_s / 4),
        t_s / t_s[-1],
    ):
        assert abs(jump_within_a_turn(angle(SPEED_RAD_S * speed))) < 0.1
    assert jump_within_a_turn(np.zeros(N)) == 0
    assert jump_within_a_turn(0.1 * t_s) == 0  # less than a turn
