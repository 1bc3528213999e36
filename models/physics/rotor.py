"""The six-degree-of-freedom rotor: parameters, their possible changes, and matrices (Eqs. 1-6, 13-16, 26, 27)."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, Field

from models.signals.block import FloatArray


class KnownRotor(BaseModel, extra="forbid", frozen=True):
    """Parameters of a rotor as far as they are known; see `RotorParameters` for the meaning of each."""

    m1_kg: float | None = Field(default=None, gt=0, le=1e5)
    m2_kg: float | None = Field(default=None, gt=0, le=1e5)
    I2_kg_m2: float | None = Field(default=None, gt=0, le=1e5)
    I2p_kg_m2: float | None = Field(default=None, ge=0, le=1e5)
    shaft_length_m: float | None = Field(default=None, gt=0, le=50)
    shaft_diameter_m: float | None = Field(default=None, gt=0, le=5)
    shaft_E_Pa: float | None = Field(default=None, gt=0, le=1e12)
    k_by_N_per_m: float | None = Field(default=None, gt=0, le=1e12)
    k_bz_N_per_m: float | None = Field(default=None, gt=0, le=1e12)
    c_by_N_s_per_m: float | None = Field(default=None, gt=0, le=1e9)
    c_bz_N_s_per_m: float | None = Field(default=None, gt=0, le=1e9)
    e_m: float | None = Field(default=None, gt=0, le=0.1)  # changes are relative to it

    @property
    def unknown(self) -> tuple[str, ...]:
        """Fields that are not given."""
        return tuple(name for name in type(self).model_fields if getattr(self, name) is None)

    @property
    def modes_hz(self) -> tuple[float, ...]:
        """Natural frequencies at rest and without damping, ascending, Hz; empty if parameters are missing.

        Raises
        ------
        ValueError
            If parameters are so small or large that no natural frequencies can be computed.

        Examples
        --------
        >>> from models.machine import load_machine
        >>> [round(one) for one in load_machine("lab").rotor.modes_hz]
        [28, 30, 92, 94, 489, 489]
        """
        if self.unknown:
            return ()
        rotor = RotorParameters.model_validate(self, from_attributes=True)
        try:
            with np.errstate(divide="raise", over="raise", invalid="raise"):
                root = 1 / np.sqrt(np.diag(M_matrix(rotor)))
                squares = np.linalg.eigvalsh(Q_matrix(rotor) * np.outer(root, root))
        except (ArithmeticError, np.linalg.LinAlgError):
            squares = np.zeros(1)
        if squares[0] <= 0:
            raise ValueError("[rotor] has no natural frequencies: expected masses, lengths and stiffness of a machine")
        return tuple(float(one) for one in np.sqrt(squares) / (2 * np.pi))


class RotorParameters(KnownRotor):
    """Bearing mass on springs and dampers, flexible shaft, overhung disc (paper §2.1, Fig. 2).

    The shaft between bearing and disc is a cantilever that keeps its slope at the bearing. The paper's own values
    (Table 1) are lost; nothing here depends on a particular number.
    """

    m1_kg: float = Field(gt=0, le=1e5, description="bearing mass")
    m2_kg: float = Field(gt=0, le=1e5, description="disc mass")
    I2_kg_m2: float = Field(gt=0, le=1e5, description="disc moment of inertia about a diameter")
    I2p_kg_m2: float = Field(ge=0, le=1e5, description="disc polar moment of inertia")
    shaft_length_m: float = Field(gt=0, le=50, description="bearing to disc")
    shaft_diameter_m: float = Field(gt=0, le=5, description="solid round shaft")
    shaft_E_Pa: float = Field(gt=0, le=1e12, description="Young's modulus of the shaft")
    k_by_N_per_m: float = Field(gt=0, le=1e12, description="bearing stiffness, horizontal")
    k_bz_N_per_m: float = Field(gt=0, le=1e12, description="bearing stiffness, vertical")
    c_by_N_s_per_m: float = Field(gt=0, le=1e9, description="bearing damping, horizontal")
    c_bz_N_s_per_m: float = Field(gt=0, le=1e9, description="bearing damping, vertical")
    e_m: float = Field(gt=0, le=0.1, description="eccentricity of the disc's centre of mass")

    @property
    def EI_N_m2(self) -> float:
        """Bending stiffness of the shaft, N m²."""
        return self.shaft_E_Pa * math.pi * self.shaft_diameter_m**4 / 64


class _Parameter(NamedTuple):
    field: str
    text: str
    quantity: str


_TABLE = {
    "k_by": _Parameter("k_by_N_per_m", "bearing stiffness, horizontal", "stiffness"),
    "c_by": _Parameter("c_by_N_s_per_m", "bearing damping, horizontal", "damping"),
    "k_bz": _Parameter("k_bz_N_per_m", "bearing stiffness, vertical", "stiffness"),
    "c_bz": _Parameter("c_bz_N_s_per_m", "bearing damping, vertical", "damping"),
    "e": _Parameter("e_m", "unbalance (eccentricity)", "distance"),
    "EI": _Parameter("shaft_E_Pa", "shaft bending stiffness", "stiffness"),
}

PARAMETERS: tuple[str, ...] = tuple(_TABLE)  # the diagnosed parameters, in the order in which they are always reported
# Parameters a fault can change, and the field that carries them (EI through Young's modulus).
FAULT_FIELDS: Mapping[str, str] = MappingProxyType({name: row.field for name, row in _TABLE.items()})
# Each parameter in a vibration engineer's words.
PARAMETER_TEXT: Mapping[str, str] = MappingProxyType({name: row.text for name, row in _TABLE.items()})
# The kind of quantity that each parameter is.
QUANTITY: Mapping[str, str] = MappingProxyType({name: row.quantity for name, row in _TABLE.items()})


def changed(rotor: RotorParameters, relative_changes: Mapping[str, float]) -> RotorParameters:
    """Return the rotor with some of `PARAMETERS` changed by a relative amount, above -1; -0.2 is a loss of 20 %.

    Raises
    ------
    ValueError
        For an unknown parameter or a change of -100 % and more.

    Examples
    --------
    >>> from models.machine import load_machine
    >>> round(changed(load_machine("lab").rotor, {"k_by": -0.2}).k_by_N_per_m)
    40000
    """
    update: dict[str, float] = {}
    for name, change in relative_changes.items():
        if name not in FAULT_FIELDS:
            raise ValueError(f"parameter {name!r} is not one of {', '.join(PARAMETERS)}")
        if not change > -1:
            raise ValueError(f"relative change of {name} is {change}, expected above -1")
        update[FAULT_FIELDS[name]] = getattr(rotor, FAULT_FIELDS[name]) * (1 + change)
    return rotor.model_copy(update=update)


COORDINATES = ("y1", "y2", "psi", "z1", "z2", "phi")  # order of the six degrees of freedom (Eq. 13)
# Order of the twelve states (Eq. 2); the paper counts them from 1.
STATES = (*COORDINATES, *(f"{name}_dot" for name in COORDINATES))
# Position of each state, counted from 0.
STATE_INDEX: Mapping[str, int] = MappingProxyType({name: index for index, name in enumerate(STATES)})


def M_matrix(rotor: RotorParameters) -> FloatArray:
    """Mass matrix (Eq. 14), shape (6, 6), kg and kg m²."""
    plane = [rotor.m1_kg, rotor.m2_kg, rotor.I2_kg_m2]
    return np.diag([*plane, *plane])


def Q_shaft(rotor: RotorParameters) -> FloatArray:
    """Stiffness of the shaft alone, shape (6, 6), N/m, N and N m; linear in EI.

    The shaft is a cantilever from the bearing, which keeps its slope, to the disc: a = 12EI/L³, b = 6EI/L², c = 4EI/L.
    The matrix has the zero pattern and the signs of Eq. (26).
    """
    L = rotor.shaft_length_m
    a, b, c = 12 * rotor.EI_N_m2 / L**3, 6 * rotor.EI_N_m2 / L**2, 4 * rotor.EI_N_m2 / L
    plane = np.array([[a, -a, b], [-a, a, -b], [b, -b, c]])
    mirror, apart = np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3))
    return np.block([[plane, apart], [apart, mirror @ plane @ mirror]])


def Q_matrix(rotor: RotorParameters) -> FloatArray:
    """Stiffness matrix, shaft and bearing springs, shape (6, 6)."""
    Q = Q_shaft(rotor)
    Q[0, 0] += rotor.k_by_N_per_m
    Q[3, 3] += rotor.k_bz_N_per_m
    return Q


def P_matrix(rotor: RotorParameters, speed_rad_s: float) -> FloatArray:
    """Damping at the bearing and gyroscopic coupling of the tilts, shape (6, 6).

    This is Eq. (27) with the entry c44, which is missing in print.
    """
    P = np.zeros((6, 6))
    P[0, 0] = rotor.c_by_N_s_per_m
    P[3, 3] = rotor.c_bz_N_s_per_m
    P[2, 5] = speed_rad_s * rotor.I2p_kg_m2
    P[5, 2] = -speed_rad_s * rotor.I2p_kg_m2
    return P


def H_matrix(rotor: RotorParameters, speed_rad_s: float) -> FloatArray:
    """Input matrix of n(t) = (cos Ωt, sin Ωt): unbalance force on the disc (Eq. 16), shape (6, 2), N."""
    force_N = rotor.m2_kg * rotor.e_m * speed_rad_s**2
    H = np.zeros((6, 2))
    H[1, 0] = H[4, 1] = force_N
    return H


def system_A(rotor: RotorParameters, speed_rad_s: float) -> FloatArray:
    """System matrix A of the state equation (Eq. 4), shape (12, 12)."""
    inverse_masses = 1 / np.diag(M_matrix(rotor))[:, None]
    forces = [-inverse_masses * Q_matrix(rotor), -inverse_masses * P_matrix(rotor, speed_rad_s)]
    return np.block([[np.zeros((6, 6)), np.eye(6)], forces])


def natural_frequencies(rotor: RotorParameters, speed_rad_s: float) -> tuple[FloatArray, FloatArray]:
    """Natural frequencies (Hz) and damping ratios of a turning rotor, of each mode that oscillates."""
    poles = np.linalg.eigvals(system_A(rotor, speed_rad_s))
    poles = poles[poles.imag > 0]
    return np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)


def impossible(change: float, quantity: str) -> str:
    """Why a relative change of a positive quantity (a mass, a gain, a length) is impossible; empty if it is possible.

    Examples
    --------
    >>> impossible(-0.4, "mass")
    ''
    >>> impossible(-4.7, "mass")
    'reads as −470 %, which is impossible: a mass cannot fall by 100 % or more'
    """
    if change > -1:
        return ""
    return f"reads as −{-100 * change:.0f} %, which is impossible: a {quantity} cannot fall by 100 % or more"
