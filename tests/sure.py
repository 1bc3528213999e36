"""Optional values that a test expects to be there."""

from typing import TypeVar

Found = TypeVar("Found")


def sure(value: Found | None) -> Found:
    """The value, which must not be None."""
    assert value is not None
    return value
