"""Charts: points with their intervals, and distributions."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from benchmarks.studies.reporting.results import Chart, Estimate

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's palette, distinguishable with any colour vision."""
_MARKERS = ("o", "s", "^", "D", "v", "P")
_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
}
_Series = Mapping[str, Sequence[tuple[str | float, Estimate | float]]]
_ACROSS, _WIDE_IN, _HIGH_IN = 4, 3.1, 2.4


def draw(chart: Chart, folder: Path) -> Path:
    """Draw a chart into a folder as PNG; returns its path."""
    columns = 3 if len(chart.panels) % 3 == 0 else min(_ACROSS, len(chart.panels))
    rows = -(-len(chart.panels) // columns)
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]  # the stub wants literal keys
        figure = Figure(figsize=(max(6.4, _WIDE_IN * columns), _HIGH_IN * rows + 0.8), layout="constrained")
        panels = figure.subplots(rows, columns, sharey=True, sharex=not chart.steps, squeeze=False).ravel()
        names = list(dict.fromkeys(name for series in chart.panels.values() for name in series))
        for axes, (title, series) in zip(panels, chart.panels.items(), strict=False):
            axes.set_title(title, loc="left")
            (_steps if chart.steps else _points)(axes, series, names)
            for line in chart.lines:
                axes.axhline(line, color="black", linewidth=0.9, linestyle="--")
        for axes in panels[len(chart.panels) :]:
            axes.set_visible(False)
        if chart.log:
            panels[0].set_yscale("log")
        figure.supxlabel(chart.x, fontsize=9)
        figure.supylabel(chart.y, fontsize=9)
        handles = [
            panels[0].plot([], [], color=_COLOURS[n % 6], marker="" if chart.steps else _MARKERS[n % 6], label=name)[0]
            for n, name in enumerate(names)
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=min(6, len(handles)))
        path = folder / f"{chart.name}.png"
        figure.savefig(path, dpi=130, bbox_inches="tight", metadata={"Software": None})
    with Image.open(path) as image:  # fewer colours for a smaller file
        small = image.convert("RGB").quantize(48, dither=Image.Dither.NONE)
    small.save(path, optimize=True)
    return path


def _points(axes: Axes, series: _Series, names: list[str]) -> None:
    words = list(dict.fromkeys(x for points in series.values() for x, _ in points if isinstance(x, str)))
    for name, points in series.items():
        n = names.index(name)
        shift = 0.7 * ((n + 0.5) / len(names) - 0.5)
        at = [words.index(x) + shift if isinstance(x, str) else x for x, _ in points]
        figures = [one if isinstance(one, Estimate) else Estimate(one, one, one, 1) for _, one in points]
        middle = np.array([one.value for one in figures])
        reach = np.abs([[one.low for one in figures], [one.high for one in figures]] - middle)
        axes.errorbar(
            at,
            middle,
            yerr=reach,
            linestyle="" if words else "-",
            color=_COLOURS[n % 6],
            marker=_MARKERS[n % 6],
            markersize=4.5,
            linewidth=1.1,
            capsize=2,
        )
    if words:
        axes.set_xticks(range(len(words)), words, rotation=35, ha="right")


def _steps(axes: Axes, series: _Series, names: list[str]) -> None:
    for name, points in series.items():
        x = [float(at) for at, _ in points]
        y = [one.value if isinstance(one, Estimate) else one for _, one in points]
        axes.step([0.0, *x], [0.0, *y], where="post", color=_COLOURS[names.index(name) % 6], linewidth=1.2)
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1.02)
