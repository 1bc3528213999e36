"""Displacement and velocity of one degree of freedom as one motion."""

import numpy as np
import pytest

from models.diagnosis.likelihood.motions import Motions
from models.diagnosis.window.moments import ComplexArray
from models.signals.block import FloatArray

STATES = ("y1", "z1", "y1_dot")
SCALE = np.array([2e-6, 3e-6, 4e-4])
W = 2 * np.pi * np.linspace(5.0, 150.0, 60)


def spectra(motion: FloatArray, noise: FloatArray, gains: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> ComplexArray:
    """Expected cross-spectra of y1, z1 and the rate of y1, with white noise in units of SCALE."""
    shape = np.zeros((W.size, 3, 2), dtype=np.complex128)
    shape[:, 0, 0], shape[:, 1, 1], shape[:, 2, 0] = 1, 1, 1j * W
    seen = np.array(gains)[:, None] * shape
    return np.asarray(seen @ (motion * np.eye(2)) @ seen.conj().swapaxes(1, 2) + np.diag(noise * SCALE**2))


def test_noise_of_equal_size_stays_one_and_white() -> None:
    motions = Motions(STATES, SCALE)
    assert motions.n == 2
    seen = motions.spectra(spectra(np.array(0.0), np.ones(3)), W)
    np.testing.assert_allclose(seen, np.broadcast_to(np.eye(2), seen.shape), atol=1e-12)


def test_a_motion_holds_what_both_sensors_say_of_it() -> None:
    """Its signal-to-noise ratio is the sum of the sensors' own: nothing is lost, nothing counted twice."""
    motions = Motions(STATES, SCALE)
    power = 1e-12
    seen = motions.spectra(spectra(np.array(power), np.zeros(3)), W)
    np.testing.assert_allclose(seen[:, 0, 0].real, power / SCALE[0] ** 2 + power * W**2 / SCALE[2] ** 2)
    np.testing.assert_allclose(seen[:, 1, 1].real, power / SCALE[1] ** 2)
    np.testing.assert_allclose(np.abs(motions.factor(W, W)[:, 0]) ** 2 * power, seen[:, 0, 0].real)


def test_shares_of_a_motion_add_up_to_one() -> None:
    shares = Motions(STATES, SCALE).shares(W)
    assert {state: number for state, (number, _) in shares.items()} == {"y1": 0, "z1": 1, "y1_dot": 0}
    np.testing.assert_allclose(shares["y1"][1] + shares["y1_dot"][1], 1.0)
    np.testing.assert_allclose(shares["z1"][1], 1.0)


@pytest.mark.parametrize("gain", [0.9, 1.0, 1.1])
def test_a_wrong_gain_shows_in_the_rest_of_its_pair(gain: float) -> None:
    motions = Motions(STATES, SCALE)
    states = spectra(np.array(1e-10), np.full(3, 1e-3), gains=(1.0, 1.0, gain))
    (found,) = motions.mismatches(states, W, np.full(W.size, 11.0))
    assert found.states == ("y1", "y1_dot")
    assert found.change == pytest.approx(gain - 1, abs=0.02)
    assert (abs(found.z) > 5) == (gain != 1.0)
