"""Wrong gains, exchanged and reversed places are distinguished from changes of the machine and of its excitation."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from models.levels.bands import BandLevels
from models.levels.contact import LatestContact
from models.levels.judgement import LevelJudge
from models.levels.measures import WindowLevels, level_plan
from models.levels.places import GainReference, learn_gains, left_of_1x, rewired, wrong_gain
from models.levels.reference import learn_levels
from models.levels.settings import LevelSettings
from models.signals.channels import Channel
from tests.levels.test_measures import taken
from tests.sure import sure

RATE_HZ, HOP_S, HOPS = 1000.0, 5.0, 12
PLACES = ("bearing y", "disc y", "disc z")
RESONANCES_HZ = (40.0, 60.0, 90.0)
CHANNELS = [
    Channel(name=name, quantity="displacement", location=place, direction=way, unit="um")
    for name, place, way in (("y1", "bearing", "y"), ("y2", "disc", "y"), ("z2", "disc", "z"))
]
PLAN = level_plan(CHANNELS, RATE_HZ, (10.0, 400.0))


def whole(
    seed: int,
    resonances_hz: Sequence[float] = RESONANCES_HZ,
    gains: Sequence[float] = (1.0, 1.0, 1.0),
    pole: float = 0.5,
) -> WindowLevels:
    """Shared noise, coloured by `pole`, and some independent noise, through a resonance at each place."""
    rng, n = np.random.default_rng([20261130, seed]), round(HOPS * HOP_S * RATE_HZ)
    shared = lfilter([1 - pole], [1, -pole], rng.standard_normal(n))
    columns = []
    for gain, hz in zip(gains, resonances_hz, strict=True):
        root = 0.9 * np.exp(2j * np.pi * hz / RATE_HZ)
        force = shared + 0.1 * rng.standard_normal(n)
        columns.append(gain * lfilter([1.0], [1, -2 * root.real, abs(root) ** 2], force))
    return taken(PLAN, 1e-6 * np.column_stack(columns), HOPS)


def window(*of: Any, **settings: Any) -> BandLevels:
    return sure(whole(*of, **settings).bands)


@pytest.fixture(scope="module")
def reference() -> GainReference:
    """Learned from two recordings with excitation of two colours."""
    return sure(
        learn_gains(PLACES, [[window(10 * n + k, pole=pole) for k in range(4)] for n, pole in ((1, 0.5), (2, 0.8))])
    )


@pytest.mark.parametrize("at", range(3))
@pytest.mark.parametrize("gain", [0.75, 1.2])
def test_a_wrong_gain_is_named_with_its_place(reference: GainReference, at: int, gain: float) -> None:
    gains = [1.0, 1.0, 1.0]
    gains[at] = gain
    found = sure(wrong_gain(window(100 + at, gains=gains, pole=0.8), PLACES, reference))
    assert found[0] == PLACES[at]
    assert found[1] == pytest.approx(gain, rel=0.03)


def test_a_moved_resonance_or_a_changed_excitation_is_no_wrong_gain(reference: GainReference) -> None:
    for resonances_hz in ((36.0, 60.0, 90.0), (40.0, 52.0, 90.0), (40.0, 60.0, 100.0)):
        assert wrong_gain(window(200, resonances_hz), PLACES, reference) is None
    for seed, gain, pole in ((300, 1.0, 0.5), (301, 2.0, 0.8), (302, 0.5, 0.2), (303, 1.0, 0.95)):
        assert wrong_gain(window(seed, gains=(gain,) * 3, pole=pole), PLACES, reference) is None


@pytest.mark.parametrize(("at", "held"), [(0, True), (1, False)])
def test_a_wrong_gain_says_whether_a_bearing_or_support_holds_its_place(
    reference: GainReference, at: int, *, held: bool
) -> None:
    healthy = learn_levels("commissioned", [one.name for one in CHANNELS], [whole(10), whole(11)], reference)
    judge, now = (
        LevelJudge(PLAN, CHANNELS, LevelSettings()),
        whole(150, gains=[1.2 if n == at else 1.0 for n in range(3)]),
    )
    found = judge.foreign(now, judge.judge(now, healthy), healthy, LatestContact(4), named=False)
    assert found.text.startswith(f"gain of {CHANNELS[at].name}")
    assert found.held == held


def test_dead_channels_and_other_places_or_bands_give_no_wrong_gain(reference: GainReference) -> None:
    now = window(400)
    dead = replace(now, rms=now.rms * [0.0, 1.0, 1.0])
    assert wrong_gain(dead, PLACES, reference) is None
    assert wrong_gain(now, ("bearing z", "disc y", "disc z"), reference) is None
    assert wrong_gain(replace(now, edges_hz=1.1 * now.edges_hz), PLACES, reference) is None


@pytest.mark.parametrize(
    ("changes", "fits"),
    [
        ((0.15, 0.0, 0.0), True),  # a gain
        ((0.35, 0.2, 0.2), True),  # and a heavier unbalance
        ((0.12, -0.04, 0.0), False),  # a bearing moves the disc, too
        ((np.nan, 0.0, 0.0), True),  # nothing is known
    ],
)
def test_changes_of_1x_support_or_contradict_a_wrong_gain(changes: tuple[float, ...], *, fits: bool) -> None:
    errors = np.array([0.01, 0.004, 0.004])
    left = left_of_1x(np.array(changes), errors, PLACES, "bearing y", float(np.exp(0.15)))
    assert left == 0 if fits else left > 20


def test_two_sensors_of_a_place_count_once() -> None:
    changes, errors, places = np.array([0.12, -0.04, 0.0]), np.full(3, 0.004), ("bearing y", "disc y", "disc z")
    once = left_of_1x(changes, errors, places, "bearing y", 1.15)
    assert left_of_1x(np.tile(changes, 2), np.tile(errors, 2), 2 * places, "bearing y", 1.15) == pytest.approx(once)


def test_gains_are_not_learned_from_windows_that_cannot_be_compared() -> None:
    windows = [window(500), window(501)]
    assert learn_gains(PLACES, [windows]) is not None
    assert learn_gains(PLACES, [windows[:1], windows[1:]]) is None  # no scatter
    assert learn_gains(("bearing y", "bearing y", "disc y"), [windows]) is None  # which of two has changed?


PAIRED = [
    Channel.model_validate(
        {"name": f"{way}{number}{rate}", "quantity": quantity, "location": place, "direction": way, "unit": unit}
    )
    for place, number in (("bearing", 1), ("disc", 2))
    for way in "yz"
    for quantity, rate, unit in (("displacement", "", "um"), ("velocity", "_dot", "mm/s"))
]
Vectors = npt.NDArray[np.complex128]
# y1, y1_dot, z1, z1_dot, y2, ...
HEALTHY: Vectors = np.array([3, 3j, -2j, 2, 5 + 1j, 5j - 1, 1 - 4j, 1j + 4], dtype=np.complex128)


def hops(vectors: Vectors, seed: int, noise: float = 0.15) -> Vectors:
    rng = np.random.default_rng([2612100, seed])
    parts = rng.standard_normal((2, HOPS, len(vectors)))
    return np.asarray(vectors + noise * np.abs(vectors) * (parts[0] + 1j * parts[1]) / np.sqrt(2))


@pytest.mark.parametrize("columns", [[0, 1], [4, 5], [0, 1, 2, 3], [2, 3, 4, 5, 6, 7]])
def test_reversed_places_are_told(columns: list[int]) -> None:
    now = HEALTHY.copy()
    now[columns] *= -1
    found = sure(rewired(hops(now, 1), HEALTHY, PAIRED))
    assert (found.kind, found.value) == ("gain", -2.0)
    assert found.states == tuple(PAIRED[column].name for column in columns)
    assert "reversed" in found.text


@pytest.mark.parametrize(("one", "other"), [([0, 1], [2, 3]), ([4, 5], [6, 7]), ([0, 1], [6, 7])])
def test_exchanged_places_are_told(one: list[int], other: list[int]) -> None:
    now = HEALTHY.copy()
    now[one + other] = HEALTHY[other + one]
    found = sure(rewired(hops(now, 2), HEALTHY, PAIRED))
    assert found.kind == "swapped"
    assert found.states == tuple(PAIRED[column].name for column in one + other)


def test_three_hops_are_enough_and_fewer_are_not() -> None:
    now, reversed_y1 = hops(HEALTHY, 3), hops(HEALTHY, 3)
    reversed_y1[:, :2] *= -1
    assert rewired(np.concatenate([now[2:], reversed_y1[:2]]), HEALTHY, PAIRED) is None
    found = sure(rewired(np.concatenate([now[3:], reversed_y1[:3]]), HEALTHY, PAIRED))
    assert found.states == ("y1", "y1_dot")


@pytest.mark.parametrize(
    "factor",
    [
        np.ones(8), -np.ones(8), 1.5 * np.ones(8), np.exp(0.8j) * np.ones(8),  # all alike, as of an unbalance
        [-1, 1, 1, 1, 1, 1, 1, 1],  # one sensor of a place: its other one tells
        [-0.5, -0.5, 1, 1, 1, 1, 1, 1], [-1, -1, 1, 1, 0.6, 0.6, 1, 1],  # a bearing
        [-1, -1, 1, 1, -1, -1, 1, 1],  # a plane that runs above its critical speed instead of below
    ],
)  # fmt: skip
def test_what_a_machine_does_is_no_wiring(factor: npt.ArrayLike) -> None:
    assert rewired(hops(np.asarray(factor, dtype=np.complex128) * HEALTHY, 4), HEALTHY, PAIRED) is None


def test_vectors_that_noise_hides_tell_nothing() -> None:
    now = HEALTHY.copy()
    now[:2] *= -1
    assert rewired(hops(now, 5, noise=1.0), HEALTHY, PAIRED) is None
