"""Correlation functions from theory: the Ljapunov equation and the unbalance part (Eqs. 17-25)."""

import numpy as np
import scipy.linalg

from models.errors import EstimationError
from models.physics.excitation import Source, expanded_A, expanded_B
from models.physics.matrices import H_matrix, M_matrix, P_matrix, Q_matrix
from models.physics.parameters import RotorParameters
from models.signals.block import FloatArray

__all__ = [
    "correlation",
    "stationary_covariance",
    "stochastic_covariance",
    "synchronous_correlation",
    "synchronous_response",
]


def stationary_covariance(A: FloatArray, B: FloatArray) -> FloatArray:
    """Solve A R(0) + R(0) Aᵀ = -B Bᵀ for the covariance of a stable system under unit white noise.

    The states are balanced first: they differ by many orders of magnitude, and the solver's error is relative to the
    largest.

    Parameters
    ----------
    A : ndarray, shape (n, n)
        System matrix, all eigenvalues in the left half plane.
    B : ndarray, shape (n, p)
        Input matrix of independent white noise of unit intensity.

    Raises
    ------
    EstimationError
        If A is not stable: there is no stationary covariance.
    """
    fastest = float(np.linalg.eigvals(A).real.max())
    if fastest >= 0:
        raise EstimationError(
            f"the system is unstable: an eigenvalue has real part {fastest:.3g} 1/s, expected below 0"
        )
    _, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    rough = scipy.linalg.solve_continuous_lyapunov(
        A * (scale / scale[:, None]), -(B / scale[:, None]) @ (B / scale[:, None]).T
    )
    # One refinement in units of the states' own standard deviations.
    deviation = np.sqrt(np.maximum(np.diag(rough), np.finfo(float).tiny)) * scale
    if not np.any(B):
        return np.zeros_like(A)
    inputs = B / deviation[:, None]
    R = scipy.linalg.solve_continuous_lyapunov(A * (deviation / deviation[:, None]), -inputs @ inputs.T)
    R = (R + R.T) / 2 * np.outer(deviation, deviation)
    return np.asarray(R, dtype=np.float64)


def correlation(A: FloatArray, covariance: FloatArray, lag_s: float) -> FloatArray:
    """R(τ) = E{x(t) xᵀ(t+τ)} = R(0) e^{Aᵀτ} for τ ≥ 0, transposed for τ < 0 (Eq. 18); shape (n, n)."""
    if lag_s < 0:
        return correlation(A, covariance, -lag_s).T
    return np.asarray(covariance @ scipy.linalg.expm(A.T * lag_s), dtype=np.float64)


def stochastic_covariance(rotor: RotorParameters, speed_rad_s: float, sources: tuple[Source, ...]) -> FloatArray:
    """Covariance of the twelve rotor states under the sources, without unbalance; shape (12, 12)."""
    A, B = expanded_A(rotor, speed_rad_s, sources), expanded_B(sources)
    return stationary_covariance(A, B)[:12, :12]


def synchronous_response(rotor: RotorParameters, speed_rad_s: float) -> tuple[FloatArray, FloatArray]:
    """Amplitudes q1, q2 of x_n(t) = q1 cos Ωt + q2 sin Ωt (Eq. 17), shape (12,) each."""
    W = speed_rad_s
    dynamic = -(W**2) * M_matrix(rotor) + 1j * W * P_matrix(rotor, W) + Q_matrix(rotor)
    H = H_matrix(rotor, W)
    xi = np.linalg.solve(dynamic, H[:, 0] - 1j * H[:, 1])  # force = Re{(h1 - j h2) e^{jΩt}}
    x = np.concatenate([xi, 1j * W * xi])
    return x.real.copy(), -x.imag


def synchronous_correlation(q1: FloatArray, q2: FloatArray, angle_rad: float) -> FloatArray:
    """Contribution of the unbalance to R(τ) at shaft angle Ωτ, time-averaged; shape (n, n)."""
    cosine = np.outer(q1, q1) + np.outer(q2, q2)
    sine = np.outer(q1, q2) - np.outer(q2, q1)
    return np.asarray(0.5 * (cosine * np.cos(angle_rad) + sine * np.sin(angle_rad)), dtype=np.float64)
