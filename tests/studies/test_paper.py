"""Correlations as the paper's own diagnostician takes them, against theory."""

import numpy as np
import pytest

from benchmarks.studies.paper import PAPER_EQUATIONS, full_correlation, phase_correlation
from models.machine import Machine, load_machine
from models.physics.excitation import expanded_A, expanded_B
from models.physics.response import correlation, stationary_covariance, synchronous_correlation, synchronous_response
from models.physics.rotor import STATE_INDEX
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_window, with_tilt

_SEED = 4711


@pytest.fixture(scope="module")
def rig() -> Machine:
    return with_tilt(load_machine("lab"))


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
