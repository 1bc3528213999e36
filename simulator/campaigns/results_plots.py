"""Figures of the results page, drawn from a machine's summary."""

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from models.physics.parameters import PARAMETERS
from simulator.campaigns.evaluation import RATES
from simulator.campaigns.evaluation_cells import Topic
from simulator.campaigns.evaluation_goals import LAYOUT_TEXT, anomaly_text, excitation_text
from simulator.campaigns.evaluation_summary import CellSummary, Interval, ParameterSummary, Summary, pooled
from simulator.campaigns.rates import Rate
from simulator.campaigns.study_plots import COLOURS, MARKERS, METHOD_TEXT, STYLE, save_figure
from simulator.training.draws import Anomaly, Layout

__all__ = ["FIGURES", "draw_results", "figure_name", "shows"]

_LOOK = {
    "likelihood": (COLOURS[0], "o"),
    "network": (COLOURS[1], "s"),
    "relation": (COLOURS[2], "^"),
}
_OF_LAYOUT = {Layout.ONE_SOURCE: (COLOURS[1], "s"), Layout.INDEPENDENT: (COLOURS[0], "o")}
_KINDS = {"bearing stiffness": ("k_by", "k_bz"), "bearing damping": ("c_by", "c_bz"), "unbalance": ("e",)}
_FEWEST = 50
"""Cells of fewer windows have no coverage worth a point."""
_CHANGED = (Topic.HEALTHY, Topic.SMALL, Topic.PAPER)


def draw_results(summary: Summary, folder: Path) -> list[Path]:
    """Draw every figure for which the evaluation has windows; returns their paths.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]  # the stub wants literal keys
        return [
            save_figure(draw(summary), folder / figure_name(summary, name))
            for name, (_, draw) in FIGURES.items()
            if shows(summary, name)
        ]


def figure_name(summary: Summary, name: str) -> str:
    """File name of a figure."""
    return f"results-{summary.campaign.machine}-{name}.png"


def shows(summary: Summary, name: str) -> bool:
    """Whether the evaluation has windows for a figure."""
    return bool(summary.of(FIGURES[name][0]))


def _spread(summary: Summary) -> Figure:
    """Spread over the bound, parameter by parameter."""
    figure = Figure(figsize=(9.2, 3.6), layout="constrained")
    for axes, layout in zip(figure.subplots(1, 2, sharey=True), Layout, strict=True):
        cells = summary.of(Topic.HEALTHY, layout=layout)
        labels = []
        for x, name in enumerate(PARAMETERS):
            bound = None
            for n, by in enumerate(summary.diagnosticians):
                for one in _read(cells, by, name):
                    bound = one.bound if bound is None else bound
                    _bar(axes, x, n, summary, one.spread_in_bounds, by)
            labels.append(name if bound is None else f"{name}\n{100 * bound:.2g} %")
        axes.axhline(1, color="black", linewidth=0.9, linestyle="--")
        axes.set_yscale("log")
        axes.set_xticks(range(len(PARAMETERS)), labels)
        axes.set_xlabel("parameter, and its median Cramér–Rao bound per window")
        axes.set_title(f"{LAYOUT_TEXT[layout]}, {_count(cells)} healthy windows", loc="left")
    figure.axes[0].set_ylabel("spread over the bound")
    _legend(figure, summary, ("Cramér–Rao bound", "--"))
    return figure


def _detection(summary: Summary) -> Figure:
    """Detected at the first declared rate, over the size of the change."""
    figure = Figure(figsize=(9.2, 5.4), layout="constrained")
    panels = figure.subplots(2, 3, sharey=True, sharex=True)
    sizes: set[float] = set()
    for row, layout in zip(panels, Layout, strict=True):
        for axes, (kind, names) in zip(row, _KINDS.items(), strict=True):
            for n, by in enumerate(summary.diagnosticians):
                rates: dict[float, list[Rate]] = {}
                for name in names:
                    for one in _read(summary.of(Topic.SMALL, Topic.PAPER, layout=layout), by, name):
                        if one.truth and one.found:
                            rates.setdefault(abs(one.truth), []).append(one.found[0])
                points = [(size, rate) for size in sorted(rates) if (rate := pooled(rates[size])) is not None]
                sizes |= {size for size, _ in points}
                shift = 1 + 0.05 * (n - 1)
                _rates(axes, [100 * size * shift for size, _ in points], [rate for _, rate in points], by)
            axes.set_xscale("log")
            axes.set_title(f"{kind}, {LAYOUT_TEXT[layout]}", loc="left")
            axes.set_ylim(-3, 103)
    ticks = [100 * size for size in sorted(sizes)]
    for axes in panels.ravel():
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    figure.supxlabel("true change, % (stiffness and damping down, unbalance up)", fontsize=9)
    figure.supylabel(f"windows in which it is named at {100 * RATES[0]:g} % false alarms, %", fontsize=9)
    _legend(figure, summary)
    return figure


def _coverage(summary: Summary) -> Figure:
    """Coverage of the 95 % intervals: all windows, and every cell as a small point."""
    figure = Figure(figsize=(9.2, 4.0), layout="constrained")
    for axes, layout in zip(figure.subplots(1, 2, sharey=True), Layout, strict=True):
        cells = summary.of(*_CHANGED, layout=layout)
        axes.axhspan(93, 97, color="#eeeeee")
        axes.axhline(95, color="black", linewidth=0.9, linestyle="--")
        for x, name in enumerate(PARAMETERS):
            for n, by in enumerate(summary.diagnosticians):
                read = _read(cells, by, name)
                every = pooled(one.covered for one in read)
                if every is None:
                    continue
                at = _offset(x, n, summary)
                large = [100 * one.covered.rate for one in read if one.n >= _FEWEST]
                axes.plot(
                    np.linspace(at - 0.05, at + 0.05, len(large)),
                    large,
                    linestyle="",
                    marker=".",
                    markersize=3,
                    color=_LOOK[by][0],
                    alpha=0.5,
                )
                _rates(axes, [at], [every], by)
        axes.set_xticks(range(len(PARAMETERS)), PARAMETERS)
        axes.set_title(f"{LAYOUT_TEXT[layout]}, {_count(cells)} windows", loc="left")
    figure.axes[0].set_ylabel("windows whose 95 % interval holds the truth, %")
    _legend(figure, summary, ("stated; grey: 93–97 %", "--"))
    return figure


def _length(summary: Summary) -> Figure:
    """Spread of the likelihood over the window length."""
    names = ("k_by", "c_by", "e", "k_bz", "c_bz", "EI")
    figure = Figure(figsize=(9.2, 5.4), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True)
    lengths = sorted({cell.length_s for cell in summary.of(Topic.LENGTH, Topic.HEALTHY)})
    for axes, name in zip(panels.ravel(), names, strict=True):
        for layout in Layout:
            colour, marker = _OF_LAYOUT[layout]
            cells = sorted(summary.of(Topic.LENGTH, Topic.HEALTHY, layout=layout), key=lambda cell: cell.length_s)
            read = [(cell.length_s, one) for cell in cells for one in _read([cell], "likelihood", name)]
            spread = [(length_s, one.spread) for length_s, one in read if one.spread is not None]
            _intervals(axes, [at for at, _ in spread], [_percent(one) for _, one in spread], colour, marker)
            bound = [(length_s, one.bound) for length_s, one in read if one.bound is not None]
            axes.plot([at for at, _ in bound], [100 * value for _, value in bound], ":", color=colour, linewidth=1.2)
            own = [one for at, one in spread if at == summary.length_s]
            if own:
                x = np.array(lengths)
                axes.plot(x, 100 * own[0].value * np.sqrt(summary.length_s / x), "-", color=colour, linewidth=0.8)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(lengths, [f"{length_s:g}" for length_s in lengths])
        axes.minorticks_off()
        axes.set_title(name, loc="left")
    figure.supxlabel("window length, s", fontsize=9)
    figure.supylabel("spread of the likelihood's reading, %", fontsize=9)
    handles = [
        axes.plot([], [], linestyle="", marker=marker, color=colour, label=LAYOUT_TEXT[layout])[0]
        for layout, (colour, marker) in _OF_LAYOUT.items()
    ]
    handles.append(axes.plot([], [], "-", color="#555555", linewidth=0.8, label="1/√T through the machine's length")[0])
    handles.append(axes.plot([], [], ":", color="#555555", linewidth=1.2, label="median Cramér–Rao bound")[0])
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


def _false_alarms(summary: Summary) -> Figure:
    """Measured over declared rate of false alarms."""
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    cells = {layout: summary.of(Topic.HEALTHY, layout=layout) for layout in Layout}
    panels = figure.subplots(1, len(RATES))
    for axes, at in zip(panels, range(len(RATES)), strict=True):
        for y, layout in enumerate(Layout):
            for n, by in enumerate(summary.diagnosticians):
                rate = pooled(cell.opinions[by].any_named[at] for cell in cells[layout] if by in cell.opinions)
                if rate is None:
                    continue
                _intervals(axes, [_offset(y, n, summary)], [_of_rate(rate)], *_LOOK[by], across=True)
        axes.axvline(100 * RATES[at], color="black", linewidth=0.9, linestyle="--")
        axes.set_yticks(
            range(len(Layout)),
            [f"{LAYOUT_TEXT[one]}\n{_count(cells[one])} windows" for one in Layout] if at == 0 else [],
        )
        axes.set_ylim(-0.5, len(Layout) - 0.5)
        axes.set_xlim(left=-0.02 * axes.get_xlim()[1])
        axes.set_xlabel("healthy windows with a parameter named, %")
        axes.set_title(f"{100 * RATES[at]:g} % declared", loc="left")
    _legend(figure, summary, ("declared", "--"))
    return figure


def _excitation(summary: Summary) -> Figure:
    """Bias and spread of the likelihood where the excitation is another one than assumed."""
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col")
    for row, layout in zip(panels, Layout, strict=True):
        cells = [*summary.of(Topic.HEALTHY, layout=layout), *summary.of(Topic.EXCITATION, layout=layout)]
        for y, cell in enumerate(cells):
            for n, name in enumerate(PARAMETERS):
                for one in _read([cell], "likelihood", name):
                    at = y + 0.12 * (n - (len(PARAMETERS) - 1) / 2)
                    for axes, interval in zip(row, (one.bias_in_errors, one.spread_in_errors), strict=True):
                        if interval is not None:
                            _intervals(axes, [at], [interval], COLOURS[n], MARKERS[n], across=True)
        for axes, limits, middle in zip(row, ((-0.5, 0.5), (1.5,)), (0.0, 1.0), strict=True):
            axes.axvline(middle, color="black", linewidth=0.8)
            for limit in limits:
                axes.axvline(limit, color="black", linewidth=0.9, linestyle="--")
            axes.set_yticks(range(len(cells)), [excitation_text(cell.excitation) for cell in cells])
            axes.set_ylim(len(cells) - 0.5, -0.5)
        row[1].tick_params(labelleft=False)
        row[0].set_title(f"{LAYOUT_TEXT[layout]}: bias", loc="left")
        row[1].set_title(f"{LAYOUT_TEXT[layout]}: spread", loc="left")
    panels[1, 0].set_xlabel("mean of (reading − truth) / stated error")
    panels[1, 1].set_xlabel("spread of (reading − truth) / stated error")
    axes = panels[0, 0]
    handles = [
        axes.plot([], [], linestyle="", marker=MARKERS[n], color=COLOURS[n], label=name)[0]
        for n, name in enumerate(PARAMETERS)
    ]
    handles.append(axes.plot([], [], "k--", linewidth=0.9, label="goal")[0])
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    return figure


def _outside(summary: Summary) -> Figure:
    """Misfit and verdict of the likelihood: healthy, other excitation, outside the model."""
    cells = [
        cell for cell in summary.of(Topic.HEALTHY, Topic.EXCITATION, Topic.OUTSIDE) if "likelihood" in cell.opinions
    ]
    figure = Figure(figsize=(9.6, 0.26 * len(cells) + 1.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    verdicts = (
        ("flagged outside the model", COLOURS[0]),
        ("not evaluable", "#bbbbbb"),
        ("nothing said", "#eeeeee"),
        ("shaft claimed", COLOURS[3]),
        ("bearing or unbalance claimed", COLOURS[1]),
    )
    for y, cell in enumerate(cells):
        one = cell.opinions["likelihood"]
        if one.misfit_z:
            low, quarter, median, three, high = one.misfit_z
            left.plot([low, high], [y, y], color=COLOURS[0], linewidth=1.2)
            left.plot([quarter, three], [y, y], color=COLOURS[0], linewidth=5, solid_capstyle="butt")
            left.plot([median], [y], "o", color=COLOURS[0], markeredgecolor="white", markersize=6)
        counts = [one.outside[0].count, one.refused, 0, one.claimed_shaft[0].count, one.claimed[0].count]
        counts[2] = one.n - sum(counts)
        start = 0.0
        for count, (_, colour) in zip(counts, verdicts, strict=True):
            share = 100 * count / one.n
            right.barh(y, share, left=start, color=colour, height=0.75, edgecolor="#888888", linewidth=0.4)
            start += share
    left.set_xscale("symlog", linthresh=4)
    left.set_xticks([-2, 0, 2, 4, 10, 30, 100, 300], ["−2", "0", "2", "4", "10", "30", "100", "300"])
    left.minorticks_off()
    right.set_axisbelow(True)
    right.grid(visible=False)
    left.axvline(2.326, color="black", linewidth=0.9, linestyle="--")
    left.annotate("1 %", (2.326, 1), xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=8)
    left.set_yticks(range(len(cells)), [f"{_kind(cell)}, {LAYOUT_TEXT[cell.layout]}" for cell in cells])
    left.set_ylim(len(cells) - 0.5, -0.5)
    left.set_xlabel("misfit, standard normal in the model (5–95 %, quartiles, median)")
    right.set_xlabel(f"windows, % (at {100 * RATES[0]:g} % false alarms)")
    right.tick_params(labelleft=False)
    handles = [right.barh([0], [0], color=colour, edgecolor="#888888", label=text) for text, colour in verdicts]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=8)
    return figure


def _kind(cell: CellSummary) -> str:
    if cell.anomaly is not Anomaly.NONE:
        return anomaly_text(cell.anomaly)
    return "healthy" if cell.topic is Topic.HEALTHY else excitation_text(cell.excitation)


def _read(cells: list[CellSummary], by: str, name: str) -> list[ParameterSummary]:
    opinions = [cell.opinions[by] for cell in cells if by in cell.opinions]
    return [one for opinion in opinions if (one := opinion.parameter(name)) is not None]


def _count(cells: list[CellSummary]) -> int:
    return sum(cell.n for cell in cells)


def _offset(at: float, n: int, summary: Summary) -> float:
    return at + 0.2 * (n - (len(summary.diagnosticians) - 1) / 2)


def _percent(interval: Interval) -> Interval:
    return Interval(value=100 * interval.value, low=100 * interval.low, high=100 * interval.high)


def _bar(axes: Axes, x: float, n: int, summary: Summary, interval: Interval | None, by: str) -> None:
    if interval is not None and interval.value > 0:
        _intervals(axes, [_offset(x, n, summary)], [interval], *_LOOK[by])


def _rates(axes: Axes, x: list[float], rates: list[Rate], by: str) -> None:
    _intervals(axes, x, [_of_rate(rate) for rate in rates], *_LOOK[by], line="-")


def _of_rate(rate: Rate) -> Interval:
    """In percent."""
    return Interval(value=100 * rate.rate, low=100 * rate.low, high=100 * rate.high)


def _intervals(
    axes: Axes,
    at: Sequence[float],
    intervals: Sequence[Interval],
    colour: str,
    marker: str,
    *,
    line: str = "",
    across: bool = False,
) -> None:
    """Points with upright intervals over `at`; with `across`, lying ones at these heights."""
    middle = [one.value for one in intervals]
    reach = [
        [max(0.0, one.value - one.low) for one in intervals],
        [max(0.0, one.high - one.value) for one in intervals],
    ]
    axes.errorbar(
        middle if across else at,
        at if across else middle,
        xerr=reach if across else None,
        yerr=None if across else reach,
        color=colour,
        marker=marker,
        markersize=4.5,
        linestyle=line,
        linewidth=1.1,
        capsize=2,
    )


def _legend(figure: Figure, summary: Summary, rule: tuple[str, str] | None = None) -> None:
    axes = figure.axes[0]
    handles = [
        axes.plot([], [], linestyle="", marker=_LOOK[by][1], color=_LOOK[by][0], label=METHOD_TEXT[by])[0]
        for by in summary.diagnosticians
    ]
    if rule is not None:
        handles.append(axes.plot([], [], f"k{rule[1]}", linewidth=0.9, label=rule[0])[0])
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))


FIGURES: dict[str, tuple[Topic, Callable[[Summary], Figure]]] = {
    "spread": (Topic.HEALTHY, _spread),
    "detection": (Topic.SMALL, _detection),
    "coverage": (Topic.HEALTHY, _coverage),
    "false-alarms": (Topic.HEALTHY, _false_alarms),
    "excitation": (Topic.EXCITATION, _excitation),
    "length": (Topic.LENGTH, _length),
    "outside": (Topic.OUTSIDE, _outside),
}
"""Name of each figure: the topic without which it is not drawn, and what draws it."""
