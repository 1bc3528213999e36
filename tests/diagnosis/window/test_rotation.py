"""The hops whose lines belong to one shaft."""

from dataclasses import replace

import numpy as np
import pytest

from models.diagnosis.window.rotation import RotationLine, followed_speeds, rotation_line, settled_hops
from models.signals.block import FloatArray
from tests.sure import sure

HOP_S, HOPS, SPEED_HZ = 5.0, 12, 15.0
SEED = 51_900


def lines(seed: int, wander_hz: float, sweep_hz_s: float, strength: float = 30.0) -> tuple[RotationLine, ...]:
    rng = np.random.default_rng(SEED + seed)
    speeds, sweeps = SPEED_HZ + wander_hz * rng.standard_normal(HOPS), sweep_hz_s * rng.standard_normal(HOPS)
    return tuple(RotationLine(2 * np.pi * f, 2 * np.pi * s, strength) for f, s in zip(speeds, sweeps, strict=True))


def test_a_steady_shaft_is_followed_despite_errors_of_its_sweeps() -> None:
    """On a machine that vibrates mostly at its resonance: lines to 0.01 Hz, sweeps to 0.02 Hz/s."""
    for seed in range(50):
        speeds = sure(followed_speeds(lines(seed, 0.01, 0.02), HOP_S))
        assert np.all(np.abs(speeds / (2 * np.pi) - SPEED_HZ) < 0.06)


def test_a_hop_with_another_peak_is_left_out() -> None:
    steady = lines(0, 0.01, 0.02)
    other = RotationLine(2 * np.pi * 15.5, 0.0, 8.0)
    speeds = sure(followed_speeds((*steady[:4], other, *steady[5:9], None, *steady[10:]), HOP_S))
    assert np.flatnonzero(~np.isfinite(speeds)).tolist() == [4, 9]


def test_a_line_wandering_like_a_resonance_peak_is_no_shaft() -> None:
    followed = [followed_speeds(lines(seed, 0.15, 0.02), HOP_S) is not None for seed in range(200)]
    assert np.mean(followed) < 0.05


@pytest.mark.parametrize("to", [0.7, 0.97, 1.3])
def test_a_drive_is_followed_at_each_set_point(to: float) -> None:
    """Between them one hop holds no line, and its neighbours may have a part of the change."""
    turning, lost = lines(3, 0.01, 0.02), RotationLine(2 * np.pi * 16.1, 0.0, 2.0)
    other = tuple(RotationLine(to * one.speed_rad_s, one.sweep_rad_s2, one.strength) for one in turning)
    drive = (*turning[:6], lost, *other[7:])
    speeds = sure(followed_speeds(drive, HOP_S))
    hz = np.delete(speeds, 6) / (2 * np.pi)
    assert np.all(np.abs(hz - np.repeat([SPEED_HZ, to * SPEED_HZ], [6, 5])) < 0.06)
    assert np.flatnonzero(~settled_hops(drive, speeds, HOP_S)).tolist() == [5, 6, 7]


def test_a_ramp_is_settled_only_if_the_sweeps_confirm_it() -> None:
    rng = np.random.default_rng(SEED)
    hz = SPEED_HZ + 0.25 * np.clip(np.arange(HOPS) - 3.5, 0.0, 6.0)  # from the fifth hop to the tenth
    sweeps = np.repeat([0.0, 0.05, 0.0], [4, 6, 2]) + 0.001 * rng.standard_normal(HOPS)
    ramp = tuple(RotationLine(2 * np.pi * f, 2 * np.pi * s, 30.0) for f, s in zip(hz, sweeps, strict=True))
    speeds = sure(followed_speeds(ramp, HOP_S))
    assert settled_hops(ramp, speeds, HOP_S).all()
    smeared = tuple(replace(one, strength=5.0 if one.sweep_rad_s2 > 0.1 else 100.0) for one in ramp)
    assert np.flatnonzero(settled_hops(smeared, speeds, HOP_S)).tolist() == [0, 1, 2, 11]
    stairs = tuple(RotationLine(one.speed_rad_s, 0.0, one.strength) for one in ramp)
    assert not settled_hops(stairs, speeds, HOP_S)[4:10].any()


@pytest.mark.parametrize("weak", [range(6, 12), range(11, 12), range(3, 4)])
def test_weaker_lines_at_the_same_speed_leave_all_hops_settled(weak: range) -> None:
    steady = lines(5, 0.01, 0.02, strength=100.0)
    grown = tuple(
        replace(one, strength=30.0 if n == 11 else 15.0) if n in weak else one for n, one in enumerate(steady)
    )
    assert settled_hops(grown, sure(followed_speeds(grown, HOP_S)), HOP_S).all()


def test_faint_lines_leave_all_hops_settled() -> None:
    weak = lines(4, 0.01, 0.02, strength=8.0)
    speeds = sure(followed_speeds((*weak[:5], None, *weak[6:]), HOP_S))
    assert settled_hops((*weak[:5], None, *weak[6:]), speeds, HOP_S).all()


RATE_HZ, SHAFT_HZ = 500.0, 22.0


TIME_S = np.arange(round(62.5 * RATE_HZ)) / RATE_HZ
HOP = round(HOP_S * RATE_HZ)


def heard(angle: FloatArray, snr: float | FloatArray) -> FloatArray:
    """Two channels of a minute, in white noise, of a shaft at these angles."""
    noise = np.random.default_rng(SEED).standard_normal((2, TIME_S.size))
    return np.asarray(snr * np.cos(angle - [[0.0], [1.0]]) + noise, dtype=np.float64)


def hunting(part: float, every_s: float, snr: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """The channels, and the angle of a shaft whose speed swings by `part`."""
    angle = 2 * np.pi * SHAFT_HZ * (TIME_S - part * every_s / (2 * np.pi) * np.cos(2 * np.pi * TIME_S / every_s))
    return heard(angle, snr), angle


def found_in(channels: FloatArray) -> tuple[RotationLine, ...]:
    """The line of each hop, with half of a hop before it."""
    parts = (channels[:, first : first + HOP + HOP // 2] for first in range(0, TIME_S.size - HOP // 2 - HOP + 1, HOP))
    return tuple(sure(rotation_line(part, RATE_HZ, 2 * np.pi * SHAFT_HZ, 0.05)) for part in parts)


@pytest.mark.parametrize("every_s", [2.0, 3.3, 5.0, 6.5, 20.0])
@pytest.mark.parametrize("part", [0.01, 0.03])
def test_a_speed_that_hunts_is_followed_within_a_hop(part: float, every_s: float) -> None:
    channels, angle = hunting(part, every_s)
    found, t_s = found_in(channels), TIME_S[: HOP + HOP // 2]
    for number, line in enumerate(found):
        true = angle[number * HOP : number * HOP + t_s.size]
        assert np.std(np.unwrap(line.angle(t_s - t_s.mean() - 0.5 / RATE_HZ) - true)) < 0.35
    speeds = sure(followed_speeds(found, HOP_S))
    assert np.isfinite(speeds).all()
    assert settled_hops(found, speeds, HOP_S).all()


@pytest.mark.parametrize(("part", "ramp_s"), [(0.004, 1.0), (0.013, 5.0), (-0.02, 14.0)])
def test_hops_in_which_a_drive_begins_or_ends_a_ramp_are_not_settled(part: float, ramp_s: float) -> None:
    begin_s = 29.0
    ramped_s = np.clip(TIME_S - begin_s, 0.0, ramp_s)
    after_s = np.clip(TIME_S - begin_s - ramp_s, 0.0, None)
    angle = 2 * np.pi * SHAFT_HZ * (TIME_S + part * (ramped_s**2 / (2 * ramp_s) + after_s))
    lines = found_in(heard(angle, 10.0))
    bends = {int(at_s // HOP_S) for at_s in (begin_s, begin_s + ramp_s)}
    settled = settled_hops(lines, sure(followed_speeds(lines, HOP_S)), HOP_S)
    assert bends <= set(np.flatnonzero(~settled).tolist()) <= {*range(min(bends) - 1, max(bends) + 2)}


def test_a_line_that_changes_at_one_speed_leaves_all_hops_settled() -> None:
    angle = 2 * np.pi * SHAFT_HZ * TIME_S + np.where(TIME_S > 33.0, 0.5, 0.0)
    lines = found_in(heard(angle, np.where(TIME_S > 33.0, 14.0, 10.0)))
    assert settled_hops(lines, sure(followed_speeds(lines, HOP_S)), HOP_S).all()


@pytest.mark.parametrize("tolerance", [0.0, 1e-4, 0.003, 0.02, 0.05])
@pytest.mark.parametrize("size", [600, 3750, 8001])
def test_a_narrow_band_is_searched_as_far_as_it_goes(tolerance: float, size: int) -> None:
    """In a band of few samples, a swing would not be determined."""
    channels, _ = hunting(0.03, 5.0)
    for shaft_hz in (1.5, SHAFT_HZ, 200.0):
        line = rotation_line(channels[:, :size], RATE_HZ, 2 * np.pi * shaft_hz, tolerance)
        assert line is None or np.isfinite(line.angle(np.linspace(-1.0, 1.0, 5))).all()


def test_a_steady_speed_does_not_swing() -> None:
    """However strong its line is."""
    for snr in (0.3, 0.5, 1.0, 10.0):
        channels, _ = hunting(0.0, 5.0, snr)
        for first in range(0, channels.shape[1] - 3750, 2500):
            line = sure(rotation_line(channels[:, first : first + 3750], RATE_HZ, 2 * np.pi * SHAFT_HZ, 0.05))
            assert line.swing == ()


def test_a_single_hop_is_settled() -> None:
    (first, *_) = lines(6, 0.01, 0.02, strength=100.0)
    assert settled_hops((first,), sure(followed_speeds((first,), HOP_S)), HOP_S).tolist() == [True]
