"""Compensation of what sensors and inputs do to a vibration: the high-pass of AC coupling, and delays of channels.

Both are compensated exactly in the frequency domain, where the moments of a window already are: cross-spectra and
vectors are divided by the response that the machine file states. Samples are left as they are: an inverse high-pass in
time would restore mostly noise below the band, and make a window depend on the samples before it.
"""

import math
from collections.abc import Sequence

import numpy as np

from models.signals.block import ComplexArray, FloatArray
from models.signals.channels import Sensor


class Equaliser:
    """Responses of a machine's sensors, one column each."""

    def __init__(self, sensors: Sequence[Sensor]) -> None:
        # (n,): corner and order of the high-pass, 0 Hz where there is none; delay behind the times of the samples.
        self._corner_hz = np.array([one.high_pass_hz or 0.0 for one in sensors])
        self._order = np.array([one.high_pass_order or 1 for one in sensors], dtype=np.intp)
        self._delay_s = np.array([(one.delay_us or 0.0) * 1e-6 for one in sensors])

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Complex gain of each sensor, shape (..., n); 1 where the frequency is unknown (nan) or 0.

        Frequencies, shape (...), are negative for a shaft angle that decreases.
        """
        known = (np.isfinite(frequency_hz) & (frequency_hz != 0))[..., np.newaxis]
        f = np.where(known, frequency_hz[..., np.newaxis], 1.0)
        below = self._corner_hz / (1j * f)
        damped = np.where(self._order == 2, 1 + math.sqrt(2) * below + below**2, 1 + below)
        return np.asarray(np.where(known, np.exp(-2j * np.pi * f * self._delay_s) / damped, 1.0), dtype=np.complex128)

    def missing(self, segments: ComplexArray, frequencies_hz: FloatArray, lags_s: FloatArray) -> FloatArray:
        """What the sensors' responses remove from the correlations, shape (n_hops, n_lags, n, n).

        Add it to E{x_i(t) x_j(t + τ)} of each hop. `segments`, shape (n_hops, n_segments, n_bins, n), are Fourier
        coefficients of the sensors' output, two-sided densities.
        """
        n_hops, n_segments, n_bins, n = segments.shape
        of_bins = segments.transpose(0, 2, 3, 1)
        seen = of_bins.conj() @ of_bins.swapaxes(2, 3) / n_segments
        response = self.response(frequencies_hz)
        lacks = seen * (1 / (response[:, :, np.newaxis].conj() * response[:, np.newaxis]) - 1)
        step_hz = float(frequencies_hz[1] - frequencies_hz[0])
        turn = 2 * step_hz * np.exp(2j * np.pi * np.outer(lags_s, frequencies_hz))
        return np.asarray((turn @ lacks.reshape(n_hops, n_bins, n * n)).real.reshape(n_hops, -1, n, n))


def equaliser_of(sensors: Sequence[Sensor]) -> Equaliser | None:
    """Equaliser of sensors, one per column; None if the file states no high-pass and no delay."""
    if all(one.high_pass_hz is None and one.delay_us is None for one in sensors):
        return None
    return Equaliser(sensors)
