"""Pictures of a run-up or coast-down: Bode plot, polar plot and average shaft centreline.

They follow ISO 13373-2 and API 670: phase is the lag from the keyphasor pulse to the positive peak. In a polar plot 0°
is at the sensor, and the lag is counted against the rotation, so that angles on the plot are angles on the machine.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import FuncFormatter, MaxNLocator, MultipleLocator

from models.errors import RotorwatchError
from models.signals.block import FloatArray
from service.analysis.figures.style import (
    COLOURS,
    GREY,
    PLATE,
    Look,
    along_path,
    frame_plane,
    heading,
    place_text,
    rotation_text,
    speeds_text,
    spread_marks,
)
from service.analysis.orbit import planes_of, recorded_pairs
from service.analysis.past import Past
from service.analysis.recorded import Recorded
from service.analysis.runup import RunUp, read_centreline, read_run_up
from service.analysis.spectrum import steady

_APART = 0.16
"""Least distance between marks, as a fraction of the longest vector."""


def bode(
    look: Look,
    data: Recorded | Past,
    channels: Sequence[str],
    order: int,
    revolutions: int,
    slow_roll_rpm: float | None,
    between_rpm: tuple[float, float] | None = None,
) -> Figure:
    """Amplitude of one order over speed and, where there is one, the phase lag above it, channel by channel."""
    found = read_run_up(data, data.chosen(channels), order, revolutions, slow_roll_rpm, between_rpm)
    if text := steady(found.speed_rad_s):
        raise RotorwatchError(f"a Bode plot needs a run-up or coast-down: {text}")
    columns = min(2, len(found.channels))
    rows = -(-len(found.channels) // columns)
    figure = Figure(figsize=look.size_in or (5.6 * columns if columns > 1 else 10.4, 0.8 + 4.4 * rows))
    figure.set_layout_engine("constrained", h_pad=0.03, hspace=0.0)
    grid = figure.add_gridspec(
        3 * rows - 1, columns, height_ratios=([0.01 if found.estimated else 1.0, 1.4, 0.08] * rows)[:-1]
    )
    rpm = np.abs(found.speed_rad_s) * 30 / np.pi
    for number, channel in enumerate(found.channels):
        row, column = 3 * (number // columns), number % columns
        lower = figure.add_subplot(grid[row + 1, column])
        known = np.isfinite(found.amplitude[:, number])
        speed, amplitude, lag = rpm[known], found.amplitude[known, number], found.lag_deg[known, number]
        top, panels, text = int(np.argmax(amplitude)), [lower], ""
        if not found.estimated:
            panels.append(figure.add_subplot(grid[row, column], sharex=lower))
            _lag(panels[-1], speed, lag, amplitude)
            panels[-1].tick_params(labelbottom=False)
            text = f", {lag[top]:.0f}° lag"
        panels[-1].set_title(f"{channel.name}   {place_text(channel)}", fontweight="bold")
        lower.plot(speed, amplitude, "." if found.estimated else ".-", color=COLOURS[0], markersize=3, linewidth=0.7)
        lower.set_ylim(0, 1.15 * float(np.max(amplitude)) or 1.0)
        lower.set_ylabel(f"{found.order}× amplitude, {found.units[number]}")
        lower.set_xlabel("speed, rpm")
        for axes in panels:
            axes.axvline(speed[top], color=COLOURS[1], linewidth=0.9, linestyle=(0, (3, 2)), zorder=1)
        lower.set_title(
            f"greatest: {amplitude[top]:.3g} {found.units[number]} at {speed[top]:.0f} rpm{text}",
            loc="right", color=COLOURS[1],
        )  # fmt: skip
    _heading(figure, look, found, f"{data.name}: Bode plot of {found.order}×")
    return figure


def _lag(axes: Axes, speed: FloatArray, lag_deg: FloatArray, amplitude: FloatArray) -> None:
    """Draw the phase lag, growing downwards, wrapped at an angle with few strong vectors to avoid jumps."""
    cut = _cut_deg(lag_deg, amplitude)
    shown = (lag_deg - cut) % 360 + cut
    jumps = np.abs(np.diff(shown, append=shown[-1])) > 180
    axes.plot(speed, np.where(jumps, np.nan, shown), "-", color=COLOURS[0], linewidth=0.7)
    axes.plot(speed, shown, ".", color=COLOURS[0], markersize=3)
    low, high = (float(np.percentile(shown, part)) for part in (1, 99))
    middle, half = (low + high) / 2, max(60.0, 0.6 * (high - low))
    axes.set_ylim(middle + half, middle - half)
    axes.yaxis.set_major_locator(MultipleLocator(90 if half > 200 else 45 if half > 80 else 30))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value % 360:.0f}°"))
    axes.set_ylabel("phase lag")


def _cut_deg(lag_deg: FloatArray, amplitude: FloatArray) -> float:
    weights, _ = np.histogram(lag_deg, bins=36, range=(0, 360), weights=amplitude)
    near = np.convolve(np.concatenate([weights[-4:], weights, weights[:4]]), np.hanning(11)[1:-1], mode="valid")
    return 10.0 * (int(np.argmin(near)) + 0.5)


def polar(
    look: Look,
    data: Recorded | Past,
    channels: Sequence[str],
    order: int,
    revolutions: int,
    slow_roll_rpm: float | None,
) -> Figure:
    """Vectors of one order in the polar plane, with points labelled by speed or time."""
    found = read_run_up(data, data.chosen(channels), order, revolutions, slow_roll_rpm)
    columns = min(2, len(found.channels))
    rows = -(-len(found.channels) // columns)
    figure = Figure(figsize=look.size_in or (10.4, 0.9 + 5.6 * rows))
    figure.set_layout_engine("constrained")
    direction = found.direction
    panels = figure.subplots(rows, columns, squeeze=False, subplot_kw={"projection": "polar"}).ravel()
    for number, (axes, channel) in enumerate(zip(panels, found.channels, strict=False)):
        along_y, along_z = channel.axis
        axes.set_theta_offset(np.arctan2(along_z, along_y))
        axes.set_theta_direction(-direction)
        axes.set_title(f"{channel.name}   {place_text(channel)}", fontweight="bold", loc="left", y=1.13, pad=0)
        _trace(axes, found, number)
        axes.set_thetagrids(range(0, 360, 45), ["0°\nsensor", *(f"{one}°" for one in range(45, 360, 45))])
    for axes in panels[len(found.channels) :]:
        axes.remove()
    _heading(figure, look, found, f"{data.name}: polar plot of {found.order}×")
    return figure


def _trace(axes: PolarAxes, found: RunUp, number: int) -> None:
    """Draw the tips of the vectors in order of time, labelled with speeds or times."""
    known = np.isfinite(found.amplitude[:, number])
    lag_deg, amplitude = found.lag_deg[known, number], found.amplitude[known, number]
    lag = np.radians(lag_deg)
    axes.plot(lag, amplitude, ".-", color=COLOURS[0], markersize=3, linewidth=0.7)
    axes.set_rmax(1.12 * float(np.max(amplitude)) or 1.0)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_rlabel_position(45 * (_cut_deg(lag_deg, amplitude) // 45) + 22.5)
    axes.tick_params(labelsize=8)
    along, unit = along_path(found.speed_rad_s, found.time_ns)
    along = along[known]
    for at in spread_marks(along, amplitude * np.exp(1j * lag), _APART * float(np.max(amplitude))):
        _label(axes, (lag[at], amplitude[at]), along[at], unit, size=4, offset=(4, 4))
    axes.set_xlabel(f"{found.order}× amplitude, {found.units[number]}; marks: {unit}", fontsize=8, color=GREY)


def _label(
    axes: Axes, place: tuple[float, float], value: float, unit: str, *, size: float, offset: tuple[int, int]
) -> None:
    """Mark a point of a path, and write its speed or time beside it."""
    axes.plot(*place, "o", color=COLOURS[1], markersize=size, zorder=4)
    axes.annotate(
        f"{value:.0f}" if unit.endswith("rpm") else f"{round(value, 2):.3g}", place, xytext=offset,
        textcoords="offset points", fontsize=8, color=COLOURS[1], bbox=PLATE, zorder=5,
    )  # fmt: skip


def _heading(figure: Figure, look: Look, found: RunUp, title: str) -> None:
    span = int(found.time_ns[0]), int(found.time_ns[-1])
    slow_roll = "" if found.slow_roll_rpm is None else f"less slow roll up to {found.slow_roll_rpm:g} rpm"
    points = "windows of the monitor" if found.revolutions is None else f"{found.revolutions} revolutions a point"
    turns = rotation_text(found.direction)
    if found.estimated:
        points, turns = "speed found in the vibration, no phase", ""
    heading(figure, look, title, span, speeds_text(found.speed_rad_s), points, slow_roll, turns)


def centreline(
    look: Look, data: Recorded | Past, place: str | None, each_s: float, clearance_um: float | None
) -> Figure:
    """Mean positions of the shaft at pairs of probes, relative to the first one."""
    found = read_centreline(data, recorded_pairs(data, place), each_s)
    columns = len(found.pairs)
    figure = Figure(figsize=look.size_in or (max(7.2, 5.4 * columns), 6.2), layout="constrained")
    every, unit = along_path(found.speed_rad_s, found.time_ns)
    norm = Normalize(float(every.min()), float(every.max()))
    panels = figure.subplots(1, columns, squeeze=False)[0]
    for number, (axes, pair) in enumerate(zip(panels, found.pairs, strict=True)):
        path = np.stack([found.y_um[:, number], found.z_um[:, number]], axis=1)
        known = np.isfinite(path).all(axis=1)
        path, along = path[known], every[known]
        names = planes_of(pair).names
        y_um, z_um = (f"{name} {value:.4g} µm" for name, value in zip(names, path[0].tolist(), strict=True))
        start = f"start: {y_um}," + (" " if len(y_um) < 24 else "\n") + z_um  # names of probes at an angle are long
        path = path - path[0]
        y, z = path.T
        lines = LineCollection(list(np.stack([path[:-1], path[1:]], axis=1)), cmap="viridis_r", norm=norm)
        lines.set_array((along[:-1] + along[1:]) / 2)
        axes.add_collection(lines)
        axes.scatter(y, z, c=along, cmap="viridis_r", norm=norm, s=9, zorder=3, linewidths=0)
        _frame(axes, names, start, path, clearance_um)
        for at in spread_marks(along, y + 1j * z, 0.12 * float(np.ptp(axes.get_xlim()))):
            _label(axes, (y[at], z[at]), along[at], unit, size=4.5, offset=(5, 4))
        if clearance_um is not None:
            axes.add_patch(Circle((0, clearance_um / 2), clearance_um / 2, fill=False, color=GREY, linestyle="--"))
        axes.set_title(f"{pair[0].location}", fontweight="bold")
    bar = figure.colorbar(lines, ax=list(panels), pad=0.02, aspect=32, shrink=0.9)
    bar.set_label(unit)
    span, text = (int(found.time_ns[0]), int(found.time_ns[-1])), f"means over {found.each_s:.3g} s"
    heading(figure, look, f"{data.name}: shaft centreline", span, speeds_text(found.speed_rad_s), text)
    return figure


def _frame(axes: Axes, names: tuple[str, str], start: str, path: FloatArray, clearance_um: float | None) -> None:
    """Set limits with equal scales on both axes, and state the start position."""
    if clearance_um is not None:
        start += f"\ncircle: clearance of {clearance_um:g} µm, if the shaft lies at its bottom to begin with"
    frame_plane(axes, names, "µm from the start", start)
    half = clearance_um / 2 if clearance_um else 0.0
    left, bottom = np.minimum(path.min(axis=0), (-half, 0.0)).tolist()
    right, top = np.maximum(path.max(axis=0), (half, 2 * half)).tolist()
    reach = 0.6 * max(right - left, top - bottom, 1.0)
    axes.set_xlim((left + right) / 2 - reach, (left + right) / 2 + reach)
    axes.set_ylim((bottom + top) / 2 - reach, (bottom + top) / 2 + 1.15 * reach)
