"""An alarm, its life cycle, the sentences operators read, and what they do to it."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from models.alarm_names import alarm_kind
from models.diagnosis.readings import Z95, percent_digits
from models.errors import RotorwatchError
from models.physics.rotor import PARAMETER_TEXT
from rotorwatch.records.alarms import AlarmState, EventKind, Evidence, Severity, Shelf
from rotorwatch.records.operations import OperationKind


@dataclass(frozen=True, slots=True)
class Alarm:
    """One alarm of a machine; fields that it shares with `rotorwatch.records.alarms.Alarm` are described there."""

    name: str
    state: AlarmState = AlarmState.NORMAL
    present: bool = False
    severity: Severity = Severity.ALERT
    since_ns: int = 0
    raised_ns: int | None = None
    occurrence: int = 0
    # Since when readings have called for the condition to begin, or to end: starts of the on-delay and off-delay.
    beyond_ns: int | None = None
    small_ns: int | None = None
    change: float | None = None
    standard_error: float | None = None
    low_confidence: bool = False
    taken_back: bool = False  # it still reads as changed, but another parameter may have changed instead
    note: str = ""
    rival: str = ""  # causes outside the model of which a change explains the data as well
    evidence: Evidence | None = None
    shelf: Shelf | None = None
    rules: tuple[str, ...] = ()  # identities of the rules that suppress it now; empty if none, whatever the state
    suppressed_by: str = ""
    out_of_service_by: str = ""
    out_of_service_reason: str = ""
    # While suppressed: state to return to without the condition, because somebody has to acknowledge or reset.
    owed: AlarmState = AlarmState.NORMAL
    version: int = -1

    @property
    def raised(self) -> bool:
        """Whether the condition is present and operators are notified."""
        return self.present and self.state.annunciated

    @property
    def due(self) -> bool:
        """Whether the condition is present, or will be after the on-delay."""
        return self.present or self.beyond_ns is not None

    @property
    def open(self) -> bool:
        """Whether the alarm is in any state but normal, or its on-delay runs."""
        return self.state is not AlarmState.NORMAL or self.beyond_ns is not None


@dataclass(frozen=True, slots=True)
class AlarmEvent:
    """One entry of the log: what happened to an alarm."""

    kind: EventKind
    time_ns: int
    sequence: int
    alarm: Alarm  # as it is afterwards
    before: AlarmState = AlarmState.NORMAL
    actor: str = ""
    reason: str = ""

    @property
    def text(self) -> str:
        """The event in a sentence."""
        alarm, words = self.alarm, alarm_kind(self.alarm.name).text
        what = f"{words} ({alarm.name})" if alarm.name in PARAMETER_TEXT else words
        if self.kind in {EventKind.RAISED, EventKind.ESCALATED, EventKind.CLEARED}:
            hidden = "" if alarm.state.annunciated else f" ({alarm.state.value})"
            return self._about_condition(what) + hidden
        who = f" by {self.actor}" if self.actor else ""
        why = f": {self.reason}" if self.reason else ""
        return f"{self.kind.value.replace('-', ' ')}{who}: {what}{why}"

    def _about_condition(self, what: str) -> str:
        alarm, texts = self.alarm, alarm_kind(self.alarm.name)
        if alarm.name not in PARAMETER_TEXT:
            if self.kind is EventKind.CLEARED:
                return f"cleared: {texts.cleared}"
            said = alarm.note or texts.raised
            return f"{alarm.severity.upper()}: {what}" + (f": {said}" if said else "")
        half = Z95 * (alarm.standard_error or 0.0)
        digits = percent_digits(half)
        size = f"{alarm.change or 0.0:+.{digits}%} ± {half:.{digits}%}" + (f": {alarm.note}" if alarm.note else "")
        cause = f"a change of {alarm.rival} explains the data as well" if alarm.rival else "another cause is possible"
        reserve = f" (low confidence: {cause})" if alarm.low_confidence else ""
        if self.kind is EventKind.RAISED:
            return f"{alarm.severity.upper()}: {what} changed by {size}{reserve}"
        if self.kind is EventKind.ESCALATED:
            return f"{alarm.severity.upper()}: {what} changed further, now {size}{reserve}"
        if alarm.taken_back:
            return f"cleared: {what} is no longer named as changed; it reads {size}"
        return f"cleared: {what} is back {texts.cleared} at {size}"


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


STAYS = "stays"
"""The event is recorded, and the state stays as it is."""

REFUSED = "refused"
"""The operation is not allowed in this state."""

OWED = "as owed"
"""To the state in which somebody still has to acknowledge or reset; normal if nobody has to."""

Cell = str | tuple[str, AlarmState]
"""A state, `STAYS`, `REFUSED`, or two states: for *cleared* without and with latching, otherwise without and with the
condition present."""

_N, _U, _A, _R = AlarmState.NORMAL, AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED, AlarmState.RETURNED
_LU, _LA = AlarmState.LATCHED_UNACKNOWLEDGED, AlarmState.LATCHED_ACKNOWLEDGED
_SH, _SU, _OOS, _NO = AlarmState.SHELVED, AlarmState.SUPPRESSED, AlarmState.OUT_OF_SERVICE, REFUSED
_ROWS: Mapping[EventKind, tuple[Cell, ...]] = {
    # from:                          normal unackn.    ackn.      ret.   latch. l.ack. shelved   suppr.      out
    EventKind.RAISED:               (_U,    STAYS,     STAYS,     _U,    _U,    _U,    STAYS,    STAYS,      STAYS),
    EventKind.CLEARED:              (STAYS, (_R, _LU), (_N, _LA), STAYS, STAYS, STAYS, STAYS,    STAYS,      STAYS),
    EventKind.ESCALATED:            (STAYS, STAYS,     _U,        STAYS, STAYS, STAYS, STAYS,    STAYS,      STAYS),
    EventKind.ACKNOWLEDGED:         (_NO,   _A,        _NO,       _N,    _LA,   _NO,   _NO,      _NO,        _NO),
    EventKind.RESET:                (_NO,   _NO,       _NO,       _NO,   _R,    _N,    _NO,      _NO,        _NO),
    EventKind.SHELVED:              (_SH,   _SH,       _SH,       _SH,   _SH,   _SH,   STAYS,    _NO,        _NO),
    EventKind.UNSHELVED:            (_NO,   _NO,       _NO,       _NO,   _NO,   _NO,   (_N, _U), _NO,        _NO),
    EventKind.SUPPRESSED:           (_SU,   _SU,       _SU,       _SU,   _SU,   _SU,   STAYS,    STAYS,      STAYS),
    EventKind.UNSUPPRESSED:         (STAYS, STAYS,     STAYS,     STAYS, STAYS, STAYS, STAYS,    (OWED, _U), STAYS),
    EventKind.REMOVED_FROM_SERVICE: (_OOS,  _OOS,      _OOS,      _OOS,  _OOS,  _OOS,  _OOS,     _OOS,       _NO),
    EventKind.RETURNED_TO_SERVICE:  (_NO,   _NO,       _NO,       _NO,   _NO,   _NO,   _NO,      _NO,        (_N, _U)),
}  # fmt: skip

TABLE: Mapping[tuple[AlarmState, EventKind], Cell] = MappingProxyType(
    {(state, kind): row[at] for kind, row in _ROWS.items() for at, state in enumerate(AlarmState)}
)
"""Next state of an alarm, by its state and the event, after ISA-18.2 / IEC 62682; ``docs/alarms.md`` shows the same.

::

                  condition                      acknowledge
      NORMAL ------------------> UNACKNOWLEDGED -------------> ACKNOWLEDGED
        ^  ^                       |   ^     ^ escalate             | |
        |  |            clear      v   |     '---------------------'  |
        |  '--- acknowledge --- RETURNED                              |
        |                                       clear                 |
        '-------------------------------------------------------------'

A latching alarm goes to a latched state where others return, and leaves it by *reset*. From every state an alarm can be
hidden from operators: shelved, suppressed by design, out of service. It goes on following its condition there, and on
leaving it is unacknowledged if the condition is present. If not, it is normal if an operator had hidden it; if a rule
had, the acknowledgement or reset that was owed before is still owed.
"""


def owed_after(state: AlarmState, *, latching: bool) -> AlarmState:
    """State that an alarm suppressed by a rule in `state` returns to, once its condition is gone.

    Examples
    --------
    >>> owed_after(AlarmState.UNACKNOWLEDGED, latching=False).value
    'returned'
    """
    if state in {AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED}:
        return follow(state, EventKind.CLEARED, present=False, latching=latching) or state
    return state


def follow(
    state: AlarmState, kind: EventKind, *, present: bool, latching: bool, owed: AlarmState = AlarmState.NORMAL
) -> AlarmState | None:
    """Next state of an alarm; None if the event is refused in this state.

    `present` is whether the condition is present after the event. If not, the end of suppression leads to `owed`.

    Examples
    --------
    >>> follow(AlarmState.UNACKNOWLEDGED, EventKind.CLEARED, present=False, latching=False).value
    'returned'
    """
    cell = TABLE[state, kind]
    if isinstance(cell, tuple):
        without, with_ = cell
        if latching if kind is EventKind.CLEARED else present:
            return with_
        return owed if without == OWED else AlarmState(without)
    if cell == REFUSED:
        return None
    return state if cell == STAYS else AlarmState(cell)
