"""What a machine file gives that hardly any machine has: mostly a wrong unit."""

import math
from collections.abc import Iterator

from models.machine import MachineFile

_GRAVITY_M_PER_S2 = 9.81
_MODULUS_PA = (5e9, 6e11)  # from fibre composites to above tungsten
_BENT = 0.02
"""Largest sag of the shaft under the disc's weight, as a fraction of its length."""
_SUNK_M = 0.02
"""Largest deflection of a bearing under the rotor's weight: its natural frequency is then 3.5 Hz."""
_GYRATION_M = 3.0
_GRADE_MM_PER_S = 250.0
"""Largest unbalance, eccentricity times speed; fans have 6.3, crankshafts of cars 100."""
_SLOW_RPM = 120.0
_SAMPLES_PER_TURN = 2.56


def doubts(machine: MachineFile) -> Iterator[str]:
    """What is doubtful in a machine file, in words; a machine may really be so, and nothing is refused.

    Examples
    --------
    >>> from models.machine import load_machine
    >>> list(doubts(load_machine("lab")))
    []
    """
    yield from _of_speed(machine)
    rotor = machine.rotor
    if rotor is None:
        return
    modulus, length, diameter = rotor.shaft_E_Pa, rotor.shaft_length_m, rotor.shaft_diameter_m
    low, high = _MODULUS_PA
    if modulus is not None and not low <= modulus <= high:
        yield f"rotor.shaft_E_Pa is {modulus:g} Pa, that of steel is 2.1e+11: is it given in another unit?"
    elif modulus and length and diameter and rotor.m2_kg:
        stiffness = 3 * modulus * math.pi * diameter**4 / 64 / length**3
        sag_m = rotor.m2_kg * _GRAVITY_M_PER_S2 / stiffness
        if sag_m > _BENT * length:
            fields = "m2_kg, shaft_length_m and shaft_diameter_m"
            yield f"rotor: the disc's weight would bend the shaft by {1e3 * sag_m:.3g} mm; check the units of {fields}"
    if rotor.I2_kg_m2 is not None and (rotor.I2p_kg_m2 or 0.0) > 2.001 * rotor.I2_kg_m2:
        yield (
            f"rotor.I2p_kg_m2 is {rotor.I2p_kg_m2:g}, more than twice I2_kg_m2 ({rotor.I2_kg_m2:g}), which no rigid "
            "body has: a thin disc has twice, a long cylinder less than once"
        )
    if rotor.I2_kg_m2 and rotor.m2_kg and (radius_m := math.sqrt(rotor.I2_kg_m2 / rotor.m2_kg)) > _GYRATION_M:
        yield f"rotor: I2_kg_m2 and m2_kg give a radius of gyration of {radius_m:.3g} m; check their units"
    weight = ((rotor.m1_kg or 0.0) + (rotor.m2_kg or 0.0)) * _GRAVITY_M_PER_S2
    for field in ("k_by_N_per_m", "k_bz_N_per_m"):
        stiffness = getattr(rotor, field) or math.inf
        if weight / stiffness > _SUNK_M:
            moved = f"the rotor's weight would move the bearing by {1e3 * weight / stiffness:.3g} mm"
            yield f"rotor.{field}: {moved}; check the units of it and m1_kg"


def _of_speed(machine: MachineFile) -> Iterator[str]:
    if machine.operation is None:
        return
    speed_rpm = machine.operation.speed_rpm
    speed_hz = speed_rpm / 60
    if machine.rate_hz < _SAMPLES_PER_TURN * speed_hz:
        yield (
            f"rate_hz is {machine.rate_hz:g}, too few for 1x of {speed_rpm:g} rpm, which is at {speed_hz:.4g} Hz: "
            f"expected at least {_SAMPLES_PER_TURN * speed_hz:.4g}"
        )
    if speed_rpm <= _SLOW_RPM:
        yield (
            f"operation.speed_rpm is {speed_rpm:g}, so 1x is at {speed_hz:.4g} Hz; "
            f"if this number is in Hz, give {60 * speed_rpm:.6g}"
        )
    eccentricity_m = None if machine.rotor is None else machine.rotor.e_m
    if eccentricity_m and (grade := 1e3 * eccentricity_m * 2 * math.pi * speed_hz) > _GRADE_MM_PER_S:
        yield (
            f"rotor.e_m is {eccentricity_m:g} m, at {speed_rpm:g} rpm a balance grade of G {grade:.0f}, where fans and "
            "pumps have G 6.3: is it given in another unit?"
        )
