"""Fields that many records have."""

from typing import Annotated

from pydantic import ConfigDict, Field

__all__ = ["EXAMPLE_NS", "JSON", "BundleIdentity", "MachineHash", "Name", "Reason", "Site"]

JSON = ConfigDict(extra="forbid", frozen=True)
"""Of every record."""

EXAMPLE_NS = 1767225805000000000


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


Reason = Annotated[str, Field(description="why it was not evaluated; empty if it was", examples=[""])]
