"""Pulses to shaft angle: jitter, missing and extra pulses, stops, toothed wheels, sampled signals."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.signals.block import FloatArray
from models.signals.keyphasor import EdgeDetector, pulse_train, shaft_angle
from service.interchange.source import SourceError
from tests.interchange.material import RATE_HZ, SPEED_HZ, START, imported, signals, stretches

CHANNELS = """
[channels]
y1 = { column = "x", unit = "um" }
y1_dot = { column = "v", unit = "mm/s" }
"""
TIME = f'[time]\nrate_hz = 2000.0\nstart = "{START}"\n'


def off_by(angle: FloatArray, expected: FloatArray) -> FloatArray:
    """Difference of angles the short way round, rad."""
    return np.asarray(np.abs(np.angle(np.exp(1j * (angle - expected)))))


@pytest.mark.parametrize("per_turn", [1, 24])
@pytest.mark.parametrize("reverse", [False, True])
def test_uniform_rotation_is_recovered(per_turn: int, reverse: bool) -> None:
    pulses = np.arange(0, 5, 1 / (SPEED_HZ * per_turn))
    at = np.arange(0, 4.99, 1 / RATE_HZ)
    angle = shaft_angle(pulse_train(pulses, per_turn), at, reverse=reverse)
    assert off_by(angle, (-1 if reverse else 1) * 2 * np.pi * SPEED_HZ * at).max() < 1e-6
    assert ((angle >= 0) & (angle < 2 * np.pi)).all()


@settings(max_examples=50)
@given(
    seed=st.integers(0, 2**32 - 1),
    marks=st.lists(st.sampled_from(["good", "missing", "extra"]), min_size=12, max_size=12),
    run_up=st.floats(-0.2, 0.2),
)
def test_jitter_missing_and_extra_pulses_are_repaired(seed: int, marks: list[str], run_up: float) -> None:
    missing = [6 + 8 * place for place, mark in enumerate(marks) if mark == "missing"]
    extra = [6 + 8 * place for place, mark in enumerate(marks) if mark == "extra"]
    rng = np.random.default_rng(seed)
    number = np.arange(100.0)
    # number = f t + r t² / 2 solved for t: the speed rises or falls by a fifth.
    f, end = SPEED_HZ, 100 / SPEED_HZ
    r = run_up * f / end
    exact = number / f if abs(r) < 1e-9 else (-f + np.sqrt(f**2 + 2 * r * number)) / r
    jitter = rng.uniform(-0.01, 0.01, 100) / f
    pulses = np.delete(exact + jitter, missing)
    doubled = [exact[place] + jitter[place] + 0.2 / f for place in extra]
    train = pulse_train(np.sort(np.concatenate([pulses, doubled])))
    assert (train.missing, train.extra, train.interruptions) == (len(missing), len(extra), 0)
    at = np.linspace(exact[1], exact[98], 5000)
    turned = f * at + r * at**2 / 2
    assert off_by(shaft_angle(train, at), 2 * np.pi * turned).max() < 2 * np.pi * 0.03


def test_a_stop_leaves_the_angle_unknown() -> None:
    pulses = np.concatenate([np.arange(0, 1, 0.05), np.arange(3.01, 4, 0.05)])
    train = pulse_train(pulses)
    assert train.interruptions == 1
    at = np.array([0.975, 0.999, 1.01, 2.0, 2.95, 2.97, 3.035])
    angle = shaft_angle(train, at)
    assert np.isnan(angle).tolist() == [False, False, True, True, True, False, False]
    assert off_by(angle[[0, 6]], np.pi * np.ones(2)).max() < 1e-6


@pytest.mark.parametrize(
    ("times", "said"),
    [([], "0 pulses"), ([1.0], "1 pulses"), ([0.0, 1.0, 1.0], "pulse 3 at 1"), ([0, np.nan, 2], "pulse 2 has no")],
)
def test_unusable_pulses_are_named(times: list[float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        pulse_train(np.array(times))


@settings(max_examples=50)
@given(cuts=st.lists(st.integers(1, 3999), max_size=8, unique=True), rising=st.booleans())
def test_edges_are_the_same_in_whatever_pieces_the_signal_comes(cuts: list[int], rising: bool) -> None:
    time = np.arange(4000) / RATE_HZ
    noise = 0.3 * np.random.default_rng(2).standard_normal(4000)
    signal = (1 if rising else -1) * (4 * (np.mod(SPEED_HZ * time, 1) > 0.8) + noise)
    level = 2.0 if rising else -2.0
    detector = EdgeDetector(level, 1.5, rising=rising)
    bounds = [0, *sorted(cuts), 4000]
    found = np.concatenate([detector.feed(time[a:b], signal[a:b]) for a, b in itertools.pairwise(bounds)])
    expected = (np.arange(44) + 0.8) / SPEED_HZ
    assert found.size == 44
    assert np.abs(found - expected).max() < 1.01 / RATE_HZ


def test_a_chattering_edge_counts_once_with_hysteresis_and_often_without() -> None:
    time = np.arange(12, dtype=np.float64)
    signal = np.array([0.0, 0, 3, 1.8, 3, 1.9, 3, 0, 0, 3, 3, 0])
    assert EdgeDetector(2.0, 1.0, rising=True).feed(time, signal).size == 2
    assert EdgeDetector(2.0, 0.0, rising=True).feed(time, signal).size == 4


def test_pulse_times_of_a_file_become_its_shaft_angle(tmp_path: Path) -> None:
    _, x, v, angle = signals(20_000)
    pulses = np.arange(0, 10, 1 / SPEED_HZ)
    np.savez(tmp_path / "run.npz", x=x, v=v, k=np.delete(pulses, 50) * 1e3)
    mapping = TIME + CHANNELS + '[keyphasor]\npulse_times = "k"\nunit = "ms"\n'
    done, recording = imported(tmp_path, tmp_path / "run.npz", mapping)
    (found,) = stretches(recording)
    assert done.pulses is not None
    assert done.pulses.missing == 1
    assert found.samples.shape == (20_000, 3)
    assert off_by(found.samples[:, 2], angle).max() < 1e-6


def test_pulses_of_a_time_column_count_from_its_zero(tmp_path: Path) -> None:
    time, x, v, angle = signals(20_000)
    np.savez(tmp_path / "run.npz", t=time + 77, x=x, v=v, k=np.arange(0, 10, 1 / SPEED_HZ) + 77)
    mapping = f'[time]\ncolumn = "t"\nstart = "{START}"\n' + CHANNELS + '[keyphasor]\npulse_times = "k"\n'
    _, recording = imported(tmp_path, tmp_path / "run.npz", mapping)
    assert off_by(stretches(recording)[0].samples[:, 2], angle).max() < 1e-6


def test_a_sampled_tachometer_becomes_the_shaft_angle(tmp_path: Path) -> None:
    time, x, v, angle = signals(140_000)
    teeth = np.sin(8 * 2 * np.pi * SPEED_HZ * time)
    np.savez(tmp_path / "run.npz", x=x, v=v, tacho=2 + teeth)
    mapping = (
        TIME
        + CHANNELS
        + '[keyphasor]\ncolumn = "tacho"\nthreshold = 2.0\nhysteresis = 0.5\npulses_per_revolution = 8\n'
    )
    _, recording = imported(tmp_path, tmp_path / "run.npz", mapping)
    (found,) = stretches(recording)
    # Which of the eight teeth is the first is not known: the angle is right but for a constant eighth.
    difference = np.angle(np.exp(1j * (found.samples[:, 2] - angle[-found.samples.shape[0] :])))
    assert np.ptp(difference) < 0.01
    assert found.samples.shape[0] >= 140_000 - RATE_HZ / SPEED_HZ / 8


def test_where_the_shaft_stood_there_is_a_gap(tmp_path: Path) -> None:
    _, x, v, _ = signals(20_000)
    pulses = np.arange(0, 10, 1 / SPEED_HZ)
    np.savez(tmp_path / "run.npz", x=x, v=v, k=pulses[(pulses < 4) | (pulses > 6)])
    mapping = TIME + CHANNELS + '[keyphasor]\npulse_times = "k"\n'
    done, recording = imported(tmp_path, tmp_path / "run.npz", mapping)
    first, second = stretches(recording)
    assert first.samples.shape[0] + second.samples.shape[0] + done.unknown_angle == 20_000
    assert 2 * RATE_HZ - 2.1 * RATE_HZ / SPEED_HZ < done.unknown_angle < 2 * RATE_HZ


def test_pulses_that_do_not_ascend_are_named(tmp_path: Path) -> None:
    _, x, v, _ = signals(2000)
    np.savez(tmp_path / "run.npz", x=x, v=v, k=np.array([0.0, 0.1, 0.05]))
    with pytest.raises(SourceError, match="keyphasor k: pulse 3 at 50000000 is not later"):
        imported(tmp_path, tmp_path / "run.npz", TIME + CHANNELS + '[keyphasor]\npulse_times = "k"\n')
