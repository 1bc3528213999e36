"""Reports and alarms as single lines of text for a terminal."""

from datetime import UTC, datetime

from models.diagnosis.readings import Z95
from rotorwatch.records.alarms import Alarm, AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Health, Report
from rotorwatch.records.windows import Opinion, Parameter, Verdict

__all__ = ["alarm_event_line", "alarm_state_lines", "health_line", "report_line"]


def report_line(report: Report) -> str:
    """One window in a line: time (UTC, of the data), machine, state, parameters with 95 % half widths, verdict.

    While the window straddles a change the parameters are those of the data since the change.

    Examples
    --------
    >>> from rotorwatch.records.example import example
    >>> from rotorwatch.records.health import Report
    >>> report_line(Report.model_validate(example(Report)))
    '00:03:25  demo/lab  alert          k_by −24.7±1.4 %  |  changed: k_by  |  relation agrees'
    """
    if report.parameters:
        verdict = report.verdict
        shown = report.parameters if verdict is None or verdict.settled else verdict.current
        parts = ["  ".join(_parameter(parameter) for parameter in shown) or "too little data since the change"]
        parts += [] if verdict is None else [_verdict(verdict)]
        parts += [_opinion(opinion) for opinion in report.opinions]
        tail = "  |  ".join(parts)
    else:
        tail = report.reason or f"window {report.filled:.0%} full"
    return f"{_clock(report.end_ns)}  {report.site}/{report.machine}  {report.state:<13}  {tail}"


def alarm_event_line(event: AlarmCloudEvent) -> str:
    """One alarm event in a line.

    Examples
    --------
    >>> from rotorwatch.records.alarms import AlarmCloudEvent
    >>> from rotorwatch.records.example import example
    >>> alarm_event_line(AlarmCloudEvent.model_validate(example(AlarmCloudEvent)))
    '00:03:25  demo/lab  ALERT: bearing stiffness, horizontal (k_by) changed by -24.7% ± 1.4%'
    """
    data = event.data
    # Where the text has no name, as that of some that cleared, it must be seen which alarm it is about.
    name = "" if f"({data.name})" in data.text else f" ({data.name})"
    return f"{_clock(data.time_ns)}  {data.site}/{data.machine}  {data.text}{name}"


def alarm_state_lines(states: AlarmStates) -> tuple[str, ...]:
    """One line per raised alarm."""
    place = f"{states.site}/{states.machine}"
    return tuple(
        f"{_clock(alarm.raised_ns or alarm.since_ns)}  {place}  {alarm.severity.upper()} ({alarm.state}): "
        f"{alarm.text}{_known(alarm)}"
        for alarm in states.alarms
        if alarm.raised
    )


def health_line(health: Health) -> str:
    """The state of a machine in a line, with the reason if there is one.

    Examples
    --------
    >>> from rotorwatch.records.example import example
    >>> from rotorwatch.records.health import Health
    >>> health_line(Health.model_validate(example(Health)))
    '00:03:25  demo/lab  state is alert'
    """
    at = "--:--:--" if health.window_end_ns is None else _clock(health.window_end_ns)
    why = f": {health.reason}" if health.reason else ""
    return f"{at}  {health.site}/{health.machine}  state is {health.state}{why}"


def _known(alarm: Alarm) -> str:
    """The change of a parameter; of any other alarm, what has been noted."""
    if alarm.relative_change is not None:
        return f"  {_change(alarm.name, alarm.relative_change, alarm.standard_error)}"
    return f": {alarm.note}" if alarm.note else ""


def _verdict(verdict: Verdict) -> str:
    names = ", ".join(finding.name for finding in verdict.changed)
    text = f"changed: {names or '?'}" if verdict.detected or names else "no change"
    return f"{text}, outside the model" if verdict.outside_model else text


def _opinion(opinion: Opinion) -> str:
    """Whether another diagnostician agrees."""
    if opinion.reason:
        return f"{opinion.by} n/a"
    apart = [one.name for one in opinion.agreement if one.verdict == "disagree"]
    return f"{opinion.by} disagrees on {', '.join(apart)}" if apart else f"{opinion.by} agrees"


def _clock(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // 10**9, UTC).strftime("%H:%M:%S")


def _parameter(parameter: Parameter) -> str:
    return _change(parameter.name, parameter.relative_change, parameter.standard_error)


def _change(name: str, change: float | None, standard_error: float | None) -> str:
    if change is None or standard_error is None:
        return f"{name} n/a"
    # A true minus sign is as wide as the plus sign, so that columns stay put.
    return f"{name} {100 * change:+5.1f}±{100 * Z95 * standard_error:.1f} %".replace("-", "−")
