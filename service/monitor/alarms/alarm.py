"""An alarm, what happens to it, and the sentences operators read."""

from dataclasses import dataclass

from models.alarm_names import alarm_kind
from models.diagnosis.readings import Z95
from models.physics.rotor import PARAMETER_TEXT
from rotorwatch.records.alarms import AlarmState, EventKind, Evidence, Severity, Shelf


@dataclass(frozen=True, slots=True)
class Alarm:
    """One alarm of a machine.

    Attributes
    ----------
    name : str
        One of `ALARMS`.
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
        words = alarm_kind(alarm.name).text
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
        words = alarm_kind(alarm.name).text
        if alarm.name not in PARAMETER_TEXT:
            if self.kind is EventKind.CLEARED:
                return f"cleared: {alarm_kind(alarm.name).cleared}"
            said = alarm.note or alarm_kind(alarm.name).raised
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
                return f"cleared: {what} is back {alarm_kind(alarm.name).cleared} at {size}"
