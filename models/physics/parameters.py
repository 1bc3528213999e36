"""Physical parameters of the six-degree-of-freedom rotor and their relative changes."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["FAULT_FIELDS", "PARAMETERS", "PARAMETER_TEXT", "QUANTITY", "KnownRotor", "RotorParameters", "changed"]


class KnownRotor(BaseModel):
    """What is known of a rotor's parameters; see `RotorParameters` for the meaning of each."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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
    e_m: float | None = Field(default=None, ge=0, le=0.1)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Fields that are not given."""
        return tuple(name for name in type(self).model_fields if getattr(self, name) is None)


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
    e_m: float = Field(ge=0, le=0.1, description="eccentricity of the disc's centre of mass")

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

PARAMETERS: tuple[str, ...] = tuple(_TABLE)
"""The diagnosed parameters, in the order in which they are always reported."""

FAULT_FIELDS: Mapping[str, str] = MappingProxyType({name: row.field for name, row in _TABLE.items()})
"""Parameters a fault can change, and the field that carries them (EI through Young's modulus)."""

PARAMETER_TEXT: Mapping[str, str] = MappingProxyType({name: row.text for name, row in _TABLE.items()})
"""Each parameter in a vibration engineer's words."""

QUANTITY: Mapping[str, str] = MappingProxyType({name: row.quantity for name, row in _TABLE.items()})
"""What kind of quantity each parameter is."""


def changed(rotor: RotorParameters, relative_changes: Mapping[str, float]) -> RotorParameters:
    """Return the rotor with some parameters changed by a relative amount.

    Parameters
    ----------
    rotor : RotorParameters
        Parameters before the change.
    relative_changes : mapping of str to float
        Parameter (one of `PARAMETERS`) to relative change, above -1; -0.2 is a loss of 20 %.

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
