"""Sliding correlations: online equals batch for any splitting, and theory; offsets, gaps and the synchronous part."""

from dataclasses import fields, replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.window.excluded import ExcludedLine
from models.diagnosis.window.lagged import lagged_products
from models.diagnosis.window.moments import Plan, hop_moments, plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import load_machine
from models.physics.excitation import expanded_A, expanded_B
from models.physics.response import stationary_covariance, synchronous_response
from models.physics.rotor import STATE_INDEX
from models.signals.block import FloatArray
from models.signals.waveform import Waveform, waveform_of
from simulator.scenario import Event, Scenario, Sensors
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition
from tests.diagnosis.sensors.test_sensor_checks import sources_along
from tests.sure import sure
from tests.windows import correlation, last_window

RATE = 200.0


def small_plan(*, angle: bool = True, hops: int = 4) -> Plan:
    return Plan(
        rate_hz=RATE, states=("y1", "y1_dot"), columns=np.array([0, 1]), scales=np.array([1.0, 1.0]),
        angle_column=2 if angle else None, hop=100, stride=100, preamble=50, segment=100, lags=np.arange(0, 21, 2),
        bins=np.arange(2, 40), hops=hops, max_span_ns=10**12,
    )  # fmt: skip


def signal(n_samples: int, seed: int, *, offset: float = 0.0, angle: bool = True) -> FloatArray:
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((n_samples + 5, 2))
    x: FloatArray = np.stack([noise[5 - lag : n_samples + 5 - lag] for lag in range(5)]).sum(axis=0) + offset
    if not angle:
        return x
    theta = np.mod(0.4 + 2 * np.pi * 7.3 / RATE * np.arange(n_samples), 2 * np.pi)
    x = x + np.outer(np.cos(theta), [2.0, 0.5]) + np.outer(np.sin(theta), [-1.0, 0.3])
    return np.column_stack([x, theta])


def feed(window: SlidingWindow, samples: FloatArray, start: int = 0) -> list[WindowStatistics]:
    got = []
    for _ in window.feed(samples, round(start * 1e9 / RATE)):
        statistics = window.statistics()
        if statistics is not None:
            got.append(statistics)
    return got


def assert_identical(a: WindowStatistics, b: WindowStatistics) -> None:
    for field in fields(WindowStatistics):
        assert_same(getattr(a, field.name), getattr(b, field.name), field.name)


def assert_same(x: object, y: object, name: str) -> None:
    if isinstance(x, np.ndarray):
        np.testing.assert_array_equal(x, y, err_msg=name)
    elif isinstance(x, Waveform) and isinstance(y, Waveform):
        for field in fields(Waveform):
            assert_same(getattr(x, field.name), getattr(y, field.name), f"{name}.{field.name}")
    elif isinstance(x, tuple) and isinstance(y, tuple):
        for one, other in zip(x, y, strict=True):
            assert_same(one, other, name)
    else:
        assert x == y or (x != x and y != y), name


def batch_correlation(plan: Plan, samples: FloatArray, end: int) -> FloatArray:
    """Straight from the definition: regress the window on mean and rotation, correlate what is left."""
    start = end - plan.hops * plan.hop
    n = 2
    regressors = np.ones((samples.shape[0], 1))
    if samples.shape[1] > n:
        theta = samples[:, n]
        regressors = np.column_stack([regressors, np.cos(theta), np.sin(theta)])
    x = samples[:, :n] - samples[start:end, :n].mean(axis=0)
    beta = np.linalg.lstsq(regressors[start:end], x[start:end], rcond=None)[0]
    rest = x - regressors @ beta
    return np.stack([rest[start - lag : end - lag].T @ rest[start:end] / (end - start) for lag in plan.lags])


@pytest.mark.parametrize("hop", [100, 306, 307, 2000])
def test_lagged_products_match_their_definition_for_any_hop(hop: int) -> None:
    """Shorter and longer than a block of the transform, with channels six orders of magnitude apart."""
    plan = replace(small_plan(), hop=hop, stride=hop)
    samples = signal(plan.preamble + hop, 31)
    samples[:, 1] *= 1e6
    products = hop_moments(plan, samples, np.zeros(2), 0).products
    theta = samples[:, 2]
    a = np.column_stack([samples[:, :2], np.ones(len(theta)), np.cos(theta), np.sin(theta)])
    now = slice(plan.preamble, plan.preamble + hop)
    direct = np.stack([a[plan.preamble - lag : plan.preamble + hop - lag].T @ a[now] for lag in plan.lags])
    scale = np.sqrt(np.diag(direct[0]))
    np.testing.assert_allclose(products / np.outer(scale, scale), direct / np.outer(scale, scale), atol=1e-12)


@pytest.mark.parametrize("lags", [[0, 1, 2, 3], [0, 3, 6, 9], [0, 7, 14], [0, 6, 9], [0, 40]])
def test_lagged_products_match_their_definition_at_any_lags(lags: list[int]) -> None:
    a = np.random.default_rng(32).standard_normal((3, 50 + 1000))
    direct = np.stack([a[:, 50 - lag : 1050 - lag] @ a[:, 50:].T for lag in lags])
    np.testing.assert_allclose(lagged_products(a, np.array(lags), 50), direct, atol=1e-9)


def test_a_past_window_is_recomputed_although_the_stream_has_moved_on() -> None:
    window, samples = SlidingWindow(small_plan()), signal(1200, 33)
    feed(window, samples[:300])
    assert window.again() is None
    then = feed(window, samples[300:700], 300)[-1]
    again = sure(window.again())
    feed(window, samples[700:], 700)
    assert_identical(again(), then)
    assert again() is again()


@settings(max_examples=12)
@given(cuts=st.lists(st.integers(1, 1199), max_size=40), seed=st.integers(0, 1000))
def test_any_splitting_gives_identical_statistics_after_every_block(cuts: list[int], seed: int) -> None:
    plan, samples = small_plan(), signal(1200, seed)
    whole = feed(SlidingWindow(plan), samples)
    window, split = SlidingWindow(plan), []
    edges = [0, *sorted(set(cuts)), 1200]
    for begin, end in pairwise(edges):
        split += feed(window, samples[begin:end], begin)
        complete = max(0, (end - plan.preamble) // plan.hop - plan.hops + 1)
        assert len(split) == complete
        if split:
            stop = plan.preamble + plan.hop * (complete + plan.hops - 1)
            np.testing.assert_allclose(split[-1].correlation, batch_correlation(plan, samples, stop), atol=1e-11)
    assert len(split) == len(whole) == 8
    for a, b in zip(split, whole, strict=True):
        assert_identical(a, b)


@pytest.mark.slow
def test_sliding_equals_batch_despite_an_offset_a_million_times_the_fluctuation() -> None:
    """After every block of 100 000 samples the sliding estimate is the batch estimate of the same window."""
    longer = replace(small_plan(angle=False), rate_hz=1e4, hop=25_000, stride=25_000, max_span_ns=10**13)
    plan = replace(longer, lags=np.array([0, 5, 20]), bins=np.arange(2, 5))
    window, tail, checked = SlidingWindow(plan), np.empty((0, 2)), 0
    for block in range(12):
        samples = signal(100_000, block, offset=2e6, angle=False)
        statistics = [*[None], *[window.statistics() for _ in window.feed(samples, round(block * 1e10))]][-1]
        tail = np.concatenate([tail, samples])[-160_000:]
        end = tail.shape[0] - (100_000 * (block + 1) - plan.preamble) % plan.hop
        if statistics is None or end < 100_020:
            continue
        expected = batch_correlation(plan, tail, end)
        np.testing.assert_allclose(statistics.correlation, expected, atol=1e-9 * expected[0, 0, 0])
        checked += 1
    assert checked >= 10


def test_synchronous_part_and_speed_are_recovered_and_removed() -> None:
    plan, samples = small_plan(hops=20), signal(2100, 1)
    statistics = feed(SlidingWindow(plan), samples)[-1]
    # Least squares over 2000 samples of noise with density 25 at low frequency: standard error √(2·25/2000)·√2 ≈ 0.22.
    np.testing.assert_allclose(sure(statistics.synchronous), [2.0 + 1.0j, 0.5 - 0.3j], atol=0.9)
    assert statistics.speed_rad_s == pytest.approx(2 * np.pi * 7.3, rel=1e-9)
    assert sure(statistics.hop_synchronous).shape == (20, 2)
    clean = signal(2100, 1)
    theta = clean[:, 2]
    clean[:, :2] += 50 * np.cos(theta)[:, None]
    louder = feed(SlidingWindow(plan), clean)[-1]
    np.testing.assert_allclose(louder.correlation, statistics.correlation, atol=1e-10)
    # A bin keeps seven digits of what is largest in it.
    np.testing.assert_allclose(louder.spectrum, statistics.spectrum, atol=1e-6)


@pytest.mark.parametrize(("drift", "most"), [(np.array([1.0, -0.7]), 0.02), (np.array([4.0, 0.0]), 0.05)])
def test_a_drift_of_the_mean_is_no_vibration(drift: FloatArray, most: float) -> None:
    plan, samples = replace(small_plan(hops=20), hop=400, stride=400), signal(8_200, 17)
    (still,) = feed(SlidingWindow(plan), samples)[-1:]
    samples[:, :2] += np.outer(np.linspace(-1, 1, len(samples)), drift * samples[:, :2].std(axis=0))
    (drifting,) = feed(SlidingWindow(plan), samples)[-1:]
    power = np.sqrt(np.outer(*[np.diag(still.correlation[0])] * 2))
    assert np.abs((drifting.correlation - still.correlation) / power).max() < most
    assert np.abs((drifting.hop_correlation.mean(axis=0) - still.correlation) / power).max() < most


def test_a_drift_of_the_1x_vector_is_no_vibration() -> None:
    plan, samples = replace(small_plan(hops=20), hop=400, stride=400), signal(8_200, 18)
    (still,) = feed(SlidingWindow(plan), samples)[-1:]
    assert still.with_steady_rotation is still
    theta, size = samples[:, 2], samples[:, :2].std(axis=0)
    samples[:, :2] += np.outer(np.linspace(-1, 1, len(samples)) * np.cos(theta), size)
    samples[:, :2] += np.outer(np.linspace(1, -1, len(samples)) * np.sin(theta), size * [1.0, -0.5])
    (drifting,) = feed(SlidingWindow(plan), samples)[-1:]
    power = np.sqrt(np.outer(*[np.diag(still.correlation[0])] * 2))
    steady = drifting.with_steady_rotation
    assert np.abs((drifting.correlation - still.correlation) / power).max() > 0.2
    for found in (steady.correlation, steady.hop_correlation.mean(axis=0)):
        assert np.abs((found - still.correlation) / power).max() < 0.04


def test_spectrum_is_the_two_sided_density() -> None:
    """White noise of unit variance has density 1/rate; 400 averages make the standard error of the mean 0.1 %."""
    plan = small_plan(angle=False, hops=200)
    x = np.random.default_rng(5).standard_normal((plan.preamble + 200 * plan.hop, 2))
    statistics = feed(SlidingWindow(plan), x)[-1]
    power = np.einsum("fii->i", statistics.spectrum).real / statistics.spectrum.shape[0]
    np.testing.assert_allclose(power, 1 / RATE, rtol=0.03)
    np.testing.assert_allclose(statistics.spectrum, statistics.spectrum.conj().transpose(0, 2, 1))


def test_a_gap_costs_the_hop_it_falls_into_and_no_more() -> None:
    plan, samples = small_plan(), signal(1200, 2)
    window = SlidingWindow(plan)
    feed(window, samples[:530])  # four hops and 80 samples
    assert window.filled == 1.0
    before = sure(window.statistics())
    window.gap()
    later = signal(1200, 3)
    feed(window, later[:140], 1000)
    now = sure(window.statistics())
    assert_identical(now, before)
    feed(window, later[140:150], 1140)
    now = sure(window.statistics())
    assert (now.start_ns, now.end_ns) == (before.start_ns + round(0.5e9), round(1150e9 / RATE))


def test_hops_too_old_leave_the_window() -> None:
    plan = small_plan()
    short = Plan(**{field.name: getattr(plan, field.name) for field in fields(Plan)} | {"max_span_ns": 3 * 10**9})
    window = SlidingWindow(short)
    feed(window, signal(450, 2))
    assert window.filled == 1.0
    window.gap()
    feed(window, signal(150, 3), 2000)
    assert window.filled == 0.25
    assert window.statistics() is None


def test_plan_of_a_machine_names_its_states_in_the_order_of_the_theory() -> None:
    machine = load_machine("lab")
    plan = plan_for(machine)
    assert plan.states == ("y1", "y2", "z1", "z2", "y1_dot", "y2_dot", "z1_dot", "z2_dot")
    raw = np.arange(18, dtype=np.float32).reshape(2, 9)
    si = plan.to_si(raw)
    order = [machine.descriptor.states.index(name) for name in plan.states]
    np.testing.assert_allclose(si[:, :4], raw[:, order[:4]] * 1e-6)
    np.testing.assert_allclose(si[:, 4:8], raw[:, order[4:]] * 1e-3)
    np.testing.assert_allclose(si[:, 8], raw[:, 8])


def test_the_waveform_matches_its_definition() -> None:
    x = np.array([[0.0, 1, 1, 2, 2, 2, -1, -1, 0, 2], [3.0] * 10, [0.5, 1.5, 0.25, 4, 3, 2, 1, 0, -1, -2]]).T
    seen, _ = waveform_of(x)
    np.testing.assert_allclose(seen.mean, x.mean(axis=0))
    np.testing.assert_allclose(seen.rms, x.std(axis=0))
    np.testing.assert_array_equal(seen.minimum, [-1, 3, -2])
    np.testing.assert_array_equal(seen.maximum, [2, 3, 4])
    np.testing.assert_array_equal(seen.at_minimum, [2, 10, 0])
    np.testing.assert_array_equal(seen.at_maximum, [3, 10, 0])  # the last sample stands alone
    np.testing.assert_array_equal(seen.longest_run, [3, 10, 1])
    np.testing.assert_array_equal(seen.step, [1, np.nan, np.nan])


def test_pairs_of_a_motion_and_its_rate_keep_their_powers() -> None:
    """A gain of 0.8 and a sign on the rate of an otherwise exact sine, whatever the offset."""
    plan = replace(small_plan(), states=("y1", "y1_dot"))
    t, w = np.arange(1000) / RATE, 2 * np.pi * 8.0
    samples = np.column_stack([3 * np.sin(w * t) + 1e4, -0.8 * 3 * w * np.cos(w * t), np.mod(t, 2 * np.pi)])
    statistics = feed(SlidingWindow(plan), samples)[-1]
    (powers,) = np.sum(statistics.pair_powers, axis=0)
    gain = powers[:, 1].sum() / powers[:, 0].sum()
    # Hann segments of four periods smear the line over three bins, whose jω differ: 1 / (1 + 1/3 · (1/4)²) of the gain.
    assert gain.real == pytest.approx(-0.8 / (1 + 1 / 48), rel=1e-3)
    assert abs(gain.imag) < 1e-3
    assert len(statistics.pair_powers) == 4


LAB = load_machine("lab")


@cache
def run_of_lab(seed: int, change: float = 0.0, *, unbalanced: bool = True) -> FloatArray:
    """A window of four independent sources while the speed changes by a part of the nominal one, through its middle."""
    rpm = LAB.operation.speed_rpm
    events = [Event(at_s=0.0, speed_rpm=rpm * (1 - change / 2))]
    if change:
        events.append(Event(at_s=1.0, ramp_s=61.0, speed_rpm=rpm * (1 + change / 2)))
    if not unbalanced:
        events.append(Event(at_s=0.0, parameter="e", relative_change=-0.9999))
    rotor = LAB.rotor
    force_N = rotor.m2_kg * rotor.e_m * LAB.operation.speed_rad_s**2 * 0.5
    sources = sources_along(np.eye(6)[[0, 1, 3, 4]], 90.0, force_N)
    sensors = Sensors(noise_relative=0.02, noise_corner_hz=300.0)
    scenario = Scenario(
        machine="lab", seed=seed, duration_s=63.0, sources=sources, sensors=sensors, events=tuple(events)
    )
    plan = plan_for(LAB)
    return np.concatenate([plan.to_si(block.samples) for block, _ in blocks(scenario, LAB, 1.0)])


def without_angle(plan: Plan) -> Plan:
    return replace(plan, angle_column=None)


@pytest.mark.slow
def test_readings_stay_unbiased_across_the_flank_of_a_resonance() -> None:
    """A rise of 15 % from below 0.72 to 0.83 of the first resonance, where the 1x amplitude doubles."""
    plan = without_angle(plan_for(LAB, lagged=False))
    (window,) = feed(SlidingWindow(plan), run_of_lab(40, 0.15)[:, :-1])
    assert window.removed_by_hop
    assert window.speed_source == "estimated"
    assert window.speed_range[1] / window.speed_range[0] > 1.12
    diagnosis = LikelihoodFit(LAB).diagnose(window)
    assert all(abs(sure(reading.z)) < 3 for reading in diagnosis.parameters[:4])
    assert sure(diagnosis.misfit_z) < 4


@pytest.mark.slow
@pytest.mark.parametrize("change", [0.0, 0.1])
def test_the_speed_is_found_without_a_phase_reference(change: float) -> None:
    samples, plan = run_of_lab(50, change), plan_for(LAB, lagged=False)
    (known,) = feed(SlidingWindow(plan), samples)
    (found,) = feed(SlidingWindow(without_angle(plan)), samples[:, :-1])
    assert (found.speed_source, known.speed_source) == ("estimated", "phase reference")
    np.testing.assert_allclose(found.hop_speed_rad_s, known.hop_speed_rad_s, rtol=2e-3)
    assert found.synchronous is None
    relative, absolute = sure(found.relative_synchronous), sure(known.hop_synchronous)
    zero = np.abs(relative.imag).max(axis=0).argmin()
    turned = absolute * np.exp(-1j * np.angle(absolute[:, [zero]]))
    error = np.abs(relative - turned) / np.abs(turned).mean(axis=0)
    assert np.median(error) < 0.05


def test_without_a_line_there_is_no_speed_and_nothing_is_removed() -> None:
    samples, plan = run_of_lab(51, unbalanced=False)[:, :-1], without_angle(plan_for(LAB, lagged=False))
    (window,) = feed(SlidingWindow(plan), samples)
    assert window.speed_source == "unknown"
    assert np.isnan(window.speed_rad_s)
    assert np.all(np.isnan(window.hop_speed_rad_s))
    assert window.rotation_vectors is None
    (plain,) = feed(SlidingWindow(replace(plan, speed_rad_s=None)), samples)
    np.testing.assert_allclose(window.spectrum, plain.spectrum, rtol=1e-9, atol=1e-12 * abs(plain.spectrum).max())


@settings(max_examples=8)
@given(cuts=st.lists(st.integers(1, 2449), max_size=20), angle=st.booleans())
def test_hop_by_hop_any_splitting_gives_identical_statistics(cuts: list[int], angle: bool) -> None:
    t = np.arange(2450) / RATE
    theta = 2 * np.pi * (9.0 * t + 0.015 * t**2)
    samples = np.column_stack([signal(2450, 8, angle=False), np.mod(theta, 2 * np.pi)])
    samples[:, :2] += 20 * np.outer(np.cos(theta), [1.0, 2.0])
    plan = replace(
        small_plan(angle=angle, hops=6), hop=300, stride=300, speed_rad_s=2 * np.pi * 10, speed_tolerance=0.3
    )
    samples = samples if angle else samples[:, :2]
    whole, window, split = feed(SlidingWindow(plan), samples), SlidingWindow(plan), []
    for begin, end in pairwise([0, *sorted(set(cuts)), 2450]):
        split += feed(window, samples[begin:end], begin)
    assert len(split) == len(whole) == 3
    assert all(one.removed_by_hop for one in whole)
    for a, b in zip(split, whole, strict=True):
        assert_identical(a, b)


def test_spectra_are_interpolated_across_lines_and_not_from_adjacent_ones() -> None:
    window = feed(SlidingWindow(small_plan()), signal(500, 5))[-1]
    spectrum = window.spectrum.copy()
    spectrum[[10, 11, 12, 15, 16, 17]] *= 1e6
    loud = replace(window, spectrum=spectrum, lines=(ExcludedLine(26.0, 2.0), ExcludedLine(36.0, 2.0)))
    np.testing.assert_array_equal(window.frequencies_hz[[11, 16]], [26, 36])
    np.testing.assert_array_equal(loud.spectrum_without_lines[[13, 14]], spectrum[[13, 14]])
    assert np.abs(loud.spectrum_without_lines).max() <= np.abs(window.spectrum).max()
    everywhere = replace(window, lines=(ExcludedLine(20.0, 1000.0),))
    np.testing.assert_array_equal(everywhere.spectrum_without_lines, window.spectrum)


SEED = 7_700_004


@pytest.mark.slow
def test_correlation_functions_and_synchronous_vectors_agree_with_theory() -> None:
    """Twelve independent windows: every correlation at every lag within 5.5 standard errors of their mean.

    Each of 8064 correlated comparisons, t-distributed with 11 degrees of freedom, exceeds 5.5 twice in ten thousand
    runs, so a handful may: 0.1 % of them.
    """
    machine = LAB.model_copy(update={"window": LAB.window.model_copy(update={"length_s": 30.0})})
    condition = draw_condition(Draw(machine, SEED, Purpose.EVALUATION, 0, layout=Layout.INDEPENDENT), 0)
    quiet = condition.sensors.model_copy(update={"noise_relative": 0.0})
    runs = [condition.model_copy(update={"sensors": quiet, "seed": SEED + number}) for number in range(12)]
    streams = (blocks(run, machine, block_s=1.0) for run in runs)
    windows = [last_window(plan_for(machine), (block for block, _ in stream)) for stream in streams]
    speed = next(event.speed_rpm for event in condition.events if event.speed_rpm is not None) * 2 * np.pi / 60
    A, B = expanded_A(machine.rotor, speed, condition.sources), expanded_B(condition.sources)
    R0 = stationary_covariance(A, B)
    index = [STATE_INDEX[name] for name in windows[0].states]
    theory = np.stack([correlation(A, R0, lag)[np.ix_(index, index)] for lag in windows[0].lags_s])
    estimates = np.stack([window.correlation for window in windows])
    error = estimates.std(axis=0, ddof=1) / np.sqrt(12)
    deviation = np.abs(estimates.mean(axis=0) - theory) / error
    assert np.mean(deviation > 5.5) < 1e-3
    scale = np.sqrt(np.diagonal(R0)[index])
    assert np.all(error / np.outer(scale, scale) < 0.05)  # or agreement would mean little
    q1, q2 = synchronous_response(machine.rotor, speed)
    expected = (q1 - 1j * q2)[index]
    found = np.stack([window.synchronous for window in windows if window.synchronous is not None])
    off = np.sqrt(np.var(found, axis=0, ddof=1) / 12)
    assert np.all(np.abs(found.mean(axis=0) - expected) < 5 * off)
    assert np.all(off < 0.05 * np.abs(expected))
    assert windows[0].speed_rad_s == pytest.approx(speed, rel=1e-6)
