"""The Timoshenko beam element, which becomes the Euler–Bernoulli element without shear.

References
----------
M. I. Friswell, J. E. T. Penny, S. D. Garvey, A. W. Lees, Dynamics of Rotating Machines (Cambridge, 2010), section 5.4.
"""

import numpy as np

from models.signals.block import FloatArray


def shear_ratio(EI: float, shear_stiffness_N: float, length_m: float) -> float:
    """Φ = 12 EI / (κGA L²), the ratio of an element's bending to its shear stiffness; 0 neglects shear."""
    return 12 * EI / (shear_stiffness_N * length_m**2)


def beam_stiffness(length_m: float, EI: float, phi: float) -> FloatArray:
    """Stiffness on (v, v', v, v') at both ends, shape (4, 4), N and m."""
    L = length_m
    K = [
        [12, 6 * L, -12, 6 * L],
        [6 * L, (4 + phi) * L**2, -6 * L, (2 - phi) * L**2],
        [-12, -6 * L, 12, -6 * L],
        [6 * L, (2 - phi) * L**2, -6 * L, (4 + phi) * L**2],
    ]
    return EI / ((1 + phi) * L**3) * np.array(K)


def beam_mass(length_m: float, mass_per_m: float, phi: float) -> FloatArray:
    """Consistent mass of translation, shape (4, 4), kg and m."""
    L, p = length_m, phi
    a = 312 + 588 * p + 280 * p**2
    b = (44 + 77 * p + 35 * p**2) * L
    c = 108 + 252 * p + 140 * p**2
    d = -(26 + 63 * p + 35 * p**2) * L
    e = (8 + 14 * p + 7 * p**2) * L**2
    f = -(6 + 14 * p + 7 * p**2) * L**2
    M = [[a, b, c, d], [b, e, -d, f], [c, -d, a, -b], [d, f, -b, e]]
    return mass_per_m * L / (840 * (1 + p) ** 2) * np.array(M)


def beam_inertia(length_m: float, inertia_kg_m: float, phi: float) -> FloatArray:
    """Consistent rotary inertia, shape (4, 4); twice that times the speed is the shaft's gyroscopic matrix.

    `inertia_kg_m` is density times second moment of area, i.e. the moment of inertia about a diameter per length; `phi`
    is from `shear_ratio`.
    """
    L, p = length_m, phi
    a = 36.0
    b = (3 - 15 * p) * L
    c = (4 + 5 * p + 10 * p**2) * L**2
    d = (-1 - 5 * p + 5 * p**2) * L**2
    N = [[a, b, -a, b], [b, c, -b, d], [-a, -b, a, -b], [b, d, -b, c]]
    return inertia_kg_m / (30 * (1 + p) ** 2 * L) * np.array(N)
