"""The front page: every machine's state, raised alarms and latest readings, as plain HTML without scripts or assets."""

import html
from datetime import UTC, datetime

from models.diagnosis.readings import Z95
from rotorwatch.records.alarms import Alarm, Severity
from rotorwatch.records.health import MEASURES, Health, Report
from rotorwatch.records.windows import Opinion, Parameter, Verdict

_RELOAD_S = 5
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; color: #1c2530 }
h2 { margin: 2rem 0 .3rem } h2 span { font-size: 1rem; padding: .1rem .6rem; border-radius: 1rem; color: #fff }
.healthy { background: #23804b } .warming, .not-evaluable { background: #66727f } .alert { background: #b26a00 }
.unchanged, .watching { background: #3d7f6a } .data-health { background: #7a3e9d }
.danger { background: #b3261e } .outside-model { background: #8a5a00 } .no-data { background: #7a3e9d }
td span { padding: 0 .5rem; border-radius: .7rem; color: #fff; font-weight: normal }
table { border-collapse: collapse; margin: .6rem 0 }
td, th { padding: .2rem 1rem .2rem 0; text-align: left; border-bottom: 1px solid #dde2e7 }
td.number { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums } .raised { font-weight: bold }
.disagree { color: #b3261e } .note { color: #66727f }
"""
_ROUTES = ("health", "reports", "alarms", "alarms/events", "detectable")


def front_page(healths: tuple[Health, ...]) -> str:
    """Lay the page out; it reloads itself every five seconds."""
    machines = "".join(_machine(health) for health in healths)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="{_RELOAD_S}">'
        f"<title>rotorwatch</title><style>{_STYLE}</style><h1>rotorwatch</h1>{machines}"
        '<p>Monitoring, not machine protection. <a href="/docs">HTTP API</a>, '
        '<a href="/openapi.json">its description (OpenAPI)</a>, <a href="/readyz">readiness</a></p></html>'
    )


def _machine(health: Health) -> str:
    name = f"{health.site}/{health.machine}"
    place = f"/api/v1/machines/{name}"
    links = ", ".join(f'<a href="{place}/{part}">{part}</a>' for part in _ROUTES)
    raised = {alarm.name: alarm.severity for alarm in health.alarms if alarm.raised}
    silent = ' <span class="no-data">no data</span>' if health.stream.silent and health.state != "no-data" else ""
    reason = f"<p>{html.escape(health.reason)}</p>" if health.reason else ""
    report, said = health.report, ""
    if report is not None and report.verdict is not None:
        suspect = f" Best explained by: {html.escape(report.suspect)}." if report.suspect else ""
        said = f"<p>{html.escape(report.verdict.text)}.{suspect}</p>"
    window = "" if report is None else _measures(report) + _table(report, raised) + _shapes(report) + _levels(report)
    return (
        f'<h2><a href="{place}">{html.escape(name)}</a> <span class="{health.state}">{health.state}</span>{silent}</h2>'
        f"{reason}{said}<p>window {health.filled:.0%} full; {health.quality.accepted_blocks} blocks accepted, "
        f"{sum(health.quality.refused_blocks.values())} refused, {health.quality.gaps} gaps; {links}</p>"
        f"{_alarms(health)}{window}"
    )


def _measures(report: Report) -> str:
    """Numbers of the window, those that there are."""
    values = ((name, getattr(report, field), measure.unit) for name, (field, measure) in MEASURES.items())
    shown = [
        f"{name} {value:.4g}{'' if unit == '1' else ' ' + unit}" for name, value, unit in values if value is not None
    ]
    return f"<p>In the window: {', '.join(shown)}</p>" if shown else ""


def _alarms(health: Health) -> str:
    """What is to be seen of alarms: raised ones first, then those that somebody has to look at, then silenced ones."""
    if not health.alarms:
        return '<p class="note">No alarm is raised, and none waits to be acknowledged.</p>'
    rows = ""
    for alarm in sorted(health.alarms, key=lambda one: (not one.raised, one.since_ns)):
        what = f"{alarm.text} ({alarm.name})"
        rows += (
            f"<tr{' class=raised' if alarm.raised else ''}><td>{html.escape(what)}<td>{_alarm_state(alarm)}"
            f"<td>{_clock(alarm.raised_ns or alarm.since_ns)}<td>{html.escape(_alarm_note(alarm))}</tr>"
        )
    return f"<table><tr><th>alarm<th>state<th>since (UTC)<th>what is known</tr>{rows}</table>"


def _alarm_state(alarm: Alarm) -> str:
    if alarm.pending:
        return "pending"
    severity = f' <span class="{alarm.severity}">{alarm.severity}</span>' if alarm.raised else ""
    return f"{alarm.state.value}{severity}"


def _alarm_note(alarm: Alarm) -> str:
    """Why it is silenced, or how large the change is, or what the note says."""
    if alarm.shelf is not None:
        how = " or until it clears" if alarm.shelf.one_shot else ""
        return f"shelved by {alarm.shelf.by} until {_clock(alarm.shelf.until_ns)}{how}: {alarm.shelf.reason}"
    if alarm.out_of_service_by:
        return f"taken out of service by {alarm.out_of_service_by}: {alarm.out_of_service_reason}"
    if alarm.suppressed_by:
        return f"suppressed: {alarm.suppressed_by}"
    if alarm.relative_change is not None and alarm.interval_95 is not None:
        low, high = alarm.interval_95
        reserve = ", low confidence: outside the model" if alarm.low_confidence else ""
        return f"{alarm.relative_change:+.1%} ({low:+.1%} … {high:+.1%}){reserve}"
    return alarm.note


def _clock(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _shapes(report: Report) -> str:
    """What is said channel by channel where no equation can be evaluated."""
    if not report.shapes:
        return ""
    items = "".join(f"<li>{html.escape(shape.text)}" for shape in report.shapes)
    return f"<p>Each channel beside its own healthy form; no part of the machine can be named:</p><ul>{items}</ul>"


def _levels(report: Report) -> str:
    """Vibration levels of each channel, the nearest limits beside them, and what is beyond them."""
    if not report.levels:
        return ""
    rows = ""
    for one in report.levels:
        shown = one.limit("velocity") or one.limit("overall")
        edges = "" if shown is None else f"{_figure(shown.alert)} / {_figure(shown.danger)}"
        figures = (one.overall, one.velocity, one.x1, one.x2, one.mean, one.crest, one.kurtosis)
        rows += (
            f"<tr{' class=raised' if one.beyond else ''}><td>{html.escape(one.channel)}<td>{html.escape(one.unit)} "
            f"{'pp' if one.detection == 'peak to peak' else 'rms'}"
            + "".join(f'<td class="number">{_figure(value)}' for value in figures)
            + f'<td class="number">{edges}<td>{one.zone}<td>'
            + (f'<span class="{one.beyond}">{one.beyond}</span>' if one.beyond else "")
            + "</tr>"
        )
    return (
        "<table><tr><th>channel<th>unit<th>overall<th>velocity, mm/s<th>1x<th>2x<th>gap<th>crest<th>kurtosis"
        f"<th>alert / danger from<th>zone<th></tr>{rows}</table>"
        + ("" if report.level_growth is None else f"<p>{html.escape(_sentence(report.level_growth.text))}</p>")
    )


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _table(report: Report, raised: dict[str, Severity]) -> str:
    """Who reads what of each parameter, and what would have been noticed."""
    verdict = report.verdict
    if verdict is None or not any(one.relative_change is not None for one in report.parameters):
        return ""
    by = next(one.by for one in report.parameters)
    readings = {parameter.name: parameter for parameter in (() if verdict.settled else verdict.current)}
    limits = {found.name: found for found in report.detectable}
    heads = "".join(f"<th>{html.escape(opinion.by)}" for opinion in report.opinions)
    rows = ""
    for stated in report.parameters:
        parameter, alarm = readings.get(stated.name, stated), raised.get(stated.name, "")
        marked = ' class="raised"' if alarm else ""
        others = "".join(_other(opinion, stated.name) for opinion in report.opinions)
        found = limits.get(stated.name)
        least = "" if found is None else f"{found.loss:+.1%} / {found.gain:+.1%}"
        rows += (
            f"<tr{marked}><td>{html.escape(stated.text)} ({html.escape(stated.name)}){_reading(parameter, verdict)}"
            f'{others}<td class="number">{least}<td>{alarm}</tr>'
        )
    beside = "; the others read the whole window beside it" if report.opinions else ""
    since = "" if verdict.settled else " While the window straddles a change, what is read is the machine since then."
    return (
        f"<table><tr><th>parameter<th>relative change<th>95 % interval{heads}<th>noticed from<th>alarm</tr>{rows}"
        f'</table><p class="note">Decided on the {by}{beside}.{since} '
        "Noticed from: smallest loss and gain that one window shows with 95 % probability.</p>"
    )


def _reading(parameter: Parameter, verdict: Verdict) -> str:
    read = {one.name for one in verdict.current}
    if not verdict.settled and parameter.relative_change is not None and parameter.name not in read:
        return "<td colspan=2>too little data since the change"
    if parameter.relative_change is None or parameter.interval_95 is None:
        return f"<td colspan=2>not evaluable: {html.escape(parameter.reason)}"
    low, high = parameter.interval_95
    return f'<td class="number">{parameter.relative_change:+.1%}<td class="number">{low:+.1%} … {high:+.1%}'


def _other(opinion: Opinion, name: str) -> str:
    """What another diagnostician reads of a parameter, and whether that agrees."""
    said = next((one for one in opinion.parameters if one.name == name), None)
    if said is None or said.relative_change is None or said.standard_error is None:
        return '<td class="number">–'
    apart = any(one.name == name and one.verdict == "disagree" for one in opinion.agreement)
    text = f"{said.relative_change:+.1%} ± {Z95 * said.standard_error:.1%}"
    return f'<td class="number disagree">{text} disagrees' if apart else f'<td class="number">{text}'
