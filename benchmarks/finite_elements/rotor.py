"""Components of a finite-element rotor, and its changes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.finite_elements.film import Film
from models.signals.block import FloatArray

CHANGEABLE = ("k_by", "c_by", "k_bz", "c_bz", "e")
"""Parameters that can change: stiffness and damping of the measured bearing, unbalance of all discs."""


@dataclass(frozen=True, slots=True)
class Disc:
    """A rigid disc of even thickness; its moments of inertia are mr²/4 about a diameter and mr²/2 polar."""

    node: int
    mass_kg: float
    radius_m: float
    unbalance_kg_m: float = 0.0
    phase_rad: float = 0.0  # angle of the heavy spot from the phase reference


@dataclass(frozen=True, slots=True)
class Bearing:
    """A bearing in a housing on its support: stiffness, N/m, and damping, Ns/m, horizontal and vertical."""

    node: int
    k_y: float
    k_z: float
    c_y: float
    c_z: float
    k_yz: float = 0.0  # force in the first direction per displacement in the second
    k_zy: float = 0.0
    housing_kg: float = 0.0  # mass that moves with the bearing
    cubic_N_per_m3: float = 0.0  # force over the third power of the displacement, in y
    cubic_ratio_z: float = 1.0  # cubic stiffness in z over that in y
    film: Film | None = None  # oil film; k and c are then factors on its coefficients, and k_yz and k_zy are ignored

    def coefficients(self, speed_rad_s: float) -> tuple[FloatArray, FloatArray]:
        """Stiffness, N/m, and damping, Ns/m, on (y, z), shape (2, 2) each, without cubic stiffness."""
        own = np.diag([self.k_y, self.k_z]), np.diag([self.c_y, self.c_z])
        coupling = np.array([[0.0, self.k_yz], [self.k_zy, 0.0]])
        if self.film is None:
            return own[0] + coupling, own[1]
        K, C = self.film.coefficients(speed_rad_s)
        crossed = 1 - np.eye(2)
        return K * (own[0] + crossed), C * (own[1] + crossed)


@dataclass(frozen=True, slots=True)
class Stand:
    """Stand of all bearings: a mass that moves in y and z, with the same stiffness and damping in both."""

    mass_kg: float
    k: float  # stiffness, N/m, and damping, Ns/m, between stand and ground
    c: float


@dataclass(frozen=True, slots=True)
class Gear:
    """A gear wheel in mesh with one that does not move sideways: a spring along the line of pressure, and a mesh tone.

    Torsion is neglected, and variation of the mesh stiffness from tooth to tooth is modelled by the tone alone.
    """

    node: int
    k: float  # mean stiffness, N/m, and damping, Ns/m, of the mesh
    c: float
    pressure_rad: float  # angle of the line of pressure from y towards z
    teeth: int
    error_m: float  # amplitude of the transmission error at the tooth frequency

    @property
    def along(self) -> FloatArray:
        """Unit vector of the line of pressure in (y, z)."""
        return np.array([math.cos(self.pressure_rad), math.sin(self.pressure_rad)])


@dataclass(frozen=True, slots=True)
class BeamRotor:
    """A round shaft of equally long beam elements; the probes are at the first bearing and the first disc."""

    name: str
    description: str
    length_m: float
    diameter_m: float
    elements: int  # nodes are numbered from 0 to this number
    bearings: tuple[Bearing, ...]
    discs: tuple[Disc, ...]
    speed_rad_s: float  # nominal
    shaft_damping_s: float = 2.0e-5  # distributed damping matrix over the shaft's stiffness matrix
    E_Pa: float = 2.1e11
    poisson: float = 0.3
    density_kg_m3: float = 7850.0
    shear: bool = True  # Timoshenko beam with rotary inertia; otherwise Euler–Bernoulli
    stand: Stand | None = None  # None is rigid ground
    gear: Gear | None = None

    @property
    def size(self) -> int:
        """Number of coordinates: four for every node, and two for a stand."""
        return 4 * (self.elements + 1) + (2 if self.stand else 0)

    @property
    def linear(self) -> bool:
        """Whether no bearing has cubic stiffness."""
        return all(bearing.cubic_N_per_m3 == 0 for bearing in self.bearings)

    @property
    def bending_stiffness(self) -> float:
        """EI, N m²."""
        return self.E_Pa * math.pi * self.diameter_m**4 / 64

    @property
    def area_m2(self) -> float:
        """Cross-section."""
        return math.pi * self.diameter_m**2 / 4


def changed_rotor(rotor: BeamRotor, changes: Mapping[str, float]) -> BeamRotor:
    """The rotor with relative changes of `CHANGEABLE` parameters; cubic stiffness changes with the linear stiffness.

    Raises ValueError if a parameter is unknown or would become negative.
    """
    for name, change in changes.items():
        if name not in CHANGEABLE or change < -1:
            raise ValueError(f"{rotor.name}: change {name} {change:+g}, expected one of {CHANGEABLE} and at least -1")
    one = {name: 1 + changes.get(name, 0.0) for name in CHANGEABLE}
    bearing = rotor.bearings[0]
    own = replace(
        bearing,
        k_y=bearing.k_y * one["k_by"],
        k_z=bearing.k_z * one["k_bz"],
        c_y=bearing.c_y * one["c_by"],
        c_z=bearing.c_z * one["c_bz"],
        cubic_N_per_m3=bearing.cubic_N_per_m3 * one["k_by"],
        cubic_ratio_z=bearing.cubic_ratio_z * (one["k_bz"] / one["k_by"] if one["k_by"] else 1.0),
    )
    discs = tuple(replace(disc, unbalance_kg_m=disc.unbalance_kg_m * one["e"]) for disc in rotor.discs)
    return replace(rotor, bearings=(own, *rotor.bearings[1:]), discs=discs)
