"""Kinds of sensor faults: one row per kind."""

from enum import StrEnum
from typing import Self


class FaultKind(StrEnum):
    """Kind of a sensor fault."""

    text: str  # in words, for the alarm
    measure: str  # unit or meaning of the value of such a fault

    def __new__(cls, name: str, text: str, measure: str) -> Self:
        """Create a member from its name in records, words, and the unit or meaning of its value."""
        kind = str.__new__(cls, name)
        kind._value_, kind.text, kind.measure = name, text, measure
        return kind

    @classmethod
    def _missing_(cls, value: object) -> "FaultKind | None":
        """Create a member for an unknown kind, from a later version, with its name as text."""
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
    # If no other kind explains it.
    INCOHERENT = "incoherent", "sensors contradict each other", "share of motion that the sensors have in common"
    NOISE = "noise", "noise level", "its rms over that of the channel (rad for the shaft angle)"
