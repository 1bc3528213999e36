"""Pictures of the readings and errors of a commissioning, for the page: SVG in the page's own colours."""

import math
import re
from collections.abc import Callable, Sequence
from io import StringIO

import numpy as np
from markupsafe import Markup, escape
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from models.commissioning.commission import CommissioningReport, ParameterSummary
from models.diagnosis.readings import Z95
from models.diagnosis.verdict.stretch import to_scale
from simulator.commission.verdict import percent

# After Okabe and Ito: distinguishable with any colour vision.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
INK, GREY, BAND = "#1c2530", "#66727f", "#edf2f6"
WIDTH_IN = 10.0  # width of every picture, so that letters are of one size on the page
_GRID = "#dde2e6"
_VARIABLES = {INK: "var(--ink)", GREY: "var(--grey)", _GRID: "var(--line)", BAND: "var(--band)"} | {
    colour: f"var(--c{number})" for number, colour in enumerate(COLOURS)
}
"""Colours and the page's properties that replace them, which differ between light, dark and paper."""

_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.edgecolor": GREY,
    "axes.facecolor": "none",
    "axes.formatter.useoffset": False,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "figure.facecolor": "none",
    "grid.color": _GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "text.color": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "svg.fonttype": "path",  # no font is needed to look at it
    "svg.hashsalt": "rotorwatch",  # the same numbers make the same page
}
_NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))


def inline_svg(name: str, label: str, paint: Callable[[], Figure | None]) -> Markup | None:
    """Draw a picture in the house style, of width `WIDTH_IN`, as an element of an HTML page; None if there is nothing.

    Every identifier in the picture begins with the name, unique on the page. The label is for screen readers.
    """
    written = StringIO()
    with style.context(["default", _STYLE]):
        figure = paint()
        if figure is None:
            return None
        engine = figure.get_layout_engine()
        if engine is not None:  # otherwise the figure would be drawn twice, first to find the layout
            FigureCanvasSVG(figure)
            engine.execute(figure)
            figure.set_layout_engine(None)
        figure.savefig(written, format="svg", metadata=_NO_METADATA)
    text = written.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style .*?</style>", "", text, flags=re.DOTALL)
    box = re.search(r'viewBox="[^"]*"', text)
    assert box is not None  # noqa: S101  # matplotlib always writes one
    text = f'<svg {box[0]} role="img" aria-label="{escape(label)}">' + text[text.index(">") + 1 :]
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(?:xlink:)?href="#', f'href="#{name}-', text)
    text = text.replace("url(#", f"url(#{name}-")
    return Markup(re.sub(r"#[0-9a-f]{6}\b", lambda found: _VARIABLES.get(found[0], found[0]), text))  # noqa: S704  # drawn, not given


_ROW_IN, _PANEL_IN = 0.42, 1.75
_ROOM = 0.35
_MOST_LABELS = 24


def draw_readings(report: CommissioningReport, recordings: Sequence[str]) -> Figure | None:
    """Each parameter's healthy readings with 95 % intervals against zero, by recording; None without readings."""
    read = [one for one in report.parameters if one.readings]
    if not read:
        return None
    columns = min(2, len(read))
    rows = -(-len(read) // columns)
    figure = Figure(figsize=(WIDTH_IN, 0.5 + _PANEL_IN * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, parameter in zip(panels, read, strict=False):
        _readings(axes, parameter, recordings)
    for axes in panels[len(read) :]:
        axes.set_visible(False)
    figure.supylabel("change from healthy, %", fontsize=9)
    figure.supxlabel("healthy windows in order of time, by number of the recording", fontsize=9)
    return figure


def _readings(axes: Axes, parameter: ParameterSummary, recordings: Sequence[str]) -> None:
    axes.axhline(0, color=INK, linewidth=1.0)
    start, ticks = 0.0, []
    labelled = math.ceil(len(recordings) / _MOST_LABELS)
    for name in dict.fromkeys(recordings):
        number = recordings.index(name)
        own = sorted((one for one in parameter.readings if one.recording == name), key=lambda one: one.end_ns)
        if not own:
            continue
        if start:
            axes.axvline(start - 0.5, color=GREY, linewidth=0.7, linestyle=":")
        x = start + np.arange(len(own))
        change = 100 * np.array([one.relative_change for one in own])
        reach = 100 * Z95 * np.array([one.standard_error for one in own])
        axes.errorbar(
            x, change, yerr=reach, color=COLOURS[number % len(COLOURS)], marker="o", markersize=4, linestyle="",
            linewidth=1.1, capsize=2.5,
        )  # fmt: skip
        if number % labelled == 0:
            ticks.append((float(x.mean()), str(number + 1)))
        start += len(own)
    axes.set_xlim(-0.5 - _ROOM, start - 0.5 + _ROOM)
    axes.set_xticks([at for at, _ in ticks], [text for _, text in ticks])
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False, axis="x")
    axes.set_title(f"{parameter.text} ({parameter.name})")


def draw_budget(report: CommissioningReport) -> Figure | None:
    """Standard errors of a window and of the commissioning against what a wished change allows; None without them."""
    read = [one for one in report.parameters if one.window_error]
    if not read:
        return None
    figure = Figure(figsize=(WIDTH_IN, 1.35 + _ROW_IN * len(read)), layout="constrained")
    axes = figure.subplots()
    y = np.arange(len(read))
    own = np.array([one.window_error or 0.0 for one in read])
    shared = np.array([one.commissioning_error or 0.0 for one in read])
    total = np.hypot(own, shared)
    axes.hlines(y, np.minimum(own, np.where(shared > 0, shared, own)), total, color=GREY, linewidth=1.0, zorder=1)
    axes.plot(own, y, linestyle="", marker="o", markersize=7, color=COLOURS[0], label="one window")
    if shared.any():
        axes.plot(
            shared[shared > 0], y[shared > 0], linestyle="", marker="s", markersize=6.5, color=COLOURS[1],
            label="commissioning (part of every later interval)",
        )  # fmt: skip
    axes.plot(total, y, linestyle="", marker="|", markersize=15, markeredgewidth=2, color=INK, label="both together")
    known = [(at, limit) for at, one in enumerate(read) if (limit := _allowed(one)) is not None]
    if known:
        sizes = sorted({one.wished for one in read if one.wished is not None})
        label = f"at most this to find the wished change of {' or '.join(percent(size) for size in sizes)}"
        at, allowed = (np.array(part) for part in zip(*known, strict=True))
        axes.vlines(
            allowed, at - 0.42, at + 0.42, color=COLOURS[2], linewidth=2.2, linestyle=(0, (3, 1.2)), label=label
        )
    axes.set_xscale("log")
    low = min([*own, *shared[shared > 0], *(limit for _, limit in known)])
    high = max([*total, *(limit for _, limit in known)])
    axes.set_xlim(low / 1.5, high * 1.5)
    axes.set_xticks(_ticks(low / 1.5, high * 1.5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g}%"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.minorticks_off()
    axes.set_yticks(y, [f"{one.text} ({one.name})" for one in read])
    axes.set_ylim(len(read) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("standard error of a relative change (logarithmic)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


def _allowed(parameter: ParameterSummary) -> float | None:
    """Standard error, of window and commissioning together, with which the wished change is just found."""
    own, gain, wished = parameter.window_error, parameter.detectable_gain, parameter.wished
    if own is None or gain is None or wished is None:
        return None
    now = math.hypot(own, parameter.commissioning_error or 0.0)
    # For a gain, the stricter side, as the report computes what the wished change takes.
    return abs(to_scale(parameter.name, wished)) * now / to_scale(parameter.name, gain)


def _ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 of each decade inside the limits."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [step * 10.0**decade for decade in decades for step in (1, 2, 5) if low <= step * 10.0**decade <= high]
