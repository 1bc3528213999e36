"""Operators' actions on alarms: orders and their results."""

from typing import Annotated, Literal

from pydantic import Field

from rotorwatch.records.alarms import Alarm, AlarmCloudEvent, AlarmState
from rotorwatch.records.fields import Record, Request

OperationKind = Literal["acknowledge", "reset", "shelve", "unshelve", "remove-from-service", "return-to-service"]

PRINTABLE = r"^[^\x00-\x1f\x7f]*$"
NOT_BLANK = r"^[^\x00-\x1f\x7f]*[^\x00-\x20\x7f][^\x00-\x1f\x7f]*$"

_Reason = Annotated[
    str,
    Field(
        max_length=500,
        pattern=PRINTABLE,
        description="reason for the operation; it is written into the alarm log and the audit log",
        examples=["sensor cable is being replaced"],
    ),
]
_GivenReason = Annotated[_Reason, Field(pattern=NOT_BLANK)]
_ExpectedState = Annotated[
    AlarmState | None,
    Field(description="state in which you saw the alarm; needed without If-Match", examples=["unacknowledged"]),
]


class OperationOrder(Request):
    """Request to acknowledge, unshelve or reset an alarm, or to return it to service."""

    reason: _Reason = ""
    expected_state: _ExpectedState = None


class ReasonedOrder(Request):
    """Request to take an alarm out of service."""

    reason: _GivenReason
    expected_state: _ExpectedState = None


class ShelveOrder(Request):
    """Request to shelve an alarm."""

    reason: _GivenReason
    duration_s: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="duration in data time; if left out, the longest that the machine file allows (`longest_shelf_s`)",
        examples=[3600.0],
    )
    one_shot: bool = Field(
        default=False, description="end shelving when the condition clears, if that is earlier", examples=[False]
    )
    expected_state: _ExpectedState = None


class OperationDone(Record):
    """Result of an operation."""

    alarm: Alarm = Field(description="alarm after the operation; its version is the new ETag")
    events: tuple[AlarmCloudEvent, ...] = Field(description="events caused by the operation")
