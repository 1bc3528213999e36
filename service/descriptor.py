"""Compares the channel descriptor a publisher announces with what the machine file expects."""

from pydantic import ValidationError

from models.machine import MachineFile
from models.signals.channels import ChannelDescriptor

__all__ = ["descriptor_mismatch"]


def descriptor_mismatch(announced: bytes, machine: MachineFile) -> tuple[str, ...]:
    """Differences between an announced descriptor and the machine file, one sentence per field.

    Parameters
    ----------
    announced : bytes
        JSON from the ``descriptor`` key.
    machine : MachineFile
        What is expected.

    Returns
    -------
    tuple of str
        Empty if they agree; else each names the field, the value found and the value expected.
    """
    try:
        found = ChannelDescriptor.model_validate_json(announced)
    except ValidationError as error:
        faults = (f"{'.'.join(str(part) for part in f['loc']) or 'descriptor'}: {f['msg']}" for f in error.errors())
        return tuple(f"descriptor cannot be read: {fault}" for fault in faults)
    expected = machine.descriptor
    differences = [
        f"{field} is {getattr(found, field)!r}, expected {getattr(expected, field)!r}"
        for field in ("site", "machine", "rate_hz", "dtype")
        if getattr(found, field) != getattr(expected, field)
    ]
    if len(found.channels) != len(expected.channels):
        differences.append(f"channels has {len(found.channels)} entries, expected {len(expected.channels)}")
    for number, (theirs, ours) in enumerate(zip(found.channels, expected.channels, strict=False)):
        for field in ("name", "quantity", "location", "direction", "unit"):
            is_, should = str(getattr(theirs, field)), str(getattr(ours, field))
            if is_ != should:
                differences.append(f"channels.{number}.{field} ({ours.name}) is {is_!r}, expected {should!r}")
    return tuple(differences)
