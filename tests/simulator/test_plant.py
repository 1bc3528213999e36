"""The plant against theory it does not use: Lyapunov covariances, correlation functions, an ODE solver, exact angles.

Statistical tolerances are five standard errors, estimated from independent seeds of the test itself: with fixed seeds
the outcome is certain, and an inconsistency of a few percent is far outside.
"""

from collections.abc import Callable
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from models.errors import EstimationError
from models.machine import Machine, load_machine
from models.physics.excitation import expanded_A, expanded_B
from models.physics.response import stationary_covariance, synchronous_response
from models.physics.rotor import PARAMETERS, STATE_INDEX, STATES, M_matrix, P_matrix, Q_matrix, Q_shaft, changed
from models.signals.block import FloatArray
from simulator.plant import NonlinearPlant, Plant, crack_stiffness, theoretical_moments
from simulator.scenario import NamedSource, Rub, load_scenario
from simulator.timeline import Condition
from tests.windows import correlation

SEEDS = 16
SECONDS = 20.0
RATE_HZ = 2000.0
LAB = load_machine("lab")
BALANCED = LAB.model_copy(update={"rotor": LAB.rotor.model_copy(update={"e_m": 0.0})})


def _condition(sources: tuple[NamedSource, ...] = (), speed_rpm: float = 1320.0, **changes: float) -> Condition:
    return Condition({**dict.fromkeys(PARAMETERS, 0.0), **changes}, speed_rpm, sources)


def _uneven() -> Condition:
    scenario, machine = load_scenario("healthy")
    # Different forces and cutoffs, and one source on everything at once: nothing is symmetric.
    sources = [
        source.model_copy(update={"force_rms_N": 0.3 + 0.2 * n, "cutoff_hz": 60.0 + 25 * n})
        for n, source in enumerate(scenario.sources)
    ]
    sources[3] = sources[3].model_copy(update={"direction": (0.5, -0.3, 0.02, 0.2, 1.0, -0.01)})
    return _condition(tuple(sources), machine.operation.speed_rpm)


CONDITION = _uneven()


@cache
def stochastic() -> list[FloatArray]:
    """Stochastic part of independent runs, each (n_samples, 12): without unbalance there is no other."""
    n_samples = round(SECONDS * RATE_HZ)
    return [Plant(BALANCED, CONDITION, np.random.default_rng(seed)).advance(n_samples).states for seed in range(SEEDS)]


def _assert_agrees(estimates: FloatArray, theory: FloatArray, scale: FloatArray, largest_error: float = 0.05) -> None:
    """Mean over independent runs within five of its standard errors, and those small enough to mean something."""
    error = estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    assert np.all(error < largest_error * scale)
    assert np.all(np.abs(estimates.mean(axis=0) - theory) < 5 * error)


def _covariance(machine: Machine, condition: Condition) -> tuple[FloatArray, FloatArray]:
    A = expanded_A(machine.rotor, condition.speed_rpm * 2 * np.pi / 60, condition.sources)
    return A, stationary_covariance(A, expanded_B(condition.sources))


def test_covariances_agree_with_lyapunov_theory_from_the_first_sample_on() -> None:
    _, R = _covariance(LAB, CONDITION)
    deviation = np.sqrt(np.diag(R)[:12])
    estimates = np.array([x.T @ x / len(x) for x in stochastic()]) / np.outer(deviation, deviation)
    _assert_agrees(estimates, R[:12, :12] / np.outer(deviation, deviation), np.ones((12, 12)))
    first = np.array([Plant(BALANCED, CONDITION, np.random.default_rng(s)).advance(1).states[0] for s in range(500)])
    squares = first[:, :, None] * first[:, None, :] / np.outer(deviation, deviation)
    _assert_agrees(squares, R[:12, :12] / np.outer(deviation, deviation), np.ones((12, 12)), largest_error=0.1)


def test_displacement_differs_from_integrated_velocity_as_theory_says() -> None:
    """Defect of Simpson's rule from sample to sample, 1e-8 m: a noise factor without scaling adds as much again."""
    A, R = _covariance(LAB, CONDITION)
    h = 1 / RATE_HZ
    R_lag = [correlation(A, R, lag * h) for lag in (0, 1, 2)]
    R_pair = [[R_lag[b - a] if b >= a else R_lag[a - b].T for b in range(3)] for a in range(3)]
    for i in (0, 1, 3, 4):
        weights = np.zeros((3, len(A)))  # of the states at three successive samples
        weights[:, i] = (-1, 0, 1)
        weights[:, i + 6] = (-h / 3, -4 * h / 3, -h / 3)
        theory = sum(weights[a] @ R_pair[a][b] @ weights[b] for a in range(3) for b in range(3))
        runs = ((x[:, i], x[:, i + 6]) for x in stochastic())
        defects = [np.var(y[2:] - y[:-2] - (v[:-2] + 4 * v[1:-1] + v[2:]) * h / 3) / theory for y, v in runs]
        _assert_agrees(np.array(defects)[:, None], np.ones(1), np.ones(1))


def test_the_shaft_angle_is_measured_from_the_phase_reference() -> None:
    """The heavy spot stands at unbalance_phase_rad when the angle is 0: the same response, later by that angle."""
    phase = 2 * np.pi / 5
    turned = LAB.model_copy(update={"operation": LAB.operation.model_copy(update={"unbalance_phase_rad": phase})})
    n = 2000
    reference = Plant(LAB, _condition(), np.random.default_rng(0)).advance(n)
    other = Plant(turned, _condition(), np.random.default_rng(0)).advance(n)
    angle = np.unwrap(reference.theta_rad)
    x = np.interp(angle[:1500] + phase, angle, reference.states[:, STATE_INDEX["y2"]])
    np.testing.assert_allclose(other.states[:1500, STATE_INDEX["y2"]], x, atol=2e-3 * np.abs(x).max())


def test_changes_give_the_motion_of_the_forced_equation() -> None:
    """Without noise, through changes of unbalance, stiffness, damping and speed: an ODE solver says the same."""
    conditions = [
        _condition(), _condition(e=0.5), _condition(e=0.5, k_by=-0.4),
        _condition(speed_rpm=1700.0, k_by=-0.4, c_bz=0.8), _condition(speed_rpm=1000.0, EI=-0.2),
    ]  # fmt: skip
    plant = Plant(LAB, conditions[0], np.random.default_rng(0))
    pieces, angles, solution = [], [], []
    state, theta, n = None, 0.0, 150
    for condition in conditions:
        plant.change(condition)
        samples = plant.advance(n)
        pieces.append(samples.states)
        angles.append(samples.theta_rad)
        state = samples.states[0] if state is None else state
        machine = LAB.model_copy(update={"rotor": changed(LAB.rotor, condition.relative_changes)})
        solved = _solved(machine, n + 1, speed_rpm=condition.speed_rpm, theta=theta, start=state)
        solution.append(solved[:n])
        state, theta = solved[-1], theta + condition.speed_rpm * 2 * np.pi / 60 * n / RATE_HZ
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
def test_displacement_and_velocity_are_continuous_through_a_change(change: dict[str, float]) -> None:
    force, cutoff = change.get("force", 1.0), change.get("cutoff", 1.0)
    sources = tuple(
        s.model_copy(update={"force_rms_N": force * s.force_rms_N, "cutoff_hz": cutoff * s.cutoff_hz})
        for s in CONDITION.sources
    )
    parameters = {name: value for name, value in change.items() if name in PARAMETERS}
    after = _condition(sources, change.get("speed_rpm", 1320.0), **parameters)
    plant = Plant(LAB, CONDITION, np.random.default_rng(3))
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


def test_a_change_shows_in_the_covariance() -> None:
    soft = Condition({**CONDITION.relative_changes, "k_by": -0.5}, CONDITION.speed_rpm, CONDITION.sources)
    _, R = _covariance(LAB.model_copy(update={"rotor": changed(LAB.rotor, {"k_by": -0.5})}), soft)
    estimates = []
    for seed in range(8):
        plant = Plant(BALANCED, CONDITION, np.random.default_rng(seed))
        plant.advance(1000)
        plant.change(soft)
        plant.advance(1000)  # the transient takes 0.1 s
        estimates.append(plant.advance(40000).states[:, 0].var())
    _assert_agrees(np.array(estimates)[:, None] / R[0, 0], np.ones(1), np.ones(1))


def test_the_shaft_angle_is_exact_over_hours() -> None:
    slow = LAB.model_copy(update={"rate_hz": 128.0})
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


def test_the_realisation_depends_on_the_generator_alone() -> None:
    one, same, other = (Plant(LAB, CONDITION, np.random.default_rng(seed)).advance(50).states for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.any(one[:, 0] == other[:, 0])


def test_advancing_in_parts_equals_advancing_at_once() -> None:
    whole = Plant(LAB, CONDITION, np.random.default_rng(1)).advance(3000)
    plant = Plant(LAB, CONDITION, np.random.default_rng(1))
    parts = [plant.advance(n) for n in (1, 999, 137, 1863)]
    states = np.concatenate([part.states for part in parts])
    np.testing.assert_allclose(states / whole.states.std(axis=0), whole.states / whole.states.std(axis=0), atol=1e-9)
    np.testing.assert_allclose(np.concatenate([part.theta_rad for part in parts]), whole.theta_rad, atol=1e-12)


def test_theoretical_moments_include_the_random_and_the_synchronous_part() -> None:
    squares, stochastic = (np.diag(theoretical_moments(machine, CONDITION)) for machine in (LAB, BALANCED))
    q1, q2 = synchronous_response(LAB.rotor, LAB.operation.speed_rad_s)
    np.testing.assert_allclose(squares - stochastic, (q1**2 + q2**2) / 2, rtol=1e-6)
    assert len(squares) == len(STATES)


SPEED_RPM = 1320.0
CLEARANCE_M = 18e-6


def _anomalous(stochastic: bool = False, friction: float = 0.1, **anomalies: float) -> Condition:
    sources = load_scenario("healthy")[0].sources if stochastic else ()
    rub = Rub(clearance_m=CLEARANCE_M, friction=friction)
    return Condition(dict.fromkeys(PARAMETERS, 0.0), SPEED_RPM, sources, anomalies=anomalies, rub=rub)


def _solved(
    machine: Machine,
    n_samples: int,
    extra: Callable[[float, FloatArray], FloatArray] = lambda *_: np.zeros(6),
    *,
    speed_rpm: float = SPEED_RPM,
    theta: float = 0.0,
    start: FloatArray | None = None,
) -> FloatArray:
    """States from the equation of motion itself with an additional force, from the healthy unbalance response on."""
    rotor, speed = machine.rotor, speed_rpm * 2 * np.pi / 60
    mass, P, Q = np.diag(M_matrix(rotor)), P_matrix(rotor, speed), Q_matrix(rotor)
    phase = machine.operation.unbalance_phase_rad + theta
    force_N = rotor.m2_kg * rotor.e_m * speed**2

    def rate(t: float, x: FloatArray) -> FloatArray:
        force = extra(speed * t, x) - P @ x[6:] - Q @ x[:6]
        force[1] += force_N * np.cos(speed * t + phase)
        force[4] += force_N * np.sin(speed * t + phase)
        return np.concatenate([x[6:], force / mass])

    if start is None:
        q1, q2 = synchronous_response(rotor, speed)
        start = q1 * np.cos(phase) + q2 * np.sin(phase)
    times = np.arange(n_samples) / machine.rate_hz
    solved = solve_ivp(rate, (0, times[-1]), start, t_eval=times, method="DOP853", rtol=1e-9, atol=1e-13, max_step=2e-4)
    return np.asarray(solved.y.T)


def _begun(machine: Machine, condition: Condition, n_samples: int) -> FloatArray:
    """States of a plant that is healthy until its first sample."""
    plant = NonlinearPlant(machine, _anomalous(), np.random.default_rng(1))
    plant.change(condition)
    return plant.advance(n_samples).states


def _crack(theta: float, x: FloatArray, depth: float = 0.3) -> FloatArray:
    weight = np.zeros(6)
    weight[3], weight[4] = -9.81 * LAB.rotor.m1_kg, -9.81 * LAB.rotor.m2_kg
    sag = np.linalg.solve(Q_matrix(LAB.rotor), weight)
    return np.asarray(depth * crack_stiffness(LAB.rotor, np.array([theta]))[0] @ (x[:6] + sag))


def _contact(friction: float) -> Callable[[float, FloatArray], FloatArray]:
    k = 0.5 * 3 * LAB.rotor.EI_N_m2 / LAB.rotor.shaft_length_m**3

    def force(_: float, x: FloatArray) -> FloatArray:
        out, y, z = np.zeros(6), float(x[1]), float(x[4])
        radius = float(np.hypot(y, z))
        if radius > CLEARANCE_M:
            normal = k * (radius - CLEARANCE_M)
            out[1] = -normal * (y - friction * z) / radius
            out[4] = -normal * (z + friction * y) / radius
        return out

    return force


def test_the_crack_takes_stiffness_from_its_own_direction_only() -> None:
    shaft = Q_shaft(LAB.rotor)
    up, down, along = crack_stiffness(LAB.rotor, np.array([np.pi / 2, -np.pi / 2, 0.0]))
    np.testing.assert_allclose(up[3:, 3:], shaft[3:, 3:], rtol=1e-12)
    np.testing.assert_allclose(up[:3], 0, atol=1e-9 * shaft.max())
    np.testing.assert_allclose(down, 0, atol=1e-9 * shaft.max())
    np.testing.assert_allclose(along[:3, :3], shaft[:3, :3] / 2, rtol=1e-12)


def test_a_cracked_rotor_moves_as_the_equation_of_motion_says() -> None:
    expected = _solved(LAB, 500, _crack)
    states = _begun(LAB, _anomalous(crack=0.3), 500)
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(states / scale, expected / scale, atol=2e-3)
    synchronous = _begun(LAB, _anomalous(), 500)
    assert np.abs(expected - synchronous).max(axis=0)[1] > 0.2 * scale[1]


@pytest.mark.parametrize("friction", [pytest.param(0.0, marks=pytest.mark.long), 0.2])
def test_a_rubbing_rotor_moves_as_the_equation_of_motion_says(friction: float) -> None:
    condition = _anomalous(rub=0.5, friction=friction)
    expected = _solved(LAB, 1000, _contact(friction))
    scale = np.abs(expected).max(axis=0)
    errors = []
    for rate_hz in (1000.0, 2000.0, 4000.0):
        every = round(rate_hz / 1000)
        states = _begun(LAB.model_copy(update={"rate_hz": rate_hz}), condition, 500 * every)[::every]
        errors.append(np.abs((states - expected[::2]) / scale)[:, [0, 1, 3, 4, 6, 7, 9, 10]].max())
    assert errors[1] < 2e-3
    assert errors[2] < errors[1] < errors[0]
    assert np.hypot(expected[:, 1], expected[:, 4]).min() < CLEARANCE_M < np.hypot(expected[:, 1], expected[:, 4]).max()


def test_an_anomaly_of_zero_size_is_the_healthy_plant() -> None:
    plain = Plant(LAB, _anomalous(stochastic=True), np.random.default_rng(5)).advance(3000).states
    none = NonlinearPlant(LAB, _anomalous(stochastic=True), np.random.default_rng(5)).advance(3000).states
    np.testing.assert_array_equal(none, plain)
    for anomalies in ({"crack": 1e-9}, {"rub": 1e-9}):
        plant = NonlinearPlant(LAB, _anomalous(stochastic=True), np.random.default_rng(5))
        plant.change(_anomalous(stochastic=True, **anomalies))
        states = plant.advance(3000).states
        np.testing.assert_allclose(states / plain.std(axis=0), plain / plain.std(axis=0), atol=1e-6)


def test_a_crack_present_from_the_start_is_in_steady_state() -> None:
    """Periodic from the first sample on, with the second harmonic that a healthy rotor lacks."""
    turn = round(60 * 2200 / SPEED_RPM)
    machine = LAB.model_copy(update={"rate_hz": 2200.0})
    states = NonlinearPlant(machine, _anomalous(crack=0.3), np.random.default_rng(1)).advance(4 * turn).states
    np.testing.assert_allclose(states[turn:], states[:-turn], atol=1e-3 * np.abs(states).max())
    harmonics = np.abs(np.fft.rfft(states[: 4 * turn, 4]))[4::4]
    assert harmonics[1] > 0.02 * harmonics[0]


def test_a_rub_made_unstable_by_friction_is_refused() -> None:
    plant = NonlinearPlant(LAB, _anomalous(), np.random.default_rng(1))
    plant.change(_anomalous(rub=5.0, friction=1.0))
    with pytest.raises(EstimationError, match="the rub is unstable"):
        plant.advance(40_000)
