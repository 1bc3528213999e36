"""All alarms of one machine: from readings to conditions, from conditions and operators to events.

A reading calls for an alarm's condition to begin (*beyond* its limit) or to end (*small* again). In the deadband
between the two limits, and where nothing was read, it calls for neither: missing data neither raise nor clear. What is
called for throughout the on-delay or off-delay, in data time, happens; `service.monitor.alarms.alarm.TABLE` gives the
alarm's next state.

A parameter is beyond its limit if the sequential test names it as changed, almost certainly, by more than that limit.
If others explain the data too, the alarm is `changed`, with the candidates. A parameter is small again when it has come
back, or when a whole window after the change says that it is not this parameter.
"""

import math
from dataclasses import dataclass, replace

from pydantic import TypeAdapter

from models.alarm_names import ALARMS, CHANGED, MODEL, alarm_kind, data_alarm, is_alarm
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.readings import Z95
from models.errors import CheckpointError
from models.machine import AlarmSettings, SuppressRule
from models.physics.rotor import PARAMETERS
from rotorwatch.records.alarms import AlarmState, EventKind, Evidence, Severity, Shelf
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import Verdict
from service.monitor.alarms.alarm import (
    KIND_OF_EVENT,
    Alarm,
    AlarmEvent,
    OperationConflict,
    OperationRefused,
    OperatorAction,
    UnknownAlarm,
    follow,
    owed_after,
)

_LEAST_KEPT_PROBABILITY = 0.5
"""Probability below which a parameter that was named is no longer taken to have changed."""
_LEAST_CHANGES_UNNAMED = 4
"""Outside the model, number of apparently changed parameters from which none is named: it is another machine, or what
is wrong concerns all of it."""
_HELD_STIFF_NOTE = "no fault makes a shaft stiffer; something may hold it, such as a locked coupling"
_VANISHED, _VANISHED_NOTE = -0.9, "its 1x has all but vanished; the sensors may no longer see this shaft"
_HUNTING_NOTE = "without a shaft angle, a speed that hunts within seconds makes 1x look smaller, too"


@dataclass(frozen=True, slots=True)
class _Page:
    """What survives a restart."""

    alarms: tuple[Alarm, ...]
    next_sequence: int


_PAGE = TypeAdapter(_Page)

NO_ALARMS = _PAGE.dump_json(_Page((), 0)).decode()
"""What `AlarmBook.checkpoint` returns before anything has happened."""


class AlarmBook:
    """The alarms of one machine; `by_angle` says whether its shaft angle is measured."""

    def __init__(self, settings: AlarmSettings, *, by_angle: bool = True) -> None:
        self._settings, self._by_angle = settings, by_angle
        self._alarms: dict[str, Alarm] = {}
        self.next_sequence = 0  # number the next event will have
        self._pending_events: list[AlarmEvent] = []

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Every alarm seen so far, normal ones included."""
        return tuple(self._alarms.values())

    @property
    def severity(self) -> Severity | None:
        """Highest severity of the alarms raised on the machine; alarms on its data do not count."""
        of_machine = (one for one in self._alarms.values() if one.raised and alarm_kind(one.name).about == "machine")
        raised = {alarm.severity for alarm in of_machine}
        return next((severity for severity in (Severity.DANGER, Severity.ALERT) if severity in raised), None)

    def present(self, name: str) -> bool:
        """Whether the condition of an alarm is present."""
        return name in self._alarms and self._alarms[name].present

    def take(self) -> tuple[AlarmEvent, ...]:
        """Hand over, in order and once, all events that have happened.

        An event is numbered as soon as it happens. If its caller fails before passing it on, the next caller does:
        otherwise the number would be missing from the log for ever.
        """
        told, self._pending_events = tuple(self._pending_events), []
        return told

    # What the data say

    def found(
        self,
        verdict: Verdict,
        unexplained: str,
        suspect: str,
        end_ns: int,
        astride_s: float = 0.0,
        *,
        hidden: bool = False,
        rival: str | None = None,
    ) -> bool:
        """Judge the sequential test's verdict at the end of a hop; without clean data alarms stay as they are.

        Returns whether a parameter change, or its repair, that operators are told of explains the data without reserve.

        Parameters
        ----------
        unexplained : str
            Why no parameter can be read; empty if one can.
        suspect : str
            What explains data outside the model best; empty if nothing does.
        astride_s : float
            For how long the window may still straddle a change, and be outside the model for that alone.
        hidden : bool
            Whether the suspect hides what parameters do: none is named then, and none that was named is taken back. If
            a parameter explains the data as well, so that they are not outside the model, both are candidates.
        rival : str, optional
            Cause outside the model that explains the data as well as the changes of the verdict; empty if none does,
            None if nobody has looked.
        """
        named, outside = [finding.name for finding in verdict.changed], verdict.outside_model
        unreserved = set(named)
        probability = {one.name: one.probability for one in verdict.candidates}
        another = outside and len(named) >= _LEAST_CHANGES_UNNAMED
        nameless = another or hidden
        sure = {one for one in named if not nameless and probability.get(one, 0.0) >= self._settings.name_confidence}
        held = {*named, *(one for one, likely in probability.items() if likely >= _LEAST_KEPT_PROBABILITY)}
        # Without parameters the unbalance is read through the stiffness to ground at running speed. If that has changed
        # in both planes, the bearings' support may move, which makes the stiffness differ between frequencies. The same
        # holds if only one stiffness, or the unbalance in their place, is named, and both read softer.
        softer = {
            one.name
            for one in verdict.current
            if one.relative_change is not None and one.relative_change < -Z95 * (one.standard_error or math.inf)
        }
        # While the window straddles a change of a bearing, its means are not those of one machine: near a resonance an
        # unbalance would fit them.
        bearings = set(named) - {"e", "EI"}
        unlike = {"k_by", "k_bz"} <= bearings | softer or (bearings != set() and not verdict.settled)
        start_ns = end_ns - round(verdict.decided_s * 1e9)
        evidence = Evidence(start_ns=start_ns, end_ns=end_ns, confidence=verdict.confidence)
        # Noise in place of the signals has no 1x, and windows that hold its beginning may be evaluated.
        blind = not verdict.settled or self.present(data_alarm(FaultKind.INCOHERENT))
        for reading in verdict.current:
            if reading.relative_change is not None and reading.standard_error is not None:
                larger = reading.relative_change if reading.vector is None else reading.vector.magnitude_change
                unlikely = _unlikely(reading.name, larger, reading.standard_error, by_angle=self._by_angle)
                if unlikely:
                    unreserved.discard(reading.name)
                self.update(
                    reading.name,
                    reading.relative_change,
                    reading.standard_error,
                    end_ns,
                    named=reading.name in sure and not (blind and unlikely == _VANISHED_NOTE),
                    taken_back=verdict.settled and not hidden and (another or reading.name not in held),
                    low_confidence=outside
                    or hidden
                    or unlikely != ""
                    or (unlike and (reading.name, reading.by) == ("e", BaselineDiagnostician.by)),
                    rival=rival if reading.name in named else None,
                    growth=larger if reading.name == "e" else None,
                    evidence=evidence,
                    note=unlikely or ("" if reading.vector is None else reading.vector.text),
                )
        if outside and not verdict.current:
            # Nothing is read from unexplained data, and parameters named before are named with reserve from now on.
            self._alarms |= {
                name: replace(self._alarms[name], low_confidence=True) for name in PARAMETERS if self.present(name)
            }
        if verdict.current:
            # Outside the model no candidate need be right, which alarm `model` says; and one cause has one alarm.
            told = outside or any(self.present(name) for name in probability)
            unsure = [] if sure or told else named
            beside = [suspect] if hidden and suspect else []  # stated however little the parameter would have changed
            changes = [
                (abs(one.relative_change or 0.0), self._settings.for_parameter(one.name))
                for one in verdict.current
                if one.name in unsure
            ]
            # With their probabilities if parameters are the only candidates.
            candidates = [
                f"{one.text} ({one.name})" + ("" if beside else f" {one.probability:.0%}") for one in verdict.candidates
            ]
            self.update_state(
                CHANGED,
                any(change > limits.raise_above or beside for change, limits in changes),
                end_ns,
                " or ".join(candidates + beside),
                evidence=evidence,
                danger=any(change > limits.danger_above and not beside for change, limits in changes),
            )
        if verdict.current or unexplained or outside:
            at_once = f"{', '.join(named)} seem to have changed at the same time, so none is named" if another else ""
            within_s = astride_s + self._settings.on_delay_s
            just = f"if a parameter has just changed, it can be named in {within_s:.0f} s" if astride_s else ""
            note = "; ".join(filter(None, (unexplained, suspect and f"best explained by: {suspect}", at_once, just)))
            self.update_state(MODEL, outside, end_ns, note, evidence=evidence)
        heard = any(self._alarms[one].due for one in (*probability, CHANGED) if one in self._alarms)
        standing = any(self.present(one) and not self._alarms[one].low_confidence for one in PARAMETERS)
        # After a repair, the window still holds data from before.
        explained = (unreserved and heard) or (standing and not verdict.settled)
        return bool(explained) and not (outside or hidden or rival)

    def update(  # noqa: PLR0913  # what one reading says
        self,
        parameter: str,
        change: float,
        standard_error: float,
        time_ns: int,
        *,
        named: bool,
        taken_back: bool = False,
        low_confidence: bool = False,
        rival: str | None = None,
        growth: float | None = None,
        evidence: Evidence | None = None,
        note: str = "",
    ) -> tuple[AlarmEvent, ...]:
        """Judge the reading of one parameter at the end of a hop (`time_ns`).

        Parameters
        ----------
        named : bool
            Whether the parameter is among those found to have changed.
        taken_back : bool
            Whether a whole window after the change says that it is not.
        rival : str, optional
            See `found`; None leaves it as it was.
        growth : float, optional
            Relative increase of the load on the machine, if it differs from the change: an unbalance that has only
            turned, or has become smaller, is not dangerous.
        """
        if not (math.isfinite(change) and 0 < standard_error < math.inf):
            return ()
        limits, size = self._settings.for_parameter(parameter), abs(change)
        known = self._alarm_named(parameter, time_ns)
        if rival is None:
            rival = known.rival if known.due else ""
        low_confidence |= rival != ""
        alarm = replace(
            known,
            change=change,
            standard_error=standard_error,
            low_confidence=low_confidence,
            rival=rival,
            taken_back=taken_back and size >= limits.clear_below,
            evidence=evidence,
            note=note,
        )
        beyond, small = named and size > limits.raise_above, taken_back or size < limits.clear_below
        # With reserve, another parameter may have changed instead; levels say whether it is dangerous.
        danger = beyond and min(size, size if growth is None else growth) > limits.danger_above and not low_confidence
        return self._run_delays(alarm, time_ns, beyond=beyond, small=small, danger=danger)

    def update_state(  # noqa: PLR0913  # what is known of a state
        self,
        name: str,
        present: bool,
        time_ns: int,
        note: str = "",
        *,
        evidence: Evidence | None = None,
        at_once: bool = False,
        danger: bool = False,
        small: bool | None = None,
    ) -> tuple[AlarmEvent, ...]:
        """Judge an alarm that is not on a parameter: `at_once`, without delay, if it is a fact rather than an estimate.

        `small` is whether the condition has ended; by default it has if it is not `present`.
        """
        if not present and name not in self._alarms:
            return ()
        known = self._alarm_named(name, time_ns)
        evidence = evidence or known.evidence
        alarm = replace(known, note=note if present else known.note, evidence=evidence)
        gone = not present if small is None else small
        return self._run_delays(alarm, time_ns, beyond=present, small=gone, danger=danger, at_once=at_once)

    def suppress(self, speed_rpm: float | None, time_ns: int) -> tuple[AlarmEvent, ...]:
        """Apply the suppression rules; where the speed is unknown, those that depend on it stay as they are.

        An alarm that no rule names any more, because the machine file has changed, is no longer suppressed.
        """
        events: list[AlarmEvent] = []
        ruled = [name for rule in self._settings.suppress for name in rule.alarms]
        for name in dict.fromkeys((*ruled, *(alarm.name for alarm in self.alarms if alarm.rules))):
            alarm = self._alarm_named(name, time_ns)
            about = [rule for rule in self._settings.suppress if name in rule.alarms]
            holding = [rule for rule in about if self._applies(rule, alarm, speed_rpm)]
            rules = tuple(rule.identity for rule in holding)
            if rules == alarm.rules:
                continue
            because = "; ".join(dict.fromkeys(rule.because for rule in holding))
            alarm = replace(alarm, rules=rules, suppressed_by=because)
            if rules and alarm.state is not AlarmState.SUPPRESSED:
                events += self._transition(alarm, EventKind.SUPPRESSED, time_ns, reason=because)
            elif not rules:
                events += self._transition(alarm, EventKind.UNSUPPRESSED, time_ns)
            else:
                self._alarms[name] = alarm
        return tuple(events)

    # What time and operators do

    def passed(self, time_ns: int) -> tuple[AlarmEvent, ...]:
        """End the shelving of alarms whose time is over."""
        events: list[AlarmEvent] = []
        for alarm in self.alarms:
            if alarm.shelf is not None and time_ns >= alarm.shelf.until_ns:
                events += self._unshelve(alarm, alarm.shelf.until_ns, "the shelf time has expired")
        return tuple(events)

    def clock_stepped(self, time_ns: int, step_ns: int) -> None:
        """Restart all running delays and keep the remaining shelving times: the data's clock was set."""
        for name, alarm in self._alarms.items():
            shelf = alarm.shelf and alarm.shelf.model_copy(update={"until_ns": alarm.shelf.until_ns + step_ns})
            beyond_ns = None if alarm.beyond_ns is None else time_ns
            small_ns = None if alarm.small_ns is None else time_ns
            self._alarms[name] = replace(alarm, beyond_ns=beyond_ns, small_ns=small_ns, shelf=shelf)

    def operate(self, operation: OperatorAction, time_ns: int) -> tuple[AlarmEvent, ...]:
        """Do what an operator asks for, at the data time that has been reached.

        Raises
        ------
        UnknownAlarm
            If there is no such alarm.
        OperationConflict
            If the alarm is no longer as the operator saw it.
        OperationRefused
            If it is in a state in which this cannot be done, a reason is missing, or the time is too long.
        """
        if not is_alarm(operation.alarm):
            raise UnknownAlarm(f"no alarm {operation.alarm}; there are: {', '.join(ALARMS)}")
        alarm = self._alarm_named(operation.alarm, time_ns)
        self._must_be_as_seen(alarm, operation)
        kind = KIND_OF_EVENT[operation.kind]
        if follow(alarm.state, kind, present=alarm.present, latching=alarm.name in self._settings.latching) is None:
            raise OperationRefused(f"{alarm.name} is {alarm.state.value}: {operation.kind} is not possible")
        if kind in {EventKind.SHELVED, EventKind.REMOVED_FROM_SERVICE} and not operation.reason.strip():
            raise OperationRefused(f"{operation.kind} of {alarm.name}: reason is empty, expected an explanation")
        actor, reason = operation.actor, operation.reason
        if kind is EventKind.SHELVED:
            alarm = replace(alarm, shelf=self._shelf(operation, time_ns))
        elif kind is EventKind.UNSHELVED:
            return self._unshelve(alarm, time_ns, reason, actor)
        elif kind is EventKind.REMOVED_FROM_SERVICE:
            alarm = replace(alarm, shelf=None, out_of_service_by=actor, out_of_service_reason=reason)
        elif kind is EventKind.RETURNED_TO_SERVICE:
            alarm = replace(alarm, out_of_service_by="", out_of_service_reason="")
        events = self._transition(alarm, kind, time_ns, actor=actor, reason=reason)
        return events + self._suppressed_again(alarm.name, time_ns)

    # Surviving a restart

    def checkpoint(self) -> str:
        """The complete state as JSON."""
        return _PAGE.dump_json(_Page(self.alarms, self.next_sequence)).decode()

    def restore(self, text: str, next_sequence: int | None = None) -> None:
        """Continue from what `checkpoint` returned.

        The log's number of the next event may be ahead of the checkpoint's; it is behind only if the log was begun
        anew.

        Raises
        ------
        CheckpointError
            If the text is not of this form.
        """
        try:
            page = _PAGE.validate_json(text)
        except ValueError as error:
            raise CheckpointError(f"alarms cannot be restored: {error}") from error
        # Another version of the program may have had other alarms.
        self._alarms = {alarm.name: alarm for alarm in page.alarms if is_alarm(alarm.name)}
        self.next_sequence = max(page.next_sequence, next_sequence or 0)
        self._pending_events = []

    # Inside

    def _alarm_named(self, name: str, time_ns: int) -> Alarm:
        return self._alarms.get(name) or Alarm(name, since_ns=time_ns)

    def _applies(self, rule: SuppressRule, alarm: Alarm, speed_rpm: float | None) -> bool:
        if rule.while_alarm is not None:
            return self.present(rule.while_alarm)
        if speed_rpm is None:
            return rule.identity in alarm.rules
        speed_rpm = abs(speed_rpm)  # either way round
        if rule.below_rpm is not None:
            return speed_rpm < rule.below_rpm
        return rule.above_rpm is not None and speed_rpm > rule.above_rpm

    def _must_be_as_seen(self, alarm: Alarm, operation: OperatorAction) -> None:
        state, version = operation.expected_state, operation.expected_version
        if (state is not None and state != alarm.state) or (version is not None and version != alarm.version):
            seen = f"state {state}" if state is not None else f"version {version}"
            raise OperationConflict(
                f"{alarm.name} is {alarm.state.value} (version {alarm.version}), no longer as it was seen ({seen}): "
                "look again"
            )

    def _shelf(self, operation: OperatorAction, time_ns: int) -> Shelf:
        longest_s = self._settings.longest_shelf_s
        duration_s = longest_s if operation.duration_s is None else operation.duration_s
        if not 0 < duration_s <= longest_s:
            raise OperationRefused(
                f"shelve of {operation.alarm}: duration_s is {duration_s:g}, expected more than 0 and at most "
                f"{longest_s:g}"
            )
        until_ns = time_ns + round(duration_s * 1e9)
        return Shelf(until_ns=until_ns, one_shot=operation.one_shot, by=operation.actor, reason=operation.reason)

    def _run_delays(
        self, alarm: Alarm, time_ns: int, *, beyond: bool, small: bool, danger: bool, at_once: bool = False
    ) -> tuple[AlarmEvent, ...]:
        """Run the delays, and raise, clear or escalate the alarm if that is due."""
        settings = self._settings
        began_ns = [time_ns if since_ns is None else since_ns for since_ns in (alarm.beyond_ns, alarm.small_ns)]
        beyond_ns = began_ns[0] if beyond and not alarm.present else None
        small_ns = began_ns[1] if small and alarm.present else None
        alarm = replace(alarm, beyond_ns=beyond_ns, small_ns=small_ns)
        if beyond_ns is not None and (at_once or (time_ns - beyond_ns) / 1e9 >= settings.on_delay_s):
            alarm = replace(
                alarm,
                present=True,
                severity=Severity.DANGER if danger else Severity.ALERT,
                raised_ns=time_ns,
                occurrence=alarm.occurrence + 1,
                beyond_ns=None,
            )
            return self._transition(alarm, EventKind.RAISED, time_ns)
        if small_ns is not None and (at_once or (time_ns - small_ns) / 1e9 >= settings.off_delay_s):
            alarm = replace(alarm, present=False, raised_ns=None, small_ns=None)
            events = self._transition(alarm, EventKind.CLEARED, time_ns)
            if alarm.shelf is not None and alarm.shelf.one_shot:
                events += self._unshelve(self._alarms[alarm.name], time_ns, "the condition has cleared")
            return events
        if alarm.present and danger and alarm.severity is Severity.ALERT:
            alarm = replace(alarm, severity=Severity.DANGER)
            return self._transition(alarm, EventKind.ESCALATED, time_ns)
        self._alarms[alarm.name] = alarm
        return ()

    def _unshelve(self, alarm: Alarm, time_ns: int, reason: str, actor: str = "") -> tuple[AlarmEvent, ...]:
        events = self._transition(replace(alarm, shelf=None), EventKind.UNSHELVED, time_ns, actor=actor, reason=reason)
        return events + self._suppressed_again(alarm.name, time_ns)

    def _suppressed_again(self, name: str, time_ns: int) -> tuple[AlarmEvent, ...]:
        """Suppress an alarm that is no longer hidden by an operator, if a rule still applies."""
        alarm = self._alarms[name]
        if not alarm.rules or not alarm.state.annunciated:
            return ()
        return self._transition(alarm, EventKind.SUPPRESSED, time_ns, reason=alarm.suppressed_by)

    def _transition(
        self, alarm: Alarm, kind: EventKind, time_ns: int, *, actor: str = "", reason: str = ""
    ) -> tuple[AlarmEvent, ...]:
        """Move the alarm through its life cycle and record the event."""
        before, latching = alarm.state, alarm.name in self._settings.latching
        state = follow(before, kind, present=alarm.present, latching=latching, owed=alarm.owed)
        if state is None:
            raise OperationRefused(f"{alarm.name} is {before.value}: it cannot be {kind.value}")
        if state is before and kind in {EventKind.SUPPRESSED, EventKind.UNSUPPRESSED}:
            self._alarms[alarm.name] = alarm  # the rule is noted; what an operator has hidden stays so
            return ()
        since_ns = alarm.since_ns if state is before else time_ns
        owed = alarm.owed if state is before else AlarmState.NORMAL
        if kind is EventKind.SUPPRESSED:
            owed = owed_after(before, latching=latching)
        alarm = replace(alarm, state=state, since_ns=since_ns, owed=owed, version=self.next_sequence)
        event = AlarmEvent(kind, time_ns, self.next_sequence, alarm, before, actor, reason)
        self.next_sequence += 1
        self._alarms[alarm.name] = alarm
        self._pending_events.append(event)
        return (event,)


def _unlikely(name: str, change: float, error: float, *, by_angle: bool) -> str:
    """Why no fault of the machine changes a parameter like that, or need not have; empty if one may.

    Without a shaft angle, the rotation is sought as a line of the vibration.
    """
    if name == "EI" and change > Z95 * error:
        return _HELD_STIFF_NOTE
    if name == "e" and change < _VANISHED:
        return _VANISHED_NOTE
    return _HUNTING_NOTE if name == "e" and change < 0 and not by_angle else ""
