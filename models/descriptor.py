"""Compares the channel descriptor a publisher announces with what the machine file expects."""

from pydantic import ValidationError

from models.machine import MachineFile
from models.mistakes import plainly
from models.signals.channels import ChannelDescriptor

MOST_BYTES = 65_536
"""Size of the largest announced descriptor that is read; one of 64 channels takes a tenth of it."""

MOST_DIFFERENCES = 20
"""Differences that are stated one by one."""

_LONGEST = 80


def descriptor_mismatch(announced: bytes, machine: MachineFile) -> tuple[str, ...]:
    """Differences between an announced descriptor (JSON) and the machine file, one sentence per field.

    Empty if they agree. Each sentence names the field, the value found and the value expected; differences beyond the
    first `MOST_DIFFERENCES` are only counted.
    """
    if len(announced) > MOST_BYTES:
        return (f"descriptor has {len(announced)} bytes, expected at most {MOST_BYTES}",)
    differences = _differences(announced, machine)
    more = len(differences) - MOST_DIFFERENCES
    return (*differences[:MOST_DIFFERENCES], *([f"and {more} more differences"] if more > 0 else ()))


def _differences(announced: bytes, machine: MachineFile) -> list[str]:
    try:
        found = ChannelDescriptor.model_validate_json(announced)
    except ValidationError as error:
        said = ((".".join(map(str, fault["loc"])), plainly(fault)) for fault in error.errors(include_url=False))
        texts = [f"{place}: {text}" if place else text for place, text in said]
        return [f"descriptor cannot be read: {text[: 2 * _LONGEST]}" for text in texts]
    expected = machine.descriptor
    differences = [
        f"{field} is {_shown(getattr(found, field))}, expected {getattr(expected, field)!r}"
        for field in ("site", "machine", "rate_hz", "dtype")
        if getattr(found, field) != getattr(expected, field)
    ]
    if len(found.channels) != len(expected.channels):
        differences.append(f"the number of channels is {len(found.channels)}, expected {len(expected.channels)}")
    for number, (theirs, ours) in enumerate(zip(found.channels, expected.channels, strict=False)):
        for field in ("name", "quantity", "location", "direction", "unit", "angle_deg"):
            is_, should = str(getattr(theirs, field)), str(getattr(ours, field))
            if is_ != should:
                differences.append(f"channels.{number}.{field} ({ours.name}) is {_shown(is_)}, expected {should!r}")
    return differences


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"
