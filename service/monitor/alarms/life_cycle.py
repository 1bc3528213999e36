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
taken away from the operator's eyes: shelved, suppressed by design, out of service. It goes on following its condition
there, and on leaving it is unacknowledged if the condition is there. If not, it is normal where an operator took it
away; where a rule did, what was owed before is owed still: an acknowledgement, or a reset.
"""

from collections.abc import Mapping
from types import MappingProxyType

from rotorwatch.records.alarms import AlarmState, EventKind

STAYS = "stays"
"""What happens is taken note of, and the state stays as it is."""

REFUSED = "refused"
"""Nobody may ask for this in this state."""

OWED = "as owed"
"""Back to where somebody still has to acknowledge or reset; normal if nobody has to."""

Cell = str | tuple[str, AlarmState]
"""A state, `STAYS`, `REFUSED`, or two states: for *cleared* without and with latching, otherwise without and with the
condition there."""

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
"""What becomes of an alarm in a state when something happens."""


def owed_after(state: AlarmState, *, latching: bool) -> AlarmState:
    """Where an alarm that a rule takes away from a state comes back to, once its condition is gone.

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
    """The state an alarm goes to; None if that is refused in this state.

    What counts is whether the condition is present after what happens. Without it, the alarm comes back after a rule to
    what is owed.

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
