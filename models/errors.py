"""The project's exceptions.

::

    RotorwatchError
    ├── MachineFileError      a machine, scenario or settings file cannot be used
    ├── WireError             bytes from outside are not a block, descriptor or report
    ├── BundleError           a trained bundle does not fit this machine or is damaged
    ├── CheckpointError       what a monitor remembered cannot be restored
    ├── RecordingError        a recording cannot be read or written
    └── EstimationError       a window cannot be evaluated (never raised for "nothing found")
        └── UnexplainedError  because nothing within the model comes near it

Expected trouble in a live stream (a gap, a duplicate, a NaN) is a value, not an exception: see ``models.ingest``.
"""

__all__ = [
    "BundleError",
    "CheckpointError",
    "EstimationError",
    "MachineFileError",
    "RecordingError",
    "RotorwatchError",
    "UnexplainedError",
    "WireError",
]


class RotorwatchError(Exception):
    """Everything this project raises on purpose."""


class MachineFileError(RotorwatchError):
    """A machine, scenario or settings file cannot be used; the message names file, field and value."""


class WireError(RotorwatchError):
    """Bytes from outside are not what the wire format says; the message names field, value and expectation."""


class BundleError(RotorwatchError):
    """A trained bundle is damaged or belongs to another machine; the message names what differs."""


class CheckpointError(RotorwatchError):
    """What a monitor remembered is damaged, or of another machine, file or version; the message says which."""


class RecordingError(RotorwatchError):
    """A recording cannot be read or written."""


class EstimationError(RotorwatchError):
    """A window's statistics do not allow an estimate."""


class UnexplainedError(EstimationError):
    """Nothing within the model comes near a window: a fault of a sensor, or something that no parameter describes."""
