"""Fields that many records have."""

import math
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

REQUEST = ConfigDict(extra="forbid", frozen=True)
"""Of what a monitor is asked for: a field that it does not know is a mistake of whoever asks."""

EXAMPLE_NS = 1767225805000000000


class Record(BaseModel):
    """Whoever reads one passes over fields that a later version has added."""

    model_config = ConfigDict(frozen=True, json_schema_serialization_defaults_required=True)


def finite(value: float | None) -> float | None:
    """Neither JSON nor the history has infinity and NaN: both become null."""
    return value if value is not None and math.isfinite(value) else None


Number = Annotated[float | None, AfterValidator(finite)]  # a finite number or null, whatever it is made of

Site = Annotated[str, Field(description="site of the machine", examples=["demo"])]

Name = Annotated[str, Field(description="name of the machine", examples=["lab"])]

BundleIdentity = Annotated[
    str | None,
    Field(description="identity of what was trained and commissioned; null without", examples=["lab-3f9c1e0b7a52"]),
]

MachineHash = Annotated[
    str,
    Field(description="12 hexadecimal digits that change with the machine file's content", examples=["9a0c41d27be8"]),
]


class OfMachine(Record):
    """A record that says first which machine it is of."""

    site: Site
    machine: Name


ParameterName = Annotated[str, Field(description="k_by, c_by, k_bz, c_bz, e or EI", examples=["k_by"])]

ParameterText = Annotated[str, Field(description="the parameter in words", examples=["bearing stiffness, horizontal"])]

Reason = Annotated[str, Field(description="why it was not evaluated; empty if it was", examples=[""])]
