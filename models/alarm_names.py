"""Names of all alarms a machine can have, and what they mean in words."""

from collections.abc import Mapping
from types import MappingProxyType

from models.physics.parameters import PARAMETER_TEXT

__all__ = [
    "ALARM_TEXT",
    "CLOCK",
    "CONFLICT",
    "DATA",
    "FAULT",
    "GAP",
    "MODEL",
    "OVERLOADED",
    "PHASE_REFERENCE",
    "SHAPE",
    "STREAM_LOST",
    "alarm_text",
    "data_alarm",
    "of_the_machine",
]

MODEL = "model"
"""The alarm that says: outside the model."""

SHAPE = "shape"
"""The alarm that says: where no equation can be evaluated, a channel's vibration is not as it was."""

STREAM_LOST = "stream-lost"
"""The alarm that says: no data come any more."""

FAULT, OVERLOADED = "monitor-fault", "monitor-overloaded"
"""The alarms on the monitor itself: a defect, or a history that refuses; and a computer that cannot keep up."""

DATA = "data-"
"""What the names of all alarms of data health begin with."""

GAP, CLOCK, CONFLICT, PHASE_REFERENCE = "data-gap", "data-clock", "data-conflict", "data-phase-reference"

ALARM_TEXT: Mapping[str, str] = MappingProxyType(
    {
        **PARAMETER_TEXT,
        MODEL: "outside the model",
        SHAPE: "vibration changed",
        STREAM_LOST: "stream lost",
        FAULT: "fault in the monitor",
        OVERLOADED: "monitor overloaded",
        GAP: "data health, gap",
        CLOCK: "data health, clock",
        CONFLICT: "data health, conflict of publishers",
        PHASE_REFERENCE: "data health, phase reference",
        "data-stuck": "data health, sensor stuck",
        "data-clipped": "data health, sensor clipped",
        "data-offset": "data health, offset",
        "data-gain": "data health, gain",
        "data-delay": "data health, delay",
        "data-swapped": "data health, channels swapped",
        "data-incoherent": "data health, sensors contradict each other",
        "data-noise": "data health, noise level",
    }
)
"""Every alarm, by its name, in words."""


def alarm_text(name: str) -> str:
    """An alarm in words; one that has none is told by its name rather than not at all."""
    return ALARM_TEXT.get(name, name)


def data_alarm(kind: str) -> str:
    """Name of the alarm for one kind of fault of a sensor."""
    return DATA + kind


def of_the_machine(name: str) -> bool:
    """Whether an alarm says something of the machine; what is wrong with the data or the monitor is none of it."""
    return not name.startswith(DATA) and name not in {STREAM_LOST, FAULT, OVERLOADED}
