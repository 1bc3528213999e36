"""The project's exceptions."""


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


class PictureError(RotorwatchError):
    """A picture cannot be written."""


class EstimationError(RotorwatchError):
    """A window's statistics do not allow an estimate."""


class UnexplainedError(EstimationError):
    """Nothing within the model comes near a window: a fault of a sensor, or something that no parameter describes."""
