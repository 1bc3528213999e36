"""Reports and alarms as single lines of text for a terminal."""

import re
from datetime import UTC, datetime

from models.diagnosis.readings import Z95, percent_digits
from models.physics.rotor import PARAMETERS
from rotorwatch.records.alarms import Alarm, AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Health, Report
from rotorwatch.records.windows import Opinion, Parameter, Verdict

_NUMBER = 10
_TOO_LITTLE = "too little data since the change"
_OUTSIDE = ", outside the model"


def report_line(report: Report) -> str:
    """One window in a line: time (UTC, of the data), machine, state, parameters with 95 % half widths, verdict.

    While the window straddles a change the parameters are those of the data since the change.

    Examples
    --------
    >>> from rotorwatch.records.example import example
    >>> report_line(Report.model_validate(example(Report)))
    '00:03:25  demo/lab  alert          k_by −24.7±1.4 %  |  changed: k_by  |  relation agrees'
    """
    verdict = report.verdict
    if report.parameters and not report.shapes:
        read = "  ".join(_change(one.name, one.relative_change, one.standard_error) for one in _shown(report))
        told = [read or _TOO_LITTLE]
        if verdict is not None:
            changed = f"changed: {_names(verdict) or '?'}" if _found(verdict) else "no change"
            told.append(changed + _OUTSIDE * verdict.outside_model)
        told += [_opinion(opinion) for opinion in report.opinions]
        told += [one.text for one in report.natural_frequencies if one.verdict == "changed"]
    else:
        told = [one.text for one in report.levels if report.state == "watching" or one.beyond]
        if report.shapes:  # no parameter can be read on this machine: growth of levels, or the reason
            told.append(report.level_growth.text if report.level_growth else report.reason)
    tail = "  |  ".join(told) or report.reason or f"window {report.filled:.0%} full"
    # A change was found, but no alarm is raised (yet): "healthy" would contradict the finding.
    state = "no alarm" if report.state == "healthy" and _found(verdict) else report.state
    return f"{_clock(report.end_ns)}  {report.site}/{report.machine}  {state:<13}  {tail}"


def report_heading() -> str:
    """Heading of a table of `report_row`."""
    return "time      " + "".join(f"{name:<{_NUMBER}}" for name in PARAMETERS) + "found"


def report_row(report: Report) -> str:
    """One window in a row of a table: time, each parameter in percent, finding; rarely wider than 80 columns.

    Examples
    --------
    >>> from rotorwatch.records.example import example
    >>> report_row(Report.model_validate(example(Report)))
    '00:03:25  −24.7±1.4                                                   k_by'
    """
    if not report.parameters:
        return f"{_clock(report.end_ns)}  {report.state}: {report.reason or f'window {report.filled:.0%} full'}"
    shown = {one.name: _percent(one.relative_change, one.standard_error) for one in _shown(report)}
    numbers = "".join(f"{shown.get(name, ''):<{_NUMBER}}" for name in PARAMETERS)
    if not shown:
        numbers = f"{_TOO_LITTLE:<{_NUMBER * len(PARAMETERS)}}"
    verdict, found = report.verdict, str(report.state)
    if verdict is not None and _found(verdict):
        found = (_names(verdict) or "changed") + _OUTSIDE * verdict.outside_model
    return f"{_clock(report.end_ns)}  {numbers}{found}"


def with_minus_signs(text: str) -> str:
    """Replace hyphens before numbers with true minus signs, which are as wide as plus signs.

    Examples
    --------
    >>> with_minus_signs("k_by -24.7 %, since 2026-01-01")
    'k_by −24.7 %, since 2026-01-01'
    """
    return re.sub(r"(?<![\w-])-(?=\d)", "−", text)


def alarm_event_line(event: AlarmCloudEvent) -> str:
    """One alarm event in a line.

    Examples
    --------
    >>> from rotorwatch.records.example import example
    >>> alarm_event_line(AlarmCloudEvent.model_validate(example(AlarmCloudEvent)))
    '00:03:25  demo/lab  ALERT: bearing stiffness, horizontal (k_by) changed by −24.7% ± 1.4%'
    """
    data = event.data
    # Some texts, such as those of cleared alarms, lack the alarm's name, so it is appended.
    name = "" if f"({data.name})" in data.text else f" ({data.name})"
    return f"{_clock(data.time_ns)}  {data.site}/{data.machine}  {with_minus_signs(data.text)}{name}"


def alarm_state_lines(states: AlarmStates) -> tuple[str, ...]:
    """One line per raised alarm."""
    place = f"{states.site}/{states.machine}"
    return tuple(
        f"{_clock(alarm.raised_ns or alarm.since_ns)}  {place}  {alarm.severity.upper()} ({alarm.state}): "
        f"{alarm.text}{with_minus_signs(_alarm_detail(alarm))}"
        for alarm in states.alarms
        if alarm.raised
    )


def health_line(health: Health) -> str:
    """The state of a machine in a line, with the reason if there is one.

    Examples
    --------
    >>> from rotorwatch.records.example import example
    >>> health_line(Health.model_validate(example(Health)))
    '00:03:25  demo/lab  state is alert'
    >>> health_line(Health.model_validate(example(Health) | {"reason": "the machine is at a standstill"}))
    '00:03:25  demo/lab  state is alert; latest window: the machine is at a standstill'
    """
    at = "--:--:--" if health.report is None else _clock(health.report.end_ns)
    # An alarm explains itself; the reason is then why the latest window says nothing, or little.
    link = "; latest window" if health.state in {"alert", "danger"} else ""
    reason = reason_of(health)
    why = f"{link}: {reason}" if reason else ""
    return f"{at}  {health.site}/{health.machine}  state is {health.state}{why}"


def reason_of(health: Health) -> str:
    """The reason of a state, without the name of the machine, which stands before it.

    Examples
    --------
    >>> from rotorwatch.records.example import example
    >>> reason_of(Health.model_validate(example(Health) | {"reason": "demo/lab: speed is 900 rpm"}))
    'speed is 900 rpm'
    """
    return health.reason.removeprefix(f"{health.site}/{health.machine}: ")


def _alarm_detail(alarm: Alarm) -> str:
    """Change of the parameter that the alarm is about, or the note of any other alarm."""
    if alarm.relative_change is not None:
        return f"  {_change(alarm.name, alarm.relative_change, alarm.standard_error)}"
    return f": {alarm.note}" if alarm.note else ""


def _shown(report: Report) -> tuple[Parameter, ...]:
    """Parameters of the window, or of the data since a change within it."""
    verdict = report.verdict
    return report.parameters if verdict is None or verdict.settled else verdict.current


def _found(verdict: Verdict | None) -> bool:
    """Whether a change was found; one before the data of this window, without named parameters, does not count."""
    return verdict is not None and bool(verdict.changed or (verdict.detected and not verdict.settled))


def _names(verdict: Verdict) -> str:
    return ", ".join(finding.name for finding in verdict.changed)


def _opinion(opinion: Opinion) -> str:
    """Whether another diagnostician agrees."""
    if opinion.reason:
        return f"{opinion.by} n/a"
    apart = [one.name for one in opinion.agreement if one.verdict == "disagree"]
    return f"{opinion.by} disagrees on {', '.join(apart)}" if apart else f"{opinion.by} agrees"


def _clock(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // 10**9, UTC).strftime("%H:%M:%S")


def _change(name: str, change: float | None, standard_error: float | None) -> str:
    if change is None or standard_error is None:
        return f"{name} n/a"
    return f"{name} {_percent(change, standard_error)} %"


def _percent(change: float | None, standard_error: float | None) -> str:
    if change is None or standard_error is None:
        return "n/a"
    half = Z95 * standard_error
    digits = percent_digits(half)
    return with_minus_signs(f"{100 * change:+.{digits}f}±{100 * half:.{digits}f}".rjust(9))
