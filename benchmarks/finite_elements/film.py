"""The oil film of a plain cylindrical bearing: eight speed-dependent coefficients in closed form.

Short-bearing theory (Ocvirk): pressure gradients are axial only, and half of the film carries load.

References
----------
F. W. Ocvirk, Short-bearing approximation for full journal bearings (NACA Technical Note 2808, 1952).
M. I. Friswell, J. E. T. Penny, S. D. Garvey, A. W. Lees, Dynamics of Rotating Machines (Cambridge, 2010), section
5.5.1.
"""

import math
from dataclasses import dataclass

import numpy as np

from models.signals.block import FloatArray


@dataclass(frozen=True, slots=True)
class Film:
    """Oil film of a bearing that carries a constant load downwards, against z."""

    diameter_m: float
    length_m: float
    clearance_m: float  # radial
    viscosity_Pa_s: float
    load_N: float

    def sommerfeld(self, speed_rad_s: float) -> float:
        """Ocvirk's number D Ω η L³ / (8 f c²)."""
        viscous = self.diameter_m * speed_rad_s * self.viscosity_Pa_s * self.length_m**3
        return viscous / (8 * self.load_N * self.clearance_m**2)

    def eccentricity(self, speed_rad_s: float) -> float:
        """Eccentricity of the journal over the clearance."""
        S2 = self.sommerfeld(speed_rad_s) ** 2
        roots = np.roots([1, -4, 6 - S2 * (16 - math.pi**2), -(4 + math.pi**2 * S2), 1])
        return math.sqrt(min(root.real for root in roots if abs(root.imag) < 1e-9 and 0 < root.real < 1))

    def coefficients(self, speed_rad_s: float) -> tuple[FloatArray, FloatArray]:
        """Stiffness, N/m, and damping, Ns/m, on (y, z), shape (2, 2) each, for rotation from y to z."""
        e = self.eccentricity(speed_rad_s)
        p, q = math.pi**2, math.sqrt(1 - e**2)
        h = 1 / (p * (1 - e**2) + 16 * e**2) ** 1.5
        cross = p * (1 + 2 * e**2) - 16 * e**2
        K = [
            [4 * (p * (2 - e**2) + 16 * e**2), math.pi * (p * (1 - e**2) ** 2 - 16 * e**4) / (e * q)],
            [
                -math.pi * (p * (1 - e**2) * (1 + 2 * e**2) + 32 * e**2 * (1 + e**2)) / (e * q),
                4 * (p * (1 + 2 * e**2) + 32 * e**2 * (1 + e**2) / (1 - e**2)),
            ],
        ]
        C = [
            [2 * math.pi * q * cross / e, -8 * cross],
            [-8 * cross, 2 * math.pi * (p * (1 - e**2) ** 2 + 48 * e**2) / (e * q)],
        ]
        unit = h * self.load_N / self.clearance_m
        return unit * np.array(K), unit / speed_rad_s * np.array(C)
