"""Rotors of realistic size, unknown to the monitor and all unlike its model of six degrees of freedom."""

import math
from dataclasses import replace

from benchmarks.finite_elements.film import Film
from benchmarks.finite_elements.rotor import BeamRotor, Bearing, Disc, Gear, Stand

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

_FILM = Film(diameter_m=0.025, length_m=0.0125, clearance_m=1.0e-4, viscosity_Pa_s=0.02, load_N=30.0)

_PLAIN_BEARINGS = replace(
    _BETWEEN,
    name="plain-bearings",
    description="Two discs between plain bearings, all eight coefficients of an oil film at its speed",
    diameter_m=_FILM.diameter_m,
    bearings=(
        Bearing(node=0, k_y=1.0, k_z=1.0, c_y=1.0, c_z=1.0, film=_FILM),
        Bearing(node=6, k_y=1.0, k_z=1.0, c_y=1.0, c_z=1.0, film=replace(_FILM, load_N=27.0)),
    ),
    speed_rad_s=2 * math.pi * 40.0,
)

_SOFT_STAND = BeamRotor(
    name="soft-stand",
    description="Vertical pump, impeller overhung, isotropic bearings in a stand that sways",
    length_m=0.9,
    diameter_m=0.030,
    elements=6,
    bearings=(
        Bearing(node=4, k_y=1.2e6, k_z=1.2e6, c_y=700.0, c_z=700.0, housing_kg=1.5),
        Bearing(node=1, k_y=1.5e6, k_z=1.5e6, c_y=700.0, c_z=700.0, housing_kg=1.5),
    ),
    discs=(
        Disc(node=6, mass_kg=6.0, radius_m=0.09, unbalance_kg_m=6.0e-5),
        Disc(node=2, mass_kg=5.0, radius_m=0.07, unbalance_kg_m=2.0e-5, phase_rad=2.0),
    ),
    speed_rad_s=2 * math.pi * 24.5,
    stand=Stand(mass_kg=60.0, k=1.4e5, c=300.0),
)

_GEARED = replace(
    _BETWEEN,
    name="geared",
    description="Shaft between bearings with a gear wheel, whose mesh couples the planes along the line of pressure",
    gear=Gear(node=4, k=6.0e5, c=60.0, pressure_rad=math.radians(70.0), teeth=19, error_m=5.0e-6),
    speed_rad_s=2 * math.pi * 22.0,
)

ROTORS: tuple[BeamRotor, ...] = (
    *(_OVERHUNG, _BETWEEN, _BOTH_SIDES, _ASYMMETRIC, _STIFFENING, _FLUID_FILM),
    *(_PLAIN_BEARINGS, _SOFT_STAND, _GEARED),
)
"""All machines of the table."""


def rotor_named(name: str) -> BeamRotor:
    """Return a machine of the table; raises KeyError if there is none of this name."""
    return {rotor.name: rotor for rotor in ROTORS}[name]
