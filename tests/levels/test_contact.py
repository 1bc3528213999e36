"""Contact of a shaft is detected, whatever else moves the shaft."""

from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from models.levels.bands import BandLevels
from models.levels.contact import LatestContact, contact
from models.levels.judgement import LevelJudge
from models.levels.kurtosis import HopReference
from models.levels.measures import WindowLevels, level_plan
from models.levels.reference import LevelReference, OperatingState, expected_levels
from models.levels.settings import LevelSettings
from models.physics.rotor import RotorParameters, system_A
from models.signals.block import FloatArray
from tests.levels.test_measures import channel

N, SPEED_HZ, MODE_HZ = 10_000, 22.0, 31.0
COUNT = 24  # realisations of each, five seconds at 2 kHz
ROTOR = {
    "m1_kg": 0.897, "m2_kg": 2.87, "I2_kg_m2": 0.0374, "I2p_kg_m2": 0.0591,
    "shaft_length_m": 0.494, "shaft_diameter_m": 0.02558, "shaft_E_Pa": 2.07e11,
    "k_by_N_per_m": 106_600.0, "k_bz_N_per_m": 109_200.0, "c_by_N_s_per_m": 20.4, "c_bz_N_s_per_m": 20.7, "e_m": 5e-5,
}  # fmt: skip


def told(
    seed: int, *, clearance: float = np.inf, stiff: float = 0.5, cubic: float = 0.0, unbalance: float = 0.3,
    line: tuple[float, float] = (0.0, 1.0), spikes: float = 0.0, angle_deg: float = 90.0, rate_hz: float = 2000.0,
    velocity: bool = False, mode_hz: float = MODE_HZ,
) -> FloatArray:  # fmt: skip
    """Contact statistics of a disc on a shaft of stiffness one, random motion of rms about one, and 1 % noise."""
    rng, omega, dt = np.random.default_rng(seed), 2 * np.pi * mode_hz, 1 / rate_hz
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
        seen[at] = v / omega if velocity else x
    seen += 0.01 * rng.standard_normal(seen.shape)
    seen += spikes * (rng.random(seen.shape) < 2e-4)
    skew = np.cos(np.radians(angle_deg))
    seen[:, 1] = skew * seen[:, 0] + np.sqrt(1 - skew**2) * seen[:, 1]  # as a probe at that angle to the other sees it
    pairs = (seen - seen.mean(axis=0)).transpose(2, 1, 0)
    return np.array([contact(pair, circle, SPEED_HZ * n * dt, rate_hz, skew, velocity) for pair in pairs])


def of_a_rotor(seed: int, hops: int = 48) -> FloatArray:
    """Hops of a healthy rotor at its bearing, sampled 117 times a turn, with noise of two per cent."""
    rate_hz, speed_hz, n = 2560.0, 21.9, 12_800
    rng, rotor = np.random.default_rng(seed), RotorParameters.model_validate(ROTOR)
    forces = rng.standard_normal(((hops + 1) * n, 4)) * [0.6, 0.5, 0.9, 0.7]
    pole = np.exp(2 * np.pi * 88.4 / rate_hz * np.exp(0.75j * np.pi))
    forces = lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], forces, axis=0)
    values, modes = np.linalg.eig(system_A(rotor, 2 * np.pi * speed_hz))
    inputs = np.linalg.inv(modes)[:, [6, 7, 9, 10]] / ([rotor.m1_kg, rotor.m2_kg] * 2)
    pair = np.zeros((2, len(forces)))
    for value, mode, into in zip(values, modes[[0, 3]].T, inputs, strict=True):
        if value.imag > 0:
            pair += 2 * np.outer(mode, lfilter([0.0, 1.0], [1.0, -np.exp(value / rate_hz)], forces @ into)).real
    pair /= pair.std(axis=1, keepdims=True)
    angle = 2 * np.pi * speed_hz / rate_hz * np.arange(len(forces))
    circle = np.stack([np.cos(angle), np.sin(angle)])
    pair += 0.5 * circle + 0.02 * rng.standard_normal(pair.shape)
    parts = [slice(at * n, (at + 1) * n) for at in range(1, hops + 1)]
    means = [pair[:, part].mean(axis=1, keepdims=True) for part in parts]
    turns = speed_hz * n / rate_hz
    return np.array([contact(pair[:, p] - m, circle[:, p], turns, rate_hz) for p, m in zip(parts, means, strict=True)])


def z(found: FloatArray) -> FloatArray:
    return np.asarray(found.sum(axis=0) / np.sqrt(len(found)), dtype=np.float64)


@pytest.mark.parametrize(
    ("velocity", "how"),
    [
        *((False, how) for how in ({}, {"cubic": 0.05}, {"line": (0.5, 0.6)}, {"rate_hz": 4000.0})),
        *((True, how) for how in ({}, {"unbalance": 3.0}, {"spikes": 6.0})),
        *(
            pytest.param(velocity, how, marks=pytest.mark.long)
            for velocity, how in (
                (False, {"line": (2.0, 4.4)}), (True, {"line": (0.5, 0.6)}), (True, {"rate_hz": 4000.0}),
            )
        ),
    ],
)  # fmt: skip
def test_without_contact_it_is_standard_normal_or_lower_for_velocities(velocity: bool, how: dict[str, Any]) -> None:
    found = told(20261131 if velocity else 20261126, velocity=velocity, **how)
    assert np.all(z(found) < 4.5)
    assert velocity or np.all(z(found) > -4.5)
    assert np.all((found.std(axis=0) > 0.6) & (found.std(axis=0) < 1.5))


def test_a_slow_rotor_sampled_many_times_a_turn_is_not_pushed_back() -> None:
    found = np.concatenate([of_a_rotor(seed) for seed in range(2637002, 2637005)])
    assert np.all(found.mean(axis=0) < 0.5)


@pytest.mark.parametrize(
    ("which", "seed", "how"),
    [
        (0, 20261127, {"clearance": 2.5, "stiff": 1.0}),
        (1, 20261132, {"clearance": 1.5, "stiff": 2.0, "velocity": True}),
        *((0, 20261128, {"clearance": 2.5, "stiff": 1.0} | how) for how in ({"rate_hz": 4000.0}, {"angle_deg": 60.0})),
        (0, 20261127, {"clearance": 2.8, "stiff": 4.0, "mode_hz": 200.0}),  # it lasts for a few samples
    ],
)  # fmt: skip
def test_a_contact_is_detected_for_any_quantity_rate_and_probe_angle(
    which: int, seed: int, how: dict[str, Any]
) -> None:
    assert z(told(seed, **how))[which] > 6


def test_velocities_are_used_at_places_without_two_displacements() -> None:
    def contacts(*channels: tuple[str, str, str]) -> list[tuple[int, int]]:
        plan = level_plan([channel(one, way, place) for one, way, place in channels], 2000.0, (10.0, 1000.0))
        return [(first, second) for first, second, _ in plan.contacts]

    velocities = [("velocity", way, place) for place in ("bearing", "disc", "casing") for way in "yz"]
    assert contacts(*velocities) == [(0, 1), (2, 3)]
    assert contacts(*velocities, ("displacement", "y", "disc"), ("displacement", "z", "disc")) == [(6, 7), (0, 1)]
    assert contacts(*velocities, ("displacement", "y", "disc")) == [(0, 1), (2, 3)]


def test_outlying_single_samples_are_no_contact() -> None:
    assert np.all(z(told(20261130, spikes=6.0)) < 4.5)


@pytest.mark.parametrize("change", ["short", "dead", "copied", "coarse"])
def test_unusable_signals_show_no_contact(change: str) -> None:
    pair = np.random.default_rng(20261129).standard_normal((2, 900 if change == "short" else N))
    pair[1] = {"short": pair[1], "dead": 0.0, "copied": pair[0], "coarse": np.round(8 * pair[1])}[change]
    angle = 0.07 * np.arange(pair.shape[1])
    found = contact(pair, np.stack([np.cos(angle), np.sin(angle)]), 0.07 * pair.shape[1] / (2 * np.pi), 2000.0)
    assert np.all(np.abs(found) < 4.5) if change == "copied" else np.all(np.isnan(found))


WINDOW, LATEST = 12, 48
SILENT = BandLevels(np.array([1.0, 2.0]), np.zeros((1, 2)), np.zeros((1, 2)), np.ones(1))
PAIR = [channel("displacement", way) for way in "yz"]
HEALTHY = HopReference(mean=0.0, scatter=1.0, hops=144, range=0.5)


def heard(
    hops: FloatArray, *, faster: int | None = None, stop: int | None = None, window: int = WINDOW,
    reference: LevelReference | None = None,
) -> list[int]:  # fmt: skip
    """Numbers of hops after which a contact is reported, given the two statistics of hops, shape (n_hops, 2).

    After `faster` hops the machine runs faster; after `stop` hops another monitor takes over.
    """
    contacts = {one.name: HEALTHY for one in PAIR}
    slow, fast = (
        OperatingState(windows=12, speed_rad_s=(speed, speed), levels={}, hops=WINDOW, contact=contacts)
        for speed in (100.0, 200.0)
    )
    reference = reference or LevelReference(source="commissioned", states=(slow, fast))
    judge, latest = LevelJudge(level_plan(PAIR, 2000.0, (10.0, 1000.0)), PAIR, LevelSettings()), LatestContact(LATEST)
    found = []
    for end in range(window, len(hops) + 1):
        speed_rad_s = 100.0 if faster is None or end <= faster else 200.0
        levels = WindowLevels({}, {}, None, SILENT, speed_rad_s, window, contact=hops[end - window : end])
        if end == stop:
            arrays, latest = latest.checkpoint(), LatestContact(LATEST)
            latest.restore(arrays)
        if judge.foreign(levels, (), reference, latest, named=False).text:
            found.append(end)
    return found


def hops_of(seed: int, before: int, touching: int, after: int = 0, *, size: float = 1.4) -> FloatArray:
    found = np.random.default_rng(seed).standard_normal((before + touching + after, 2))
    found[before : before + touching, 0] += size
    return found


def test_a_light_contact_is_reported_after_some_minutes_and_stays_reported() -> None:
    for seed in range(20261201, 20261205):
        assert set(range(24 + LATEST, 24 + 97)) <= set(heard(hops_of(seed, 24, 96)))
        assert not heard(hops_of(seed, 960, 0))


def test_theory_allows_for_what_slow_modes_and_noise_show() -> None:
    """A healthy rotor of 4 kg whose lowest modes, at 11 Hz, ring for 2 s has such hops at its bearing."""
    levels = WindowLevels({}, {}, None, SILENT, 100.0, WINDOW, contact=np.zeros((WINDOW, 2)))
    theory = expected_levels([one.name for one in PAIR], levels, (100.0, 100.0), ())
    for seed in range(20261221, 20261225):
        assert not heard(0.66 + 1.3 * hops_of(seed, 960, 0), reference=theory)
        assert set(range(24 + LATEST, 24 + 97)) <= set(heard(hops_of(seed, 24, 96, size=2.0), reference=theory))


def test_a_single_hop_is_no_contact_and_a_past_contact_is_no_longer_reported() -> None:
    once = hops_of(20261211, 120, 0)
    once[60] += 100.0
    assert not heard(once)
    first = np.full((6, 2), 0.75)
    first[3] = 8.0  # the newest of the first window, and all that is known of several
    assert not heard(first, window=4)
    over = heard(hops_of(20261212, 24, 24, 96, size=10.0))
    assert over
    assert max(over) < 24 + 24 + WINDOW


def test_a_resumed_monitor_remembers_earlier_hops() -> None:
    light = hops_of(20261213, 24, 96)
    assert heard(light, stop=90) == heard(light)


def test_hops_of_another_operating_state_do_not_count() -> None:
    light = hops_of(20261214, 24, 96)
    assert not set(heard(light, faster=100)) & set(range(101, 107))
    assert set(range(101, 107)) <= set(heard(light))
