"""Exact discretisation of a linear stochastic system (matrix exponential, Van Loan's covariance), never Euler.

References
----------
C. F. Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans. Automatic Control 23 (1978).
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from models.physics.lyapunov import stationary_covariance
from models.signals.block import FloatArray

__all__ = ["DiscreteSystem", "advance", "discretise"]


@dataclass(frozen=True, slots=True)
class DiscreteSystem:
    """x[k+1] = F x[k] + G w[k], w standard normal.

    Attributes
    ----------
    F : ndarray, shape (n, n)
        State transition over one sample.
    G : ndarray, shape (n, n)
        Factor of the process-noise covariance.
    """

    F: FloatArray
    G: FloatArray


def discretise(A: FloatArray, B: FloatArray, step_s: float) -> DiscreteSystem:
    """Discretise ẋ = A x + B w exactly for one sample of `step_s` seconds.

    Displacement, velocity and filter states differ by many orders of magnitude. They are scaled to unit standard
    deviation before the covariance is factored; without that the displacement-velocity pair comes out inconsistent and
    damping is off by tens of percent.

    Parameters
    ----------
    A : ndarray, shape (n, n)
        Stable system matrix.
    B : ndarray, shape (n, p)
        Input matrix of unit-intensity white noise.
    step_s : float
        Sampling interval, s.

    Returns
    -------
    DiscreteSystem
        In the original, unscaled states.
    """
    n = A.shape[0]
    deviation = np.sqrt(np.diag(stationary_covariance(A, B)))
    scale = np.where(deviation > 0, deviation, 1.0)
    scaled_A = A * (scale / scale[:, None])
    scaled_B = B / scale[:, None]
    loan = np.zeros((2 * n, 2 * n))
    loan[:n, :n] = -scaled_A
    loan[:n, n:] = scaled_B @ scaled_B.T
    loan[n:, n:] = scaled_A.T
    exponential = scipy.linalg.expm(loan * step_s)
    F = exponential[n:, n:].T
    covariance = F @ exponential[:n, n:]
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    G = vectors * np.sqrt(np.maximum(values, 0.0))  # the noise has full rank in theory only; rounding goes below zero
    return DiscreteSystem(F * (scale[:, None] / scale), G * scale[:, None])


def advance(system: DiscreteSystem, state: FloatArray, noise: FloatArray) -> FloatArray:
    """Advance by many samples at once.

    Equals the recursion ``x = F @ x + G @ w`` row by row. The samples are cut into pieces that advance side by side
    from rest; the pieces' starting states follow and are carried through each piece, which costs √n array operations
    instead of n.

    Parameters
    ----------
    system : DiscreteSystem
        F and G.
    state : ndarray, shape (n,)
        State before the first step.
    noise : ndarray, shape (n_samples, n)
        Standard normal numbers, one row per step.

    Returns
    -------
    ndarray, shape (n_samples, n)
        States after each step; the last row is where to go on from.
    """
    n_samples, n = noise.shape
    length = max(1, int(np.sqrt(n_samples)))
    pieces = -(-n_samples // length)
    driven = np.zeros((pieces * length, n))
    driven[:n_samples] = noise @ system.G.T
    x = driven.reshape(pieces, length, n)
    F_T = system.F.T
    for k in range(1, length):
        x[:, k] += x[:, k - 1] @ F_T
    starts = np.empty((pieces, n))
    F_length = np.linalg.matrix_power(system.F, length)
    carried = np.asarray(state, dtype=np.float64)
    for piece in range(pieces):
        starts[piece] = carried
        carried = F_length @ carried + x[piece, -1]
    for k in range(length):
        starts = starts @ F_T
        x[:, k] += starts
    return x.reshape(-1, n)[:n_samples]
