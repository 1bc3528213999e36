"""The kurtosis of a random part against closed forms, and departures from that of a healthy machine."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy.signal import lfilter

from models.levels.contact import LatestContact
from models.levels.judgement import LevelJudge
from models.levels.kurtosis import HopReference, departure, learn_hops
from models.levels.measures import LevelPlan, WindowLevels, level_plan
from models.levels.reference import learn_levels
from models.levels.settings import LevelSettings
from models.signals.block import FloatArray
from models.signals.channels import Channel
from tests.levels.test_measures import taken
from tests.sure import sure

RATE_HZ, HOP_S, HOPS = 1000.0, 5.0, 12
Y = Channel(name="y2", quantity="displacement", location="disc", direction="y", unit="um")
PLAN: LevelPlan = level_plan([Y], RATE_HZ, (10.0, 400.0))
T = np.arange(round(HOPS * HOP_S * RATE_HZ)) / RATE_HZ
THETA = 2 * np.pi * 23.0 * T


def noise(seed: int) -> FloatArray:
    return np.random.default_rng([20261123, seed]).standard_normal(T.size)


def window(samples: FloatArray, *, turning: bool = True, phase: bool = True) -> WindowLevels:
    return taken(PLAN, 1e-6 * samples[:, None], HOPS, THETA if turning else None, phase=turning and phase)


def kurtosis(samples: FloatArray, *, turning: bool = True) -> FloatArray:
    found = sure(window(samples, turning=turning).random_kurtosis)
    return found[:, 0]


@pytest.mark.parametrize("lines", [(0.0, 0.0), (2.0, 0.0), (3.0, 1.0)])
def test_gaussian_vibration_has_kurtosis_three_whatever_its_lines(lines: tuple[float, float]) -> None:
    first, second = lines
    samples = noise(1) + first * np.cos(THETA + 0.4) + second * np.cos(2 * THETA)
    # 5000 samples a hop: their kurtosis scatters by √(24 / 60 000) over twelve of them
    assert kurtosis(samples).mean() == pytest.approx(3, abs=5 * np.sqrt(24 / T.size))


def test_clipping_lowers_kurtosis_and_knocking_raises_it() -> None:
    # A normal variable clipped at 1.5 of its deviations, from its moments: 1.2357 / 0.7785².
    assert kurtosis(np.clip(noise(2), -1.5, 1.5)).mean() == pytest.approx(2.039, abs=0.03)
    knocks = np.zeros(T.size)
    knocks[:: round(RATE_HZ / 10)] = 5.0
    assert kurtosis(noise(3) + knocks).mean() > 6


def test_without_a_known_rotation_there_is_no_kurtosis() -> None:
    found = kurtosis(noise(4), turning=False)
    assert np.all(np.isnan(found))
    assert learn_hops([found]) is None


def reference() -> HopReference:
    return sure(learn_hops([kurtosis(noise(10 + n) + 2 * np.cos(THETA)) for n in range(5)]))


def test_healthy_windows_stay_within_the_limit_and_another_excitation_too() -> None:
    healthy = reference()
    assert healthy.hops == 60
    for n in range(20):
        gain = np.repeat(np.random.default_rng([7, n]).uniform(0.5, 2.0, HOPS), T.size // HOPS)
        samples = gain * noise(100 + n) + (1 + n % 3) * np.cos(THETA)
        assert departure(kurtosis(samples), healthy, 6.0) == 0.0


def test_a_departure_in_the_newest_half_of_a_window_is_detected() -> None:
    healthy, samples = reference(), noise(200) + 2 * np.cos(THETA)
    at = T.size // 2
    samples[at:] = np.clip(samples[at:], -2.5, 2.5)
    assert departure(kurtosis(samples), healthy, 6.0) < 0


def suspects(
    meshes: Sequence[float],
    healthy_mesh: float,
    spoilt: Callable[[FloatArray], FloatArray],
    *,
    phase: bool = True,
    healthy_noise: float = 1.0,
) -> list[str]:
    """Texts for spoilt windows of noise and a gear mesh of these amplitudes, on a commissioned machine."""

    def samples(seed: int, mesh: float, size: float = 1.0) -> FloatArray:
        lines = 2 * np.cos(THETA) + mesh * np.cos(11 * THETA + seed)
        return np.asarray(size * noise(seed) + lines, dtype=np.float64)

    windows = [window(samples(60150 + n, healthy_mesh, healthy_noise), phase=phase) for n in range(5)]
    healthy = learn_levels("commissioned", [Y.name], windows)
    found, judge = [], LevelJudge(PLAN, [Y], LevelSettings())
    for number, mesh in enumerate(meshes):
        levels = window(spoilt(samples(60160 + number, mesh)), phase=phase)
        found.append(judge.foreign(levels, judge.judge(levels, healthy), healthy, LatestContact(4), named=False).text)
    return found


def clipped(samples: FloatArray) -> FloatArray:
    return np.asarray(np.clip(samples, -1.3 * samples.std(), 1.3 * samples.std()), dtype=np.float64)


def knocking(samples: FloatArray) -> FloatArray:
    knocks = np.zeros(T.size)
    knocks[:: round(RATE_HZ / 10)] = 12.0
    return samples + knocks


@pytest.mark.parametrize("healthy_mesh", [0.0, 1.5])
def test_a_gear_mesh_that_grows_or_vanishes_is_no_rub_and_a_rub_is_found(healthy_mesh: float) -> None:
    meshes = (0.0, 0.7, 1.5, 3.0)
    assert suspects(meshes, healthy_mesh, lambda samples: samples) == [""] * 4
    assert all("clipped, as by a rub" in one for one in suspects(meshes, healthy_mesh, clipped))
    assert all(") with impacts" in one for one in suspects(meshes[:2], healthy_mesh, knocking))


def cycling(samples: FloatArray) -> FloatArray:
    """The samples with a random part that doubles every ten seconds, and the same rotation."""
    steady = 2 * np.cos(THETA)
    return np.asarray((samples - steady) * (1.5 + 0.5 * np.cos(2 * np.pi * T / 10)) + steady, dtype=np.float64)


def test_a_cycling_load_is_no_impact_and_impacts_beside_it_are_found() -> None:
    """Over a cycle such a force makes a kurtosis of 3.6, which healthy recordings of a steady load never have."""
    assert suspects((0.0,) * 4, 0.0, cycling) == [""] * 4
    assert all("with impacts" in one for one in suspects((0.0,) * 4, 0.0, lambda samples: knocking(cycling(samples))))


def test_kurtosis_does_not_depend_on_the_beat_of_a_line_beside_the_rotation() -> None:
    """Otherwise kurtosis would vary with the beat frequency, and so with the slip of a motor."""
    found = []
    for number, beside_hz in enumerate((0.3, 0.6, 1.0, 1.3)):
        lines = 2 * np.cos(THETA) + 1.5 * np.cos(THETA + 2 * np.pi * beside_hz * T)
        found.append(kurtosis(np.asarray(0.5 * noise(400 + number) + lines, dtype=np.float64)).mean())
    assert np.ptp(found) < 0.1


def test_a_steady_load_after_commissioning_under_a_cycling_one_is_no_rub() -> None:
    healthy = sure(learn_hops([kurtosis(cycling(noise(300 + n) + 2 * np.cos(THETA))) for n in range(5)]))
    for n in range(4):
        assert departure(kurtosis(noise(320 + n) + 2 * np.cos(THETA)), healthy, 6.0) == 0.0


LATE = np.arange(T.size) >= round(0.63 * T.size)  # in the midst of a hop


def meshing_late(samples: FloatArray) -> FloatArray:
    return np.asarray(samples + np.where(LATE, 2.0 * np.cos(11 * THETA), 0.0), dtype=np.float64)


@pytest.mark.parametrize(
    "spoilt",
    [
        lambda samples: np.where(LATE, 2.0, 1.0) * samples,
        lambda samples: samples + 40.0 * (np.arange(T.size) == T.size - 3000),
        lambda samples: samples + 1.5 * np.cos(2 * np.pi * 46.6 * T),  # beside 2x at 46 Hz
        meshing_late,
    ],
    ids=["step", "knock", "hum", "mesh"],
)
def test_a_step_a_single_knock_hum_and_a_new_line_are_neither_rub_nor_impact(
    spoilt: Callable[[FloatArray], FloatArray],
) -> None:
    assert suspects((0.0, 0.0, 0.0), 0.0, spoilt) == [""] * 3


def test_a_rub_is_found_beside_a_line_that_begins() -> None:
    (found,) = suspects((0.0,), 0.0, lambda samples: clipped(meshing_late(samples)))
    assert "clipped, as by a rub" in found


def test_a_lower_threshold_detects_a_smaller_departure() -> None:
    healthy = HopReference(mean=3.0, scatter=0.1, hops=1000, range=0.0)
    by_five_errors = np.full(HOPS, 3.0 - 5 * 0.1 / np.sqrt(HOPS))
    assert departure(by_five_errors, healthy, 6.0) == 0.0
    assert departure(by_five_errors, healthy, 4.0) == pytest.approx(-0.144, abs=1e-3)


@pytest.mark.parametrize(("scatter", "is_clipped"), [(0.009, False), (0.003, True)])
def test_a_kurtosis_that_falls_and_scatters_more_is_no_clipping(scatter: float, *, is_clipped: bool) -> None:
    """As of a random part that grew beside its 1x, because the bearing had lost 40 % of its damping."""
    healthy = HopReference(mean=3.0, scatter=0.003, hops=78, range=0.001)
    hops = 2.994 + scatter * np.resize([-1.0, 1.0], HOPS)
    assert (departure(hops, healthy, 4.0) < 0) == is_clipped


def test_a_random_part_that_has_grown_beside_its_1x_is_no_impact_and_impacts_in_it_are_found() -> None:
    """A force of another direction: the kurtosis of the whole then scatters more, because less of it is the 1x."""
    assert suspects([0.0] * 10, 0.0, lambda samples: samples, healthy_noise=0.1) == [""] * 10
    assert all("with impacts" in one for one in suspects([0.0] * 4, 0.0, knocking, healthy_noise=0.1))
    assert all("clipped, as by a rub" in one for one in suspects([0.0] * 4, 0.0, clipped, healthy_noise=0.1))


def ringing(samples: FloatArray, frequency_hz: float = 20.0, damping: float = 0.007) -> FloatArray:
    """A mode excited by the samples."""
    w = 2 * np.pi * frequency_hz / RATE_HZ
    r = np.exp(-damping * w)
    filtered = lfilter([1.0], [1.0, -2 * r * np.cos(w), r * r], samples - 2 * np.cos(THETA))
    return np.asarray(filtered / filtered.std() + 0.5 * np.cos(THETA), dtype=np.float64)


def test_beats_of_a_narrow_mode_are_hardly_ever_a_rub_and_a_rub_beside_them_is_found() -> None:
    """A hop holds six of its beats: kurtosis falls from 3 to 2.2, which was called clipping in 8 of 24 windows."""
    assert sum(map(bool, suspects([0.0] * 24, 0.0, ringing))) <= 2
    assert all("clipped, as by a rub" in one for one in suspects([0.0] * 4, 0.0, lambda one: clipped(ringing(one))))


def test_beats_are_no_rub_in_a_window_whose_hops_differ_little_by_chance() -> None:
    """In its band, the mode has few degrees of freedom in a hop; 4 of 40 windows were called clipped."""
    assert sum(map(bool, suspects([0.0] * 40, 0.0, lambda samples: ringing(samples, 12.0, 0.012)))) <= 1


def test_vibration_that_grows_or_one_disturbed_hop_is_no_2x_and_a_2x_that_begins_in_the_window_is_found() -> None:
    assert suspects([0.0] * 20, 0.0, lambda samples: np.where(LATE, 20.0, 1.0) * samples) == [""] * 20
    hop = np.where(T // HOP_S == 4, 6 * np.cos(2 * THETA), 0.0)
    assert suspects([0.0] * 4, 0.0, lambda samples: samples + hop) == [""] * 4
    twice = np.where(LATE, 3 * np.cos(2 * THETA + 1), 0.0)
    assert all(" 2x " in one for one in suspects([0.0] * 4, 0.0, lambda samples: samples + twice))


@pytest.mark.parametrize("phase", [True, False])
def test_louder_vibration_is_no_2x_and_a_2x_within_it_is_found(*, phase: bool) -> None:
    def louder(samples: FloatArray) -> FloatArray:
        return np.asarray(10 * (samples - 2 * np.cos(THETA)) + 2 * np.cos(THETA), dtype=np.float64)

    assert suspects([0.0] * 6, 0.0, louder, phase=phase) == [""] * 6
    twice = 6 * np.cos(2 * THETA + 1)
    assert all(suspects([0.0] * 4, 0.0, lambda samples: louder(samples) + twice, phase=phase))
