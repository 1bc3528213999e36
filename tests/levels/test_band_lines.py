"""A line that the healthy machine did not have is reported, however loud that machine was in another condition."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from models.levels.contact import LatestContact
from models.levels.judgement import LevelJudge
from models.levels.measures import WindowLevels, hop_levels, level_plan, window_levels
from models.levels.reference import LevelReference, expected_levels, learn_levels
from models.levels.settings import LevelSettings
from models.signals.channels import Channel
from models.signals.waveform import waveform_of

RATE_HZ, HOP, HOPS, SPEED_HZ = 2000.0, 10_000, 12, 22.0
CHANNELS = [
    Channel(name=name, quantity="velocity", location="DE", direction=way, unit="m/s")
    for name, way in (("V", "y"), ("H", "z"))
]
NAMES = [channel.name for channel in CHANNELS]
PLAN = level_plan(CHANNELS, RATE_HZ, (10.0, 1000.0), lines=True)
TIME_S = np.arange(HOP * HOPS) / RATE_HZ


def window(
    seed: int, *, loud: float = 1.0, mesh: float = 0.0, damping: float = 0.02, wander: float = 0.0,
    speed_hz: float = SPEED_HZ, unbalance: float = 0.5, known: bool = True, natural_hz: float = 480.0,
) -> WindowLevels:  # fmt: skip
    """A resonance under noise of level `loud`, 1x, and a mesh of 22 teeth in the first channel.

    The speed may wander up and down within a hop, and the shaft angle be known or not.
    """
    rng = np.random.default_rng([20261240, seed])
    pole = np.exp(2 * np.pi * natural_hz / RATE_HZ * (-damping + 1j))
    noise = lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], rng.standard_normal((2, TIME_S.size)))
    noise = loud * (noise / noise.std() + 0.3 * rng.standard_normal(noise.shape))
    angle = 2 * np.pi * speed_hz * (TIME_S + wander / (2 * np.pi * 0.33) * np.sin(2 * np.pi * 0.33 * TIME_S))
    samples = noise + unbalance * np.cos(angle)
    samples[0] += mesh * np.cos(22 * angle + rng.uniform(0, 2 * np.pi))
    hops = []
    for part, turning in zip(np.split(samples, HOPS, axis=1), np.split(angle, HOPS), strict=True):
        waveform, deviations = waveform_of(part.T)
        speed_rad_s = (turning[-1] - turning[0]) / (HOP / RATE_HZ) if known else np.nan
        hops.append((hop_levels(PLAN, waveform, deviations, turning if known else None), speed_rad_s))
    speeds = np.array([speed for _, speed in hops])
    return window_levels(PLAN, [levels for levels, _ in hops], speeds, phase_reference=known)


def told(levels: WindowLevels, healthy: list[WindowLevels] | LevelReference) -> str:
    judge = LevelJudge(PLAN, CHANNELS, LevelSettings())
    reference = learn_levels("commissioned", NAMES, healthy) if isinstance(healthy, list) else healthy
    reference = type(reference).model_validate_json(reference.model_dump_json())
    return judge.foreign(levels, judge.judge(levels, reference), reference, LatestContact(4), named=False).text


@pytest.fixture(scope="module")
def healthy() -> list[WindowLevels]:
    """Windows of three conditions, one of them ten times as loud as another."""
    return [window(number, loud=loud) for number, loud in enumerate([0.3, 0.3, 1.0, 1.0, 3.0, 3.0])]


def test_a_new_line_is_reported_although_no_level_has_grown(healthy: list[WindowLevels]) -> None:
    levels = window(100, loud=0.3, mesh=0.4)
    text = told(levels, healthy)
    assert "a line within 460 to 487 Hz (20.9 to 22.1 times running speed" in text
    assert "of the vibration of V without its 1x) that the healthy machine did not have" in text
    judged = LevelJudge(PLAN, CHANNELS, LevelSettings()).judge(levels, learn_levels("commissioned", NAMES, healthy))
    assert all(limit.state == "normal" for one in judged for limit in one.limits)


@pytest.mark.parametrize("loud", [0.1, 3.0])
def test_noise_is_no_line_whatever_its_level_or_resonance(healthy: list[WindowLevels], loud: float) -> None:
    for seed in range(200, 204):
        assert told(window(seed, loud=loud), healthy) == ""
        assert "a line" not in told(window(seed, loud=loud, damping=0.008), healthy)


@pytest.mark.filterwarnings("error")
def test_a_weak_line_or_a_dead_signal_is_not_reported(healthy: list[WindowLevels]) -> None:
    assert told(window(300, loud=3.0, mesh=0.3), healthy) == ""
    assert told(window(820, loud=0.0, unbalance=0.0), healthy) == ""


def test_an_unbalance_is_no_new_line() -> None:
    balanced = [window(700 + number, loud=0.3, speed_hz=100.0, unbalance=0.003) for number in range(4)]
    assert "a line" not in told(window(710, loud=0.3, speed_hz=100.0, unbalance=1.0), balanced)


def test_without_a_known_speed_a_line_is_compared_with_all_vibration() -> None:
    healthy = [window(800 + number, loud=0.3, known=False) for number in range(4)]
    text = told(window(810, loud=0.3, mesh=0.4, known=False), healthy)
    assert "a line within 460 to 487 Hz (27% of the vibration of V) that" in text
    assert told(window(811, loud=0.3, mesh=0.4, unbalance=4.0, known=False), healthy) == ""


@pytest.mark.parametrize("wander", [0.0, 0.01])
def test_a_line_of_the_healthy_machine_is_not_new_whether_steadier_or_not(wander: float) -> None:
    geared = [window(400 + number, mesh=0.4, loud=0.3, wander=wander) for number in range(6)]
    for mesh in (0.2, 0.5, 1.0):  # nor is a grown line a rub, as it clips nothing
        assert told(window(500, mesh=mesh, loud=0.3), geared) == ""
    assert "a line" not in told(window(501, mesh=0.5, loud=0.3, wander=0.005), geared)


def test_a_line_hidden_by_noise_or_unsteady_speed_at_commissioning_is_not_new() -> None:
    under_noise = [window(900 + number, mesh=0.15) for number in range(4)]
    assert "a line" not in told(window(910, mesh=0.15, loud=0.1), under_noise)
    spread = [window(920 + number, mesh=0.4, loud=0.3, wander=0.03) for number in range(4)]
    assert "a line" not in told(window(930, mesh=0.4, loud=0.3), spread)


def test_without_lines_at_commissioning_none_are_reported(healthy: list[WindowLevels]) -> None:
    assert level_plan(CHANNELS, RATE_HZ, (10.0, 1000.0)).lines is False
    without = [type(one)(one.values, one.errors, one.vectors, one.bands, one.speed_rad_s, one.hops) for one in healthy]
    assert told(window(600, loud=0.3, mesh=0.4), without) == ""


def by_theory(levels: WindowLevels, damping: float, natural_hz: float = 480.0, speed_hz: float = SPEED_HZ) -> str:
    """What is reported for an uncommissioned machine with this mode."""
    speeds = (0.9 * 2 * np.pi * speed_hz, 1.1 * 2 * np.pi * speed_hz)
    return told(levels, expected_levels(NAMES, levels, speeds, [(natural_hz, damping)]))


@pytest.mark.parametrize("damping", [0.02, 0.001])
def test_an_uncommissioned_machine_is_compared_with_the_lines_of_theory(damping: float) -> None:
    assert not any(by_theory(window(100 + n, damping=damping, loud=loud), damping) for n, loud in enumerate([0.3, 3.0]))
    text = by_theory(window(102, mesh=4.0, damping=damping), damping)
    assert "a line within 4" in text
    assert "that no rotor of the machine file makes" in text


def test_the_skirt_of_a_mode_at_the_edge_of_a_band_is_no_line() -> None:
    bands = window(110).bands
    assert bands is not None
    edge_hz = float(bands.edges_hz[np.searchsorted(bands.edges_hz, 480.0)])
    at_edge = window(117, damping=0.00097, natural_hz=edge_hz)
    assert not by_theory(at_edge, 0.00097, natural_hz=edge_hz)


def test_a_line_at_a_mode_without_damping_is_not_reported() -> None:
    assert not by_theory(window(104, mesh=4.0), 1e-5)
    assert by_theory(window(104, mesh=4.0), 1e-5, natural_hz=700.0)  # a mode at another frequency can


def test_running_speed_away_from_its_mean_is_no_line() -> None:
    slow = replace(window(105, speed_hz=137.0, unbalance=5.0), speed_rad_s=2 * np.pi * 150.0)
    assert not by_theory(replace(slow, speeds_rad_s=2 * np.pi * np.array([142.5, 157.5])), 0.02, speed_hz=150.0)
    assert by_theory(slow, 0.02, speed_hz=150.0)  # as if the speed had been steady
