"""Shapes of the excitation: variance, spectrum and correlation of every filter against the theory it does not use."""

import numpy as np
import pytest
import scipy.signal

from models.machine import load_machine
from models.physics.excitation import Source, colouring_filter, expanded_A, expanded_B, source_spectrum, unit_spectrum
from models.physics.response import advance, discretise, stationary_covariance
from models.physics.rotor import M_matrix, P_matrix, Q_matrix

DIRECTION = (0.2, 0.7, 0.01, 0.5, 1.0, 0.02)
SHAPES = {
    **{f"order {n}": Source(cutoff_hz=60, direction=DIRECTION, force_rms_N=2, order=n) for n in (1, 2, 3, 4)},
    "hump": Source(cutoff_hz=150, direction=DIRECTION, force_rms_N=2, hump_share=0.7, hump_hz=70, hump_damping=0.3),
    "hump alone": Source(cutoff_hz=30, direction=DIRECTION, force_rms_N=2, order=1, hump_share=1.0),
}
shapes = pytest.mark.parametrize("source", SHAPES.values(), ids=SHAPES.keys())


@shapes
def test_the_force_has_the_stated_variance_and_spectrum(source: Source) -> None:
    colour = colouring_filter(source)
    covariance = stationary_covariance(colour.R, colour.S)
    assert colour.output @ covariance @ colour.output == pytest.approx(1.0, rel=1e-9)
    frequency_hz = np.array([0.0, 5.0, 30.0, 70.0, 200.0])
    for f, density in zip(frequency_hz, source_spectrum(frequency_hz, source), strict=True):
        response = colour.output @ np.linalg.solve(2j * np.pi * f * np.eye(len(colour.R)) - colour.R, colour.S)
        assert np.sum(np.abs(response) ** 2) * source.force_rms_N**2 == pytest.approx(density, rel=1e-9)
    if source.order == 2 and source.hump_share == 0:
        np.testing.assert_allclose(source_spectrum(frequency_hz, source) / 4, unit_spectrum(frequency_hz, 60.0))


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_the_low_pass_is_a_butterworth(order: int) -> None:
    source = SHAPES[f"order {order}"]
    b, a = scipy.signal.butter(order, 2 * np.pi * source.cutoff_hz, analog=True)
    frequency_hz = np.geomspace(1, 1000, 50)
    _, response = scipy.signal.freqs(b, a, 2 * np.pi * frequency_hz)
    spectrum = source_spectrum(np.array([0.0, *frequency_hz]), source)
    np.testing.assert_allclose(spectrum[1:] / spectrum[0], np.abs(response) ** 2, rtol=1e-9)


@shapes
def test_the_rotor_moves_as_the_spectrum_says(source: Source) -> None:
    """Lyapunov variance of the displacements = integral of |H S|² over the force's spectrum, another way round."""
    machine = load_machine("heavy")  # damped enough for a plain sum over frequency
    rotor, speed = machine.rotor, machine.operation.speed_rad_s
    R = stationary_covariance(expanded_A(rotor, speed, (source,)), expanded_B((source,)))
    frequency_hz = np.arange(0.005, 1000, 0.01)
    w = 2 * np.pi * frequency_hz[:, None, None]
    dynamic = -(w**2) * M_matrix(rotor) + 1j * w * P_matrix(rotor, speed) + Q_matrix(rotor)
    response = np.linalg.solve(dynamic, np.array(source.direction)[:, None])[:, :, 0]
    variance = 2 * np.sum(np.abs(response) ** 2 * source_spectrum(frequency_hz, source)[:, None], axis=0) * 0.01
    np.testing.assert_allclose(np.diag(R)[:6], variance, rtol=2e-3)


@shapes
def test_a_long_simulation_has_the_spectrum(source: Source) -> None:
    """Welch spectrum of the force over 400 s in bands of 16 Hz: about 2500 averages, 2 % each."""
    colour = colouring_filter(source)
    system = discretise(colour.R, colour.S, 1 / 4000)
    rng = np.random.default_rng(21)
    states = advance(system, np.zeros(len(colour.R)), rng.standard_normal((1_600_000, len(colour.R))))
    force = source.force_rms_N * states[4000:] @ colour.output
    frequency_hz, density = scipy.signal.welch(force, 4000, nperseg=4000, detrend=False)
    band = (frequency_hz >= 10) & (frequency_hz < 170)
    estimate = density[band].reshape(-1, 16).mean(axis=1) / 2
    expected = source_spectrum(frequency_hz[band], source).reshape(-1, 16).mean(axis=1)
    np.testing.assert_allclose(estimate, expected, rtol=0.06)
    assert np.var(force) == pytest.approx(source.force_rms_N**2, rel=0.03)
