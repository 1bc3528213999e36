"""The front page: every machine's state, raised alarms and latest readings, as plain HTML without scripts or assets."""

import html

from service.schemas import Health, Parameter

__all__ = ["front_page"]

_RELOAD_S = 5
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 60rem; padding: 0 1rem; color: #1c2530 }
h2 { margin: 2rem 0 .3rem } h2 span { font-size: 1rem; padding: .1rem .6rem; border-radius: 1rem; color: #fff }
.healthy { background: #23804b } .warming, .not-evaluable { background: #66727f } .alert { background: #b26a00 }
.danger { background: #b3261e } .no-data { background: #7a3e9d } table { border-collapse: collapse; margin: .6rem 0 }
td, th { padding: .2rem 1rem .2rem 0; text-align: left; border-bottom: 1px solid #dde2e7 }
td.number { text-align: right; font-variant-numeric: tabular-nums } .raised { font-weight: bold }
"""
_ROUTES = ("health", "reports", "alarms", "alarms/events")


def front_page(healths: tuple[Health, ...]) -> str:
    """Lay the page out; it reloads itself every five seconds."""
    machines = "".join(_machine(health) for health in healths)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="{_RELOAD_S}">'
        f"<title>rotorwatch</title><style>{_STYLE}</style><h1>rotorwatch</h1>{machines}"
        '<p>Monitoring, not machine protection. <a href="/openapi.json">API description (OpenAPI)</a>, '
        '<a href="/readyz">readiness</a></p></html>'
    )


def _machine(health: Health) -> str:
    name = f"{health.site}/{health.machine}"
    place = f"/api/v1/machines/{name}"
    links = ", ".join(f'<a href="{place}/{part}">{part}</a>' for part in _ROUTES)
    raised = {alarm.parameter: alarm.severity for alarm in health.alarms if alarm.raised}
    rows = "".join(_row(parameter, raised.get(parameter.name, "")) for parameter in health.parameters)
    table = (
        "<table><tr><th>parameter<th>relative change<th>95 % interval<th>alarm</tr>" + rows + "</table>" if rows else ""
    )
    reason = f"<p>{html.escape(health.reason)}</p>" if health.reason else ""
    return (
        f'<h2><a href="{place}">{html.escape(name)}</a> <span class="{health.state}">{health.state}</span></h2>'
        f"{reason}<p>window {health.filled:.0%} full; {health.quality.accepted_blocks} blocks accepted, "
        f"{sum(health.quality.refused_blocks.values())} refused, {health.quality.gaps} gaps; {links}</p>{table}"
    )


def _row(parameter: Parameter, alarm: str) -> str:
    text = f"{html.escape(parameter.text)} ({html.escape(parameter.name)})"
    if parameter.relative_change is None or parameter.interval_95 is None:
        return f"<tr><td>{text}<td colspan=2>not evaluable: {html.escape(parameter.reason)}<td>{alarm}</tr>"
    low, high = parameter.interval_95
    marked = ' class="raised"' if alarm else ""
    return (
        f'<tr{marked}><td>{text}<td class="number">{parameter.relative_change:+.1%}'
        f'<td class="number">{low:+.1%} … {high:+.1%}<td>{alarm}</tr>'
    )
