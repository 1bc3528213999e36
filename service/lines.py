"""Reports and alarms as single lines of text for a terminal."""

from datetime import UTC, datetime

from service.schemas import AlarmCloudEvent, AlarmStates, Health, Parameter, Report

__all__ = ["alarm_event_line", "alarm_state_lines", "health_line", "report_line"]

_Z95 = 1.959964


def report_line(report: Report) -> str:
    """One window in a line: time (UTC, of the data), machine, state, every parameter with its 95 % half width.

    Examples
    --------
    >>> from service.schemas import Report, example
    >>> report_line(Report.model_validate(example(Report)))
    '00:03:25  lab  alert          k_by −24.7±1.4 %'
    """
    if report.parameters:
        tail = "  ".join(_parameter(parameter) for parameter in report.parameters)
    else:
        tail = report.reason or f"window {report.filled:.0%} full"
    return f"{_clock(report.end_ns)}  {report.machine}  {report.state:<13}  {tail}"


def alarm_event_line(event: AlarmCloudEvent) -> str:
    """One alarm event in a line.

    Examples
    --------
    >>> from service.schemas import AlarmCloudEvent, example
    >>> alarm_event_line(AlarmCloudEvent.model_validate(example(AlarmCloudEvent)))
    '00:03:25  lab  ALERT: bearing stiffness, horizontal (k_by) changed by -24.7% ± 1.4%'
    """
    return f"{_clock(event.data.time_ns)}  {event.data.machine}  {event.data.text}"


def alarm_state_lines(states: AlarmStates) -> tuple[str, ...]:
    """One line per raised alarm."""
    return tuple(
        f"{_clock(alarm.raised_ns or alarm.since_ns)}  {states.machine}  {alarm.severity.upper()} ({alarm.state}): "
        f"{alarm.text}  {_change(alarm.parameter, alarm.relative_change, alarm.standard_error)}"
        for alarm in states.alarms
        if alarm.raised
    )


def health_line(health: Health) -> str:
    """The state of a machine in a line, with the reason if there is one.

    Examples
    --------
    >>> from service.schemas import Health, example
    >>> health_line(Health.model_validate(example(Health)))
    '00:03:25  lab  state is alert'
    """
    at = "--:--:--" if health.window_end_ns is None else _clock(health.window_end_ns)
    why = f": {health.reason}" if health.reason else ""
    return f"{at}  {health.machine}  state is {health.state}{why}"


def _clock(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // 10**9, UTC).strftime("%H:%M:%S")


def _parameter(parameter: Parameter) -> str:
    return _change(parameter.name, parameter.relative_change, parameter.standard_error)


def _change(name: str, change: float | None, standard_error: float | None) -> str:
    if change is None or standard_error is None:
        return f"{name} n/a"
    # A true minus sign is as wide as the plus sign, so that columns stay put.
    return f"{name} {100 * change:+5.1f}±{100 * _Z95 * standard_error:.1f} %".replace("-", "−")
