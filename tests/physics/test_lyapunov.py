"""Excitation and response: the colouring filter, and the covariance that the Lyapunov equation gives."""

import numpy as np
import pytest
import scipy.signal

from benchmarks.studies.methods.bound import source_spectrum
from models.errors import EstimationError
from models.machine import load_machine
from models.physics.excitation import Source, colouring_filter, expanded_A, expanded_B, low_pass, low_pass_slopes
from models.physics.response import advance, discretise, stationary_covariance, synchronous_response
from models.physics.rotor import H_matrix, M_matrix, P_matrix, Q_matrix, system_A
from tests.windows import correlation

SOURCES = (
    Source(cutoff_hz=80, direction=(1, 0, 0, 0, 0, 0), force_rms_N=5),
    Source(cutoff_hz=120, direction=(0.2, 0.7, 0.01, 0.5, 1, 0.02), force_rms_N=3),
)


@pytest.mark.parametrize("name", ["lab", "heavy"])
def test_lyapunov_solution_satisfies_its_equation(name: str) -> None:
    machine = load_machine(name)
    A, B = expanded_A(machine.rotor, machine.operation.speed_rad_s, SOURCES), expanded_B(SOURCES)
    R = stationary_covariance(A, B)
    deviation = np.sqrt(np.diag(R))
    # Relative to the rates at which each pair of states turns over, so that small states count as much as large ones.
    residual = (A @ R + R @ A.T + B @ B.T) / np.outer(deviation, deviation)
    rate = np.abs(A * deviation / deviation[:, None]).sum(axis=1)
    assert np.all(np.abs(residual) < 1e-10 * (rate[:, None] + rate))
    assert np.all(np.linalg.eigvalsh(R / np.outer(deviation, deviation)) > -1e-12)


def test_one_mass_under_white_force_has_the_covariance_and_correlation_of_its_closed_form() -> None:
    m, c, k, S = 1.0, 4.0, 900.0, 1.0
    A = np.array([[0, 1], [-k / m, -c / m]])
    R0 = stationary_covariance(A, np.array([[0.0], [np.sqrt(S) / m]]))
    zeta, w0 = c / (2 * np.sqrt(k * m)), np.sqrt(k / m)
    wd = w0 * np.sqrt(1 - zeta**2)
    assert R0[1, 1] == pytest.approx(S / (2 * c * m), rel=1e-12)
    assert abs(R0[0, 1]) < 1e-12 * np.sqrt(R0[0, 0] * R0[1, 1])
    for lag_s in (0.0, 0.01, 0.1, 0.7):
        envelope = S / (2 * c * k) * np.exp(-zeta * w0 * lag_s)
        expected = envelope * (np.cos(wd * lag_s) + zeta * w0 / wd * np.sin(wd * lag_s))
        assert correlation(A, R0, lag_s)[0, 0] == pytest.approx(expected, rel=1e-9)


def test_unstable_system_is_refused() -> None:
    with pytest.raises(EstimationError, match="unstable"):
        stationary_covariance(np.array([[0.1]]), np.array([[1.0]]))


def test_slopes_of_the_low_pass_are_its_derivatives() -> None:
    frequency_hz, step = np.linspace(-3000, 3000, 601), 1e-6
    slope = np.log(low_pass(frequency_hz, 60 * np.exp(step)) / low_pass(frequency_hz, 60 * np.exp(-step))) / (2 * step)
    np.testing.assert_allclose(low_pass_slopes(frequency_hz, 60)[0], slope, atol=1e-6)


def test_synchronous_response_satisfies_the_equation_of_motion() -> None:
    machine = load_machine("lab")
    rotor, W = machine.rotor, machine.operation.speed_rad_s
    q1, q2 = synchronous_response(rotor, W)
    for angle in (0.0, 0.4, 2.0):
        xi = q1[:6] * np.cos(angle) + q2[:6] * np.sin(angle)
        rate = W * (-q1[:6] * np.sin(angle) + q2[:6] * np.cos(angle))
        force = H_matrix(rotor, W) @ [np.cos(angle), np.sin(angle)]
        balance = -(W**2) * M_matrix(rotor) @ xi + P_matrix(rotor, W) @ rate + Q_matrix(rotor) @ xi
        np.testing.assert_allclose(balance, force, atol=1e-9 * np.abs(force).max())
        np.testing.assert_allclose(q1[6:] * np.cos(angle) + q2[6:] * np.sin(angle), rate, rtol=1e-12)


def test_stiffness_has_the_pattern_of_the_paper() -> None:
    A = system_A(load_machine("lab").rotor, 100.0)
    A1 = A[6:, :6]
    assert np.all(A1[:3, 3:] == 0)
    assert np.all(A1[3:, :3] == 0)  # Eq. 26: the planes couple through the gyroscopic term only
    np.testing.assert_allclose(A1[1, 0], -A1[1, 1])  # row 2 sees only y2 - y1
    assert A1[1, 2] == -A1[4, 5]  # b changes sign between the planes
    A2 = A[6:, 6:]
    assert A2[0, 0] < 0
    assert A2[3, 3] < 0  # c44, which the printed Eq. 27 lost
    assert A2[2, 5] == -A2[5, 2] != 0
    assert np.count_nonzero(A2) == 4


def test_discretisation_keeps_the_stationary_covariance() -> None:
    machine = load_machine("lab")
    A, B = expanded_A(machine.rotor, machine.operation.speed_rad_s, SOURCES), expanded_B(SOURCES)
    R = stationary_covariance(A, B)
    F, G = discretise(A, B, 1 / 2000)
    deviation = np.sqrt(np.diag(R))
    kept = (F @ R @ F.T + G @ G.T) / np.outer(deviation, deviation)
    np.testing.assert_allclose(kept, R / np.outer(deviation, deviation), atol=1e-11)


def test_advance_equals_the_recursion() -> None:
    rng = np.random.default_rng(0)
    A, B = expanded_A(load_machine("lab").rotor, 138.0, SOURCES), expanded_B(SOURCES)
    F, G = discretise(A, B, 1 / 2000)
    scale = np.sqrt(np.diag(stationary_covariance(A, B)))
    for n_samples in (1, 2, 37, 1000):
        x = scale * rng.standard_normal(scale.size)
        noise = rng.standard_normal((n_samples, scale.size))
        got = advance(F, G, x, noise)
        for step, w in enumerate(noise):
            x = F @ x + G @ w
            np.testing.assert_allclose(got[step] / scale, x / scale, atol=1e-10)


def test_process_noise_of_a_double_integrator_has_its_closed_form() -> None:
    """White force of intensity S on a barely bound mass: G Gᵀ = S/m² [[T³/3, T²/2], [T²/2, T]]."""
    S, m, T = 4.0, 2.0, 1e-4
    A = np.array([[0.0, 1.0], [-1e-6, -1e-3]])
    _, G = discretise(A, np.array([[0.0], [np.sqrt(S) / m]]), T)
    expected = S / m**2 * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    np.testing.assert_allclose(G @ G.T, expected, rtol=1e-5)


DIRECTION = (0.2, 0.7, 0.01, 0.5, 1.0, 0.02)
SHAPES = {
    **{f"order {n}": Source(cutoff_hz=60, direction=DIRECTION, force_rms_N=2, order=n) for n in (1, 2, 3, 4)},
    "hump": Source(cutoff_hz=150, direction=DIRECTION, force_rms_N=2, hump_share=0.7, hump_hz=70, hump_damping=0.3),
    "hump alone": Source(cutoff_hz=30, direction=DIRECTION, force_rms_N=2, order=1, hump_share=1.0),
}


@pytest.mark.parametrize("source", SHAPES.values(), ids=SHAPES.keys())
def test_the_force_has_the_stated_variance_and_spectrum(source: Source) -> None:
    colour = colouring_filter(source)
    covariance = stationary_covariance(colour.R, colour.S)
    assert colour.output @ covariance @ colour.output == pytest.approx(1.0, rel=1e-9)
    frequency_hz = np.array([0.0, 5.0, 30.0, 70.0, 200.0])
    for f, density in zip(frequency_hz, source_spectrum(frequency_hz, source), strict=True):
        response = colour.output @ np.linalg.solve(2j * np.pi * f * np.eye(len(colour.R)) - colour.R, colour.S)
        assert np.sum(np.abs(response) ** 2) * source.force_rms_N**2 == pytest.approx(density, rel=1e-9)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_the_low_pass_is_a_butterworth(order: int) -> None:
    source = SHAPES[f"order {order}"]
    b, a = scipy.signal.butter(order, 2 * np.pi * source.cutoff_hz, analog=True)
    frequency_hz = np.geomspace(1, 1000, 50)
    _, response = scipy.signal.freqs(b, a, 2 * np.pi * frequency_hz)
    spectrum = source_spectrum(np.array([0.0, *frequency_hz]), source)
    np.testing.assert_allclose(spectrum[1:] / spectrum[0], np.abs(response) ** 2, rtol=1e-9)


@pytest.mark.parametrize("source", [SHAPES["order 3"], SHAPES["hump"]], ids=["order 3", "hump"])
def test_the_lyapunov_variance_equals_the_integral_of_the_spectrum(source: Source) -> None:
    """Lyapunov variance of the displacements = integral of |H S|² over the force's spectrum."""
    machine = load_machine("heavy")  # damped enough for a plain sum over frequency
    rotor, speed = machine.rotor, machine.operation.speed_rad_s
    R = stationary_covariance(expanded_A(rotor, speed, (source,)), expanded_B((source,)))
    frequency_hz = np.arange(0.005, 1000, 0.01)
    w = 2 * np.pi * frequency_hz[:, None, None]
    dynamic = -(w**2) * M_matrix(rotor) + 1j * w * P_matrix(rotor, speed) + Q_matrix(rotor)
    response = np.linalg.solve(dynamic, np.array(source.direction)[:, None])[:, :, 0]
    variance = 2 * np.sum(np.abs(response) ** 2 * source_spectrum(frequency_hz, source)[:, None], axis=0) * 0.01
    np.testing.assert_allclose(np.diag(R)[:6], variance, rtol=2e-3)
