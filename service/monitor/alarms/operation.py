"""What operators do to alarms."""

from dataclasses import dataclass

from models.errors import RotorwatchError
from rotorwatch.records.alarms import EventKind
from rotorwatch.records.operations import OperationKind

KIND_OF_EVENT: dict[OperationKind, EventKind] = {
    "acknowledge": EventKind.ACKNOWLEDGED,
    "reset": EventKind.RESET,
    "shelve": EventKind.SHELVED,
    "unshelve": EventKind.UNSHELVED,
    "remove-from-service": EventKind.REMOVED_FROM_SERVICE,
    "return-to-service": EventKind.RETURNED_TO_SERVICE,
}
"""The event that each operation makes in the life cycle and in the log."""


class UnknownAlarm(RotorwatchError):  # noqa: N818  # said to an operator, by its name
    """There is no alarm of this name; the message lists those there are."""


class OperationRefused(RotorwatchError):  # noqa: N818
    """The alarm is in a state in which this cannot be done; the message says which."""


class OperationConflict(RotorwatchError):  # noqa: N818
    """The alarm is no longer as the operator saw it; the message says how it is."""


class NotInTime(RotorwatchError):  # noqa: N818
    """The machine's thread did not get round to what was asked; whether it will be done is not known."""


@dataclass(frozen=True, slots=True)
class OperatorAction:
    """Something an operator wants done to an alarm."""

    kind: OperationKind
    alarm: str
    # Who, and why; a reason is needed for shelving and for taking out of service.
    actor: str
    reason: str = ""
    duration_s: float | None = None  # for how long to shelve; None: as long as the machine file allows
    one_shot: bool = False  # shelve only until the condition clears
    expected_state: str | None = None  # state in which the operator saw it
    expected_version: int | None = None  # its `version` when the operator saw it
