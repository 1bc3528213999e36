"""Pictures of a run-up or coast-down: vectors over the speed (Bode), and in their plane (polar).

As ISO 13373-2 and API 670 have them: phase is the lag from the keyphasor's pulse to the positive peak. In a polar plot
0° is where the sensor is, and the lag is counted against the rotation, so that an angle on the plot is one on the
machine.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import FuncFormatter, MaxNLocator, MultipleLocator

from models.errors import RotorwatchError
from models.signals.block import FloatArray
from service.analysis.figures.style import (
    COLOURS,
    GREY,
    PLATE,
    Look,
    Paint,
    along_path,
    heading,
    mark_text,
    place_text,
    rotation_text,
    speeds_text,
    spread_marks,
)
from service.analysis.past import Past
from service.analysis.recorded import Recorded
from service.analysis.runup import RunUp, read_run_up
from service.analysis.spectrum import steady

_APART = 0.16
"""Distance of marks, of the longest vector."""


def bode(  # what may be asked for
    data: Recorded | Past,
    channels: Sequence[str],
    order: int,
    revolutions: int,
    slow_roll_rpm: float | None,
    between_rpm: tuple[float, float] | None = None,
) -> Paint:
    """Amplitude and phase lag at an order over the speed."""
    found = read_run_up(data, data.chosen(channels), order, revolutions, slow_roll_rpm, between_rpm)
    if text := steady(found.speed_rad_s):
        raise RotorwatchError(f"a Bode plot needs a run-up or coast-down: {text}")
    return partial(_paint_bode, found, data.name)


def polar(
    data: Recorded | Past, channels: Sequence[str], order: int, revolutions: int, slow_roll_rpm: float | None
) -> Paint:
    """The same as vectors in their plane, with speeds or times written at points."""
    found = read_run_up(data, data.chosen(channels), order, revolutions, slow_roll_rpm)
    return partial(_paint_polar, found, data.name)


def _paint_bode(found: RunUp, name: str, look: Look) -> Figure:
    """For each channel phase above, where there is one, and amplitude below."""
    columns = min(2, len(found.channels))
    rows = -(-len(found.channels) // columns)
    figure = Figure(figsize=look.size_in or (5.6 * columns if columns > 1 else 8.0, 0.8 + 4.4 * rows))
    figure.set_layout_engine("constrained", h_pad=0.03, hspace=0.0)
    grid = figure.add_gridspec(
        3 * rows - 1, columns, height_ratios=([0.01 if found.estimated else 1.0, 1.4, 0.08] * rows)[:-1]
    )
    speed = np.abs(found.speed_rad_s) * 30 / np.pi
    for number, channel in enumerate(found.channels):
        row, column = 3 * (number // columns), number % columns
        lower = figure.add_subplot(grid[row + 1, column])
        amplitude, lag = found.amplitude[:, number], found.lag_deg[:, number]
        panels, text = [lower], ""
        if not found.estimated:
            panels.append(figure.add_subplot(grid[row, column], sharex=lower))
            _lag(panels[-1], speed, lag, amplitude)
            panels[-1].tick_params(labelbottom=False)
            text = f", {lag[np.argmax(amplitude)]:.0f}° lag"
        panels[-1].set_title(f"{channel.name}   {place_text(channel)}", fontweight="bold")
        lower.plot(speed, amplitude, "." if found.estimated else ".-", color=COLOURS[0], markersize=3, linewidth=0.7)
        lower.set_ylim(0, 1.15 * float(np.max(amplitude)) or 1.0)
        lower.set_ylabel(f"{found.order}× amplitude, {found.units[number]}")
        lower.set_xlabel("speed, rpm")
        top = int(np.argmax(amplitude))
        for axes in panels:
            axes.axvline(speed[top], color=COLOURS[1], linewidth=0.9, linestyle=(0, (3, 2)), zorder=1)
        lower.set_title(
            f"greatest: {amplitude[top]:.3g} {found.units[number]} at {speed[top]:.0f} rpm{text}",
            loc="right", color=COLOURS[1],
        )  # fmt: skip
    _heading(figure, look, found, f"{name}: Bode plot of {found.order}×")
    return figure


def _lag(axes: Axes, speed: FloatArray, lag_deg: FloatArray, amplitude: FloatArray) -> None:
    """Phase lag, downwards; cut where the fewest strong vectors are, so that the curve stays in one piece."""
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


def _paint_polar(found: RunUp, name: str, look: Look) -> Figure:
    columns = min(2, len(found.channels))
    rows = -(-len(found.channels) // columns)
    figure = Figure(figsize=look.size_in or (max(8.0, 5.2 * columns), 0.9 + 5.6 * rows))
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
    _heading(figure, look, found, f"{name}: polar plot of {found.order}×")
    return figure


def _trace(axes: PolarAxes, found: RunUp, number: int) -> None:
    """The vectors' ends in order of time, with speeds along the way."""
    lag_deg, amplitude = found.lag_deg[:, number], found.amplitude[:, number]
    lag = np.radians(lag_deg)
    axes.plot(lag, amplitude, ".-", color=COLOURS[0], markersize=3, linewidth=0.7)
    axes.set_rmax(1.12 * float(np.max(amplitude)) or 1.0)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_rlabel_position(45 * (_cut_deg(lag_deg, amplitude) // 45) + 22.5)
    axes.tick_params(labelsize=8)
    along, unit = along_path(found.speed_rad_s, found.time_ns)
    for at in spread_marks(along, amplitude * np.exp(1j * lag), _APART * float(np.max(amplitude))):
        axes.plot(lag[at], amplitude[at], "o", color=COLOURS[1], markersize=4, zorder=4)
        axes.annotate(
            mark_text(along[at], unit), (lag[at], amplitude[at]), xytext=(4, 4),
            textcoords="offset points", fontsize=8, color=COLOURS[1], bbox=PLATE, zorder=5,
        )  # fmt: skip
    axes.set_xlabel(f"{found.order}× amplitude, {found.units[number]}; marks: {unit}", fontsize=8, color=GREY)


def _heading(figure: Figure, look: Look, found: RunUp, title: str) -> None:
    span = int(found.time_ns[0]), int(found.time_ns[-1])
    slow_roll = "" if found.slow_roll_rpm is None else f"less slow roll up to {found.slow_roll_rpm:g} rpm"
    turns = "" if found.estimated else rotation_text(found.direction)
    heading(figure, look, title, span, speeds_text(found.speed_rad_s), _points_text(found), slow_roll, turns)


def _points_text(found: RunUp) -> str:
    if found.estimated:
        return "speed found in the vibration, no phase"
    return "windows of the monitor" if found.revolutions is None else f"{found.revolutions} revolutions a point"
