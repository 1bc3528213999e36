"""Life cycle of an alarm after ISA-18.2 / IEC 62682, as a table; ``docs/alarms.md`` shows the same table.

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

from collections.abc import Mapping
from types import MappingProxyType

from rotorwatch.records.alarms import AlarmState, EventKind

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
"""Next state of an alarm, by its state and the event."""


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
