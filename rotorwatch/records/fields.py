"""Fields and base classes that many records share."""

import math
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

EXAMPLE_NS = 1767225805000000000


class Record(BaseModel):
    """Base class of published records; unknown fields, such as those of a later version, are ignored."""

    model_config = ConfigDict(frozen=True, json_schema_serialization_defaults_required=True)


class Request(BaseModel):
    """Base class of requests to a monitor; unknown fields are refused as mistakes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def finite(value: float | None) -> float | None:
    """Replace infinity and NaN, which neither JSON nor the history can hold, by None."""
    return value if value is not None and math.isfinite(value) else None


Number = Annotated[float | None, AfterValidator(finite)]  # infinity and NaN become null
Site = Annotated[str, Field(description="site of the machine", examples=["demo"])]
Name = Annotated[str, Field(description="name of the machine", examples=["lab"])]
BundleIdentity = Annotated[
    str | None,
    Field(description="identity of the trained or commissioned bundle; null without", examples=["lab-3f9c1e0b7a52"]),
]
MachineHash = Annotated[
    str,
    Field(description="12 hexadecimal digits that change with the machine file's content", examples=["9a0c41d27be8"]),
]


class OfMachine(Record):
    """A record that starts with the machine that it belongs to."""

    site: Site
    machine: Name


ParameterName = Annotated[str, Field(description="k_by, c_by, k_bz, c_bz, e or EI", examples=["k_by"])]
ParameterText = Annotated[str, Field(description="the parameter in words", examples=["bearing stiffness, horizontal"])]
Reason = Annotated[str, Field(description="why it was not evaluated; empty if it was", examples=[""])]
