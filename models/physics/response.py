"""Response of the rotor: covariance and steady motion from theory (Eqs. 17-25), and exact discretisation.

References
----------
C. F. Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans. Automatic Control 23 (1978).
"""

import numpy as np
import scipy.linalg

from models.errors import EstimationError
from models.physics.excitation import Source, expanded_A, expanded_B
from models.physics.rotor import H_matrix, M_matrix, P_matrix, Q_matrix, RotorParameters
from models.signals.block import ComplexArray, FloatArray


def stationary_covariance(A: FloatArray, B: FloatArray) -> FloatArray:
    """Solve A R(0) + R(0) Aᵀ = -B Bᵀ for the covariance of a stable system under unit white noise.

    The states are balanced first, because they differ by many orders of magnitude and the solver's error is relative to
    the largest. A, shape (n, n), is the system matrix; B, shape (n, p), is the input matrix for independent white noise
    of unit intensity.

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
    inputs = B / scale[:, None]
    rough = scipy.linalg.solve_continuous_lyapunov(A * (scale / scale[:, None]), -inputs @ inputs.T)
    # Solve once more in units of the states' standard deviations.
    deviation = np.sqrt(np.maximum(np.diag(rough), np.finfo(float).tiny)) * scale
    if not np.any(B):
        return np.zeros_like(A)
    inputs = B / deviation[:, None]
    R = scipy.linalg.solve_continuous_lyapunov(A * (deviation / deviation[:, None]), -inputs @ inputs.T)
    R = (R + R.T) / 2 * np.outer(deviation, deviation)
    return np.asarray(R, dtype=np.float64)


def stochastic_covariance(rotor: RotorParameters, speed_rad_s: float, sources: tuple[Source, ...]) -> FloatArray:
    """Covariance of the twelve rotor states under the sources, without unbalance; shape (12, 12)."""
    A, B = expanded_A(rotor, speed_rad_s, sources), expanded_B(sources)
    return stationary_covariance(A, B)[:12, :12]


def balance(rotor: RotorParameters, speed_rad_s: float) -> tuple[ComplexArray, ComplexArray]:
    """Dynamic stiffness, shape (6, 6), and force of the unbalance, shape (6,), at a speed, both of Re{… e^{jΩt}}."""
    W = speed_rad_s
    dynamic = -(W**2) * M_matrix(rotor) + 1j * W * P_matrix(rotor, W) + Q_matrix(rotor)
    return np.asarray(dynamic, dtype=np.complex128), H_matrix(rotor, W) @ np.array([1.0, -1.0j])


def synchronous_response(rotor: RotorParameters, speed_rad_s: float) -> tuple[FloatArray, FloatArray]:
    """Amplitudes q1, q2 of x_n(t) = q1 cos Ωt + q2 sin Ωt (Eq. 17), shape (12,) each."""
    xi = np.linalg.solve(*balance(rotor, speed_rad_s))
    x = np.concatenate([xi, 1j * speed_rad_s * xi])
    return x.real.copy(), -x.imag


def discretise(A: FloatArray, B: FloatArray, step_s: float) -> tuple[FloatArray, FloatArray]:
    """Discretise ẋ = A x + B w exactly: F and G, shape (n, n), of x[k+1] = F x[k] + G w[k] with w standard normal.

    Displacement, velocity and filter states differ by many orders of magnitude. They are scaled to unit standard
    deviation before the covariance is factored; otherwise displacement and velocity become inconsistent and damping is
    wrong by tens of percent. A sample is `step_s` seconds; A and B are as in `stationary_covariance`.
    """
    n = A.shape[0]
    deviation = np.sqrt(np.diag(stationary_covariance(A, B)))
    scale = np.where(deviation > 0, deviation, 1.0)
    scaled_A = A * (scale / scale[:, None])
    scaled_B = B / scale[:, None]
    loan = np.block([[-scaled_A, scaled_B @ scaled_B.T], [np.zeros((n, n)), scaled_A.T]])
    exponential = scipy.linalg.expm(loan * step_s)
    F = exponential[n:, n:].T
    covariance = F @ exponential[:n, n:]
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    G = vectors * np.sqrt(np.maximum(values, 0.0))  # full rank in theory only: rounding gives values below 0
    return F * (scale[:, None] / scale), G * scale[:, None]


def advance(F: FloatArray, G: FloatArray, state: FloatArray, noise: FloatArray) -> FloatArray:
    """States after each of many steps, shape (n_samples, n), from the state before the first one, shape (n,).

    Equals the recursion ``x = F @ x + G @ w`` row by row, with standard normal noise, shape (n_samples, n). The samples
    are cut into pieces that advance in parallel from zero states; the response to each piece's starting state is added
    afterwards. That costs √n_samples array operations instead of n_samples. The last row is the state to continue from.
    """
    n_samples, n = noise.shape
    length = max(1, int(np.sqrt(n_samples)))
    pieces = -(-n_samples // length)
    driven = np.zeros((pieces * length, n))
    driven[:n_samples] = noise @ G.T
    x = np.ascontiguousarray(driven.reshape(pieces, length, n).transpose(1, 0, 2))
    powers = F.T[np.newaxis]  # powers 1, 2, … of the transposed matrix
    while len(powers) < length:
        powers = np.concatenate([powers, powers @ powers[-1]])
    for k in range(1, length):
        x[k] += x[k - 1] @ powers[0]
    starts = np.empty((pieces, n))
    carried = np.asarray(state, dtype=np.float64)
    for piece in range(pieces):
        starts[piece] = carried
        carried = carried @ powers[length - 1] + x[-1, piece]
    x += starts @ powers[:length]
    return x.transpose(1, 0, 2).reshape(-1, n)[:n_samples]
