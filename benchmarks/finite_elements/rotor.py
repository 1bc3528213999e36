"""What a finite-element rotor is made of, and its changes."""

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
    phase_rad: float = 0.0  # of the heavy spot from the phase reference


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
    housing_kg: float = 0.0  # moves with it
    cubic_N_per_m3: float = 0.0  # force over the third power of the displacement, in y
    cubic_ratio_z: float = 1.0  # the same in z over that in y
    film: Film | None = None  # what carries; k and c are then factors on its own, and k_yz and k_zy are left out

    def coefficients(self, speed_rad_s: float) -> tuple[FloatArray, FloatArray]:
        """Stiffness, N/m, and damping, Ns/m, on (y, z), shape (2, 2) each; cubic stiffness left out."""
        own = np.diag([self.k_y, self.k_z]), np.diag([self.c_y, self.c_z])
        coupling = np.array([[0.0, self.k_yz], [self.k_zy, 0.0]])
        if self.film is None:
            return own[0] + coupling, own[1]
        K, C = self.film.coefficients(speed_rad_s)
        crossed = 1 - np.eye(2)
        return K * (own[0] + crossed), C * (own[1] + crossed)


@dataclass(frozen=True, slots=True)
class Stand:
    """What all bearings stand on: a mass that yields sideways, alike in y and z."""

    mass_kg: float
    k: float  # stiffness, N/m, and damping, Ns/m, between it and the ground
    c: float


@dataclass(frozen=True, slots=True)
class Gear:
    """A wheel in mesh with one that does not move sideways: a spring along the line of pressure, and its tone.

    What turns is left out: torsion, and how the mesh's stiffness varies from tooth to tooth but for the tone.
    """

    node: int
    k: float  # mean stiffness, N/m, and damping, Ns/m, of the mesh
    c: float
    pressure_rad: float  # of the line of pressure from y towards z
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
    elements: int  # nodes are numbered from 0 to this
    bearings: tuple[Bearing, ...]
    discs: tuple[Disc, ...]
    speed_rad_s: float  # nominal
    shaft_damping_s: float = 2.0e-5  # distributed damping: this times the shaft's stiffness matrix
    E_Pa: float = 2.1e11
    poisson: float = 0.3
    density_kg_m3: float = 7850.0
    shear: bool = True  # Timoshenko's beam with rotary inertia; otherwise Euler and Bernoulli's
    stand: Stand | None = None  # none is the ground
    gear: Gear | None = None

    @property
    def size(self) -> int:
        """Number of coordinates: four of every node, and two of a stand."""
        return 4 * (self.elements + 1) + (2 if self.stand else 0)

    @property
    def linear(self) -> bool:
        """Whether no bearing stiffens with its displacement."""
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
    """The rotor with relative changes of `CHANGEABLE` parameters; a bearing's cubic stiffness changes with its linear.

    Raises ValueError if a parameter is not known, or would become negative.
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
