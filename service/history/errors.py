"""What goes wrong with the history."""

from models.errors import RotorwatchError

__all__ = ["DamagedError", "StoreError"]


class StoreError(RotorwatchError):
    """The history cannot be opened, read or written; the message names database or machine, never a password."""


class DamagedError(StoreError):
    """The file is there and is no usable database; the message says what SQLite found."""
