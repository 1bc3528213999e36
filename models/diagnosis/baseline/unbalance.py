"""The unbalance from the rotation-synchronous vectors, through the relation that the stochastic part taught.

With the phase reference as reference channel the stochastic force drops out of the relation, and what is left of the
synchronous vectors is the unbalance force over the stiffness to ground, F = Y1 + jΩ(c/k) Y1 - Ω²(m2/k) Y2 - …, in both
planes. A bearing that changed enters with its own reading, so that its effect on the 1x amplitude is not taken for
unbalance.
"""

from dataclasses import dataclass

import numpy as np

from models.diagnosis.baseline.relation import N_COEFFICIENTS
from models.diagnosis.moments import ComplexArray
from models.diagnosis.window import WindowStatistics
from models.signals.block import FloatArray

__all__ = ["SPEED_TOLERANCE", "Rotation", "SynchronousState", "relative_force", "rotation_of", "slopes"]

SPEED_TOLERANCE = 0.03
"""Relative deviation of the speed within which synchronous vectors are compared."""

_CHANNELS = ("y1", "y2", "z1", "z2")
_NEIGHBOURS = (2, 8)


@dataclass(frozen=True, slots=True)
class Rotation:
    """Synchronous vectors of one window, or of a baseline.

    Attributes
    ----------
    vectors : ndarray, shape (8,)
        Real parts of y1, y2, z1, z2, then their imaginary parts, m.
    covariance : ndarray, shape (8, 8)
        From the stochastic part near the speed.
    speed_rad_s : float
    """

    vectors: FloatArray
    covariance: FloatArray
    speed_rad_s: float


@dataclass(frozen=True, slots=True)
class SynchronousState:
    """All that the unbalance depends on.

    Attributes
    ----------
    coefficients : ndarray, shape (8,)
        Of the relation in y, then in z.
    change : ndarray, shape (4,)
        Of stiffness and damping in y, then in z.
    now, healthy : ndarray, shape (8,)
        Synchronous vectors.
    """

    coefficients: FloatArray
    change: FloatArray
    now: FloatArray
    healthy: FloatArray


def rotation_of(window: WindowStatistics) -> Rotation | None:
    """Synchronous vectors of a window with their covariance; None without a phase reference or a channel."""
    if window.synchronous is None or any(name not in window.states for name in _CHANNELS):
        return None
    columns = [window.states.index(name) for name in _CHANNELS]
    q = window.synchronous[columns]
    step_hz = window.frequencies_hz[1] - window.frequencies_hz[0]
    distance = np.abs(np.round((window.frequencies_hz - window.speed_rad_s / (2 * np.pi)) / step_hz))
    # the regression has emptied the bin of the line itself
    near = (distance >= _NEIGHBOURS[0]) & (distance <= _NEIGHBOURS[1])
    if not np.any(near):
        return None
    density = window.spectrum[near][:, columns][:, :, columns].mean(axis=0) * (2 / window.duration_s)
    # q = a - jb with the phase of cos θ: the density of q is that of the transform
    covariance = np.block([[density.real, -density.imag], [density.imag, density.real]])
    return Rotation(np.concatenate([q.real, q.imag]), covariance, window.speed_rad_s)


def relative_force(state: SynchronousState, speed_now: float, speed_healthy: float) -> FloatArray:
    """Unbalance force over the healthy one, less one: real parts in y and z, then imaginary parts; shape (4,)."""
    now = _force(state.coefficients, state.change, state.now, speed_now)
    healthy = _force(state.coefficients, np.zeros(4), state.healthy, speed_healthy)
    ratio = now / healthy * (speed_healthy / speed_now) ** 2 - 1
    return np.concatenate([ratio.real, ratio.imag])


def _force(coefficients: FloatArray, change: FloatArray, vectors: FloatArray, W: float) -> ComplexArray:
    q = vectors[:4] + 1j * vectors[4:]
    forces = np.empty(2, dtype=np.complex128)
    for plane in range(2):
        one, two = q[2 * plane], q[2 * plane + 1]
        rate, disc, own, shaft = coefficients[N_COEFFICIENTS * plane : N_COEFFICIENTS * (plane + 1)]
        stiffness, damping = change[2 * plane : 2 * plane + 2]
        forces[plane] = (
            (1 + stiffness) * one
            - rate * (1 + damping) * 1j * W * one
            + W**2 * (disc * two + own * one)
            - shaft * (two - one)
        )
    return forces


def slopes(state: SynchronousState, speed_now: float, speed_healthy: float) -> tuple[FloatArray, ...]:
    """Derivatives of `relative_force` to coefficients, change, now and healthy, by central differences."""
    parts = [state.coefficients, state.change, state.now, state.healthy]
    derivatives = []
    for number, part in enumerate(parts):
        columns = []
        floor = 1e-3 if number == 1 else 0.0
        step_of = 1e-4 * np.maximum(np.abs(part), max(floor, 1e-3 * float(np.max(np.abs(part)))))
        for position, step in enumerate(step_of):
            ends = []
            for sign in (1, -1):
                moved = [other.copy() for other in parts]
                moved[number][position] += sign * step
                ends.append(relative_force(SynchronousState(*moved), speed_now, speed_healthy))
            columns.append((ends[0] - ends[1]) / (2 * step))
        derivatives.append(np.stack(columns, axis=1))
    return tuple(derivatives)
