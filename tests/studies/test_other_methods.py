"""The methods a user would otherwise pick, and the paper's own correlations, against theory."""

from functools import cache

import numpy as np
import pytest
import scipy.stats

from benchmarks.studies.methods.other_methods import FeatureVector, SubspaceModes, reference_modes
from benchmarks.studies.methods.paper import PAPER_EQUATIONS, full_correlation, phase_correlation
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import load_machine
from models.physics.excitation import expanded_A, expanded_B
from models.physics.response import stationary_covariance, synchronous_response
from models.physics.rotor import STATE_INDEX
from models.signals.block import FloatArray
from simulator.scenario import Scenario
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_window, with_tilt
from tests.windows import correlation

LAB = load_machine("lab")
RIG = with_tilt(LAB)


def _samples(number: int, faults: dict[str, float] | None = None) -> FloatArray:
    draw = Draw(LAB, 31, Purpose.EVALUATION, faults=faults or {}, layout=Layout.INDEPENDENT, fixed_condition=True)
    plan = plan_for(LAB)
    made = blocks(draw_condition(draw, number), LAB, block_s=5.0)
    return np.concatenate([plan.to_si(block.samples) for block, _ in made])


@pytest.mark.long
def test_ssi_finds_the_modes_of_the_machine() -> None:
    """Four modes 28-95 Hz, two close pairs of whirl modes, 7-8 % damped; one 60 s window."""
    frequency, _ = reference_modes(LAB)
    found = np.median([SubspaceModes(LAB).features(_samples(number)) for number in range(3)], axis=0)
    assert found[:4] == pytest.approx(frequency, rel=0.015)
    assert found[4:] == pytest.approx([0.084, 0.0714, 0.0727, 0.0722], rel=0.25)


@pytest.mark.long
def test_a_peer_scores_a_large_change_far_above_a_healthy_window() -> None:
    learned = [_samples(number) for number in range(12)]
    fresh, changed = _samples(60), _samples(50, {"k_by": -0.3})
    for peer in (SubspaceModes(LAB), FeatureVector(LAB)):
        peer.fit(np.stack([peer.features(samples) for samples in learned]))
        assert peer.score(peer.features(changed)) > 4 * peer.score(peer.features(fresh)), peer.name


def test_a_lost_mode_is_left_out_of_the_score() -> None:
    rng = np.random.default_rng(5)
    peer = SubspaceModes(LAB)
    peer.fit(rng.standard_normal((40, 8)))
    features = rng.standard_normal(8)
    whole = peer.score(features)
    features[3] = np.nan
    assert 0 <= peer.score(features) <= whole
    assert np.isnan(peer.score(np.full(8, np.nan)))


def test_hotellings_limit_holds_the_rate_for_gaussian_features() -> None:
    """2000 draws of n = 30 learned windows and one further one, p = 8 features; seed 9."""
    rng = np.random.default_rng(9)
    peer, count, n, p = SubspaceModes(LAB), 0, 30, 8
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


@cache
def drawn() -> tuple[Scenario, WindowStatistics]:
    draw = Draw(RIG, _SEED, Purpose.EVALUATION, layout=Layout.INDEPENDENT)
    return draw_condition(draw, 0), simulate_window(draw, 0)


def test_full_correlation_agrees_with_theory_including_the_unbalance() -> None:
    scenario, window = drawn()
    speed = window.speed_rad_s
    A = expanded_A(RIG.rotor, speed, scenario.sources)
    covariance = stationary_covariance(A, expanded_B(scenario.sources))
    q1, q2 = synchronous_response(RIG.rotor, speed)
    pairs = {pair for equation in PAPER_EQUATIONS for pair in (*equation.inputs, equation.target) if pair[1] != "n"}
    for reference, response in sorted(pairs):
        i, j = STATE_INDEX[reference], STATE_INDEX[response]
        parts = [correlation(A, covariance, lag) for lag in window.lags_s]
        unbalance = [synchronous_correlation(q1, q2, speed * lag) for lag in window.lags_s]
        expected = np.array([one[i, j] for one in parts]) + np.array([one[i, j] for one in unbalance])
        scale = np.sqrt(np.prod([covariance[k, k] + (q1[k] ** 2 + q2[k] ** 2) / 2 for k in (i, j)]))
        error = np.abs(full_correlation(window, reference, response) - expected).max() / scale
        assert error < 0.12, (reference, response)  # 60 s; sensor noise adds to lag 0 of R77


def test_the_synchronous_lag_has_the_right_sign() -> None:
    """y1 and z1 turn a quarter revolution apart: the sign of Ωτ decides the sign of R14."""
    _, window = drawn()
    q1, q2 = synchronous_response(RIG.rotor, window.speed_rad_s)
    i, j = STATE_INDEX["y1"], STATE_INDEX["z1"]
    without = window.correlation[:, window.states.index("y1"), window.states.index("z1")]
    part = full_correlation(window, "y1", "z1") - without
    theory = np.array([synchronous_correlation(q1, q2, window.speed_rad_s * lag)[i, j] for lag in window.lags_s])
    assert np.max(np.abs(part - theory)) < 0.1 * np.max(np.abs(theory))


def test_phase_correlation_follows_the_definition() -> None:
    _, window = drawn()
    q1, q2 = synchronous_response(RIG.rotor, window.speed_rad_s)
    y1 = STATE_INDEX["y1"]
    angle = window.speed_rad_s * window.lags_s
    theory = 0.5 * (q1[y1] * np.cos(angle) - q2[y1] * np.sin(angle))  # E{(q1 cos θ + q2 sin θ) cos(θ + Ωτ)}
    found = phase_correlation(window, "y1", RIG.operation.unbalance_phase_rad)
    assert np.max(np.abs(found - theory)) < 0.1 * np.max(np.abs(theory))
