"""Whether the force that moves the machine is the one that its relations were learned under.

Parts of the machine that a relation omits bias its coefficients. As long as the same force moves the machine the bias
is constant and cancels in a change. The residual of each row is that force, as far as the sensors show it. Its
cross-spectra in bands describe its level, colour and direction.
"""

from collections.abc import Sequence

import numpy as np

from models.diagnosis.baseline.lag_moments import RowWindow
from models.diagnosis.window.moments import ComplexArray
from models.signals.block import FloatArray

_BAND_HZ = 8.0
# Largest distance at which two forces count as the same. On finite-element rotors (overhung, between bearings; seeds
# 100 to 105, windows of 30 s) the same force is 0.0005 to 0.019 from itself with changes of up to c -40 %, up to 0.038
# with k -25 %; forces of the same colour and level in other directions 0.044 to 0.97, one window in ten below 0.09.
_MOST_DISTANCE = 0.03


def force_spectrum(windows: Sequence[RowWindow], combinations: Sequence[FloatArray]) -> FloatArray:
    """Mean cross-spectra of the residuals of all rows in one window, by bands, shape (n_bands, n_rows, n_rows).

    The residual of each row is a combination of its terms. Real parts are stored on and above the diagonal, imaginary
    parts below.
    """
    window = windows[0].window
    forces = np.stack([one.terms @ combination for one, combination in zip(windows, combinations, strict=True)], axis=1)
    spectra = forces @ window.spectrum @ forces.conj().transpose(0, 2, 1)
    f = window.frequencies_hz
    bands = np.array_split(spectra, max(1, int((f[-1] - f[0]) * window.time_scale // _BAND_HZ)))
    mean = np.stack([band.mean(axis=0) for band in bands])
    return np.asarray(np.triu(mean.real) + np.tril(mean.imag, -1), dtype=np.float64)


def alike(healthy: FloatArray, now: FloatArray) -> bool:
    """Whether two forces (`force_spectrum`) agree in level, colour and direction.

    In each band, every row is normalised with its own healthy power.
    """
    if healthy.size == 0 or healthy.shape != now.shape:
        return False
    power = np.einsum("fii->fi", healthy)
    if not np.all(power > 0):
        return False
    root = np.sqrt(power)
    A, B = (_hermitian(one) / root[:, :, None] / root[:, None, :] for one in (healthy, now))
    sizes = np.linalg.norm(A), np.linalg.norm(B)
    return bool(np.linalg.norm(A - B) ** 2 < 2 * _MOST_DISTANCE * sizes[0] * sizes[1])


def _hermitian(packed: FloatArray) -> ComplexArray:
    real, imaginary = np.triu(packed), np.tril(packed, -1)
    mirrored = np.triu(packed, 1).transpose(0, 2, 1)
    return np.asarray(real + mirrored + 1j * (imaginary - imaginary.transpose(0, 2, 1)), dtype=np.complex128)
