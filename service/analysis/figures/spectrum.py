"""Pictures of spectra: single spectra, waterfalls, and full spectra with forward precession right of reverse."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from models.errors import MachineFileError
from models.signals.channels import Channel
from service.analysis.figures.style import (
    COLOURS,
    INK,
    PLATE,
    Look,
    alarm_lines,
    as_dates,
    heading,
    place_text,
    rpm,
    speeds_text,
    time_axis,
)
from service.analysis.orbit import recorded_pairs
from service.analysis.recorded import Recorded
from service.analysis.spectrum import (
    FullSpectrum,
    Scaling,
    Spectrum,
    Waterfall,
    lowest_hz,
    read_full_spectrum,
    read_spectrum,
    read_waterfall,
    shown_as,
)
from service.analysis.trend import recorded_alarms

_DECADES = 4
_MOST_TRACES = 60
_ORDERS = (1, 2)
_CLOSE = 0.035
"""Distance between orders, as a fraction of the axis, below which their names would overlap."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Settings with which spectra are computed and shown."""

    window_s: float
    resolution_hz: float
    scaling: Scaling  # ``amplitude`` or ``density``
    log: bool  # whether amplitudes are on a logarithmic scale
    to_hz: float | None = None  # highest frequency shown; None stands for the range worth showing

    def __post_init__(self) -> None:
        if self.to_hz is not None and self.to_hz < 4 * self.resolution_hz:
            raise MachineFileError(
                f"--to-hz is {self.to_hz:g}, expected at least four lines of --resolution {self.resolution_hz:g} Hz"
            )


def spectrum(look: Look, data: Recorded, channels: Sequence[str], lines: Lines) -> Figure:
    """Spectra of the latest seconds; without names, of all channels of the first quantity measured."""
    found = read_spectrum(data, data.chosen(channels), lines.window_s, lines.resolution_hz, lines.scaling)
    count = len(found.channels)
    figure = Figure(figsize=look.size_in or (9.5, 1.2 + 1.75 * count), layout="constrained")
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    limits_hz, shown = _line_limits(found, lines.to_hz)
    frequency = found.frequencies_hz[shown]
    for axes, channel, values in zip(panels, found.channels, found.values[:, shown], strict=True):
        axes.plot(frequency, values, color=COLOURS[0], linewidth=0.9)
        axes.set_title(f"{channel.name}   {place_text(channel)}", fontweight="bold")
        axes.set_ylabel(shown_as(channel, found.scaling)[0])
        _heights(axes, values, _dynamic_range(found) if lines.log else None, 1.15)
        _orders(axes, found, values, frequency, channel)
    panels[-1].set_xlim(limits_hz)
    panels[-1].set_xlabel("frequency, Hz")
    title = f"{data.name}: " + ("power spectral density" if found.scaling == "density" else "amplitude spectrum")
    text = f"{found.resolution_hz:.3g} Hz, Hann, {found.averages} averages"
    heading(figure, look, title, (found.start_ns, found.end_ns), rpm(found.speed_rad_s), text)
    return figure


def waterfall(
    look: Look, data: Recorded, channels: Sequence[str], lines: Lines, *, over_speed: bool, cascade: bool
) -> Figure:
    """Spectra of one channel (without a name, the first displacement) over time or speed, as colours or lines."""
    if len(channels) > 1:
        raise MachineFileError(f"--channel: a waterfall is of one channel, found {', '.join(channels)}")
    found = read_waterfall(data, data.chosen(channels)[0], lines.window_s, lines.resolution_hz, lines.scaling)
    figure = Figure(figsize=look.size_in or (9.5, 7.0 if cascade else 6.0), dpi=look.dpi, layout="constrained")
    axes = figure.subplots()
    limits_hz, shown = _line_limits(found, lines.to_hz)
    axes.set_xlim(limits_hz)
    axes.set_xlabel("frequency, Hz")
    axes.grid(visible=False)
    (_cascade if cascade else _map)(axes, found, shown, over_speed=over_speed, log=lines.log)
    if over_speed:
        axes.set_ylabel("speed, rpm")
    else:
        time_axis(axes, vertical=True)
        alarm_lines(axes, recorded_alarms(data), vertical=True)
    title = f"{data.name}: spectra of {found.channel.name}, {place_text(found.channel)}"
    text = f"{found.values.shape[0]} spectra, {found.resolution_hz:.3g} Hz, Hann"
    span = int(found.start_ns[0]), int(found.end_ns[-1])
    heading(figure, look, title, span, speeds_text(found.speed_rad_s), text)
    return figure


def _map(axes: Axes, found: Waterfall, shown: npt.NDArray[np.bool_], *, over_speed: bool, log: bool) -> None:
    frequency = found.frequencies_hz[shown]
    half = found.resolution_hz / 2
    columns = np.append(frequency - half, frequency[-1] + half)
    if over_speed:
        edges, values = found.over_speed()
        rows = edges * 30 / np.pi
        values = values[:, shown]
    else:
        rows, values = _rows_in_time(found, found.values[:, shown])
    # Columns narrower than a pixel are not all drawn, so a steady line could be missing. Therefore adjacent lines are
    # merged, keeping the highest, until a column has two pixels.
    group = -(-frequency.size // max(1, int(axes.bbox.width / 2)))
    first = np.arange(0, frequency.size, group)
    columns, values = np.append(columns[first], columns[-1]), np.fmax.reduceat(values, first, axis=1)
    top = float(np.nanmax(values)) or 1.0
    norm = LogNorm(max(float(np.nanmin(values[values > 0], initial=top)), top * _dynamic_range(found)), top)
    limits = axes.get_xlim()
    mesh = axes.pcolormesh(
        columns, rows, values, norm=norm if log else Normalize(0, top), cmap="cividis", rasterized=True
    )
    axes.figure.colorbar(mesh, ax=axes, label=shown_as(found.channel, found.scaling)[0], pad=0.02, aspect=32)
    axes.set_xlim(limits)
    _order_lines(axes, found, rows, over_speed=over_speed)


def _cascade(axes: Axes, found: Waterfall, shown: npt.NDArray[np.bool_], *, over_speed: bool, log: bool) -> None:
    frequency = found.frequencies_hz[shown]
    if over_speed:
        edges, values = found.over_speed()
        base = (edges[:-1] + edges[1:]) / 2 * 30 / np.pi
    else:
        base, values = as_dates(found.end_ns), found.values
    there = np.flatnonzero(np.isfinite(values[:, -1]))
    there = there[:: -(-there.size // _MOST_TRACES)]
    base, values = base[there], values[there][:, shown]
    top = float(values.max()) or 1.0
    height = np.clip(np.log10(np.maximum(values, 1e-300) / top) / 3 + 1, 0, 1) if log else values / top
    step = (base[-1] - base[0]) / max(1, base.size - 1)
    scale = max(8.0, 0.2 * base.size) * step
    for order, (at, line) in enumerate(zip(base[::-1], height[::-1], strict=True)):
        axes.fill_between(frequency, at, at + scale * line, color="white", linewidth=0, zorder=2 + order)
        axes.plot(frequency, at + scale * line, color=COLOURS[0], linewidth=0.7, zorder=2 + order)
    axes.set_ylim(base[0] - step, base[-1] + 1.05 * scale)
    if np.isfinite(found.speed_rad_s).all():
        running = base / 60 if over_speed else np.abs(found.speed_rad_s[there]) / (2 * np.pi)
        for number in _ORDERS:
            axes.plot(
                number * running, base, color=COLOURS[1], linewidth=0.9, linestyle=(0, (1, 2)), zorder=300,
                scalex=False, scaley=False,
            )  # fmt: skip
            axes.annotate(
                f"{number}×", (number * running[-1], base[-1]), xytext=(6, 12), textcoords="offset points",
                fontsize=9, color=COLOURS[1], annotation_clip=True, zorder=300, bbox=PLATE,
            )  # fmt: skip
    full = f"{top:.3g} {shown_as(found.channel, found.scaling)[0]}"
    right = axes.get_xlim()[1]
    axes.annotate(
        "", (right * 0.985, base[-1]), (right * 0.985, base[-1] + scale), arrowprops={"arrowstyle": "|-|", "color": INK}
    )
    full += ", 3 decades" if log else ""
    axes.text(right * 0.975, base[-1] + scale / 2, full, ha="right", va="center", fontsize=8, zorder=400, bbox=PLATE)


def _rows_in_time(found: Waterfall, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges of the rows as dates, and the rows with a row of NaN inserted at each gap."""
    edges, rows = [found.start_ns[0]], []
    for start_ns, end_ns, row in zip(found.start_ns, found.end_ns, values, strict=True):
        if start_ns > edges[-1] + 10**6:
            edges.append(start_ns)
            rows.append(np.full_like(row, np.nan))
        edges.append(max(end_ns, edges[-1]))
        rows.append(row)
    return as_dates(np.array(edges, dtype=np.int64)), np.stack(rows)


def _orders(axes: Axes, found: Spectrum, values: np.ndarray, frequency: np.ndarray, channel: Channel) -> None:
    """Mark 1x and 2x, with the height of the line there."""
    if not np.isfinite(found.speed_rad_s) or abs(found.speed_rad_s) < 1e-6:
        return
    texts = []
    for order in _ORDERS:
        at = order * abs(found.speed_rad_s) / (2 * np.pi)
        if at > frequency[-1]:
            continue
        near = np.abs(frequency - at) <= 1.5 * found.resolution_hz
        unit, _ = shown_as(channel, found.scaling)
        high = f": {values[near].max():.3g} {unit}" if found.scaling == "amplitude" and near.any() else ""
        _mark_order(axes, at, order, of_axis=at / order / float(frequency[-1]))
        texts.append(f"{order}× {at:.4g} Hz{high}")
    axes.set_title("     ".join(texts), loc="right", color=COLOURS[1])


def _mark_order(axes: Axes, at: float, order: int, *, of_axis: float) -> None:
    """Mark an order with a line and its name; if orders are close, each name is below that of the order before."""
    axes.axvline(at, color=COLOURS[1], linewidth=0.9, linestyle=(0, (3, 2)), zorder=1)
    close = of_axis < _CLOSE
    away = close and at < 0  # keeps clear of the labels on the positive side
    axes.annotate(
        f"{'−' if at < 0 else ''}{order}×", (at, 1.0), xycoords=("data", "axes fraction"),
        xytext=(-3 if away else 3, -2 - 11 * close * (order - 1)), textcoords="offset points",
        ha="right" if away else "left", va="top", fontsize=8, color=COLOURS[1],
    )  # fmt: skip


def _order_lines(axes: Axes, found: Waterfall, rows: np.ndarray, *, over_speed: bool) -> None:
    if not np.isfinite(found.speed_rad_s).all():
        return
    right = axes.get_xlim()[1]
    for order in _ORDERS:
        if over_speed:
            place, at = order * rows / 60, rows
        else:
            place = order * np.abs(found.speed_rad_s) / (2 * np.pi)
            at = as_dates((found.start_ns + found.end_ns) // 2)
        if place.min() > right:
            continue
        axes.plot(place, at, color="white", linewidth=0.8, linestyle=(0, (2, 4)), scalex=False, scaley=False)
        axes.annotate(
            f"{order}×", (place[-1], at[-1]), xytext=(4, -3), textcoords="offset points", ha="left", va="top",
            fontsize=9, color="white", annotation_clip=True,
        )  # fmt: skip


def _line_limits(found: Spectrum | Waterfall, to_hz: float | None) -> tuple[tuple[float, float], npt.NDArray[np.bool_]]:
    """Limits of the frequency axis, Hz, and a mask of the lines between them."""
    low, high = lowest_hz(found.resolution_hz), found.useful_hz if to_hz is None else to_hz
    high = min(high, float(found.frequencies_hz[-1]))
    slack = 1e-6 * found.resolution_hz
    return (low, high), (found.frequencies_hz >= low - slack) & (found.frequencies_hz <= high + slack)


def _dynamic_range(found: Spectrum | Waterfall | FullSpectrum) -> float:
    """Ratio of the smallest to the greatest height shown on a logarithmic scale: 80 dB."""
    density = not isinstance(found, FullSpectrum) and found.scaling == "density"
    return float(10.0 ** (-2 * _DECADES if density else -_DECADES))


def _heights(axes: Axes, values: np.ndarray, depth: float | None, room: float) -> None:
    """Set the vertical axis: logarithmic down to `depth` times the top, or linear up to `room` times the top."""
    top = float(values.max()) or 1.0
    if depth is None:
        axes.set_ylim(0, room * top)
        return
    axes.set_yscale("log")
    axes.set_ylim(0.7 * max(float(values[values > 0].min(initial=top)), depth * top), 2.5 * top)


def full_spectrum(look: Look, data: Recorded, place: str | None, lines: Lines, *, orders: bool) -> Figure:
    """Full spectra of pairs of probes in the latest seconds."""
    pairs = recorded_pairs(data, place)
    found = read_full_spectrum(data, pairs, lines.window_s, lines.resolution_hz, orders=orders)
    count = len(found.pairs)
    figure = Figure(figsize=look.size_in or (9.5, 1.2 + 2.4 * count), layout="constrained")
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    # Without the shaft angle, the sense of rotation and thus forward precession are unknown.
    sides = ("reverse", "forward") if np.isfinite(found.speed_rad_s) else ("z to y", "y to z")
    to = found.useful
    if lines.to_hz is not None:
        to = lines.to_hz / (abs(found.speed_rad_s) / (2 * np.pi)) if found.orders else lines.to_hz
    shown = np.abs(found.lines) <= to * (1 + 1e-9)
    clear = shown & (np.abs(found.lines) >= lowest_hz(found.resolution) * (1 - 1e-9))
    for axes, pair, values in zip(panels, found.pairs, found.values_um, strict=True):
        axes.plot(found.lines[shown], np.where(clear, values, np.nan)[shown], color=COLOURS[0], linewidth=0.9)
        axes.axvline(0, color=INK, linewidth=0.8)
        axes.set_title(f"{pair[0].location}   {' and '.join(one.name for one in pair)}", fontweight="bold")
        axes.set_ylabel("µm pp")
        _heights(axes, values[clear], _dynamic_range(found) if lines.log else None, 1.22)
        for at, side, text in zip((0.01, 0.99), ("left", "right"), sides, strict=True):
            axes.text(at, 0.97, text, transform=axes.transAxes, ha=side, va="top", color=INK, fontstyle="italic")
        _marks(axes, found, values, shown)
    panels[-1].set_xlim(-to, to)
    panels[-1].set_xlabel("order" if found.orders else "frequency, Hz")
    text = f"{found.resolution:.3g} {'orders' if found.orders else 'Hz'}, Hann, {found.averages} averages"
    heading(figure, look, f"{data.name}: full spectrum", (found.start_ns, found.end_ns), rpm(found.speed_rad_s), text)
    return figure


def _marks(axes: Axes, found: FullSpectrum, values: np.ndarray, shown: npt.NDArray[np.bool_]) -> None:
    """Mark 1x and 2x on either side, with the height there."""
    turns = 1.0 if found.orders else abs(found.speed_rad_s) / (2 * np.pi)
    if not np.isfinite(turns) or turns < 1e-6:
        return
    texts = []
    for order in _ORDERS:
        heights = []
        for sign in (-1, 1):
            near = shown & (np.abs(found.lines - sign * order * turns) <= 1.5 * found.resolution)
            if not near.any():
                continue
            _mark_order(axes, sign * order * turns, order, of_axis=turns / float(np.ptp(found.lines[shown])))
            heights.append(f"{values[near].max():.3g}")
        if len(heights) == 2:
            texts.append(f"{order}× forward {heights[1]}, reverse {heights[0]} µm pp")
    axes.set_title("     ".join(texts), loc="right", color=COLOURS[1])
