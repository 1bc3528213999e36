"""Rotors that nobody has to know: a table of machines of realistic size, all unlike the six-degree-of-freedom model."""

import math
from dataclasses import replace

from benchmarks.finite_elements.rotor import BeamRotor, Bearing, Disc

_OVERHUNG = BeamRotor(
    name="overhung",
    description="Disc overhung beyond two bearings, a coupling disc at the other end",
    length_m=0.5,
    diameter_m=0.014,
    elements=5,
    bearings=(
        Bearing(node=3, k_y=2.0e5, k_z=2.6e5, c_y=150.0, c_z=150.0, housing_kg=0.4),
        Bearing(node=0, k_y=6.0e5, k_z=6.0e5, c_y=100.0, c_z=100.0, housing_kg=0.3),
    ),
    discs=(
        Disc(node=5, mass_kg=1.5, radius_m=0.06, unbalance_kg_m=1.5e-5),
        Disc(node=1, mass_kg=0.8, radius_m=0.05, unbalance_kg_m=4e-6, phase_rad=1.1),
    ),
    speed_rad_s=2 * math.pi * 33.0,
)

_BETWEEN = BeamRotor(
    name="between",
    description="Two discs between two bearings",
    length_m=0.6,
    diameter_m=0.020,
    elements=6,
    bearings=(
        Bearing(node=0, k_y=1.8e5, k_z=2.3e5, c_y=140.0, c_z=150.0, housing_kg=0.5),
        Bearing(node=6, k_y=2.2e5, k_z=2.6e5, c_y=120.0, c_z=130.0, housing_kg=0.5),
    ),
    discs=(
        Disc(node=2, mass_kg=2.5, radius_m=0.07, unbalance_kg_m=2.5e-5),
        Disc(node=4, mass_kg=1.8, radius_m=0.06, unbalance_kg_m=1.0e-5, phase_rad=-0.7),
    ),
    speed_rad_s=2 * math.pi * 24.0,
    shaft_damping_s=4.0e-5,
)

_BOTH_SIDES = BeamRotor(
    name="both-sides",
    description="Discs overhung on both sides of two bearings, heavy shaft",
    length_m=1.2,
    diameter_m=0.050,
    elements=6,
    bearings=(
        Bearing(node=4, k_y=3.0e6, k_z=3.8e6, c_y=2200.0, c_z=2500.0, housing_kg=4.0),
        Bearing(node=2, k_y=3.4e6, k_z=4.2e6, c_y=2000.0, c_z=2200.0, housing_kg=4.0),
    ),
    discs=(
        Disc(node=6, mass_kg=16.0, radius_m=0.14, unbalance_kg_m=2.5e-4),
        Disc(node=0, mass_kg=12.0, radius_m=0.12, unbalance_kg_m=1.0e-4, phase_rad=2.0),
    ),
    speed_rad_s=2 * math.pi * 28.0,
    shaft_damping_s=3.0e-5,
)

_ASYMMETRIC = replace(
    _OVERHUNG,
    name="asymmetric",
    description="Overhung disc on supports 1.6 times as stiff vertically as horizontally",
    diameter_m=0.016,
    bearings=(
        Bearing(node=3, k_y=1.5e5, k_z=2.4e5, c_y=140.0, c_z=170.0, housing_kg=0.6),
        Bearing(node=0, k_y=5.0e5, k_z=8.0e5, c_y=120.0, c_z=120.0, housing_kg=0.3),
    ),
    speed_rad_s=2 * math.pi * 17.0,
)

_STIFFENING = replace(
    _OVERHUNG,
    name="stiffening",
    description="Overhung disc, the bearing's stiffness grows with its displacement",
    bearings=(replace(_OVERHUNG.bearings[0], k_y=1.7e5, k_z=2.2e5, cubic_N_per_m3=2.0e13), _OVERHUNG.bearings[1]),
    speed_rad_s=2 * math.pi * 27.0,
)

_FLUID_FILM = replace(
    _BETWEEN,
    name="fluid-film",
    description="Two discs between bearings whose stiffness couples the planes by 8 %",
    bearings=(
        replace(_BETWEEN.bearings[0], k_yz=1.6e4, k_zy=-1.6e4, c_y=150.0, c_z=160.0),
        replace(_BETWEEN.bearings[1], k_yz=1.8e4, k_zy=-1.8e4, c_y=130.0, c_z=140.0),
    ),
    speed_rad_s=2 * math.pi * 26.0,
)

ROTORS: tuple[BeamRotor, ...] = (_OVERHUNG, _BETWEEN, _BOTH_SIDES, _ASYMMETRIC, _STIFFENING, _FLUID_FILM)
"""All machines of the table."""


def rotor_named(name: str) -> BeamRotor:
    """Take a machine from the table.

    Raises
    ------
    KeyError
        If it is not there.
    """
    return {rotor.name: rotor for rotor in ROTORS}[name]
