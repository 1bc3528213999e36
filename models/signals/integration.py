"""Acceleration to velocity and displacement.

Integration amplifies what is slow: 1/ω once, 1/ω² twice, so that an accelerometer's drift would drown the vibration. A
high-pass filter has to go with it, and below its corner the result is not a measurement. Both are done in the
frequency domain (A. Brandt, R. Brincker: Integrating time signals in frequency domain. Comparison with time domain
integration. Measurement 58, 2014, 511-519): the samples' Fourier transform is divided by (jω)ⁿ, exact in amplitude and
phase up to half the sampling rate, where trapezoids would fall short, and multiplied by the gain of a fourth-order
Butterworth high-pass that is run forwards and backwards, 1 / (1 + (f_c / f)⁸), which shifts no phase.
"""

import numpy as np
from scipy import fft

from models.signals.block import FloatArray

__all__ = ["integrated", "lowest_valid_hz", "settling_s"]

_ORDER = 4
_SETTLING = 5.0
_VALID = 2.0


def lowest_valid_hz(high_pass_hz: float) -> float:
    """Frequency above which amplitudes are right within 0.4 %: twice the corner of the high-pass."""
    return _VALID * high_pass_hz


def settling_s(high_pass_hz: float) -> float:
    """How far beginning and end of a stretch reach into the result: five periods of the corner frequency.

    The slowest pole of the filter decays with sin(π/8) of its corner frequency, to 6e-6 within this time.
    """
    return _SETTLING / high_pass_hz


def integrated(acceleration: FloatArray, rate_hz: float, times: int, high_pass_hz: float) -> FloatArray:
    """Integrate samples once or twice.

    The first and last `settling_s` of the result are not valid.

    Parameters
    ----------
    acceleration : ndarray, shape (n,)
        Equally spaced, without a gap.
    rate_hz : float
        Samples per second.
    times : int
        1 for velocity, 2 for displacement.
    high_pass_hz : float
        Corner of the high-pass; valid from `lowest_valid_hz`.

    Returns
    -------
    ndarray, shape (n,)
        In the unit of `acceleration` times s or s².

    Examples
    --------
    >>> t = np.arange(4000) / 1000.0
    >>> v = integrated(np.cos(2 * np.pi * 25 * t), 1000.0, 1, 5.0)
    >>> bool(np.allclose(v[1000:3000], np.sin(2 * np.pi * 25 * t[1000:3000]) / (2 * np.pi * 25), atol=1e-7))
    True
    """
    count = acceleration.size
    size = fft.next_fast_len(count, real=True)
    frequency = fft.rfftfreq(size, 1 / rate_hz)
    response = np.zeros(frequency.size, dtype=np.complex128)
    above = frequency[1:]
    response[1:] = 1 / ((2j * np.pi * above) ** times * (1 + (high_pass_hz / above) ** (2 * _ORDER)))
    level = acceleration.mean()  # what comes out of a constant is nothing; taken off, the padding makes no step
    return np.asarray(fft.irfft(fft.rfft(acceleration - level, size) * response, size)[:count], dtype=np.float64)
