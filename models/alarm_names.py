"""All alarms a machine can have: one row per alarm."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from models.physics.rotor import PARAMETER_TEXT
from rotorwatch.records.sensor_faults import FaultKind

MODEL = "model"  # the alarm that says: outside the model
CHANGED = "changed"  # the alarm that says: a parameter has changed, and it is not sure which
SHAPE = "shape"  # the alarm that says: where no equation can be evaluated, a channel's vibration is not as it was
STREAM_LOST = "stream-lost"  # the alarm that says: no data come any more
LEVEL = "level:"  # begins the name of the alarm on a channel's vibration levels; the channel's name follows
# The alarms on the monitor itself: a defect, or a history that refuses; and a computer that cannot keep up.
FAULT, OVERLOADED = "monitor-fault", "monitor-overloaded"
DATA = "data-"  # what the names of all alarms of data health begin with
GAP, CLOCK, CONFLICT, PHASE_REFERENCE = "data-gap", "data-clock", "data-conflict", "data-phase-reference"


def data_alarm(kind: FaultKind) -> str:
    """Name of the alarm for one kind of fault of a sensor."""
    return DATA + kind


@dataclass(frozen=True, slots=True)
class AlarmKind:
    """Texts and subject of an alarm."""

    text: str  # what it is about, in words
    # What is at fault while it is raised. A fault of the data or the monitor says nothing about the machine.
    about: Literal["machine", "data", "monitor"]
    cleared: str  # what holds again once it has cleared
    raised: str = ""  # what holds while it is raised, if nothing more is known


ALARMS: Mapping[str, AlarmKind] = MappingProxyType(
    {
        **{name: AlarmKind(text, "machine", "within its limits") for name, text in PARAMETER_TEXT.items()},
        MODEL: AlarmKind(
            "outside the model",
            "machine",
            "the model describes the machine again",
            "something has changed that no parameter describes, or a sensor is at fault",
        ),
        CHANGED: AlarmKind(
            "changed, not certain what",
            "machine",
            "the change has been identified, or is no longer present",
            "it is not yet certain what has changed",
        ),
        SHAPE: AlarmKind(
            "vibration changed",
            "machine",
            "the vibration is back to what it was",
            "a channel's vibration differs from that of the healthy machine",
        ),
        STREAM_LOST: AlarmKind("stream lost", "data", "data are arriving again"),
        FAULT: AlarmKind("fault in the monitor", "monitor", "the monitor is working again"),
        OVERLOADED: AlarmKind("monitor overloaded", "monitor", "the monitor is keeping up again"),
        GAP: AlarmKind("data health, gap", "data", "the data are free of gaps again"),
        CLOCK: AlarmKind("data health, clock", "data", "the clock of the data is steady again"),
        CONFLICT: AlarmKind(
            "data health, conflict of publishers", "data", "only one publisher sends, and its data are consistent"
        ),
        PHASE_REFERENCE: AlarmKind(
            "data health, phase reference",
            "data",
            "the phase reference is steady again; after a jump, phases remain shifted",
        ),
        **{
            data_alarm(kind): AlarmKind(
                f"data health, {kind.text}", "data", f"data health, {kind.text}: no longer detected"
            )
            for kind in FaultKind
        },
    }
)
"""Every alarm, by its name."""


def is_alarm(name: str) -> bool:
    """Whether an alarm of this name exists; one on a channel's levels does on machines that have the channel."""
    return name in ALARMS or re.fullmatch(f"{LEVEL}[A-Za-z0-9_.:-]{{1,64}}", name) is not None


def alarm_kind(name: str) -> AlarmKind:
    """Texts and subject of an alarm; one without a row in `ALARMS` is described by its name."""
    if name.startswith(LEVEL):
        channel = name.removeprefix(LEVEL)
        return AlarmKind(f"vibration level, {channel}", "machine", f"the levels of {channel} are within their limits")
    return ALARMS.get(name) or AlarmKind(name, "machine", f"{name}: no longer detected")
