"""Alarms on changes: a pure state machine per parameter and one for the model, time as an argument.

::

            beyond the limit              for on_delay
    NORMAL ------------------> PENDING ------------------> ACTIVE <-----------.
      ^                          |                            | small again   | beyond again
      |        small again       |                            v               |
      '--------------------------'          for off_delay  CLEARING ----------'
      '------------------------------------------------------'

Beyond the limit is a parameter that the sequential test names as changed, by more than its limit. A window that could
not be evaluated changes nothing: missing data neither raises nor clears, and an uncertain reading that is still large
clears nothing either.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType

from models.machine import AlarmSettings
from models.physics.parameters import PARAMETER_TEXT

__all__ = ["ALARM_TEXT", "MODEL", "SENSOR", "SHAPE", "Alarm", "AlarmBook", "AlarmEvent", "AlarmState", "Severity"]

MODEL = "model"
"""What the alarm is about that says: outside the model."""

SENSOR = "sensor"
"""What the alarm is about that says: a sensor is at fault."""

SHAPE = "shape"
"""What the alarm is about that says: where no equation can be evaluated, a channel's vibration is not as it was."""

ALARM_TEXT: Mapping[str, str] = MappingProxyType(
    {**PARAMETER_TEXT, MODEL: "outside the model", SENSOR: "data health", SHAPE: "vibration changed"}
)
"""What each alarm is about, in words."""


_SENTENCES: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        MODEL: (
            "something has changed that no parameter describes, or a sensor is at fault",
            "the model describes the machine again",
        ),
        SENSOR: ("a sensor is at fault", "the sensors agree with each other again"),
        SHAPE: ("a channel's vibration is no longer as on the healthy machine", "the vibration is as it was"),
    }
)
"""Of what is no parameter: what is said when it is raised, without a note, and when it clears."""


class AlarmState(StrEnum):
    """Where an alarm is."""

    NORMAL = "normal"
    PENDING = "pending"
    ACTIVE = "active"
    CLEARING = "clearing"


class Severity(StrEnum):
    """How serious a raised alarm is."""

    ALERT = "alert"
    DANGER = "danger"


@dataclass(frozen=True, slots=True)
class Alarm:
    """Alarm of one parameter, or of the model.

    Attributes
    ----------
    parameter : str
        Which parameter, or `MODEL`.
    state : AlarmState
        Where it is.
    severity : Severity
        Of the present or last occurrence; it rises with the change and falls only by clearing.
    since_ns : int
        Data time at which `state` was entered.
    raised_ns : int or None
        Data time at which the present occurrence became active.
    occurrence : int
        Counts the times it became active.
    change, standard_error : float
        Latest relative change and its standard error; nan for what is no parameter.
    note : str
        What is known of it, in a sentence; empty for a parameter.
    low_confidence : bool
        The data were outside the model too: that this parameter is the one that changed is to be taken with reserve.
    """

    parameter: str
    state: AlarmState = AlarmState.NORMAL
    severity: Severity = Severity.ALERT
    since_ns: int = 0
    raised_ns: int | None = None
    occurrence: int = 0
    change: float = 0.0
    standard_error: float = float("inf")
    low_confidence: bool = False
    note: str = ""

    @property
    def raised(self) -> bool:
        """Whether operators see it: active, or active and about to clear."""
        return self.state in {AlarmState.ACTIVE, AlarmState.CLEARING}


@dataclass(frozen=True, slots=True)
class AlarmEvent:
    """One change operators hear of: ``raised``, ``escalated`` (alert to danger) or ``cleared``."""

    kind: str
    time_ns: int
    sequence: int
    alarm: Alarm

    @property
    def text(self) -> str:
        """The event in a sentence."""
        alarm = self.alarm
        if alarm.parameter in _SENTENCES:
            raised, cleared = _SENTENCES[alarm.parameter]
            if self.kind == "cleared":
                return f"cleared: {cleared}"
            return f"{alarm.severity.upper()}: {ALARM_TEXT[alarm.parameter]}: {alarm.note or raised}"
        what = f"{PARAMETER_TEXT[alarm.parameter]} ({alarm.parameter})"
        size = f"{alarm.change:+.1%} ± {1.96 * alarm.standard_error:.1%}"
        reserve = " (low confidence: outside the model)" if alarm.low_confidence else ""
        match self.kind:
            case "raised":
                return f"{alarm.severity.upper()}: {what} changed by {size}{reserve}"
            case "escalated":
                return f"{alarm.severity.upper()}: {what} changed further, now {size}{reserve}"
            case _:
                return f"cleared: {what} is back within its limits at {size}"


class AlarmBook:
    """The alarms of one machine.

    Parameters
    ----------
    settings : AlarmSettings
        Limits and delays.
    """

    def __init__(self, settings: AlarmSettings) -> None:
        self._settings = settings
        self._alarms: dict[str, Alarm] = {}
        self._sequence = 0

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Every alarm seen so far, normal ones included."""
        return tuple(self._alarms.values())

    @property
    def severity(self) -> Severity | None:
        """Highest severity of the alarms that are raised on the machine; a sensor's fault is none of the machine."""
        raised = [alarm.severity for alarm in self._alarms.values() if alarm.raised and alarm.parameter != SENSOR]
        if not raised:
            return None
        return Severity.DANGER if Severity.DANGER in raised else Severity.ALERT

    def clock_stepped(self, time_ns: int) -> None:
        """Restart all running delays: the data's clock was set, so they cannot be measured across it."""
        for name, alarm in self._alarms.items():
            if alarm.state in {AlarmState.PENDING, AlarmState.CLEARING}:
                self._alarms[name] = replace(alarm, since_ns=time_ns)

    def update(
        self,
        parameter: str,
        change: float,
        standard_error: float,
        time_ns: int,
        *,
        named: bool,
        low_confidence: bool = False,
    ) -> tuple[AlarmEvent, ...]:
        """Judge one evaluated parameter at the end of a hop.

        Parameters
        ----------
        parameter : str
            Which one.
        change, standard_error : float
            Relative change and standard error.
        time_ns : int
            Data time of the end of the hop.
        named : bool
            Whether the parameter is among those found to have changed.
        low_confidence : bool
            Whether the data are outside the model.

        Returns
        -------
        tuple of AlarmEvent
            None, or what operators should hear.
        """
        if not (math.isfinite(change) and 0 < standard_error < math.inf):
            return ()
        limits, size = self._settings.for_parameter(parameter), abs(change)
        alarm = replace(
            self._alarms.get(parameter, Alarm(parameter, since_ns=time_ns)),
            change=change,
            standard_error=standard_error,
            low_confidence=low_confidence,
        )
        return self._judge(
            alarm,
            time_ns,
            beyond=named and size > limits.raise_above,
            small=size < limits.clear_below,
            danger=size > limits.danger_above,
        )

    def update_state(self, about: str, present: bool, time_ns: int, note: str = "") -> tuple[AlarmEvent, ...]:
        """Judge what is no parameter at the end of a hop.

        Parameters
        ----------
        about : str
            `MODEL`, `SENSOR` or `SHAPE`.
        present : bool
            Whether the data are further from the model than sampling explains, a sensor is at fault, or a channel's
            vibration has changed.
        time_ns : int
            Data time of the end of the hop.
        note : str
            What is known of it, in a sentence.
        """
        known = self._alarms.get(about, Alarm(about, since_ns=time_ns))
        alarm = replace(known, change=math.nan, standard_error=math.nan, note=note if present else known.note)
        return self._judge(alarm, time_ns, beyond=present, small=not present, danger=False)

    def _judge(self, alarm: Alarm, time_ns: int, *, beyond: bool, small: bool, danger: bool) -> tuple[AlarmEvent, ...]:
        """Move an alarm on."""
        settings = self._settings
        lasted_s = (time_ns - alarm.since_ns) / 1e9
        kind = None
        match alarm.state:
            case AlarmState.NORMAL if beyond:
                alarm = replace(alarm, state=AlarmState.PENDING, since_ns=time_ns)
                lasted_s = 0.0
            case AlarmState.PENDING if not beyond:
                alarm = replace(alarm, state=AlarmState.NORMAL, since_ns=time_ns)
            case AlarmState.ACTIVE if small:
                alarm = replace(alarm, state=AlarmState.CLEARING, since_ns=time_ns)
                lasted_s = 0.0
            case AlarmState.CLEARING if not small:
                alarm = replace(alarm, state=AlarmState.ACTIVE, since_ns=time_ns)
        if alarm.state is AlarmState.PENDING and lasted_s >= settings.on_delay_s:
            alarm = replace(
                alarm,
                state=AlarmState.ACTIVE,
                severity=Severity.DANGER if danger else Severity.ALERT,
                since_ns=time_ns,
                raised_ns=time_ns,
                occurrence=alarm.occurrence + 1,
            )
            kind = "raised"
        elif alarm.state is AlarmState.CLEARING and lasted_s >= settings.off_delay_s:
            alarm = replace(alarm, state=AlarmState.NORMAL, since_ns=time_ns, raised_ns=None)
            kind = "cleared"
        elif alarm.state is AlarmState.ACTIVE and alarm.severity is Severity.ALERT and danger:
            alarm = replace(alarm, severity=Severity.DANGER)
            kind = "escalated"
        self._alarms[alarm.parameter] = alarm
        if kind is None:
            return ()
        event = AlarmEvent(kind, time_ns, self._sequence, alarm)
        self._sequence += 1
        return (event,)
