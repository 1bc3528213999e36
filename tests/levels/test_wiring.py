"""Sensors of a place that were exchanged or reversed together, against what a machine does."""

import numpy as np
import numpy.typing as npt
import pytest

from models.levels.places import rewired
from models.signals.channels import Channel
from tests.sure import sure

CHANNELS = [
    Channel.model_validate(
        {"name": f"{way}{number}{rate}", "quantity": quantity, "location": place, "direction": way, "unit": unit}
    )
    for place, number in (("bearing", 1), ("disc", 2))
    for way in "yz"
    for quantity, rate, unit in (("displacement", "", "um"), ("velocity", "_dot", "mm/s"))
]
HOPS = 12
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
    found = sure(rewired(hops(now, 1), HEALTHY, CHANNELS))
    assert (found.kind, found.value) == ("gain", -2.0)
    assert found.states == tuple(CHANNELS[column].name for column in columns)
    assert "reversed" in found.text


@pytest.mark.parametrize(("one", "other"), [([0, 1], [2, 3]), ([4, 5], [6, 7]), ([0, 1], [6, 7])])
def test_exchanged_places_are_told(one: list[int], other: list[int]) -> None:
    now = HEALTHY.copy()
    now[one + other] = HEALTHY[other + one]
    found = sure(rewired(hops(now, 2), HEALTHY, CHANNELS))
    assert found.kind == "swapped"
    assert found.states == tuple(CHANNELS[column].name for column in one + other)


def test_three_hops_are_enough_and_fewer_are_not() -> None:
    now, reversed_y1 = hops(HEALTHY, 3), hops(HEALTHY, 3)
    reversed_y1[:, :2] *= -1
    assert rewired(np.concatenate([now[2:], reversed_y1[:2]]), HEALTHY, CHANNELS) is None
    found = sure(rewired(np.concatenate([now[3:], reversed_y1[:3]]), HEALTHY, CHANNELS))
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
    assert rewired(hops(np.asarray(factor, dtype=np.complex128) * HEALTHY, 4), HEALTHY, CHANNELS) is None


def test_vectors_that_noise_hides_tell_nothing() -> None:
    now = HEALTHY.copy()
    now[:2] *= -1
    assert rewired(hops(now, 5, noise=1.0), HEALTHY, CHANNELS) is None
