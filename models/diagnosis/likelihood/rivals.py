"""As which changes of parameters a cause outside the model would be read.

A heavier disc or a softened foundation moves the expected spectra in its own way. The part of that which parameters
imitate is read as their change, and only the rest shows in the scores (`models.diagnosis.likelihood.goodness`). The
fewer sensors there are, and the stronger the damping, the less is left: a window then fits with parameters that never
changed.
"""

import math
from collections.abc import Callable

import numpy as np

from models.diagnosis.likelihood.goodness import beyond_parameters
from models.diagnosis.likelihood.scoring import Maximum, Weights
from models.diagnosis.likelihood.spectral_model import STRUCTURAL, Sides, SpectralModel
from models.diagnosis.likelihood.unbalance import around_rotation, parts
from models.diagnosis.misfit import Rival
from models.diagnosis.readings import UnbalanceVector
from models.physics.rotor import PARAMETERS
from models.signals.block import ComplexArray, FloatArray

_Term = tuple[FloatArray, Callable[[FloatArray], ComplexArray]]
"""A matrix, shape (6, 6), and its factor at angular frequencies: a part of a change of the dynamic matrix."""

# Natural frequencies of a foundation, over that of the rotor as a rigid body on its bearings, and its damping ratio. A
# lighter damping would resolve a resonance that no one knows the place of.
_FOUNDATIONS, _FOUNDATION_DAMPING = (2.0, 2.8, 4.0, math.inf), 0.2
_AT_BEARING = [0, 3]


def rivals_at(
    model: SpectralModel,
    weights: Weights,
    found: Maximum,
    structural: FloatArray,
    speed_rad_s: float,
    duration_s: float,
    vector: UnbalanceVector | None,
) -> tuple[Rival, ...]:
    """All causes at the maximum of one window.

    `structural`, shape (5, 5), is the covariance of the logarithmic ratios of `STRUCTURAL`; `vector` the unbalance as
    read, None without a direction.
    """
    point, sides = found.whitened.point, Sides(found.whitened.point, found.whitened.L_inverse)
    causes = _causes(model, point.theta, speed_rad_s)
    w = 2 * np.pi * model.groups.nodes_hz
    slopes = np.stack([sum(sides.slope(-by(w), change=matrix.T) for matrix, by in terms) for _, terms in causes])
    score, left, known, imitated = beyond_parameters(model, weights, found, slopes)
    at_speed = np.array(
        [sum(matrix * by(np.array([speed_rad_s])) for matrix, by in terms) for _, terms in causes], dtype=np.complex128
    )
    own = imitated[:, : len(STRUCTURAL)]
    read = np.zeros((len(causes), len(PARAMETERS)))
    read[:, [PARAMETERS.index(name) for name in STRUCTURAL]] = own
    read[:, PARAMETERS.index("e")] = _as_unbalance(
        model, found, structural, speed_rad_s, duration_s, vector, at_speed, own
    )
    return tuple(
        Rival(name, taken_for, float(i), float(s))
        for (name, _), taken_for, i, s in zip(
            causes, read, np.where(known, left, 0), np.where(known, score, 0), strict=True
        )
    )


def _causes(model: SpectralModel, theta: FloatArray, speed_rad_s: float) -> list[tuple[str, list[_Term]]]:
    """Names of causes and their changes of the dynamic matrix, relative to what there is."""
    rotor, at = model.machine.rotor, dict(zip(STRUCTURAL, np.exp(theta[: len(STRUCTURAL)]).tolist(), strict=True))

    def inertial(w: FloatArray) -> ComplexArray:
        return np.asarray(-(w**2), dtype=np.complex128)

    def gyroscopic(w: FloatArray) -> ComplexArray:
        return np.asarray(1j * w, dtype=np.complex128)

    mass, tilt = (
        (np.diag(np.tile(np.eye(3)[dof] * of, 2)), inertial) for dof, of in ((1, rotor.m2_kg), (2, rotor.I2_kg_m2))
    )
    turn = np.zeros((6, 6))
    turn[2, 5], turn[5, 2] = rotor.I2p_kg_m2 * speed_rad_s, -rotor.I2p_kg_m2 * speed_rad_s
    polar = turn, gyroscopic
    k = rotor.k_by_N_per_m * at["k_by"], rotor.k_bz_N_per_m * at["k_bz"]
    c = rotor.c_by_N_s_per_m * at["c_by"], rotor.c_bz_N_s_per_m * at["c_bz"]
    rigid_rad_s = math.sqrt(sum(k) / 2 / (rotor.m1_kg + rotor.m2_kg))

    def softened(times: float) -> list[_Term]:
        # A bearing of dynamic stiffness Z on a foundation F has 1/(1/Z + 1/F), that is, Z - Z²/F for a stiff one.
        def plane(number: int) -> _Term:
            def factor(w: FloatArray) -> ComplexArray:
                r = w / (times * rigid_rad_s)
                foundation = sum(k) / 2 * (1 - r**2 + 2j * _FOUNDATION_DAMPING * r)
                return np.asarray(-((k[number] + 1j * w * c[number]) ** 2) / foundation, dtype=np.complex128)

            matrix = np.zeros((6, 6))
            matrix[_AT_BEARING[number], _AT_BEARING[number]] = 1
            return matrix, factor

        return [plane(0), plane(1)]

    return [
        ("the disc's mass", [mass]),
        ("the disc's mass", [mass, tilt, polar]),
        ("the disc's inertia", [tilt, polar]),
        ("the disc's inertia", [polar]),
        *(("the foundation", softened(times)) for times in _FOUNDATIONS),
    ]


def _as_unbalance(
    model: SpectralModel,
    found: Maximum,
    structural: FloatArray,
    speed_rad_s: float,
    duration_s: float,
    vector: UnbalanceVector | None,
    changes: ComplexArray,
    imitated: FloatArray,
) -> FloatArray:
    """Change of e as it would be read for causes that change the dynamic matrix at the speed by `changes`.

    `imitated`, shape (n_causes, 5), are the changes of `STRUCTURAL` in whose place they are read.
    """
    point, w, n = found.whitened.point, np.array([speed_rad_s]), len(STRUCTURAL)
    rotor, theta = model.machine.rotor, point.theta[: len(STRUCTURAL)]
    ratio = 1 + 0j if vector is None else complex(vector.real, vector.imaginary)
    H = model.receptance(theta, speed_rad_s, w)[0]
    moved = H @ np.array([0, 1, 0, 0, -1j, 0])
    by = np.concatenate([model.dynamic_changes(theta, speed_rad_s), changes])
    g, *slopes = ratio * model.measured(np.vstack([moved, -(by @ moved) @ H.T]).T[np.newaxis], w)[0].T
    force_N = rotor.m2_kg * rotor.e_m * speed_rad_s**2
    noise = 4 * around_rotation(model, point, speed_rad_s, duration_s) / duration_s / force_N**2
    J = parts(np.stack(slopes[:n])).T
    total = np.block([[noise.real, -noise.imag], [noise.imag, noise.real]]) / 2 + J @ structural @ J.T
    unlike = parts(np.stack(slopes[n:]) - imitated @ np.stack(slopes[:n]))
    both = np.stack([parts(g), parts(1j * g)], axis=1)
    if vector is None or not vector.moved:
        both = both[:, :1]
    weight = np.linalg.solve(total, both)
    read = np.linalg.solve(both.T @ weight, weight.T @ unlike.T)  # relative to the ratio
    if vector is None or not vector.moved:
        return np.asarray(abs(ratio) * read[0], dtype=np.float64)
    change = ratio * (read[0] + 1j * read[1])
    away = (ratio - 1) / abs(ratio - 1)
    return np.asarray((change * away.conjugate()).real, dtype=np.float64)
