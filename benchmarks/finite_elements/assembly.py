"""Equations of motion of a rotor, its modes, and its response to harmonic forces.

Coordinates are (v, v') of all nodes in the horizontal plane y, then in the vertical plane z, then y and z of a stand. A
positive speed turns from y to z.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from benchmarks.finite_elements.elements import beam_inertia, beam_mass, beam_stiffness, shear_ratio
from benchmarks.finite_elements.rotor import BeamRotor
from models.signals.block import FloatArray

ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Equations:
    """M ξ̈ + C ξ̇ + K ξ = f, shape (n, n) each; C holds damping and the gyroscopic part."""

    M: FloatArray
    C: FloatArray
    K: FloatArray

    @property
    def A(self) -> FloatArray:
        """State matrix of (ξ, ξ̇), shape (2n, 2n)."""
        n = len(self.M)
        lower = -np.linalg.solve(self.M, np.hstack([self.K, self.C]))
        return np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower])


@dataclass(frozen=True, slots=True)
class Mode:
    """A mode's frequency and damping ratio."""

    frequency_hz: float
    damping: float


def place(rotor: BeamRotor, node: int, plane: str) -> int:
    """Coordinate of a node's translation in plane ``y`` or ``z``."""
    return 2 * node + (2 * (rotor.elements + 1) if plane == "z" else 0)


def probed(rotor: BeamRotor) -> tuple[int, int, int, int]:
    """Coordinates of y1, y2, z1, z2: translations of the first bearing and the first disc."""
    one, two = rotor.bearings[0].node, rotor.discs[0].node
    return place(rotor, one, "y"), place(rotor, two, "y"), place(rotor, one, "z"), place(rotor, two, "z")


def assemble(rotor: BeamRotor, speed_rad_s: float) -> Equations:
    """Linear equations of motion at a speed, without cubic stiffness."""
    length_m, EI = rotor.length_m / rotor.elements, rotor.bending_stiffness
    kappa = 6 * (1 + rotor.poisson) / (7 + 6 * rotor.poisson)  # Cowper's, of a solid round section
    shear_stiffness_N = kappa * rotor.E_Pa / (2 * (1 + rotor.poisson)) * rotor.area_m2
    phi = shear_ratio(EI, shear_stiffness_N, length_m) if rotor.shear else 0.0
    inertia = rotor.density_kg_m3 * EI / rotor.E_Pa if rotor.shear else 0.0
    element_N = beam_inertia(length_m, inertia, phi)
    element_M = beam_mass(length_m, rotor.density_kg_m3 * rotor.area_m2, phi) + element_N
    element_K = beam_stiffness(length_m, EI, phi)
    n = 2 * (rotor.elements + 1)
    M1, K1, G1 = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    for element in range(rotor.elements):
        at = slice(2 * element, 2 * element + 4)
        M1[at, at] += element_M
        K1[at, at] += element_K
        G1[at, at] += 2 * element_N
    for disc in rotor.discs:
        v = 2 * disc.node
        M1[v, v] += disc.mass_kg
        M1[v + 1, v + 1] += disc.mass_kg * disc.radius_m**2 / 4
        G1[v + 1, v + 1] += disc.mass_kg * disc.radius_m**2 / 2
    for bearing in rotor.bearings:
        M1[2 * bearing.node, 2 * bearing.node] += bearing.housing_kg
    both, turn = np.eye(2), np.array([[0.0, 1.0], [-1.0, 0.0]])
    M = np.asarray(np.kron(both, M1), dtype=np.float64)
    K = np.asarray(np.kron(both, K1), dtype=np.float64)
    C = np.asarray(np.kron(both, rotor.shaft_damping_s * K1) + np.kron(turn, speed_rad_s * G1), dtype=np.float64)
    M, C, K = (np.pad(one, (0, rotor.size - 2 * n)) for one in (M, C, K))
    on_stand = np.zeros((2, rotor.size))
    if rotor.stand is not None:
        on_stand[:, -2:] = both
        for matrix, of_stand in ((M, rotor.stand.mass_kg), (C, rotor.stand.c), (K, rotor.stand.k)):
            matrix[-2:, -2:] += of_stand * both
    springs = [(one.node, *one.coefficients(speed_rad_s), on_stand) for one in rotor.bearings]
    if rotor.gear is not None:
        mesh = np.outer(rotor.gear.along, rotor.gear.along)
        springs.append((rotor.gear.node, rotor.gear.k * mesh, rotor.gear.c * mesh, 0 * on_stand))
    for node, stiffness, damping, moved in springs:
        against = np.eye(rotor.size)[[place(rotor, node, "y"), place(rotor, node, "z")]] - moved
        K += against.T @ stiffness @ against
        C += against.T @ damping @ against
    return Equations(M, C, K)


def modes(equations: Equations) -> tuple[Mode, ...]:
    """Oscillating modes in order of frequency."""
    roots = np.linalg.eigvals(equations.A)
    found = [Mode(float(abs(s) / (2 * np.pi)), float(-s.real / abs(s))) for s in roots if s.imag > 0]
    return tuple(sorted(found, key=lambda mode: mode.frequency_hz))


def harmonic_response(equations: Equations, frequency_rad_s: float, force: ComplexArray) -> ComplexArray:
    """Complex amplitudes of all coordinates under the force f e^{jωt}, shape (n,)."""
    w = frequency_rad_s
    return np.asarray(
        np.linalg.solve(equations.K - w**2 * equations.M + 1j * w * equations.C, force), dtype=np.complex128
    )


def unbalance_force(rotor: BeamRotor, speed_rad_s: float) -> ComplexArray:
    """Unbalance force of all discs, q of f = Re{q e^{jθ}}, N, shape (n,)."""
    force = np.zeros(rotor.size, dtype=np.complex128)
    for disc in rotor.discs:
        q = disc.unbalance_kg_m * speed_rad_s**2 * np.exp(1j * disc.phase_rad)
        force[place(rotor, disc.node, "y")] += q
        force[place(rotor, disc.node, "z")] += -1j * q
    return force


def unbalance_response(rotor: BeamRotor, speed_rad_s: float) -> ComplexArray:
    """1x vectors of all coordinates of the linear rotor, q of ξ = Re{q e^{jθ}}, shape (n,)."""
    return harmonic_response(assemble(rotor, speed_rad_s), speed_rad_s, unbalance_force(rotor, speed_rad_s))


def mesh_force(rotor: BeamRotor) -> ComplexArray:
    """Force of the transmission error on the wheel, q of f = Re{q e^{jnθ}} with n teeth, shape (size,)."""
    force = np.zeros(rotor.size, dtype=np.complex128)
    if rotor.gear is not None:
        at = [place(rotor, rotor.gear.node, "y"), place(rotor, rotor.gear.node, "z")]
        force[at] = rotor.gear.k * rotor.gear.error_m * rotor.gear.along
    return force
