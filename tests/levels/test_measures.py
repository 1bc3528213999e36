"""Levels against closed forms: sines, noise of a known spectrum, trains of impulses."""

import numpy as np
import pytest

from models.diagnosis.window.moments import hop_moments, plan_for
from models.levels.measures import CONTACT, LevelPlan, WindowLevels, hop_levels, level_plan, window_levels
from models.machine import load_machine
from models.signals.block import FloatArray
from models.signals.channels import Channel
from models.signals.waveform import waveform_of
from tests.sure import sure

RATE_HZ = 25_600.0


def channel(quantity: str, direction: str = "y", location: str = "bearing", angle_deg: float | None = None) -> Channel:
    unit = {"displacement": "um", "velocity": "mm/s", "acceleration": "m/s2"}[quantity]
    name = f"{quantity}-{direction}"
    return Channel(name=name, quantity=quantity, location=location, direction=direction, unit=unit, angle_deg=angle_deg)


def plan(*quantities: str, rate_hz: float = RATE_HZ, band_hz: tuple[float, float] = (10.0, 1000.0)) -> LevelPlan:
    return level_plan([channel(one) for one in quantities], rate_hz, band_hz)


def taken(
    sizes: LevelPlan, samples: FloatArray, hops: int = 1, angle_rad: FloatArray | None = None, *, phase: bool = False
) -> WindowLevels:
    pieces = np.split(samples, hops)
    angles = [None] * hops if angle_rad is None else np.split(angle_rad, hops)
    found = [hop_levels(sizes, *waveform_of(piece), angle) for piece, angle in zip(pieces, angles, strict=True)]
    speed = np.nan if angle_rad is None else float(np.diff(np.unwrap(angle_rad)).mean() * sizes.rate_hz)
    return window_levels(sizes, found, np.full(hops, speed), phase_reference=phase)


def times(duration_s: float, rate_hz: float = RATE_HZ) -> FloatArray:
    return np.arange(round(duration_s * rate_hz)) / rate_hz


def test_levels_of_a_sine_in_every_quantity() -> None:
    t = times(5.0)
    frequency_hz, amplitude = 49.73, 2e-3
    sine = amplitude * np.sin(2 * np.pi * frequency_hz * t)
    found = taken(plan("displacement", "velocity", "acceleration"), np.column_stack([sine] * 3)).values
    rms = amplitude / np.sqrt(2)
    assert found["overall"] == pytest.approx([2 * amplitude, rms, rms], rel=2e-3)
    assert found["velocity"][2] == pytest.approx(rms / (2 * np.pi * frequency_hz), rel=2e-3)
    assert np.isnan(found["velocity"][:2]).all()
    assert found["peak"] == pytest.approx([amplitude] * 3, rel=2e-3)
    assert found["crest"] == pytest.approx([np.sqrt(2)] * 3, rel=2e-3)
    assert found["kurtosis"] == pytest.approx([1.5] * 3, rel=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_velocity_of_white_acceleration_is_its_spectrum_over_the_frequency_squared(seed: int) -> None:
    density = 1e-4  # one-sided, (m/s²)²/Hz
    noise = np.random.default_rng([81, seed]).standard_normal(times(60.0).size) * np.sqrt(density * RATE_HZ / 2)
    found = taken(plan("acceleration"), noise[:, None], hops=12)
    expected = np.sqrt(density / (2 * np.pi) ** 2 * (1 / 10 - 1 / 1000))
    # The octaves next to 10 Hz decide: 1/(2√(BT)) with B T of about 600.
    assert found.values["velocity"][0] == pytest.approx(expected, rel=4 * 0.02)
    assert found.values["kurtosis"][0] == pytest.approx(3.0, abs=0.02)
    assert found.values["overall"][0] == pytest.approx(np.sqrt(density * RATE_HZ / 2), rel=0.005)
    assert found.values["high"][0] == pytest.approx(np.sqrt(density * (0.4 * RATE_HZ - 1000)), rel=0.005)
    # Rayleigh: the envelope of Gaussian noise of rms σ has the standard deviation σ √(2 - π/2).
    assert found.values["envelope"][0] == pytest.approx(found.values["high"][0] * np.sqrt(2 - np.pi / 2), rel=0.02)


def test_the_standard_error_matches_the_scatter_of_many_windows() -> None:
    rng = np.random.default_rng(82)
    sizes = plan("velocity", rate_hz=2560.0)
    windows = [taken(sizes, rng.standard_normal((2560 * 12, 1)), hops=12) for _ in range(60)]
    scatter = np.std([one.values["overall"][0] for one in windows], ddof=1)
    assert np.mean([one.errors["overall"][0] for one in windows]) == pytest.approx(scatter, rel=0.25)


def test_impulses_of_a_bearing_raise_kurtosis_and_envelope_before_the_level() -> None:
    t = times(5.0)
    noise = np.random.default_rng(83).standard_normal(t.size)
    since_s = np.mod(t, 1 / 87.0)
    impulses = 4.0 * np.exp(-since_s / 4e-4) * np.sin(2 * np.pi * 4000 * since_s)
    sizes = plan("acceleration")
    calm, hit = (taken(sizes, x[:, None]).values for x in (noise, noise + impulses))
    assert hit["overall"][0] / calm["overall"][0] < 1.15
    assert hit["kurtosis"][0] > 3.3
    assert hit["envelope"][0] > 1.1 * calm["envelope"][0]


def test_orders_with_a_phase_reference_are_amplitude_and_phase_lag() -> None:
    t = times(5.0, 2000.0)
    theta = 2 * np.pi * 23.7 * t + 0.4
    vectors = {1: 30e-6 * np.exp(-0.7j), 2: 10e-6 * np.exp(1.1j), 3: 4e-6, 0.5: 6e-6}
    x = sum(np.real(q * np.exp(1j * order * theta)) for order, q in vectors.items())
    wrapped = np.mod(theta, 2 * np.pi)
    found = taken(plan("displacement", rate_hz=2000.0), x[:, None], angle_rad=wrapped, phase=True)
    shown = {"x_half": 12e-6, "x1": 60e-6, "x2": 20e-6, "x3": 8e-6}
    for name, value in shown.items():
        assert found.values[name][0] == pytest.approx(value, rel=1e-3), name
    assert sure(found.vectors)[1, 0] == pytest.approx(vectors[1], rel=1e-3)
    assert found.values["not_x1"][0] == pytest.approx(np.sqrt((100 + 16 + 36) / 2) * 1e-6, rel=5e-3)


@pytest.mark.parametrize("n_samples", [10_000, 10_240, 9_973])
@pytest.mark.parametrize("turns_hz", [(2, 2), (23.7, 23.7), (-23.7, -23.7), (124, 124), (310, 310), (5, 60)])
def test_orders_equal_a_least_squares_fit_to_every_sample(n_samples: int, turns_hz: tuple[float, float]) -> None:
    rng, rate_hz = np.random.default_rng(97), 2000.0
    theta = 2 * np.pi * np.cumsum(np.linspace(*turns_hz, n_samples)) / rate_hz + 0.4
    regressors = np.stack([np.ones(n_samples), *(f(k * theta) for k in (0.5, 1, 2, 3) for f in (np.cos, np.sin))])
    clean = np.array([5.0, 0.3, 0.2, 1.0, -0.5, 0.1, 0.4, -0.2, 0.3]) @ regressors
    x = np.column_stack([clean, clean + rng.standard_normal(n_samples)])
    taper = np.hanning(n_samples + 1)[:-1]
    exact = np.linalg.solve((regressors * taper) @ regressors.T, (regressors * taper) @ x)
    sizes = plan("displacement", "displacement", rate_hz=rate_hz)
    found = hop_levels(sizes, *waveform_of(x), np.mod(theta, 2 * np.pi)).orders
    error = np.sqrt(1.5 * 2 / n_samples)  # of a vector's parts, Hann's taper and noise of one
    assert np.abs(found - (exact[1::2] - 1j * exact[2::2]))[1:] == pytest.approx(0, abs=0.02 * error)


@pytest.mark.parametrize("revolutions", [1.3, 2.5, 6.2])
def test_a_snapshot_of_few_revolutions_keeps_the_orders_apart(revolutions: float) -> None:
    t = np.arange(0.1, 0.1 + revolutions / 25, 1 / RATE_HZ)
    theta = 2 * np.pi * 25 * t
    x = 1e-3 + 5e-6 * np.cos(theta) + 2e-6 * np.cos(2 * theta + 1)
    found = taken(plan("displacement"), x[:, None], angle_rad=theta, phase=True)
    assert found.values["x1"][0] == pytest.approx(10e-6, rel=1e-4)
    assert found.values["x2"][0] == pytest.approx(4e-6, rel=1e-4)


def test_a_neighbours_line_is_not_read_as_running_speed() -> None:
    t = times(5.0, 2000.0)
    theta = 2 * np.pi * 29.6 * t
    hum = 20e-6 * np.cos(2 * np.pi * 30.6 * t)
    found = taken(plan("displacement", rate_hz=2000.0), hum[:, None], angle_rad=theta, phase=True)
    assert found.values["x1"][0] < 0.01 * 40e-6


@pytest.mark.parametrize("slope", [0.0, 1e-12, 1e-300])
def test_an_angle_that_jumps_and_pauses_gives_finite_sums(slope: float) -> None:
    n_samples = 10_000
    angle = slope * np.arange(n_samples) + 4.0 * (np.arange(n_samples) // 100)
    x = np.random.default_rng(98).standard_normal((n_samples, 1))
    found = hop_levels(plan("displacement", rate_hz=2000.0), *waveform_of(x), angle)
    assert np.isfinite(found.sums[0]).all()


def test_a_stationary_shaft_has_no_orders() -> None:
    sizes = plan("velocity", rate_hz=2000.0)
    x = np.random.default_rng(84).standard_normal((10_000, 1))
    found = taken(sizes, x, angle_rad=np.full(10_000, 1.0), phase=True)
    assert np.isnan(found.values["x1"][0])
    assert found.vectors is None
    assert found.speed_rad_s is None
    assert np.isfinite(found.values["overall"][0])


def test_s_max_is_the_largest_radius_of_the_shaft_orbit() -> None:
    t = times(5.0, 2000.0)
    theta = 2 * np.pi * 20 * t
    samples = np.column_stack([1e-4 + 30e-6 * np.cos(theta), -2e-4 + 40e-6 * np.cos(theta)])
    sizes = level_plan([channel("displacement", way) for way in "yz"], 2000.0, (10.0, 1000.0))
    found = taken(sizes, samples).values
    assert found["s_max"][0] == pytest.approx(50e-6, rel=1e-3)
    assert np.isnan(found["s_max"][1])
    assert found["mean"] == pytest.approx([1e-4, -2e-4])


def test_the_band_is_limited_by_the_sampling_rate() -> None:
    sizes = plan("velocity", "acceleration", rate_hz=1000.0)
    assert sizes.band_hz == (10.0, 400.0)
    assert sizes.high_hz is None
    assert sizes.accelerations.tolist() == [False, True]
    found = taken(sizes, np.random.default_rng(85).standard_normal((5000, 2))).values
    assert np.isnan(found["high"]).all()


@pytest.mark.parametrize(("angles", "location"), [((45, 135), "bearing"), ((20, 80), "DE"), ((-30, 190), "disc")])
def test_the_largest_radius_is_the_same_for_probes_at_any_angle(angles: tuple[float, float], location: str) -> None:
    t = times(5.0, 2000.0)
    theta = 2 * np.pi * 20 * t
    y, z = 30e-6 * np.cos(theta), 25e-6 * np.sin(theta + 0.4)
    seen = [y * np.cos(at) + z * np.sin(at) for at in np.radians(angles)]
    probes = [channel("displacement", way, location, at) for way, at in zip("XY", angles, strict=True)]
    found = taken(level_plan(probes, 2000.0, (10.0, 1000.0)), np.column_stack(seen)).values
    assert found["s_max"][0] == pytest.approx(np.hypot(y, z).max(), rel=1e-6)
    assert found["overall"] == pytest.approx([np.ptp(one) for one in seen])  # each as it is mounted


def test_nearly_parallel_probes_have_no_radius() -> None:
    probes = [channel("displacement", way, "DE", at) for way, at in (("X", 0), ("Y", 15))]
    assert level_plan(probes, 2000.0, (10.0, 1000.0)).pairs == ()


@pytest.mark.parametrize("size", [1e-60, 1e-9, 1e60])
def test_levels_keep_their_precision_at_any_size_of_vibration(size: float) -> None:
    t = times(5.0, 2000.0)
    theta = 2 * np.pi * 20 * t
    seen = np.column_stack([3 * np.cos(theta), 2 * np.sin(theta + 0.4)])
    probes = [channel("displacement", way, "disc") for way in "yz"]
    sizes = level_plan(probes, 2000.0, (10.0, 1000.0))
    one, scaled = (hop_levels(sizes, *waveform_of(scale * seen), theta) for scale in (1.0, size))
    assert scaled.orders[1] / size == pytest.approx(one.orders[1], rel=1e-6)
    powers = size ** np.array([[1], [1], [4], [1], [1], [4], [2]])
    assert scaled.sums[1:8] / powers == pytest.approx(one.sums[1:8], rel=1e-6, abs=1e-9, nan_ok=True)
    assert scaled.bands / size**2 == pytest.approx(one.bands, rel=1e-4, abs=1e-9)


def test_levels_from_the_spectrum_of_the_moments_are_the_same() -> None:
    machine = load_machine("lab")
    plan = plan_for(machine, levels=True)
    rng = np.random.default_rng(20261126)
    t = np.arange(plan.need) / plan.rate_hz
    theta = 2 * np.pi * 22.3 * t
    gap = np.linspace(1e3, 3e3, len(plan.states))  # a million times the vibration, and not what is subtracted
    seen = gap + 1e-3 * (np.cos(theta)[:, None] + rng.standard_normal((plan.need, len(plan.states))))
    moments = sure(hop_moments(plan, np.column_stack([seen, theta % (2 * np.pi)]), 0.9 * gap, 0).levels)
    alone = hop_levels(sure(plan.levels), *waveform_of(seen[-plan.hop :]), theta[-plan.hop :])
    alone.sums[CONTACT] = moments.sums[CONTACT]  # which only the moments evaluate
    assert moments.sums == pytest.approx(alone.sums, rel=1e-3, abs=0, nan_ok=True)
    assert moments.bands == pytest.approx(alone.bands, rel=1e-4, abs=0)
    assert moments.orders[1:] == pytest.approx(alone.orders[1:], rel=1e-4, abs=1e-8)
