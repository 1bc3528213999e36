"""The methods a user would otherwise pick, and the paper's own correlations, against theory."""

import numpy as np
import pytest
import scipy.stats

from benchmarks.studies.methods.other_methods import FeatureVector, SubspaceModes, reference_modes
from benchmarks.studies.methods.paper import PAPER_EQUATIONS, full_correlation, phase_correlation
from models.diagnosis.window.moments import plan_for
from models.errors import EstimationError
from models.machine import Machine, load_machine
from models.physics.excitation import expanded_A, expanded_B
from models.physics.response import correlation, stationary_covariance, synchronous_response
from models.physics.rotor import STATE_INDEX
from models.signals.block import FloatArray
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_window, with_tilt

LAB = load_machine("lab")


def _samples(number: int, faults: dict[str, float] | None = None) -> FloatArray:
    draw = Draw(LAB, 31, Purpose.EVALUATION, faults=faults or {}, layout=Layout.INDEPENDENT, fixed_condition=True)
    plan = plan_for(LAB)
    return np.concatenate(
        [plan.to_si(block.samples) for block, _ in blocks(draw_condition(draw, number), LAB, block_s=5.0)]
    )


@pytest.mark.long
def test_ssi_finds_the_modes_of_the_machine() -> None:
    """Four modes 28-95 Hz, two close pairs of whirl modes, 7-8 % damped; one 60 s window."""
    frequency, _ = reference_modes(LAB)
    found = np.median([SubspaceModes(LAB).features(_samples(number)) for number in range(3)], axis=0)
    assert found[:4] == pytest.approx(frequency, rel=0.015)
    assert found[4:] == pytest.approx([0.084, 0.0714, 0.0727, 0.0722], rel=0.25)


@pytest.mark.long
def test_ssi_follows_the_mode_that_a_soft_bearing_lowers() -> None:
    healthy, soft = (SubspaceModes(LAB).features(_samples(0, faults)) for faults in ({}, {"k_by": -0.2}))
    assert soft[0] / healthy[0] < 0.95
    assert soft[1] / healthy[1] == pytest.approx(1, abs=0.02)  # the vertical mode stays


@pytest.mark.long
def test_a_peer_learns_healthy_and_scores_a_large_change_above_its_limit() -> None:
    learned = [_samples(number) for number in range(12)]
    fresh, changed = _samples(60), _samples(50, {"k_by": -0.3})
    for peer in (SubspaceModes(LAB), FeatureVector(LAB)):
        peer.fit(np.stack([peer.features(samples) for samples in learned]))
        assert peer.score(peer.features(changed)) > 4 * peer.score(peer.features(fresh)), peer.name


def test_a_peer_that_has_learned_nothing_does_not_score() -> None:
    peer = FeatureVector(LAB)
    with pytest.raises(EstimationError, match="before any healthy window"):
        peer.score(np.zeros(72))


def test_a_lost_mode_does_not_end_the_score() -> None:
    rng = np.random.default_rng(5)
    peer = SubspaceModes(LAB)
    peer.fit(rng.standard_normal((40, 8)))
    features = rng.standard_normal(8)
    whole = peer.score(features)
    features[3] = np.nan
    assert 0 <= peer.score(features) <= whole
    assert np.isnan(peer.score(np.full(8, np.nan)))


def test_hotellings_limit_is_that_of_gaussian_features() -> None:
    """2000 draws of n = 30 learned windows and one further one, p = 8 features; seed 9."""
    rng = np.random.default_rng(9)
    peer = SubspaceModes(LAB)
    count = 0
    n, p = 30, 8
    limit = p * (n - 1) * (n + 1) / (n * (n - p)) * scipy.stats.f.isf(0.05, p, n - p)
    for _ in range(2000):
        drawn = rng.standard_normal((31, 8))
        peer.fit(drawn[:30])
        count += peer.score(drawn[30]) > limit
    low, high = scipy.stats.binom.interval(0.999, 2000, 0.05)
    assert low <= count <= high


_SEED = 4711


def synchronous_correlation(q1: FloatArray, q2: FloatArray, angle_rad: float) -> FloatArray:
    """Contribution of the unbalance to R(τ) at shaft angle Ωτ, time-averaged; shape (n, n)."""
    cosine = np.outer(q1, q1) + np.outer(q2, q2)
    sine = np.outer(q1, q2) - np.outer(q2, q1)
    return np.asarray(0.5 * (cosine * np.cos(angle_rad) + sine * np.sin(angle_rad)), dtype=np.float64)


@pytest.fixture(scope="module")
def rig() -> Machine:
    return with_tilt(load_machine("lab"))


def test_synchronous_correlation_is_the_time_average() -> None:
    rng = np.random.default_rng(3)
    q1, q2 = rng.standard_normal((2, 4))
    angles = np.arange(360) * 2 * np.pi / 360
    x = np.outer(np.cos(angles), q1) + np.outer(np.sin(angles), q2)
    lag = 25
    average = x.T @ np.roll(x, -lag, axis=0) / 360
    np.testing.assert_allclose(synchronous_correlation(q1, q2, angles[lag]), average, atol=1e-12)


def test_full_correlation_is_theory_with_the_unbalance_in_it(rig: Machine) -> None:
    draw = Draw(rig, _SEED, Purpose.EVALUATION, layout=Layout.INDEPENDENT)
    scenario, window = draw_condition(draw, 0), simulate_window(draw, 0)
    speed = window.speed_rad_s
    A = expanded_A(rig.rotor, speed, scenario.sources)
    covariance = stationary_covariance(A, expanded_B(scenario.sources))
    q1, q2 = synchronous_response(rig.rotor, speed)
    pairs = {pair for equation in PAPER_EQUATIONS for pair in (*equation.inputs, equation.target) if pair[1] != "n"}
    for reference, response in sorted(pairs):
        i, j = STATE_INDEX[reference], STATE_INDEX[response]
        expected = np.array(
            [
                correlation(A, covariance, lag)[i, j] + synchronous_correlation(q1, q2, speed * lag)[i, j]
                for lag in window.lags_s
            ]
        )
        scale = np.sqrt(
            (covariance[i, i] + (q1[i] ** 2 + q2[i] ** 2) / 2) * (covariance[j, j] + (q1[j] ** 2 + q2[j] ** 2) / 2)
        )
        error = np.abs(full_correlation(window, reference, response) - expected).max() / scale
        assert error < 0.12, (reference, response)  # 60 s; sensor noise adds to lag 0 of R77


def test_a_wrong_sign_of_the_synchronous_lag_would_show(rig: Machine) -> None:
    """y1 and z1 turn a quarter revolution apart: the sign of Ωτ decides the sign of R14."""
    window = simulate_window(Draw(rig, _SEED, Purpose.EVALUATION, layout=Layout.INDEPENDENT), 0)
    q1, q2 = synchronous_response(rig.rotor, window.speed_rad_s)
    i, j = STATE_INDEX["y1"], STATE_INDEX["z1"]
    part = (
        full_correlation(window, "y1", "z1")
        - window.correlation[:, window.states.index("y1"), window.states.index("z1")]
    )
    theory = np.array([synchronous_correlation(q1, q2, window.speed_rad_s * lag)[i, j] for lag in window.lags_s])
    assert np.max(np.abs(part - theory)) < 0.1 * np.max(np.abs(theory))


def test_phase_correlation_follows_the_definition(rig: Machine) -> None:
    window = simulate_window(Draw(rig, _SEED, Purpose.EVALUATION, layout=Layout.INDEPENDENT), 0)
    q1, q2 = synchronous_response(rig.rotor, window.speed_rad_s)
    y1 = STATE_INDEX["y1"]
    angle = window.speed_rad_s * window.lags_s
    theory = 0.5 * (q1[y1] * np.cos(angle) - q2[y1] * np.sin(angle))  # E{(q1 cos θ + q2 sin θ) cos(θ + Ωτ)}
    found = phase_correlation(window, "y1", rig.operation.unbalance_phase_rad)
    assert np.max(np.abs(found - theory)) < 0.1 * np.max(np.abs(theory))
