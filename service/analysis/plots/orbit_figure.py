"""Picture of orbits: as measured and at running speed, with the keyphasor's dots."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from service.analysis.plots.orbit import Orbit, Orbits, Vector
from service.analysis.plots.style import COLOURS, GREY, INK, Look, heading, rpm, stretch_text

_BLANK = 0.07
"""Gap before the keyphasor's dot, of the ellipse's length."""


def paint_orbits(found: Orbits, name: str, look: Look) -> Figure:
    """A row for each place: raw, and 1×."""
    rows = len(found.orbits)
    figure = Figure(figsize=look.size_in or (7.6, 1.0 + 4.2 * rows), layout="constrained")
    for row, orbit in zip(figure.subplots(rows, 2, squeeze=False), found.orbits, strict=True):
        _raw(row[0], orbit)
        _running_speed(row[1], orbit, found)
    figure.legend(
        handles=[
            Line2D(
                [],
                [],
                marker="o",
                linestyle="",
                color=COLOURS[1],
                label="keyphasor pulse (on 1×, the gap comes before it)",
            )
        ],
        loc="outside lower center",
    )
    sense = "y to z, counter-clockwise here ↺" if found.direction > 0 else "z to y, clockwise here ↻"
    heading(
        figure,
        look,
        f"{name}: orbits of {found.revolutions} revolutions",
        (stretch_text(found.start_ns, found.end_ns), rpm(found.speed_rad_s), f"rotation {sense}"),
    )
    return figure


def _raw(axes: Axes, orbit: Orbit) -> None:
    axes.plot(orbit.y_um, orbit.z_um, color=COLOURS[0], linewidth=0.8)
    axes.plot(*orbit.marks_um.T, "o", color=COLOURS[1], markersize=5, markeredgecolor="white", markeredgewidth=0.6)
    axes.set_title(f"{orbit.location}, as measured", fontweight="bold")
    across = np.ptp(orbit.y_um), np.ptp(orbit.z_um)
    _frame(axes, orbit, [f"{orbit.y.channel} {across[0]:.4g} µm pp", f"{orbit.z.channel} {across[1]:.4g} µm pp"])
    _limit(axes, orbit.y_um, orbit.z_um)


def _running_speed(axes: Axes, orbit: Orbit, found: Orbits) -> None:
    sense = found.direction
    y, z = orbit.at_running_speed(sense * np.linspace(0, 2 * np.pi, 720, endpoint=False))
    at = orbit.at_running_speed(np.zeros(1))
    far = np.hypot(y - at[0], z - at[1]) > _BLANK * orbit.major_um
    last = int(np.flatnonzero(far)[-1]) + 1 if far.any() else y.size  # the way to the dot is left blank
    axes.plot(y[:last], z[:last], color=COLOURS[0], linewidth=1.8)
    axes.plot(*at, "o", color=COLOURS[1], markersize=7, markeredgecolor="white", markeredgewidth=0.6)
    for part in (0.3, 0.8):  # which way it goes
        index = int(part * 720)
        axes.annotate(
            "",
            (y[index + 4], z[index + 4]),
            (y[index], z[index]),
            arrowprops={"arrowstyle": "-|>", "color": COLOURS[0], "mutation_scale": 16},
        )
    axes.set_title(f"{orbit.location}, 1× alone: {orbit.precession} precession", fontweight="bold")
    shape = f"ellipse {orbit.major_um:.4g} × {orbit.minor_um:.4g} µm"
    _frame(axes, orbit, [_vector(orbit.y), _vector(orbit.z), shape])
    _limit(axes, y, z)


def _vector(vector: Vector) -> str:
    return f"{vector.channel} {vector.peak_to_peak_um:.4g} µm pp ∠ {vector.phase_lag_deg:.0f}° lag"


def _frame(axes: Axes, orbit: Orbit, lines: list[str]) -> None:
    axes.axhline(0, color=GREY, linewidth=0.6)
    axes.axvline(0, color=GREY, linewidth=0.6)
    axes.set_xlabel(f"y: {orbit.y.channel}, µm")
    axes.set_ylabel(f"z: {orbit.z.channel}, µm")
    axes.text(
        0.02, 0.985, "\n".join(lines), transform=axes.transAxes, ha="left", va="top", fontsize=8, color=INK, zorder=5
    )


def _limit(axes: Axes, y: np.ndarray, z: np.ndarray) -> None:
    """The same length on both axes, and room above for the text."""
    reach = 1.12 * max(float(np.max(np.abs(y))), float(np.max(np.abs(z))), 1e-6)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, 1.35 * reach)
    axes.set_aspect("equal")
