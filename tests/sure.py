"""What a test is sure to find."""

from typing import TypeVar

Found = TypeVar("Found")


def sure(value: Found | None) -> Found:
    """The value, which is there."""
    assert value is not None
    return value
