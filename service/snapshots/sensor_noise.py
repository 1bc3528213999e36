"""Noise of single sensors, beside the spectra that theory gives what they measure.

The likelihood knows the noise of motions, which a displacement and a velocity sensor make together: where one of them
is the better one, the other's noise hardly counts, and is not determined. Here every sensor is looked at alone. The
density is d(f) = d₀ (1 + (f/f_r)²)^b with f_r two thirds of the band's end, as there, by Fisher scoring of the Whittle
likelihood with the theory held.
"""

import numpy as np

from models.signals.block import FloatArray

__all__ = ["noise_density", "sensor_noise"]

_STEPS = 12
_CLOSE = 0.01
_LEAST, _USUAL = 1e-7, 1e-3
"""Density over the channel's mean density: the least that is looked for, and where the search begins."""
_PULL = np.array([0.05, 1.0])
"""Weak pull of level and colour to what is usual, for sensors whose noise does not show."""


def noise_density(parameters: FloatArray, frequencies_hz: FloatArray, high_hz: float) -> FloatArray:
    """d(f) of a sensor, SI²/Hz.

    Parameters
    ----------
    parameters : ndarray, shape (2,)
        ln d₀ and b.
    frequencies_hz : ndarray
    high_hz : float
        End of the band.
    """
    shape = np.log1p((frequencies_hz / (2 / 3 * high_hz)) ** 2)
    return np.asarray(np.exp(parameters[0] + parameters[1] * shape), dtype=np.float64)


def sensor_noise(
    measured: FloatArray, theory: FloatArray, averages: FloatArray, frequencies_hz: FloatArray, high_hz: float
) -> FloatArray:
    """Find ln d₀ and b of one sensor.

    Parameters
    ----------
    measured, theory : ndarray, shape (n_groups,)
        Densities as estimated, and as theory has them without noise, SI²/Hz.
    averages : ndarray, shape (n_groups,)
        Independent averages of `measured`.
    frequencies_hz : ndarray, shape (n_groups,)
    high_hz : float
        End of the band.

    Returns
    -------
    ndarray, shape (2,)
    """
    shape = np.log1p((frequencies_hz / (2 / 3 * high_hz)) ** 2)
    level = float(np.log(averages @ measured / averages.sum()))
    usual = np.array([level + np.log(_USUAL), 0.0])
    found = usual.copy()
    for _ in range(_STEPS):
        noise = noise_density(found, frequencies_hz, high_hz)
        expected = theory + noise
        slopes = np.stack([noise / expected, shape * noise / expected])
        gradient = slopes @ (averages * (measured / expected - 1)) - _PULL * (found - usual)
        information = (slopes * averages) @ slopes.T + np.diag(_PULL)
        step = np.clip(np.linalg.solve(information, gradient), -1.5, 1.5)
        found = found + step
        found[0] = np.clip(found[0], level + np.log(_LEAST), level)
        found[1] = np.clip(found[1], -4.0, 4.0)
        if np.all(np.abs(step) < _CLOSE):
            break
    return found
