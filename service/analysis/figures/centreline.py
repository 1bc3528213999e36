"""Picture of the shaft's centreline: its mean position across the bearing, with speeds along the way."""

from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from service.analysis.centreline import Centreline, read_centreline
from service.analysis.figures.style import (
    COLOURS,
    GREY,
    INK,
    PLATE,
    Look,
    Paint,
    along_path,
    heading,
    mark_text,
    plane_labels,
    speeds_text,
    spread_marks,
)
from service.analysis.orbit import planes_of, recorded_pairs
from service.analysis.past import Past
from service.analysis.recorded import Recorded


def centreline(data: Recorded | Past, place: str | None, each_s: float, clearance_um: float | None) -> Paint:
    """Mean positions of pairs of probes, from the first one on."""
    pairs = recorded_pairs(data, place)
    return partial(_paint, read_centreline(data, pairs, each_s), data.name, clearance_um)


def _paint(found: Centreline, name: str, clearance_um: float | None, look: Look) -> Figure:
    columns = len(found.pairs)
    figure = Figure(figsize=look.size_in or (max(7.2, 5.4 * columns), 6.2), layout="constrained")
    along, unit = along_path(found.speed_rad_s, found.time_ns)
    norm = Normalize(float(along.min()), float(along.max()))
    panels = figure.subplots(1, columns, squeeze=False)[0]
    for number, (axes, pair) in enumerate(zip(panels, found.pairs, strict=True)):
        y, z = (values[:, number] - values[0, number] for values in (found.y_um, found.z_um))
        path = np.stack([y, z], axis=1)
        lines = LineCollection(list(np.stack([path[:-1], path[1:]], axis=1)), cmap="viridis_r", norm=norm)
        lines.set_array((along[:-1] + along[1:]) / 2)
        axes.add_collection(lines)
        axes.scatter(y, z, c=along, cmap="viridis_r", norm=norm, s=9, zorder=3, linewidths=0)
        reach = max(float(np.ptp(y)), float(np.ptp(z)), 1e-3)
        for at in spread_marks(along, y + 1j * z, 0.14 * reach):
            axes.plot(y[at], z[at], "o", color=COLOURS[1], markersize=4.5, zorder=4)
            axes.annotate(
                mark_text(along[at], unit), (y[at], z[at]), xytext=(5, 4), textcoords="offset points", fontsize=8,
                color=COLOURS[1], bbox=PLATE, zorder=5,
            )  # fmt: skip
        if clearance_um is not None:
            axes.add_patch(Circle((0, clearance_um / 2), clearance_um / 2, fill=False, color=GREY, linestyle="--"))
        _frame(axes, found, number, y, z, clearance_um)
        axes.set_title(f"{pair[0].location}", fontweight="bold")
    bar = figure.colorbar(lines, ax=list(panels), pad=0.02, aspect=32, shrink=0.9)
    bar.set_label(unit)
    span, text = (int(found.time_ns[0]), int(found.time_ns[-1])), f"means over {found.each_s:.3g} s"
    heading(figure, look, f"{name}: shaft centreline", span, speeds_text(found.speed_rad_s), text)
    return figure


def _frame(
    axes: Axes, found: Centreline, number: int, y: np.ndarray, z: np.ndarray, clearance_um: float | None
) -> None:
    """The same length on both axes."""
    names = planes_of(found.pairs[number]).names
    across, up = plane_labels(names)
    axes.set_xlabel(f"{across}, µm from the start")
    axes.set_ylabel(f"{up}, µm from the start")
    axes.axhline(0, color=GREY, linewidth=0.6)
    axes.axvline(0, color=GREY, linewidth=0.6)
    start = f"start: {names[0]} {found.y_um[0, number]:.4g} µm, {names[1]} {found.z_um[0, number]:.4g} µm"
    if clearance_um is not None:
        start += f"\ncircle: clearance of {clearance_um:g} µm, if the shaft lies at its bottom to begin with"
    axes.text(
        0.02, 0.985, start, transform=axes.transAxes, ha="left", va="top", fontsize=8, color=INK, bbox=PLATE, zorder=6,
    )  # fmt: skip
    half = clearance_um / 2 if clearance_um else 0.0
    ends = [(min(float(one.min()), low), max(float(one.max()), high)) for one, low, high in (
        (y, -half, half), (z, 0.0, 2 * half)
    )]  # fmt: skip
    reach = 0.6 * max(*(high - low for low, high in ends), 1.0)
    (left, right), (bottom, top) = ends
    axes.set_xlim((left + right) / 2 - reach, (left + right) / 2 + reach)
    axes.set_ylim((bottom + top) / 2 - reach, (bottom + top) / 2 + 1.15 * reach)
    axes.set_aspect("equal")
