"""The cracked and the rubbing rotor against an ODE solver, and both against the linear plant where they are healthy."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from models.errors import EstimationError
from models.machine import Machine, load_machine
from models.physics.response import synchronous_response
from models.physics.rotor import PARAMETERS, M_matrix, P_matrix, Q_matrix, Q_shaft
from models.signals.block import FloatArray
from simulator.plant import NonlinearPlant, Plant, crack_stiffness
from simulator.scenario import Rub, load_scenario
from simulator.timeline import Condition

LAB = load_machine("lab")
SPEED_RPM = 1320.0
CLEARANCE_M = 18e-6
HEALTHY = dict.fromkeys(PARAMETERS, 0.0)


def _condition(stochastic: bool = False, friction: float = 0.1, **anomalies: float) -> Condition:
    sources = load_scenario("healthy")[0].sources if stochastic else ()
    return Condition(
        HEALTHY, SPEED_RPM, sources, anomalies=anomalies, rub=Rub(clearance_m=CLEARANCE_M, friction=friction)
    )


def _solved(machine: Machine, extra: Callable[[float, FloatArray], FloatArray], n_samples: int) -> FloatArray:
    """States from the equation of motion itself with an additional force, from the healthy unbalance response on."""
    rotor, speed = machine.rotor, SPEED_RPM * 2 * np.pi / 60
    mass, P, Q = np.diag(M_matrix(rotor)), P_matrix(rotor, speed), Q_matrix(rotor)
    phase = machine.operation.unbalance_phase_rad
    force_N = rotor.m2_kg * rotor.e_m * speed**2

    def rate(t: float, x: FloatArray) -> FloatArray:
        force = extra(speed * t, x) - P @ x[6:] - Q @ x[:6]
        force[1] += force_N * np.cos(speed * t + phase)
        force[4] += force_N * np.sin(speed * t + phase)
        return np.concatenate([x[6:], force / mass])

    q1, q2 = synchronous_response(rotor, speed)
    times = np.arange(n_samples) / machine.rate_hz
    start = q1 * np.cos(phase) + q2 * np.sin(phase)
    solved = solve_ivp(rate, (0, times[-1]), start, t_eval=times, method="DOP853", rtol=1e-9, atol=1e-13, max_step=2e-4)
    return np.asarray(solved.y.T)


def _begun(machine: Machine, condition: Condition, n_samples: int) -> FloatArray:
    """States of a plant that is healthy until its first sample."""
    plant = NonlinearPlant(machine, _condition(), np.random.default_rng(1))
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
    expected = _solved(LAB, _crack, 500)
    states = _begun(LAB, _condition(crack=0.3), 500)
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(states / scale, expected / scale, atol=2e-3)
    synchronous = _begun(LAB, _condition(), 500)
    assert np.abs(expected - synchronous).max(axis=0)[1] > 0.2 * scale[1]


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_a_rubbing_rotor_moves_as_the_equation_of_motion_says(friction: float) -> None:
    condition = _condition(rub=0.5, friction=friction)
    expected = _solved(LAB, _contact(friction), 1000)
    scale = np.abs(expected).max(axis=0)
    errors = []
    for rate_hz in (1000.0, 2000.0, 4000.0):
        every = round(rate_hz / 1000)
        states = _begun(LAB.model_copy(update={"rate_hz": rate_hz}), condition, 500 * every)[::every]
        errors.append(np.abs((states - expected[::2]) / scale)[:, [0, 1, 3, 4, 6, 7, 9, 10]].max())
    assert errors[1] < 2e-3
    assert errors[2] < errors[1] < errors[0]
    assert np.hypot(expected[:, 1], expected[:, 4]).min() < CLEARANCE_M < np.hypot(expected[:, 1], expected[:, 4]).max()


def test_an_anomaly_of_no_size_is_the_healthy_plant() -> None:
    plain = Plant(LAB, _condition(stochastic=True), np.random.default_rng(5)).advance(3000).states
    none = NonlinearPlant(LAB, _condition(stochastic=True), np.random.default_rng(5)).advance(3000).states
    np.testing.assert_array_equal(none, plain)
    for anomalies in ({"crack": 1e-9}, {"rub": 1e-9}):
        plant = NonlinearPlant(LAB, _condition(stochastic=True), np.random.default_rng(5))
        plant.change(_condition(stochastic=True, **anomalies))
        states = plant.advance(3000).states
        np.testing.assert_allclose(states / plain.std(axis=0), plain / plain.std(axis=0), atol=1e-6)


def test_a_crack_from_the_start_has_run_in() -> None:
    """Periodic from the first sample on, with the second harmonic that a healthy rotor has not."""
    turn = round(60 * 2200 / SPEED_RPM)
    machine = LAB.model_copy(update={"rate_hz": 2200.0})
    states = NonlinearPlant(machine, _condition(crack=0.3), np.random.default_rng(1)).advance(4 * turn).states
    np.testing.assert_allclose(states[turn:], states[:-turn], atol=1e-3 * np.abs(states).max())
    harmonics = np.abs(np.fft.rfft(states[: 4 * turn, 4]))[4::4]
    assert harmonics[1] > 0.02 * harmonics[0]


def test_a_rub_that_friction_drives_off_is_refused() -> None:
    plant = NonlinearPlant(LAB, _condition(), np.random.default_rng(1))
    plant.change(_condition(rub=5.0, friction=1.0))
    with pytest.raises(EstimationError, match="the rub is unstable"):
        plant.advance(40_000)
