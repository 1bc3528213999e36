"""Amplitudes and phases at orders of running speed (ISO 13373-2), in one hop."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt
import scipy  # its sub-packages are loaded when they are first used

from models.signals.block import ComplexArray, Float32Array, FloatArray

ORDERS = {"x_half": 0.5, "x1": 1.0, "x2": 2.0, "x3": 3.0}
"""Multiples of running speed, by the name of their measure."""

_MANY_REVOLUTIONS = 8.0
_SAMPLES_A_TURN = 8.0
"""Fewest samples per turn: products of two orders reach six times running speed."""
_NEAR = 8
"""Samples over which a shaft's speed is taken as constant."""

Spectrum = npt.NDArray[np.complex64] | ComplexArray


def order_vectors(
    x: FloatArray, unit: FloatArray, spectrum: Spectrum, amplitude: FloatArray, angle_rad: FloatArray | None
) -> ComplexArray:
    """Amplitudes at the orders, by weighted least squares: exact for orders, whatever the number of revolutions.

    Over many revolutions the samples are tapered, to keep other lines out, and decimated: as tapered samples begin and
    end at zero, the low end of their spectrum is the same signal in fewer samples, without loss at the orders.

    Parameters
    ----------
    x : ndarray, shape (n, n_samples)
    unit : ndarray, shape (n,)
        Scale of each channel, to which the amplitudes are relative: SI values may be out of range of single precision.
    spectrum : ndarray, shape (n, n_samples // 2 + 1)
        Of the tapered samples.
    amplitude : ndarray, shape (n,)
        Factor that turns the spectrum into that of x.
    angle_rad : ndarray, shape (n_samples,), or None
        See `models.levels.measures.hop_levels`.

    Returns
    -------
    ndarray of complex, shape (4, n)
        q of x / unit = Re{q e^{jkθ}} for the orders k of `ORDERS`; NaN without a rotation.
    """
    n, n_samples = x.shape
    if angle_rad is None:
        return np.full((len(ORDERS), n), np.nan, dtype=np.complex128)
    steps = (angle_rad[1::_NEAR] - angle_rad[:-1:_NEAR]) / (2 * np.pi)  # between neighbours, every `_NEAR` samples
    steps -= np.rint(steps)  # where the angle starts again from zero
    weights: FloatArray | Float32Array
    if abs(np.add.reduce(steps)) * n_samples < _MANY_REVOLUTIONS * steps.size:
        # Over few revolutions the orders are nearly collinear: separating them needs double precision.
        angle, tapered, weights, every = angle_rad, x / unit[:, None], np.ones(n_samples), 1
    else:
        most = int(1 / (_SAMPLES_A_TURN * np.abs(steps).max()))
        every = next((step for step in range(most, 1, -1) if n_samples % step == 0), 1)
        angle, kept = angle_rad[::every], n_samples // every
        tapered = np.fft.irfft(spectrum[:, : kept // 2 + 1], n=kept, axis=1)
        tapered = (tapered * (amplitude / unit)[:, None]).astype(np.float32)
        weights, _ = hann_taper(kept)
    # Half the angle, wrapped to near zero: single precision has too few digits for the angle after many turns.
    halves = angle / (2 * np.pi)
    halves[1:] -= np.rint(halves[1:] - halves[:-1]).cumsum()
    halves /= 2
    halves -= np.rint(halves)
    half = (2 * np.pi * halves).astype(tapered.dtype)
    turning = np.empty((len(ORDERS), half.size), np.result_type(half, np.complex64))  # e^{jkθ}
    turning[0].real, turning[0].imag = np.cos(half), np.sin(half)
    for row, first, second in ((1, 0, 0), (2, 1, 1), (3, 2, 1)):
        np.multiply(turning[first], turning[second], out=turning[row])
    regressors = np.empty((1 + 2 * len(ORDERS), half.size), half.dtype)
    regressors[0], regressors[1::2], regressors[2::2] = 1, turning.real, turning.imag
    _, solved, singular = scipy.linalg.lapack.dposv(
        every * ((regressors * weights) @ regressors.T).astype(np.float64), (regressors @ tapered.T).astype(np.float64)
    )
    if singular:  # a shaft that stands still
        return np.full((len(ORDERS), n), np.nan, dtype=np.complex128)
    return np.asarray(solved[1::2] - 1j * solved[2::2], dtype=np.complex128)


def without_orders(x: FloatArray, vectors: ComplexArray, angle_rad: FloatArray) -> FloatArray:
    """Samples, shape (n, n_samples), less their parts at the whole orders among the vectors of `order_vectors`."""
    turn = np.exp(1j * angle_rad.astype(np.float32)).astype(np.complex64)
    turning = np.stack([turn, turn * turn, turn * turn * turn])
    vectors = np.nan_to_num(vectors[1:]).T  # NaN if the shaft stands still
    return np.asarray(x - (vectors.real @ turning.real - vectors.imag @ turning.imag), dtype=np.float64)


@lru_cache(maxsize=8)
def hann_taper(size: int) -> tuple[Float32Array, float]:
    """Hann taper of `size` samples, and the factor that turns squared magnitudes of bins into mean squares."""
    taper = np.hanning(size + 1)[:-1].astype(np.float32)
    taper.flags.writeable = False
    return taper, 2 / (size * float(taper @ taper))
