"""What goes wrong with the history."""

from models.errors import RotorwatchError

__all__ = ["StoreError"]


class StoreError(RotorwatchError):
    """The history cannot be opened, read or written; the message names database or machine, never a password."""
