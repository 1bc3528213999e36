"""A shaft that touches is told from one that does not, whatever else moves it."""

import numpy as np
import pytest

from models.levels.contact import contact
from models.signals.block import FloatArray

N, SPEED_HZ, MODE_HZ = 10_000, 22.0, 31.0
COUNT = 24  # realisations of each, five seconds at 2 kHz


def told(
    seed: int,
    *,
    clearance: float = np.inf,
    stiff: float = 0.5,
    cubic: float = 0.0,
    line: tuple[float, float] = (0.0, 1.0),
    unbalance: float = 0.3,
    spikes: float = 0.0,
    angle_deg: float = 90.0,
    rate_hz: float = 2000.0,
) -> FloatArray:
    """Of a disc on a shaft of stiffness one, shaken at random to an rms of about one, with noise of one per cent."""
    rng, omega, dt = np.random.default_rng(seed), 2 * np.pi * MODE_HZ, 1 / rate_hz
    n = round(N * rate_hz / 2000.0)
    angle = 2 * np.pi * SPEED_HZ * dt * np.arange(n)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    forced = unbalance * circle + [line[0] * np.cos(line[1] * angle), np.zeros(n)]
    kicks = np.sqrt(0.2 * omega * dt) * omega * rng.standard_normal((n, 2, COUNT))
    kicks += dt * omega**2 * forced.T[:, :, None]
    x, v, seen = np.zeros((2, COUNT)), np.zeros((2, COUNT)), np.empty((n, 2, COUNT))
    for at, kick in enumerate(kicks):
        r2 = x[0] * x[0] + x[1] * x[1]
        stiffness = 1 + cubic * r2
        if r2.max() > clearance**2:
            stiffness += stiff * np.maximum(0, 1 - clearance / np.sqrt(r2 + 1e-9))
        v += kick - (dt * omega**2) * stiffness * x - (0.1 * omega * dt) * v
        x += dt * v
        seen[at] = x
    seen += 0.01 * rng.standard_normal(seen.shape)
    seen += spikes * (rng.random(seen.shape) < 2e-4)
    skew = np.cos(np.radians(angle_deg))
    seen[:, 1] = skew * seen[:, 0] + np.sqrt(1 - skew**2) * seen[:, 1]  # as a probe at that angle to the other sees it
    pairs = (seen - seen.mean(axis=0)).transpose(2, 1, 0)
    return np.array([contact(pair, circle, SPEED_HZ * n * dt, rate_hz, skew) for pair in pairs])


def z(found: FloatArray) -> FloatArray:
    return np.asarray(found.sum(axis=0) / np.sqrt(len(found)), dtype=np.float64)


@pytest.mark.parametrize(
    "how", [{}, {"cubic": 0.05}, {"line": (0.5, 0.6)}, {"line": (0.3, 1.7)}, {"line": (2.0, 4.4)}, {"rate_hz": 4000.0}]
)
def test_without_a_contact_it_is_standard_normal(how: dict[str, float]) -> None:
    found = told(20261126, **how)  # type: ignore[arg-type]
    assert np.all(np.abs(z(found)) < 4.5)
    assert np.all((found.std(axis=0) > 0.6) & (found.std(axis=0) < 1.5))


@pytest.mark.parametrize(("clearance", "stiff", "which"), [(2.5, 1.0, 0), (2.5, 3.0, 0), (1.5, 2.0, 1)])
def test_a_contact_is_seen(clearance: float, stiff: float, which: int) -> None:
    assert z(told(20261127, clearance=clearance, stiff=stiff))[which] > 6


@pytest.mark.parametrize("how", [{"rate_hz": 4000.0}, {"angle_deg": 60.0}])
def test_a_contact_is_seen_as_well_at_another_sampling_rate_or_angle(how: dict[str, float]) -> None:
    assert z(told(20261128, clearance=2.5, stiff=1.0, **how))[0] > 6  # type: ignore[arg-type]


def test_single_samples_that_are_off_are_no_contact() -> None:
    assert np.all(z(told(20261130, spikes=6.0)) < 4.5)


@pytest.mark.parametrize("change", ["short", "dead", "copied"])
def test_it_is_not_known_where_nothing_can_be_told(change: str) -> None:
    pair = np.random.default_rng(20261129).standard_normal((2, 900 if change == "short" else N))
    pair[1] = {"short": pair[1], "dead": 0.0, "copied": pair[0]}[change]
    angle = 0.07 * np.arange(pair.shape[1])
    found = contact(pair, np.stack([np.cos(angle), np.sin(angle)]), 0.07 * pair.shape[1] / (2 * np.pi), 2000.0)
    assert np.all(np.abs(found) < 4.5) if change == "copied" else np.all(np.isnan(found))
