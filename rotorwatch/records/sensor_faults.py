"""What can be wrong with a sensor: one row per kind."""

from enum import StrEnum
from typing import Self


class FaultKind(StrEnum):
    """Kind of a sensor's fault."""

    text: str  # the same in words, for its alarm
    measure: str  # what the value of a fault of this kind is

    def __new__(cls, name: str, text: str, measure: str) -> Self:
        """A row: name in records, words, meaning of the value."""
        kind = str.__new__(cls, name)
        kind._value_, kind.text, kind.measure = name, text, measure
        return kind

    @classmethod
    def _missing_(cls, value: object) -> "FaultKind | None":
        """A kind that only a later version has is told by its name."""
        if not isinstance(value, str):
            return None
        kind = str.__new__(cls, value)
        kind._name_ = kind._value_ = kind.text = value
        kind.measure = ""
        return kind

    MISSING = "missing", "channel without numbers", "s"
    STUCK = "stuck", "sensor stuck", "s"
    CLIPPED = "clipped", "sensor clipped", "part of the samples"
    OFFSET = "offset", "offset", "SI"
    GAIN = "gain", "gain", "relative"
    DELAY = "delay", "delay", "s"
    SWAPPED = "swapped", "channels swapped", "share of motion that the sensors have in common"
    INCOHERENT = (
        "incoherent",
        "sensors contradict each other",  # and no other kind explains it
        "share of motion that the sensors have in common",
    )
    NOISE = "noise", "noise level", "its rms over that of the channel (rad for the shaft angle)"
