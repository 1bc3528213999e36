"""How much of a machine's physics its file tells, and what follows for commissioning."""

from dataclasses import dataclass
from enum import StrEnum

from models.machine import Machine, MachineFile

__all__ = ["Knowledge", "KnowledgeLevel", "knowledge_of"]

_GEOMETRY = ("m1_kg", "m2_kg", "I2_kg_m2", "I2p_kg_m2", "shaft_length_m", "shaft_diameter_m", "shaft_E_Pa")
"""What cannot be identified beside stiffness and damping: masses and shaft."""


class KnowledgeLevel(StrEnum):
    """How much is known."""

    FULL = "full"
    PARTIAL = "partial"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Knowledge:
    """Level of knowledge of a machine.

    Attributes
    ----------
    text : str
        Why, in a sentence.
    """

    level: KnowledgeLevel
    text: str


def knowledge_of(machine: MachineFile) -> Knowledge:
    """Level of knowledge that a machine file gives.

    Examples
    --------
    >>> from models.machine import load_machine_file
    >>> knowledge_of(load_machine_file("lab")).level.value
    'full'
    """
    rotor = machine.rotor
    if isinstance(machine, Machine):
        return Knowledge(KnowledgeLevel.FULL, "the machine file gives all parameters of the rotor")
    if rotor is None:
        return Knowledge(
            KnowledgeLevel.NONE, "the machine file has no [rotor]: everything is learned from the recordings"
        )
    lacking = [name for name in _GEOMETRY if name in rotor.unknown]
    if lacking:
        return Knowledge(
            KnowledgeLevel.NONE,
            f"[rotor] lacks {', '.join(lacking)}: without masses and shaft nothing of it can be used, everything is "
            "learned from the recordings",
        )
    tables = [f"[{name}]" for name in ("operation", "condition") if getattr(machine, name) is None]
    if rotor.unknown:
        return Knowledge(
            KnowledgeLevel.PARTIAL,
            f"[rotor] gives masses and shaft; {', '.join(rotor.unknown)} are identified from the recordings",
        )
    return Knowledge(
        KnowledgeLevel.PARTIAL,
        f"[rotor] is complete, but without {' and '.join(tables)} nothing can be simulated: stiffness, damping and "
        "unbalance are identified from the recordings",
    )
