"""Faults of other kinds act on a rotor's motion as its equations say."""

import numpy as np

from benchmarks.finite_elements.assembly import ComplexArray, assemble, harmonic_response, probed
from benchmarks.finite_elements.machines import rotor_named
from benchmarks.studies.subjects.fault_kinds import FAULTS, Rotor, Seen
from models.signals.block import FloatArray

BEAM = rotor_named("overhung")
SPEED_HZ, RATE_HZ, COUNT = 32.0, 2000.0, 20_000
EQUATIONS = assemble(BEAM, 2 * np.pi * SPEED_HZ)
PROBED = list(probed(BEAM))
BEARING = BEAM.bearings[0]
K, C = (BEARING.k_y + BEARING.k_z) / 2, (BEARING.c_y + BEARING.c_z) / 2


def _responses(f: FloatArray) -> ComplexArray:
    unit = np.eye(len(EQUATIONS.M))[:, PROBED].astype(np.complex128)
    return np.stack([harmonic_response(EQUATIONS, 2 * np.pi * one, unit)[PROBED] for one in f])


ROTOR = Rotor(SPEED_HZ, RATE_HZ, _responses, (K, C))


def seen(order: float, q: ComplexArray) -> Seen:
    theta = 2 * np.pi * SPEED_HZ * np.arange(COUNT) / RATE_HZ
    wave = np.exp(1j * order * theta)[:, None] * q
    return Seen(wave.real, (2j * np.pi * order * SPEED_HZ * wave).real, np.mod(theta, 2 * np.pi))


def vectors(of: FloatArray, order: float) -> ComplexArray:
    turns = 2 * np.pi * order * SPEED_HZ * np.arange(COUNT) / RATE_HZ
    return np.asarray(2 * (of * np.exp(-1j * turns)[:, None]).mean(axis=0), dtype=np.complex128)


def test_a_soft_foundation_changes_motion_as_the_changed_equations_do() -> None:
    force = np.array([0.4, 1.0, -0.3j, 0.2 + 0.1j])
    before = seen(1.0, _responses(np.array([SPEED_HZ]))[0] @ force)
    after = FAULTS["soft foundation"](ROTOR, before, np.random.default_rng(5))
    rng = np.random.default_rng(5)
    stiffness, natural, omega = K * rng.uniform(2, 4), 2 * np.pi * SPEED_HZ * rng.uniform(0.7, 3), 2 * np.pi * SPEED_HZ
    below = stiffness * (1 - (omega / natural) ** 2 + 0.1j * omega / natural)
    own = K + 1j * omega * C
    stiff = EQUATIONS.K.astype(np.complex128)
    for at in (PROBED[0], PROBED[2]):
        stiff[at, at] += own * below / (own + below) - own
    dynamic = stiff - omega**2 * EQUATIONS.M + 1j * omega * EQUATIONS.C
    acting = np.zeros(len(EQUATIONS.M), dtype=np.complex128)
    acting[PROBED] = force
    expected = np.linalg.solve(dynamic, acting)[PROBED]
    assert np.allclose(vectors(after.displacement, 1.0), expected, rtol=1e-6)
    assert np.allclose(vectors(after.velocity, 1.0), 1j * omega * expected, rtol=1e-6)


def test_a_line_moves_the_bearing_by_its_part_of_1x() -> None:
    before = seen(1.0, np.array([2e-5, 3e-5, -2e-5j, -3e-5j]))
    after = FAULTS["2x forcing"](ROTOR, before, np.random.default_rng(6))
    twice = vectors(after.displacement, 2.0)
    assert 0.3 <= np.hypot(*np.abs(twice[[0, 2]])) / np.sqrt(2) / 2e-5 <= 1.0
    assert np.allclose(vectors(after.velocity, 2.0), 4j * np.pi * SPEED_HZ * twice, rtol=1e-6)
    force = np.linalg.solve(_responses(np.array([2 * SPEED_HZ]))[0], twice)
    assert np.allclose(force[[1, 3]], 0, atol=1e-9 * np.abs(force).max())  # at the bearing alone
