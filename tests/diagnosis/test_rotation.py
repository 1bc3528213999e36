"""Which hops' lines are those of one shaft."""

import numpy as np

from models.diagnosis.rotation import RotationLine, followed_speeds

HOP_S, HOPS, SPEED_HZ = 5.0, 12, 15.0
SEED = 51_900


def lines(seed: int, wander_hz: float, sweep_hz_s: float, strength: float = 30.0) -> tuple[RotationLine, ...]:
    rng = np.random.default_rng(SEED + seed)
    speeds, sweeps = SPEED_HZ + wander_hz * rng.standard_normal(HOPS), sweep_hz_s * rng.standard_normal(HOPS)
    return tuple(RotationLine(2 * np.pi * f, 2 * np.pi * s, strength) for f, s in zip(speeds, sweeps, strict=True))


def test_a_steady_shaft_is_followed_whatever_its_sweeps_are_taken_for() -> None:
    """Of a machine that hardly vibrates but at its resonance: lines to 0.01 Hz, sweeps to 0.02 Hz/s."""
    for seed in range(50):
        speeds = followed_speeds(lines(seed, 0.01, 0.02), HOP_S)
        assert speeds is not None
        assert np.all(np.abs(speeds / (2 * np.pi) - SPEED_HZ) < 0.06)


def test_a_hop_with_another_peak_is_left_out() -> None:
    steady = lines(0, 0.01, 0.02)
    other = RotationLine(2 * np.pi * 15.5, 0.0, 8.0)
    speeds = followed_speeds((*steady[:4], other, *steady[5:9], None, *steady[10:]), HOP_S)
    assert speeds is not None
    assert np.flatnonzero(~np.isfinite(speeds)).tolist() == [4, 9]


def test_what_wanders_like_the_peak_of_a_resonance_is_no_shaft() -> None:
    followed = [followed_speeds(lines(seed, 0.15, 0.02), HOP_S) is not None for seed in range(200)]
    assert np.mean(followed) < 0.05
