"""The paper's own diagnostician against theory and on independent windows."""

import numpy as np
import pytest

from models.diagnosis.networks.paper import (
    PAPER_EQUATIONS,
    PaperDiagnostician,
    PaperNetwork,
    calibrate_paper,
    full_correlation,
    mean_squared_deviation,
    paper_rows,
    phase_correlation,
)
from models.diagnosis.networks.paper_training import train_paper_network
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine, load_machine
from models.physics.excitation import expanded_A, expanded_B
from models.physics.lyapunov import correlation, stationary_covariance, synchronous_correlation, synchronous_response
from models.physics.matrices import STATE_INDEX
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_window, with_tilt

_SEED = 4711


@pytest.fixture(scope="module")
def rig() -> Machine:
    return with_tilt(load_machine("lab"))


def _windows(rig: Machine, numbers: range) -> list[WindowStatistics]:
    """One operating condition for all, as in the paper; the realisations differ by number."""
    draw = Draw(rig, _SEED, Purpose.TRAINING, layout=Layout.ONE_SOURCE, fixed_condition=True)
    return [simulate_window(draw, number) for number in numbers]


@pytest.fixture(scope="module")
def training(rig: Machine) -> list[WindowStatistics]:
    return _windows(rig, range(3))


@pytest.fixture(scope="module")
def healthy(rig: Machine) -> list[WindowStatistics]:
    return _windows(rig, range(10, 22))


@pytest.fixture(scope="module")
def networks(rig: Machine, training: list[WindowStatistics]) -> list[PaperNetwork]:
    return [train_paper_network(equation, training, rig, seed=1) for equation in PAPER_EQUATIONS]


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


@pytest.mark.slow
def test_rows_are_the_papers_from_lag_zero(rig: Machine, training: list[WindowStatistics]) -> None:
    for equation, n_inputs in zip(PAPER_EQUATIONS, (3, 3, 2, 3), strict=True):
        inputs, target = paper_rows(equation, training[0], rig)
        assert inputs.shape == (training[0].lags_s.size, n_inputs)
        assert training[0].lags_s[0] == 0
        assert target.shape == (training[0].lags_s.size,)


@pytest.mark.slow
def test_training_fits_its_own_windows_and_is_repeatable(
    rig: Machine, networks: list[PaperNetwork], training: list[WindowStatistics]
) -> None:
    first = networks[0]
    again = train_paper_network(PAPER_EQUATIONS[0], training, rig, seed=1)
    assert np.array_equal(first.network.W1, again.network.W1)
    assert np.mean([mean_squared_deviation(first, window, rig) for window in training]) < 0.05


@pytest.mark.slow
def test_diagnostician_names_equations_and_no_sizes(
    rig: Machine, networks: list[PaperNetwork], healthy: list[WindowStatistics]
) -> None:
    limits = calibrate_paper(networks, healthy, rig, false_alarm_rate=0.1)
    paper = PaperDiagnostician(rig, networks, limits)
    # As calibrated: of the twelve windows exactly the largest score is at the limit, none above it.
    assert not any(paper.flagged_equations(paper.diagnose(window)) for window in healthy)
    changed = Draw(rig, _SEED, Purpose.TRAINING, faults={"k_by": -0.6}, layout=Layout.ONE_SOURCE, fixed_condition=True)
    diagnosis = paper.diagnose(simulate_window(changed, 50))
    assert diagnosis.by == "paper"
    assert [reading.equation for reading in diagnosis.equations] == ["28", "29", "30", "31"]
    assert all(reading.msd is not None and reading.msd_healthy is not None for reading in diagnosis.equations)
    assert all(reading.change is None and reading.reason for reading in diagnosis.parameters)
    assert "28" in paper.flagged_equations(diagnosis)


@pytest.mark.slow
def test_an_equation_without_its_channels_is_not_evaluated(
    rig: Machine, networks: list[PaperNetwork], healthy: list[WindowStatistics]
) -> None:
    paper = PaperDiagnostician(rig, networks, calibrate_paper(networks, healthy, rig, false_alarm_rate=0.2))
    lab = load_machine("lab")
    diagnosis = paper.diagnose(simulate_window(Draw(lab, _SEED, Purpose.EVALUATION), 0))
    tilt = diagnosis.equations[2]
    assert not tilt.evaluable
    assert "psi_dot" in tilt.reason
    assert tilt.msd is None
    assert "30" not in paper.flagged_equations(diagnosis)


@pytest.mark.slow
def test_too_few_windows_for_the_declared_rate_are_refused(
    rig: Machine, networks: list[PaperNetwork], healthy: list[WindowStatistics]
) -> None:
    with pytest.raises(EstimationError, match="expected at least 99"):
        calibrate_paper(networks[:1], healthy, rig, false_alarm_rate=0.01)
