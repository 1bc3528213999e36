"""Picture of a trend: a strip with the machine's state, and below it a panel for every parameter, level and measure."""

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from models.alarm_names import MODEL
from models.errors import MachineFileError
from models.machine import AlarmSettings
from models.physics.rotor import PARAMETER_TEXT
from rotorwatch.records.alarms import AlarmEventData
from rotorwatch.records.health import MEASURES
from service.analysis.figures.style import (
    COLOURS,
    GREY,
    INK,
    SEVERITY_COLOURS,
    SKIPPED,
    STATE_COLOURS,
    Look,
    alarm_lines,
    alarm_text,
    as_date,
    as_dates,
    heading,
    skip_gaps,
    time_axis,
)
from service.analysis.past import Past
from service.analysis.recorded import Recorded
from service.analysis.trend import LevelTrend, ParameterTrend, TrendSeries, past_trend, read_trend

_GAP = 2.5
_DASHES = (0, (4, 3))
_LEAST_PERCENT, _HEADROOM = 5.0, 1.6
_LETTER_IN, _ROW_PT = 0.065, 11.0
"""Width of a letter in small print, in inches, and its line spacing, in points."""


def trend(look: Look, data: Recorded | Past, machine: str | None, *, levels: bool) -> Figure:
    """Parameters or levels over time, as recorded or with the machine file ``FILE[@BUNDLE]``."""
    if isinstance(data, Recorded):
        return paint_trend(look, read_trend(data, machine, levels=levels))
    if machine is not None:
        raise MachineFileError("--machine needs samples: name recordings instead of --history")
    return paint_trend(look, past_trend(data, levels=levels))


def paint_trend(look: Look, trend: TrendSeries) -> Figure:
    """Draw all panels over one time axis."""
    count = len(trend.parameters)
    measures = [name for name in MEASURES if trend.parameters or np.isfinite(trend.measures[name]).any()]
    small = len(trend.levels) + len(measures)
    figure = Figure(figsize=look.size_in or (9.5, 1.9 + 1.15 * (count + 0.8 * small)), layout="constrained")
    heights = [0.16, *[1.0] * count, *[0.75] * small]
    panels = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    step_ns = int(np.median(np.diff(trend.end_ns))) if trend.end_ns.size > 1 else 10**9
    ends = as_dates(np.array([trend.end_ns[0], trend.end_ns[-1] + step_ns]))
    panels[-1].set_xlim(*ends)
    time_axis(panels[-1])
    skipped = skip_gaps(panels[-1], trend.end_ns, round(_GAP * step_ns))
    for axes, parameter in zip(panels[1:], trend.parameters, strict=False):
        _parameter(axes, parameter, trend, step_ns)
    for axes, level in zip(panels[1 + count :], trend.levels, strict=False):
        _level(axes, level, trend, step_ns)
    for axes, name in zip(panels[1 + count + len(trend.levels) :], measures, strict=True):
        _measure(axes, name, trend, step_ns)
    for axes in panels[1:]:
        alarm_lines(axes, trend.alarms)
    rows = {}
    for name, axes in zip((MODEL, *(one.name for one in trend.parameters)), panels, strict=False):
        # A parameter's alarms are named in its panel, all others over the strip of states.
        own = [one for one in trend.alarms if (one.name if one.name in PARAMETER_TEXT else MODEL) == name]
        rows[name] = _name_alarms(axes, own)
    _states(panels[0], trend, step_ns, rows[MODEL])
    figure.legend(handles=_legend(trend, skipped=skipped), loc="outside lower center", ncols=5, fontsize=8)
    speed = trend.measures["speed"]
    speeds = speed[np.isfinite(speed)] * 30 / np.pi
    title = f"{trend.name}: changes from nominal" if trend.parameters else f"{trend.name}: vibration levels"
    span, median = (int(trend.end_ns[0]), int(trend.end_ns[-1])), f"{np.median(speeds):.0f} rpm" if speeds.size else ""
    heading(figure, look, title, span, median, f"reports {trend.origin}")
    return figure


def _legend(trend: TrendSeries, *, skipped: bool) -> list[Patch | Line2D]:
    handles: list[Patch | Line2D] = [Patch(color=SKIPPED, label="gap, not to scale")] if skipped else []
    if trend.parameters:
        handles.append(Patch(color=COLOURS[0], alpha=0.28, linewidth=0, label="95 % interval"))
    limits = trend.limits if trend.parameters else None
    drawn = {
        "alert": limits is not None or any(_is_near(level, level.alert) for level in trend.levels),
        "danger": any(_is_near(level, level.danger) for level in trend.levels)
        or (limits is not None and any(_danger_near(parameter, limits) for parameter in trend.parameters)),
    }
    for severity in (one for one, shown in drawn.items() if shown):
        colour = SEVERITY_COLOURS[severity]
        handles.append(Line2D([], [], color=colour, linewidth=0.9, linestyle=_DASHES, label=f"{severity} limit"))
    if trend.alarms:
        handles.append(Line2D([], [], color=SEVERITY_COLOURS["alert"], linewidth=1.3, label="alarm raised"))
    if any(alarm.kind == "cleared" for alarm in trend.alarms):
        colour = SEVERITY_COLOURS["alert"]
        handles.append(Line2D([], [], color=colour, linewidth=1.3, linestyle="--", label="alarm cleared"))
    return handles


def _states(axes: Axes, trend: TrendSeries, step_ns: int, rows: int) -> None:
    """Draw a strip of the machine's states, each from its report to the next; its legend clears `rows` of alarms."""
    after = np.minimum(np.diff(trend.end_ns, append=trend.end_ns[-1] + step_ns), round(_GAP * step_ns))
    for begin, end, state in zip(as_dates(trend.end_ns), as_dates(trend.end_ns + after), trend.states, strict=True):
        axes.axvspan(float(begin), float(end), color=STATE_COLOURS[state], linewidth=0)
    axes.set_yticks([])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    axes.set_ylabel("state", rotation=0, ha="right", va="center")
    seen = [state for state in STATE_COLOURS if state in trend.states]
    axes.legend(
        handles=[Patch(color=STATE_COLOURS[state], label=state) for state in seen],
        loc="lower right",
        bbox_to_anchor=(1.0, 2.0 + 1.3 * (rows - 1)),
        ncols=len(seen),
        borderpad=0,
        handlelength=1.0,
        columnspacing=1.2,
    )


def _name_alarms(axes: Axes, alarms: list[AlarmEventData]) -> int:
    """Write the names of alarm events above a panel, and return the number of rows used.

    Events close to each other are put in different rows, because their texts would overlap.
    """
    letter = _LETTER_IN * axes.figure.dpi / axes.bbox.width
    to_fraction = axes.transData + axes.transAxes.inverted()
    taken = [letter * len(axes.get_title(loc="left")) or -1.0]  # end of the text in each row, as a fraction of the axis
    for alarm in sorted(alarms[:8], key=lambda event: event.time_ns):
        text, at = alarm_text(alarm), as_date(alarm.time_ns)
        half, middle = letter * len(text) / 2, float(to_fraction.transform((at, 0.0))[0])
        row = next((row for row, end in enumerate(taken) if middle - half > end), len(taken))
        taken[row : row + 1] = [middle + half]
        axes.annotate(
            text, (at, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 3 + _ROW_PT * row),
            textcoords="offset points", ha="center", va="bottom", fontsize=8, color=INK,
        )  # fmt: skip
    return len(taken)


def _parameter(axes: Axes, parameter: ParameterTrend, trend: TrendSeries, step_ns: int) -> None:
    time, low, high, change = _with_gaps(
        trend.end_ns, step_ns, 100 * parameter.low, 100 * parameter.high, 100 * parameter.change
    )
    axes.axhline(0, color=GREY, linewidth=0.8)
    axes.fill_between(time, low, high, color=COLOURS[0], alpha=0.28, linewidth=0)
    axes.plot(time, change, color=COLOURS[0], marker=".", markersize=3)
    axes.set_title(f"{parameter.name}   {parameter.text}")
    axes.set_ylabel("%")
    far = float(np.nanmax(np.abs(np.append(change, 0.0))))
    wide = float(np.nanmedian(np.maximum(np.abs(low - change), np.abs(high - change))))
    limit = _limits(axes, parameter, trend.limits)
    ends = float(np.nanmax(np.abs(np.append(low, high))))
    # One window with a very wide interval must not compress all others.
    top = max(_LEAST_PERCENT, 1.15 * limit, min(1.15 * ends, 2.5 * max(far + wide, limit)))
    axes.set_ylim(-top, top)


def _danger_near(parameter: ParameterTrend, alarms: AlarmSettings) -> bool:
    return float(np.nanmax(np.abs(parameter.change))) > 0.6 * alarms.for_parameter(parameter.name).danger_above


def _limits(axes: Axes, parameter: ParameterTrend, alarms: AlarmSettings | None) -> float:
    """Draw the alarm limits of both signs, danger only if it is near; return the largest one drawn, in percent."""
    if alarms is None:
        return 0.0
    limits = alarms.for_parameter(parameter.name)
    drawn = [(100 * limits.raise_above, "alert")]
    if _danger_near(parameter, alarms):
        drawn.append((100 * limits.danger_above, "danger"))
    for value, severity in drawn:
        for sign in (-1, 1):
            axes.axhline(sign * value, color=SEVERITY_COLOURS[severity], linewidth=0.9, linestyle=_DASHES)
    return drawn[-1][0]


def _level(axes: Axes, level: LevelTrend, trend: TrendSeries, step_ns: int) -> None:
    """Draw a level and the limits then in force; limits far above the level lie outside the axis."""
    time, values, alert, danger = _with_gaps(trend.end_ns, step_ns, level.level, level.alert, level.danger)
    axes.plot(time, values, color=COLOURS[0], linewidth=1.2)
    for limit, severity in ((alert, "alert"), (danger, "danger")):
        axes.plot(time, limit, color=SEVERITY_COLOURS[severity], linewidth=0.9, linestyle=_DASHES)
    axes.set_title(level.title)
    known = values[np.isfinite(values)]
    if known.size:
        axes.set_ylim(0, _HEADROOM * float(known.max()) or 1.0)
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def _is_near(level: LevelTrend, limit: npt.NDArray[np.float64]) -> bool:
    """Whether a limit is drawn inside the axis of `_level`."""
    return bool(np.any(limit < _HEADROOM * np.max(level.level, initial=0.0, where=np.isfinite(level.level))))


def _measure(axes: Axes, name: str, trend: TrendSeries, step_ns: int) -> None:
    unit = MEASURES[name][1].unit
    scale, shown = (30 / np.pi, "rpm") if unit == "rad/s" else (1.0, "" if unit == "1" else unit)
    time, values = _with_gaps(trend.end_ns, step_ns, trend.measures[name] * scale)
    axes.plot(time, values, color=INK, linewidth=1.0)
    axes.set_title(name)
    axes.set_ylabel(shown)
    known = values[np.isfinite(values)]
    if known.size:
        middle = float(np.median(known))
        spread = max(0.02 * abs(middle), 1.2 * float(np.max(np.abs(known - middle))), 1e-9)
        axes.set_ylim(middle - spread, middle + spread)
    else:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center", color=GREY)
        axes.set_yticks([])


def _with_gaps(
    end_ns: npt.NDArray[np.int64], step_ns: int, *series: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], ...]:
    """Times for matplotlib, and series with NaN inserted where reports are missing, so that no line crosses the gap."""
    after = np.flatnonzero(np.diff(end_ns) > _GAP * step_ns) + 1
    time = as_dates(np.insert(end_ns, after, end_ns[after - 1] + 1))
    return (time, *(np.insert(values, after, np.nan) for values in series))
