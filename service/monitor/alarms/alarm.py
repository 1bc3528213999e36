"""An alarm, what happens to it, and the sentences operators read."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from models.alarm_names import (
    CLOCK,
    CONFLICT,
    FAULT,
    GAP,
    MODEL,
    OVERLOADED,
    PHASE_REFERENCE,
    SHAPE,
    STREAM_LOST,
    alarm_text,
)
from models.diagnosis.readings import Z95
from models.physics.parameters import PARAMETER_TEXT
from rotorwatch.records.alarms import AlarmState, EventKind, Severity

__all__ = ["Alarm", "AlarmEvent", "Evidence", "Shelf"]

_CLEARED: Mapping[str, str] = MappingProxyType(
    {
        MODEL: "the model describes the machine again",
        SHAPE: "the vibration is as it was",
        STREAM_LOST: "data come again",
        FAULT: "the monitor works again",
        OVERLOADED: "the monitor keeps up again",
        GAP: "the data are without gaps again",
        CLOCK: "the clock of the data runs steadily again",
        CONFLICT: "one publisher sends, and does not contradict itself",
        PHASE_REFERENCE: "the phase reference is there again",
    }
)
_RAISED: Mapping[str, str] = MappingProxyType(
    {
        MODEL: "something has changed that no parameter describes, or a sensor is at fault",
        SHAPE: "a channel's vibration is no longer as on the healthy machine",
    }
)


@dataclass(frozen=True, slots=True)
class Evidence:
    """What an alarm was decided on.

    Attributes
    ----------
    start_ns, end_ns : int
        The data: a window, or the stretch that decided.
    confidence : float or None
        Probability that what is named changed and nothing else, where one is computed.
    """

    start_ns: int
    end_ns: int
    confidence: float | None = None


@dataclass(frozen=True, slots=True)
class Shelf:
    """Why an alarm is shelved, and until when.

    Attributes
    ----------
    until_ns : int
        Data time at which it ends at the latest.
    one_shot : bool
        It ends when the condition clears, if that is earlier.
    by, reason : str
        Who, and why.
    """

    until_ns: int
    one_shot: bool
    by: str
    reason: str


@dataclass(frozen=True, slots=True)
class Alarm:
    """One alarm of a machine.

    Attributes
    ----------
    name : str
        One of `ALARM_TEXT`.
    state : AlarmState
        Where it is in its life cycle.
    present : bool
        Whether the condition is there, delays included.
    severity : Severity
        Of the present or last occurrence; it rises with the change and falls only by clearing.
    since_ns : int
        Data time at which `state` was entered.
    raised_ns : int or None
        Data time at which the present occurrence began; None without one.
    occurrence : int
        Counts the times the condition began.
    beyond_ns, small_ns : int or None
        Since when the readings have asked for the condition to begin, or to end: the delays run.
    change, standard_error : float or None
        Latest relative change and its standard error; None for what is no parameter.
    low_confidence : bool
        The data were outside the model too: that this parameter is the one that changed is to be taken with reserve.
    note : str
        What is known of it, in words; for a parameter only where its change has a direction.
    evidence : Evidence or None
        Latest data that decided.
    shelf : Shelf or None
        Only while shelved.
    rules : tuple of str
        Identities of the rules that suppress it now; empty if none, whatever the state.
    suppressed_by : str
        The same in words.
    out_of_service_by, out_of_service_reason : str
        Who took it out of service, and why; empty otherwise.
    owed : AlarmState
        While suppressed: where it comes back to without its condition, because somebody has to acknowledge or reset.
    version : int
        Sequence number of its latest event; -1 before the first. Who changes an alarm says which version was seen.
    """

    name: str
    state: AlarmState = AlarmState.NORMAL
    present: bool = False
    severity: Severity = Severity.ALERT
    since_ns: int = 0
    raised_ns: int | None = None
    occurrence: int = 0
    beyond_ns: int | None = None
    small_ns: int | None = None
    change: float | None = None
    standard_error: float | None = None
    low_confidence: bool = False
    note: str = ""
    evidence: Evidence | None = None
    shelf: Shelf | None = None
    rules: tuple[str, ...] = ()
    suppressed_by: str = ""
    out_of_service_by: str = ""
    out_of_service_reason: str = ""
    owed: AlarmState = AlarmState.NORMAL
    version: int = -1

    @property
    def raised(self) -> bool:
        """Whether the condition is there and operators are to see it."""
        return self.present and self.state.annunciated

    @property
    def open(self) -> bool:
        """Whether there is anything to see: any state but normal, or a delay that runs."""
        return self.state is not AlarmState.NORMAL or self.beyond_ns is not None


@dataclass(frozen=True, slots=True)
class AlarmEvent:
    """One entry of the log: what happened to an alarm.

    Attributes
    ----------
    kind : EventKind
        What happened.
    time_ns : int
        Data time.
    sequence : int
        Counts the events of the machine, from 0, across restarts.
    alarm : Alarm
        As it is afterwards.
    before : AlarmState
        Where it was.
    actor : str
        Who did it; empty for the monitor.
    reason : str
        Why, as the actor or the rule says.
    """

    kind: EventKind
    time_ns: int
    sequence: int
    alarm: Alarm
    before: AlarmState = AlarmState.NORMAL
    actor: str = ""
    reason: str = ""

    @property
    def text(self) -> str:
        """The event in a sentence."""
        alarm = self.alarm
        words = alarm_text(alarm.name)
        match self.kind:
            case EventKind.RAISED | EventKind.ESCALATED | EventKind.CLEARED:
                hidden = "" if alarm.state.annunciated else f" ({alarm.state.value})"
                return self._about_condition() + hidden
        who = f" by {self.actor}" if self.actor else ""
        why = f": {self.reason}" if self.reason else ""
        what = f"{words} ({alarm.name})" if alarm.name in PARAMETER_TEXT else words
        return f"{self.kind.value.replace('-', ' ')}{who}: {what}{why}"

    def _about_condition(self) -> str:
        alarm = self.alarm
        words = alarm_text(alarm.name)
        if alarm.name not in PARAMETER_TEXT:
            if self.kind is EventKind.CLEARED:
                return f"cleared: {_CLEARED.get(alarm.name, f'{words}: nothing of it is seen any more')}"
            said = alarm.note or _RAISED.get(alarm.name, "")
            return f"{alarm.severity.upper()}: {words}" + (f": {said}" if said else "")
        what = f"{words} ({alarm.name})"
        half = Z95 * (alarm.standard_error or 0.0)
        size = f"{alarm.change or 0.0:+.1%} ± {half:.1%}" + (f": {alarm.note}" if alarm.note else "")
        reserve = " (low confidence: outside the model)" if alarm.low_confidence else ""
        match self.kind:
            case EventKind.RAISED:
                return f"{alarm.severity.upper()}: {what} changed by {size}{reserve}"
            case EventKind.ESCALATED:
                return f"{alarm.severity.upper()}: {what} changed further, now {size}{reserve}"
            case _:
                return f"cleared: {what} is back within its limits at {size}"
