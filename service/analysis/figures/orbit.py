"""Picture of orbits: unfiltered and at 1x, with keyphasor dots."""

from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from service.analysis.figures.style import COLOURS, INK, Look, Paint, frame_plane, heading, rotation_text, rpm
from service.analysis.orbit import Orbit, Orbits, phase_lag_deg, read_orbits
from service.analysis.recorded import Recorded

_BLANK = 0.07
"""Gap before the keyphasor dot, as a fraction of the ellipse's long axis."""


def orbit(data: Recorded, revolutions: int) -> Paint:
    """Orbits of the latest revolutions."""
    return partial(_paint, read_orbits(data, revolutions), data.name)


def _paint(found: Orbits, name: str, look: Look) -> Figure:
    """Draw a row for each location: unfiltered, and 1×."""
    rows = len(found.orbits)
    figure = Figure(figsize=look.size_in or (7.6, 1.0 + 4.2 * rows), layout="constrained")
    for row, orbit in zip(figure.subplots(rows, 2, squeeze=False), found.orbits, strict=True):
        _raw(row[0], orbit)
        _running_speed(row[1], orbit, found)
    text = "keyphasor pulse (on 1×, the gap comes before it)"
    pulse = Line2D([], [], marker="o", linestyle="", color=COLOURS[1], label=text)
    figure.legend(handles=[pulse], loc="outside lower center")
    span, turns = (found.start_ns, found.end_ns), rotation_text(found.direction)
    heading(figure, look, f"{name}: orbits of {found.revolutions} revolutions", span, rpm(found.speed_rad_s), turns)
    return figure


def _raw(axes: Axes, orbit: Orbit) -> None:
    axes.plot(orbit.y_um, orbit.z_um, color=COLOURS[0], linewidth=0.8)
    axes.plot(*orbit.marks_um.T, "o", color=COLOURS[1], markersize=5, markeredgecolor="white", markeredgewidth=0.6)
    axes.set_title(f"{orbit.location}, as measured", fontweight="bold")
    across = zip(orbit.names, (np.ptp(orbit.y_um), np.ptp(orbit.z_um)), strict=True)
    _frame(axes, orbit, (orbit.y_um, orbit.z_um), [f"{name} {length:.4g} µm pp" for name, length in across])


def _running_speed(axes: Axes, orbit: Orbit, found: Orbits) -> None:
    ellipse = orbit.ellipse
    turn = np.exp(1j * found.direction * np.linspace(0, 2 * np.pi, 720, endpoint=False))
    y, z = np.real(ellipse.y * turn), np.real(ellipse.z * turn)
    far = np.hypot(y - y[0], z - z[0]) > _BLANK * 2 * ellipse.semi_major
    last = int(np.flatnonzero(far)[-1]) + 1 if far.any() else y.size  # the curve just before the dot is left blank
    axes.plot(y[:last], z[:last], color=COLOURS[0], linewidth=1.8)
    axes.plot(y[:1], z[:1], "o", color=COLOURS[1], markersize=7, markeredgecolor="white", markeredgewidth=0.6)
    for part in (0.3, 0.8):  # arrowheads that show the sense
        index = int(part * 720)
        axes.annotate(
            "",
            (y[index + 4], z[index + 4]),
            (y[index], z[index]),
            arrowprops={"arrowstyle": "-|>", "color": COLOURS[0], "mutation_scale": 16},
        )
    axes.set_title(f"{orbit.location}, 1× alone: {ellipse.precession} precession", fontweight="bold")
    lines = [
        f"{name} {2 * abs(q):.4g} µm pp ∠ {phase_lag_deg(q, found.direction):.0f}° lag"
        for name, q in zip(orbit.names, (ellipse.y, ellipse.z), strict=True)
    ]
    lines.append(f"ellipse {2 * ellipse.semi_major:.4g} × {2 * ellipse.semi_minor:.4g} µm")
    _frame(axes, orbit, (y, z), lines)


def _frame(axes: Axes, orbit: Orbit, path: tuple[np.ndarray, np.ndarray], lines: list[str]) -> None:
    """Set both axes to the extent of the path, with room above for the text."""
    frame_plane(axes, orbit.names, "µm")
    axes.text(
        0.02, 0.985, "\n".join(lines), transform=axes.transAxes, ha="left", va="top", fontsize=8, color=INK, zorder=5
    )
    reach = 1.12 * max(float(np.max(np.abs(path))), 1e-6)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, 1.35 * reach)
