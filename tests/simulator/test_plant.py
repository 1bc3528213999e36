"""The plant against theory it does not use: Lyapunov covariances, correlation functions, an ODE solver, exact angles.

Statistical tolerances are five standard errors, estimated from independent seeds of the test itself: with fixed seeds
the outcome is certain, and an inconsistency of a few percent is far outside.
"""

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from models.machine import Machine, load_machine
from models.physics.excitation import expanded_A, expanded_B
from models.physics.response import correlation, stationary_covariance, synchronous_response
from models.physics.rotor import PARAMETERS, STATE_INDEX, STATES, H_matrix, M_matrix, RotorParameters, changed, system_A
from models.signals.block import FloatArray
from simulator.plant import Plant, theoretical_rms
from simulator.scenario import NamedSource, load_scenario
from simulator.timeline import Condition

SEEDS = 16
SECONDS = 20.0
RATE_HZ = 2000.0


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("lab")


def _condition(sources: tuple[NamedSource, ...] = (), speed_rpm: float = 1320.0, **changes: float) -> Condition:
    return Condition({**dict.fromkeys(PARAMETERS, 0.0), **changes}, speed_rpm, sources)


@pytest.fixture(scope="module")
def condition() -> Condition:
    scenario, machine = load_scenario("healthy")
    # Different forces and cutoffs, and one source on everything at once: nothing is symmetric.
    sources = [
        source.model_copy(update={"force_rms_N": 0.3 + 0.2 * n, "cutoff_hz": 60.0 + 25 * n})
        for n, source in enumerate(scenario.sources)
    ]
    sources[3] = sources[3].model_copy(update={"direction": (0.5, -0.3, 0.02, 0.2, 1.0, -0.01)})
    return _condition(tuple(sources), machine.operation.speed_rpm)


@pytest.fixture(scope="module")
def stochastic(machine: Machine, condition: Condition) -> list[FloatArray]:
    """Stochastic part of independent runs, each (n_samples, 12): without unbalance there is no other."""
    plain = _without_unbalance(machine)
    n_samples = round(SECONDS * RATE_HZ)
    return [Plant(plain, condition, np.random.default_rng(seed)).advance(n_samples).states for seed in range(SEEDS)]


def _without_unbalance(machine: Machine) -> Machine:
    return machine.model_copy(update={"rotor": machine.rotor.model_copy(update={"e_m": 0.0})})


def _assert_agrees(estimates: FloatArray, theory: FloatArray, scale: FloatArray, largest_error: float = 0.05) -> None:
    """Mean over independent runs within five of its standard errors, and those small enough to mean something."""
    error = estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    assert np.all(error < largest_error * scale)
    assert np.all(np.abs(estimates.mean(axis=0) - theory) < 5 * error)


def _covariance(machine: Machine, condition: Condition) -> tuple[FloatArray, FloatArray]:
    A = expanded_A(machine.rotor, condition.speed_rpm * 2 * np.pi / 60, condition.sources)
    return A, stationary_covariance(A, expanded_B(condition.sources))


def test_covariances_are_those_of_lyapunov_from_the_first_sample_on(
    machine: Machine, condition: Condition, stochastic: list[FloatArray]
) -> None:
    _, R = _covariance(machine, condition)
    deviation = np.sqrt(np.diag(R)[:12])
    estimates = np.array([x.T @ x / len(x) for x in stochastic]) / np.outer(deviation, deviation)
    _assert_agrees(estimates, R[:12, :12] / np.outer(deviation, deviation), np.ones((12, 12)))
    plain = _without_unbalance(machine)
    first = np.array([Plant(plain, condition, np.random.default_rng(s)).advance(1).states[0] for s in range(500)])
    squares = first[:, :, None] * first[:, None, :] / np.outer(deviation, deviation)
    _assert_agrees(squares, R[:12, :12] / np.outer(deviation, deviation), np.ones((12, 12)), largest_error=0.1)


def test_displacement_is_as_much_the_integral_of_velocity_as_theory_says(
    machine: Machine, condition: Condition, stochastic: list[FloatArray]
) -> None:
    """Defect of Simpson's rule from sample to sample, 1e-8 m: a noise factor without scaling adds as much again."""
    A, R = _covariance(machine, condition)
    h = 1 / RATE_HZ
    R_lag = [correlation(A, R, lag * h) for lag in (0, 1, 2)]
    for i in (0, 1, 3, 4):
        weights = np.zeros((3, len(A)))  # of the states at three successive samples
        weights[:, i] = (-1, 0, 1)
        weights[:, i + 6] = (-h / 3, -4 * h / 3, -h / 3)
        R_pair = [[R_lag[b - a] if b >= a else R_lag[a - b].T for b in range(3)] for a in range(3)]
        theory = sum(weights[a] @ R_pair[a][b] @ weights[b] for a in range(3) for b in range(3))
        estimates = []
        for x in stochastic:
            y, v = x[:, i], x[:, i + 6]
            estimates.append(np.var(y[2:] - y[:-2] - (v[:-2] + 4 * v[1:-1] + v[2:]) * h / 3) / theory)
        _assert_agrees(np.array(estimates)[:, None], np.ones(1), np.ones(1))


@pytest.mark.parametrize(("displacement", "velocity"), [("y1", "y1_dot"), ("z1", "z1_dot"), ("y2", "y2_dot")])
def test_velocity_correlation_is_the_derivative_of_displacement_correlation(
    machine: Machine, condition: Condition, stochastic: list[FloatArray], displacement: str, velocity: str
) -> None:
    """R_11(τ+2h) - R_11(τ) = ∫R_17, the pair whose inconsistency spoils every damping estimate."""
    i, j = STATE_INDEX[displacement], STATE_INDEX[velocity]
    A, R = _covariance(machine, condition)
    h, lags, n = 1 / RATE_HZ, np.arange(61), len(stochastic[0]) - 60
    pairs = [(x[:, i].copy(), x[:, j].copy()) for x in stochastic]
    runs_11 = np.array([[x[:n] @ x[lag : lag + n] / n for lag in lags] for x, _ in pairs])
    runs_17 = np.array([[x[:n] @ v[lag : lag + n] / n for lag in lags] for x, v in pairs])
    simpson = h / 3 * (runs_17[:, :-2] + 4 * runs_17[:, 1:-1] + runs_17[:, 2:])
    # Same data on both sides, so no statistics: Simpson's error at 100 Hz is (ωh)⁴/90 = 1e-4 of the integrand.
    largest = np.abs(simpson).max()
    np.testing.assert_allclose(simpson, runs_11[:, 2:] - runs_11[:, :-2], atol=2e-3 * largest)
    theory = np.array([correlation(A, R, lag * h)[i, j] for lag in lags])
    _assert_agrees(runs_17, theory, np.full(61, np.sqrt(R[i, i] * R[j, j])))


def test_the_shaft_angle_is_measured_from_the_phase_reference(machine: Machine) -> None:
    """The heavy spot stands at unbalance_phase_rad when the angle is 0: the same response, later by that angle."""
    phase = 2 * np.pi / 5
    turned = machine.model_copy(
        update={"operation": machine.operation.model_copy(update={"unbalance_phase_rad": phase})}
    )
    n = 2000
    reference = Plant(machine, _condition(), np.random.default_rng(0)).advance(n)
    other = Plant(turned, _condition(), np.random.default_rng(0)).advance(n)
    angle = np.unwrap(reference.theta_rad)
    x = np.interp(angle[:1500] + phase, angle, reference.states[:, STATE_INDEX["y2"]])
    np.testing.assert_allclose(other.states[:1500, STATE_INDEX["y2"]], x, atol=2e-3 * np.abs(x).max())


def _forced_equation(rotor: RotorParameters, W: float, theta: float) -> Callable[[float, FloatArray], FloatArray]:
    A = system_A(rotor, W)
    H = np.asarray(np.linalg.solve(M_matrix(rotor), H_matrix(rotor, W)), dtype=np.float64)

    def motion(t: float, x: FloatArray) -> FloatArray:
        force = H @ np.array([np.cos(theta + W * t), np.sin(theta + W * t)])
        return np.asarray(A @ x + np.concatenate([np.zeros(6), force]), dtype=np.float64)

    return motion


def test_changes_give_the_motion_of_the_forced_equation(machine: Machine) -> None:
    """Without noise, through changes of unbalance, stiffness, damping and speed: an ODE solver says the same."""
    conditions = [
        _condition(), _condition(e=0.5), _condition(e=0.5, k_by=-0.4),
        _condition(speed_rpm=1700.0, k_by=-0.4, c_bz=0.8), _condition(speed_rpm=1000.0, EI=-0.2),
    ]  # fmt: skip
    plant = Plant(machine, conditions[0], np.random.default_rng(0))
    pieces, angles, solution = [], [], []
    state, theta, n = None, 0.0, 150
    for condition in conditions:
        plant.change(condition)
        samples = plant.advance(n)
        pieces.append(samples.states)
        angles.append(samples.theta_rad)
        state = samples.states[0] if state is None else state
        W = condition.speed_rpm * 2 * np.pi / 60
        motion = _forced_equation(changed(machine.rotor, condition.relative_changes), W, theta)
        times = np.arange(n + 1) / RATE_HZ
        solved = solve_ivp(motion, (0.0, times[-1]), state, method="DOP853", t_eval=times, rtol=1e-10, atol=1e-16)
        solution.append(solved.y.T[:n])
        state, theta = solved.y[:, -1], theta + W * times[-1]
    simulated, expected = np.concatenate(pieces), np.concatenate(solution)
    np.testing.assert_allclose(
        simulated / np.abs(expected).max(axis=0), expected / np.abs(expected).max(axis=0), atol=1e-6
    )
    turned = np.unwrap(np.concatenate(angles))
    speeds = np.repeat([c.speed_rpm for c in conditions], n)[:-1] / 60 / RATE_HZ * 2 * np.pi
    np.testing.assert_allclose(np.diff(turned), speeds, rtol=1e-9)


@pytest.mark.parametrize(
    "change",
    [{"k_by": -0.25}, {"c_bz": -0.3}, {"e": 0.3}, {"EI": -0.3}, {"speed_rpm": 1500.0}, {"force": 3.0}, {"cutoff": 3.0}],
    ids="-".join,
)
def test_displacement_and_velocity_are_continuous_through_a_change(
    machine: Machine, condition: Condition, change: dict[str, float]
) -> None:
    sources = tuple(
        s.model_copy(
            update={
                "force_rms_N": s.force_rms_N * change.get("force", 1.0),
                "cutoff_hz": s.cutoff_hz * change.get("cutoff", 1.0),
            }
        )
        for s in condition.sources
    )
    parameters = {name: value for name, value in change.items() if name in PARAMETERS}
    after = _condition(sources, change.get("speed_rpm", 1320.0), **parameters)
    plant = Plant(machine, condition, np.random.default_rng(3))
    before = plant.advance(4000)
    theta = plant.theta_rad
    plant.change(after)
    assert plant.theta_rad == pytest.approx(theta, abs=1e-12)
    behind = plant.advance(4000)
    x = np.concatenate([before.states, behind.states])
    # Between samples nothing jumps: a displacement step is the mean of its two velocities, up to h³/12 of the jerk.
    defect = np.abs(np.diff(x[:, :6], axis=0) - (x[1:, 6:] + x[:-1, 6:]) / 2 / RATE_HZ)
    translations = [0, 1, 3, 4]  # the tilts swing at 500 Hz, too fast for the rule
    usual = np.delete(defect, [3999, 4000], axis=0).max(axis=0)[translations]
    assert np.all(defect[3999:4001, translations] <= 1.5 * usual)
    steps = np.abs(np.diff(x[:, 6:], axis=0))
    assert np.all(steps[3999] <= np.delete(steps, 3999, axis=0).max(axis=0))
    assert np.diff(np.unwrap(np.concatenate([before.theta_rad, behind.theta_rad])))[3999] == pytest.approx(
        1320.0 / 60 / RATE_HZ * 2 * np.pi, rel=1e-9
    )


def test_a_change_shows_in_the_covariance(machine: Machine, condition: Condition) -> None:
    plain = _without_unbalance(machine)
    soft = Condition({**condition.relative_changes, "k_by": -0.5}, condition.speed_rpm, condition.sources)
    _, R = _covariance(machine.model_copy(update={"rotor": changed(machine.rotor, {"k_by": -0.5})}), soft)
    estimates = []
    for seed in range(8):
        plant = Plant(plain, condition, np.random.default_rng(seed))
        plant.advance(1000)
        plant.change(soft)
        plant.advance(1000)  # the transient takes 0.1 s
        estimates.append(plant.advance(40000).states[:, 0].var())
    _assert_agrees(np.array(estimates)[:, None] / R[0, 0], np.ones(1), np.ones(1))


def test_the_shaft_angle_is_exact_over_hours(machine: Machine) -> None:
    slow = machine.model_copy(update={"rate_hz": 128.0})
    plant = Plant(slow, _condition(speed_rpm=1333.7), np.random.default_rng(0))
    plant.advance(100)
    plant.change(_condition(speed_rpm=1234.5))
    count = 3 * 3600 * 128
    theta = np.concatenate([plant.advance(64_000).theta_rad for _ in range(-(-count // 64_000))])
    assert theta.min() >= 0.0
    assert theta.max() < 2 * np.pi
    start = Fraction("1333.7") / 60 / 128 * 100
    for n in (0, 1, 12_345, count - 1):
        turn = (start + Fraction("1234.5") / 60 / 128 * n) % 1
        away = abs(theta[n] - 2 * np.pi * float(turn))
        assert min(away, 2 * np.pi - away) < 1e-8


def test_the_realisation_depends_on_the_generator_alone(machine: Machine, condition: Condition) -> None:
    one, same, other = (Plant(machine, condition, np.random.default_rng(seed)).advance(50).states for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.any(one[:, 0] == other[:, 0])


def test_advancing_in_parts_is_advancing_at_once(machine: Machine, condition: Condition) -> None:
    whole = Plant(machine, condition, np.random.default_rng(1)).advance(3000)
    plant = Plant(machine, condition, np.random.default_rng(1))
    parts = [plant.advance(n) for n in (1, 999, 137, 1863)]
    states = np.concatenate([part.states for part in parts])
    np.testing.assert_allclose(states / whole.states.std(axis=0), whole.states / whole.states.std(axis=0), atol=1e-9)
    np.testing.assert_allclose(np.concatenate([part.theta_rad for part in parts]), whole.theta_rad, atol=1e-12)


def test_the_number_of_sources_stays(machine: Machine, condition: Condition) -> None:
    plant = Plant(machine, condition, np.random.default_rng(1))
    with pytest.raises(ValueError, match="0 sources instead of 4"):
        plant.change(_condition())


def test_theoretical_rms_counts_both_parts(machine: Machine, condition: Condition) -> None:
    rms = theoretical_rms(machine, condition)
    stochastic = theoretical_rms(_without_unbalance(machine), condition)
    q1, q2 = synchronous_response(machine.rotor, machine.operation.speed_rad_s)
    np.testing.assert_allclose(rms**2 - stochastic**2, (q1**2 + q2**2) / 2, rtol=1e-6)
    assert len(rms) == len(STATES)
