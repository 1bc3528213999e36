"""What a finite-element rotor is made of, and its changes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

CHANGEABLE = ("k_by", "c_by", "k_bz", "c_bz", "e")
"""Parameters that can change: stiffness and damping of the measured bearing, unbalance of all discs."""


@dataclass(frozen=True, slots=True)
class Disc:
    """A rigid disc of even thickness.

    Attributes
    ----------
    node : int
    mass_kg, radius_m : float
        Moments of inertia follow: mr²/4 about a diameter, mr²/2 polar.
    unbalance_kg_m : float
    phase_rad : float
        Of the heavy spot from the phase reference.
    """

    node: int
    mass_kg: float
    radius_m: float
    unbalance_kg_m: float = 0.0
    phase_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Bearing:
    """A bearing in a housing on its support.

    Attributes
    ----------
    node : int
    k_y, k_z, c_y, c_z : float
        Stiffness, N/m, and damping, Ns/m, horizontal and vertical.
    k_yz, k_zy : float
        Force in the first direction per displacement in the second, N/m.
    housing_kg : float
        Mass that moves with it.
    cubic_N_per_m3 : float
        Force over the third power of the displacement, in y.
    cubic_ratio_z : float
        The same in z over that in y.
    """

    node: int
    k_y: float
    k_z: float
    c_y: float
    c_z: float
    k_yz: float = 0.0
    k_zy: float = 0.0
    housing_kg: float = 0.0
    cubic_N_per_m3: float = 0.0
    cubic_ratio_z: float = 1.0


@dataclass(frozen=True, slots=True)
class BeamRotor:
    """A round shaft of equally long beam elements with discs and bearings at its nodes.

    Attributes
    ----------
    name, description : str
    length_m, diameter_m : float
        Of the whole shaft, solid.
    elements : int
        Nodes are numbered from 0 to this.
    bearings, discs : tuple
        The first one of each carries the probes.
    speed_rad_s : float
        Nominal speed.
    shaft_damping_s : float
        Distributed damping: this times the shaft's stiffness matrix.
    E_Pa, poisson, density_kg_m3 : float
    shear : bool
        Timoshenko's beam with rotary inertia; otherwise Euler and Bernoulli's.
    """

    name: str
    description: str
    length_m: float
    diameter_m: float
    elements: int
    bearings: tuple[Bearing, ...]
    discs: tuple[Disc, ...]
    speed_rad_s: float
    shaft_damping_s: float = 2.0e-5
    E_Pa: float = 2.1e11
    poisson: float = 0.3
    density_kg_m3: float = 7850.0
    shear: bool = True

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

    Raises
    ------
    ValueError
        If a parameter is not known, or would become negative.
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
