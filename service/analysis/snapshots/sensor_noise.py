"""Noise of single sensors, beside the spectra that theory gives what they measure.

The likelihood knows the noise of motions, which a displacement and a velocity sensor make together: where one of them
is the better one, the other's noise hardly counts, and is not determined. Here every sensor is looked at alone. The
density is d(f) = d₀ (1 + (f/f_r)²)^b with f_r two thirds of the band's end, as there, by damped Fisher scoring of the
Whittle likelihood with the theory held.
"""

import numpy as np

from models.signals.block import FloatArray

_STEPS, _LONGEST, _CLOSE = 30, 1.5, 0.01
_STEEPEST = 4.0
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

    def seen(point: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Noise, expected density, and the log-likelihood with the pulls."""
        noise = np.exp(point[0] + point[1] * shape)
        expected = theory + noise
        fits = -float(averages @ (np.log(expected) + measured / expected))
        return noise, expected, fits - float(_PULL @ (point - usual) ** 2) / 2

    found, damping = usual, 1e-3
    noise, expected, value = seen(found)
    for _ in range(_STEPS):
        slopes = np.stack([noise / expected, shape * noise / expected])
        gradient = slopes @ (averages * (measured / expected - 1)) - _PULL * (found - usual)
        information = (slopes * averages) @ slopes.T + np.diag(_PULL)
        step = np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
        step = np.clip(step, -_LONGEST, _LONGEST)
        trial = np.clip(found + step, (level + np.log(_LEAST), -_STEEPEST), (level, _STEEPEST))
        there = seen(trial)
        if there[2] > value:
            found, (noise, expected, value), damping = trial, there, damping / 8
            if np.all(np.abs(step) < _CLOSE):
                break
        else:
            damping *= 8
    return found
