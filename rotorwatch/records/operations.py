"""Operators' actions on alarms: orders and their results."""

from typing import Annotated, Literal

from pydantic import BaseModel, Field

from rotorwatch.records.alarms import Alarm, AlarmCloudEvent, AlarmState
from rotorwatch.records.fields import REQUEST, Record

OperationKind = Literal["acknowledge", "reset", "shelve", "unshelve", "remove-from-service", "return-to-service"]

_LONGEST_REASON = 500

PRINTABLE = r"^[^\x00-\x1f\x7f]*$"
NOT_BLANK = r"^[^\x00-\x1f\x7f]*[^\x00-\x20\x7f][^\x00-\x1f\x7f]*$"

_Reason = Annotated[
    str,
    Field(
        max_length=_LONGEST_REASON,
        pattern=PRINTABLE,
        description="why; it goes into the log of alarms and the audit log",
        examples=["sensor cable is being replaced"],
    ),
]

_GivenReason = Annotated[_Reason, Field(pattern=NOT_BLANK)]

_ExpectedState = Annotated[
    AlarmState | None,
    Field(description="state in which you saw the alarm; needed without If-Match", examples=["unacknowledged"]),
]


class OperationOrder(BaseModel):
    """What an operator says when acknowledging, unshelving, resetting, or returning to service."""

    model_config = REQUEST

    reason: _Reason = ""
    expected_state: _ExpectedState = None


class ReasonedOrder(BaseModel):
    """What is said when taking an alarm out of service."""

    model_config = REQUEST

    reason: _GivenReason
    expected_state: _ExpectedState = None


class ShelveOrder(BaseModel):
    """What an operator says when shelving."""

    model_config = REQUEST

    reason: _GivenReason
    duration_s: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="for how long, data time; left out: as long as the machine file allows (`longest_shelf_s`)",
        examples=[3600.0],
    )
    one_shot: bool = Field(
        default=False, description="end it when the condition clears, if that is earlier", examples=[False]
    )
    expected_state: _ExpectedState = None


class OperationDone(Record):
    """What came of an operation."""

    alarm: Alarm = Field(description="as it is afterwards; its version is the new ETag")
    events: tuple[AlarmCloudEvent, ...] = Field(description="what happened")
