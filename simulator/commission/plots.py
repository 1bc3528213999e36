"""Pictures of a commissioning for its page, of readings, errors and recordings: SVG in the page's own colours."""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from io import StringIO

import numpy as np
from markupsafe import Markup, escape
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from models.commissioning.commission import CommissioningReport, ParameterSummary
from models.commissioning.healthy import HealthyRecording
from models.diagnosis.readings import Z95
from models.diagnosis.verdict.stretch import to_scale
from models.diagnosis.window.lines import Line, steady_lines
from models.diagnosis.window.statistics import WindowStatistics, window_statistics
from models.signals.block import FloatArray
from simulator.commission.verdict import channel_text, channel_unit, percent

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


_ROW_IN = 0.42
_ROOM = 0.35
_MOST_LABELS = 24


def _panels(count: int, edges_in: float, panel_in: float, *, sharex: bool = False) -> tuple[Figure, Sequence[Axes]]:
    """A picture with so many panels, one or more, in two columns."""
    columns = min(2, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(WIDTH_IN, edges_in + panel_in * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=sharex).ravel()
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, panels[:count].tolist()


def draw_readings(report: CommissioningReport, recordings: Sequence[str]) -> Figure | None:
    """Each parameter's healthy readings with 95 % intervals against zero, by recording; None without readings."""
    read = [one for one in report.parameters if one.readings]
    if not read:
        return None
    figure, panels = _panels(len(read), 0.5, 1.75)
    for axes, parameter in zip(panels, read, strict=True):
        _readings(axes, parameter, recordings)
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


_STYLES = ("-", "--", ":")
_BEYOND_BAND = 0.04
_NEAR, _LINE = 0.04, 0.003  # of the width of the picture: speeds that share a mark, and a mark that is drawn as a line
_PLACES = ("y1", "z1", "y2", "z2", "psi", "phi")
_ORDERS = ("", "dot", "ddot")
_RPM = 30 / np.pi


@dataclass(frozen=True, slots=True)
class Portrait:
    """What the pictures show of one recording."""

    number: int  # its number on the page, from 1
    statistics: WindowStatistics  # of all its hops
    density: FloatArray  # (n_bins, n), amplitude spectral density with the rotation in it, one-sided, SI/√Hz
    time_s: FloatArray  # (n_hops,), middle of each hop from the beginning of the recording
    broken: np.ndarray[tuple[int], np.dtype[np.bool_]]  # (n_hops,), whether a gap lies before the hop
    lines: tuple[Line, ...]  # steady lines that do not belong to the rotation

    @property
    def speed_hz(self) -> float:
        """Mean speed, NaN if unknown."""
        return self.statistics.speed_rad_s / (2 * np.pi)

    @property
    def levels(self) -> FloatArray:
        """Rms of the random part hop by hop, shape (n_hops, n), SI."""
        powers = np.diagonal(self.statistics.hop_correlation[:, 0], axis1=1, axis2=2)
        return np.asarray(np.sqrt(np.maximum(powers, 0.0)), dtype=np.float64)


def portrait(number: int, recording: HealthyRecording) -> Portrait | None:
    """Statistics of a whole recording; None if it holds no usable data."""
    hops = recording.hops
    if not hops:
        return None
    statistics = window_statistics(recording.plan, hops, lagged=False).as_mounted
    n = len(recording.plan.states)
    every = np.concatenate([hop.segments[:, :, :n] for hop in hops], dtype=np.complex128)
    if recording.plan.equaliser is not None:
        every /= recording.plan.equaliser.response(recording.plan.frequencies_hz)
    power = np.mean(np.abs(every) ** 2, axis=0)
    starts = np.array([hop.start_ns for hop in hops], dtype=np.int64)
    broken = np.zeros(len(hops), dtype=np.bool_)
    broken[np.cumsum([len(stretch) for stretch in recording.stretches])[:-1]] = True
    density = np.asarray(np.sqrt(2 * power), dtype=np.float64)
    time_s = (starts - starts[0]) / 1e9 + recording.plan.hop / recording.plan.rate_hz / 2
    return Portrait(number, statistics, density, time_s, broken, steady_lines(recording.plan, hops, statistics))


def ordered(states: Iterable[str]) -> list[str]:
    """Bearing before disc, displacement before velocity, the two planes side by side."""

    def rank(state: str) -> tuple[int, int, int]:
        place, _, ending = state.partition("_")
        at = _number(place)
        return at // 2, _ORDERS.index(ending), at % 2

    return sorted(states, key=rank)


def _number(place: str) -> int:
    """Rank by place and plane; sensors at an angle rank as those in the nearer plane."""
    location, at, angle_deg = place.partition("@")
    if not at:
        return _PLACES.index(place)
    return (0 if location == "bearing" else 2) + (float(angle_deg) % 180 >= 90)


def draw_spectra(portraits: Sequence[Portrait]) -> Figure:
    """Draw the spectra of every channel, each with all recordings, at least one."""
    states = ordered(portraits[0].statistics.states)
    figure, panels = _panels(len(states), 0.6, 1.6, sharex=True)
    for axes, state in zip(panels, states, strict=True):
        _spectrum(axes, state, portraits)
    for axes in panels[-2:]:
        axes.xaxis.set_tick_params(labelbottom=True)
    figure.supxlabel("frequency, Hz", fontsize=9)
    if len(portraits) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=min(6, len(portraits)))
    return figure


def _spectrum(axes: Axes, state: str, portraits: Sequence[Portrait]) -> None:
    unit, scale = channel_unit(state)
    frequencies = portraits[0].statistics.frequencies_hz
    axes.axvspan(float(frequencies[0]), float(frequencies[-1]), facecolor=BAND, edgecolor="none", zorder=0)
    for one in portraits:
        column = one.statistics.states.index(state)
        density = scale * one.density[:, column]
        if density.max() > 0:
            axes.semilogy(frequencies, density, label=f"recording {one.number}", **_line(one.number))
    _mark_rotation(axes, portraits, float(frequencies[-1]))
    for one in portraits:
        for line in one.lines:
            if line.state == state:
                axes.annotate(
                    f"{line.frequency_hz:.1f} Hz", (line.frequency_hz, 1), xycoords=("data", "axes fraction"),
                    xytext=(3, -11), textcoords="offset points", ha="left", va="top", fontsize=8, color=COLOURS[1],
                )  # fmt: skip
    axes.set_xlim(0, float(frequencies[-1]) * (1 + _BEYOND_BAND))
    axes.set_title(channel_text(state))
    axes.set_ylabel(f"{unit}/√Hz")


def _line(number: int) -> dict[str, str | float]:
    at = number - 1
    style = _STYLES[at // len(COLOURS) % len(_STYLES)]
    return {"color": COLOURS[at % len(COLOURS)], "linestyle": style, "linewidth": 0.9}


def _mark_rotation(axes: Axes, portraits: Sequence[Portrait], highest_hz: float) -> None:
    """Mark once and twice the speed: by a line, or a stripe for speeds that are near each other."""
    speeds = sorted(one.speed_hz for one in portraits if np.isfinite(one.speed_hz))
    groups: list[list[float]] = []
    for speed in speeds:
        if groups and speed - groups[-1][-1] < _NEAR * highest_hz:
            groups[-1].append(speed)
        else:
            groups.append([speed])
    for low, high in ((order * group[0], order * group[-1]) for group in groups for order in (1, 2)):
        if high - low < _LINE * highest_hz:
            axes.axvline((low + high) / 2, color=GREY, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1)
        else:
            axes.axvspan(low, high, facecolor=GREY, alpha=0.3, edgecolor="none", zorder=1)
    labels = [(order, order * group[-1]) for group in groups for order in ((1, 2) if len(groups) == 1 else (1,))]
    for order, at_hz in labels:
        if at_hz < highest_hz:
            axes.annotate(
                f"{order}×", (at_hz, 1), xycoords=("data", "axes fraction"), xytext=(2, -1),
                textcoords="offset points", ha="left", va="top", fontsize=8, color=INK,
            )  # fmt: skip


def draw_levels(portraits: Sequence[Portrait]) -> Figure:
    """Draw speed and level of random vibration hop by hop, the recordings, at least one, one after the other."""
    speeds_known = any(np.isfinite(one.statistics.hop_speed_rad_s).any() for one in portraits)
    heights = [1.0, 1.8] if speeds_known else [1.8]
    figure = Figure(figsize=(WIDTH_IN, 0.7 + 1.4 * sum(heights)), layout="constrained")
    panels = figure.subplots(len(heights), 1, squeeze=False, sharex=True, height_ratios=heights)[:, 0]
    states = ordered(portraits[0].statistics.states)
    columns = [portraits[0].statistics.states.index(state) for state in states]
    reference = np.median(np.concatenate([one.levels for one in portraits]), axis=0)
    total_s = sum(float(one.time_s[-1]) for one in portraits)
    unit_s, unit = (60.0, "min") if total_s > 300 else (1.0, "s")
    space_s = 0.02 * total_s
    start_s = 0.0
    for one in portraits:
        half_s = float(one.time_s[0])
        x = (start_s + one.time_s) / unit_s
        if start_s:
            for axes in panels:
                axes.axvline((start_s - space_s / 2) / unit_s, color=GREY, linewidth=0.7, linestyle=":")
        if len(portraits) > 1:
            panels[0].annotate(
                str(one.number), (float(x[0] + x[-1]) / 2, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2),
                textcoords="offset points", ha="center", va="bottom", fontsize=8, color=INK,
            )  # fmt: skip
        if speeds_known:
            rpm = _RPM * one.statistics.hop_speed_rad_s
            panels[0].plot(*_pieces(x, rpm, one.broken), color=INK, marker=".", markersize=3)
        for state, column in zip(states, columns, strict=True):
            ratio = one.levels[:, column] / max(float(reference[column]), np.finfo(float).tiny)
            panels[-1].plot(*_pieces(x, ratio, one.broken), label=channel_text(state), **_channel_line(state))
        start_s += float(one.time_s[-1]) + half_s + space_s
    if speeds_known:
        rpm = _RPM * np.concatenate([one.statistics.hop_speed_rad_s for one in portraits])
        low, high = float(np.nanmin(rpm)), float(np.nanmax(rpm))
        middle, reach = (low + high) / 2, (high - low) / 2
        reach = max(1.2 * reach, 0.01 * abs(middle), 0.1)  # a steady speed must look steady
        panels[0].set_ylabel("speed, rpm")
        panels[0].set_ylim(middle - reach, middle + reach)
    ratios = np.concatenate([one.levels for one in portraits]) / np.maximum(reference, np.finfo(float).tiny)
    seen = ratios[np.isfinite(ratios) & (ratios > 0)]
    low, high = (float(seen.min()), float(seen.max())) if seen.size else (1.0, 1.0)
    panels[-1].set_ylabel("level (rms) over its median")
    panels[-1].set_yscale("log", base=2)
    panels[-1].set_ylim(min(0.45, low / 1.2), max(2.2, high * 1.2))
    panels[-1].yaxis.set_major_formatter(lambda value, _: f"{value:g}×")
    panels[-1].set_xlabel(f"time from the beginning of each recording, one after the other, {unit}")
    handles, labels = panels[-1].get_legend_handles_labels()
    kept = dict(zip(labels, handles, strict=True))
    figure.legend(kept.values(), kept.keys(), loc="outside lower left", ncols=3, fontsize=8)
    return figure


def _pieces(
    x: FloatArray, y: FloatArray, broken: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> tuple[FloatArray, FloatArray]:
    """The same points with NaN inserted wherever data are missing, which breaks the line there."""
    at = np.flatnonzero(broken)
    return np.insert(x, at, np.nan), np.insert(y, at, np.nan)


def _channel_line(state: str) -> dict[str, str | float]:
    place, _, ending = state.partition("_")
    line = {"color": COLOURS[_number(place)], "linestyle": _STYLES[_ORDERS.index(ending)]}
    return {**line, "marker": ".", "markersize": 3, "linewidth": 1.0}
