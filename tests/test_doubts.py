"""Machine files that nothing refuses, but in which a unit is probably wrong."""

import pytest

from models.doubts import doubts
from models.machine import load_machine_file


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("rotor.shaft_E_Pa = 206", "shaft_E_Pa is 206 Pa, that of steel is 2.1e+11"),
        ("rotor.I2p_kg_m2 = 0.9", "no rigid body has"),
        ("rotor.m2_kg = 51500", "would bend the shaft by 327 mm"),
        ("rotor.I2_kg_m2 = 4240", "a radius of gyration of 9.07 m"),
        ("rotor.k_by_N_per_m = 1000", "rotor.k_by_N_per_m: the rotor's weight would move the bearing by 554 mm"),
        ("rotor.e_m = 0.02", "at 900 rpm a balance grade of G 1885"),
        ("operation.speed_rpm = 15", "at 0.25 Hz; if this number is in Hz, give 900"),
        ("operation.speed_rpm = 60000", "too few for 1x of 60000 rpm, which is at 1000 Hz: expected at least 2560"),
    ],
)
def test_probably_wrong_units_are_pointed_out(change: str, told: str) -> None:
    assert any(told in one for one in doubts(load_machine_file("heavy", change)))


@pytest.mark.parametrize("name", ["heavy", "lab", "light"])
def test_a_plausible_machine_raises_no_doubt(name: str) -> None:
    assert list(doubts(load_machine_file(name))) == []
