"""Mass, damping, stiffness and input matrices of the rotor (Eqs. 1-6, 13-16, 26, 27)."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from models.physics.parameters import RotorParameters
from models.signals.block import FloatArray

__all__ = [
    "COORDINATES",
    "STATES",
    "STATE_INDEX",
    "H_matrix",
    "M_matrix",
    "P_matrix",
    "Q_matrix",
    "Q_shaft",
    "system_A",
]

COORDINATES = ("y1", "y2", "psi", "z1", "z2", "phi")
"""Order of the six degrees of freedom (Eq. 13)."""

STATES = (*COORDINATES, *(f"{name}_dot" for name in COORDINATES))
"""Order of the twelve states (Eq. 2); the paper counts them from 1."""

STATE_INDEX: Mapping[str, int] = MappingProxyType({name: index for index, name in enumerate(STATES)})
"""Position of each state, counted from 0."""


def M_matrix(rotor: RotorParameters) -> FloatArray:
    """Mass matrix (Eq. 14), shape (6, 6), kg and kg m²."""
    plane = [rotor.m1_kg, rotor.m2_kg, rotor.I2_kg_m2]
    return np.diag([*plane, *plane])


def Q_shaft(rotor: RotorParameters) -> FloatArray:
    """Stiffness of the shaft alone, shape (6, 6), N/m, N and N m; linear in EI.

    The cantilever from bearing (which keeps its slope) to disc: a = 12EI/L³, b = 6EI/L², c = 4EI/L. It has the zero
    pattern and the signs of Eq. (26).
    """
    L = rotor.shaft_length_m
    a, b, c = 12 * rotor.EI_N_m2 / L**3, 6 * rotor.EI_N_m2 / L**2, 4 * rotor.EI_N_m2 / L
    plane = np.array([[a, -a, b], [-a, a, -b], [b, -b, c]])
    mirror = np.diag([1.0, 1.0, -1.0])
    Q = np.zeros((6, 6))
    Q[:3, :3] = plane
    Q[3:, 3:] = mirror @ plane @ mirror
    return Q


def Q_matrix(rotor: RotorParameters) -> FloatArray:
    """Stiffness matrix, shaft and bearing springs, shape (6, 6)."""
    Q = Q_shaft(rotor)
    Q[0, 0] += rotor.k_by_N_per_m
    Q[3, 3] += rotor.k_bz_N_per_m
    return Q


def P_matrix(rotor: RotorParameters, speed_rad_s: float) -> FloatArray:
    """Damping at the bearing and gyroscopic coupling of the tilts, shape (6, 6).

    Eq. (27) with the entry c44 that its printed form lost.
    """
    P = np.zeros((6, 6))
    P[0, 0] = rotor.c_by_N_s_per_m
    P[3, 3] = rotor.c_bz_N_s_per_m
    P[2, 5] = speed_rad_s * rotor.I2p_kg_m2
    P[5, 2] = -speed_rad_s * rotor.I2p_kg_m2
    return P


def H_matrix(rotor: RotorParameters, speed_rad_s: float) -> FloatArray:
    """Input matrix of n(t) = (cos Ωt, sin Ωt): unbalance force on the disc (Eq. 16), shape (6, 2), N."""
    force_N = rotor.m2_kg * rotor.e_m * speed_rad_s**2
    H = np.zeros((6, 2))
    H[1, 0] = force_N
    H[4, 1] = force_N
    return H


def system_A(rotor: RotorParameters, speed_rad_s: float) -> FloatArray:
    """System matrix A of the state equation (Eq. 4), shape (12, 12)."""
    inverse_masses = 1 / np.diag(M_matrix(rotor))[:, None]
    A = np.zeros((12, 12))
    A[:6, 6:] = np.eye(6)
    A[6:, :6] = -inverse_masses * Q_matrix(rotor)
    A[6:, 6:] = -inverse_masses * P_matrix(rotor, speed_rad_s)
    return A
