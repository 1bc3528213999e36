"""Style and output of the pictures; the same data give the same bytes."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num, num2date
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from models.errors import PictureError
from models.signals.block import FloatArray
from models.signals.channels import Channel
from rotorwatch.records.alarms import AlarmEventData
from service.analysis.spectrum import steady
from service.recordings.replay.source import clock

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's palette, distinguishable with any colour vision."""
INK, GREY, SKIPPED = "#222222", "#777777", "#dddddd"
STATE_COLOURS = {
    "healthy": "#009E73",
    "alert": "#E69F00",
    "danger": "#D55E00",
    "outside-model": "#CC79A7",
    "not-evaluable": "#999999",
    "unchanged": "#56B4E9",
    "watching": "#0072B2",
    "data-health": "#882255",
    "warming": "#dddddd",
    "no-data": "#000000",
}
SEVERITY_COLOURS = {"alert": "#E69F00", "danger": "#D55E00"}
PLATE = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
"""Background of text that is drawn over lines or colours."""

_ROUND = tuple(step * 10.0**power for power in range(-3, 9) for step in (1, 2, 5))
_MOST_MARKS = 30
_GAP_WIDTH, _MOST_BEGINS = 0.03, 8
"""Width of a skipped gap as part of the time shown; largest number of recordings labelled with their beginning."""
_UNITS = (("days", 86_400), ("hours", 3600), ("minutes", 60), ("s", 1))

_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": "#e2e2e2",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "text.hinting": "none",  # keeps letter spacing in small pictures
    "svg.hashsalt": "rotorwatch",
    "svg.fonttype": "path",  # viewing needs no font
}


@dataclass(frozen=True, slots=True)
class Look:
    """Options of the command line that concern the picture itself."""

    title: str | None = None  # replaces the default title
    size_in: tuple[float, float] | None = None  # width and height, inches; None is the default of the kind of picture
    dpi: float = 120.0  # pixels per inch of a PNG


def draw(path: Path, look: Look, picture: Callable[[], Figure]) -> None:
    """Draw in the house style, independent of the user's matplotlib settings, and write as PNG or SVG by suffix.

    The file contains neither the time nor the program that made it. `picture` reads the data and draws them; it raises
    `RotorwatchError` if there is nothing to draw.

    Raises
    ------
    PictureError
        If the file cannot be written.
    """
    with style.context(["default", _STYLE]):
        figure = picture()
        as_svg = path.suffix.lower() == ".svg"
        engine = figure.get_layout_engine()
        if engine is not None:  # otherwise the figure would be drawn twice, first to find the layout
            if as_svg:
                FigureCanvasSVG(figure)
            else:
                FigureCanvasAgg(figure)
                figure.set_dpi(look.dpi)
            engine.execute(figure)
            figure.set_layout_engine(None)
        try:
            if as_svg:
                figure.savefig(path, metadata={"Date": None})
            else:
                figure.savefig(path, dpi=look.dpi, metadata={"Software": None}, pil_kwargs={"optimize": True})
        except OSError as error:
            raise PictureError(f"{path}: cannot be written ({error.strerror or error})") from error


def heading(figure: Figure, look: Look, title: str, span_ns: tuple[int, int], *details: str) -> None:
    """Write the title and a line with the time span, UTC (the date once if it is the same), and `details`."""
    first, last = (clock(time_ns) for time_ns in span_ns)
    when = f"{first} to {last[11:] if last[:10] == first[:10] else last} UTC"
    figure.suptitle(look.title or title, x=0.012, y=0.995, ha="left", va="top", fontsize=11.5, fontweight="bold")
    height = figure.get_figheight()
    text = "   ·   ".join(filter(None, (when, *details)))
    figure.text(0.012, 1 - 0.27 / height, text, ha="left", va="top", color=GREY)
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(rect=(0.006, 0.006, 0.988, 1 - 0.48 / height - 0.006))


def place_text(channel: Channel) -> str:
    """Quantity, location and direction of a channel, in words."""
    return f"{channel.quantity.replace('_', ' ')}, {channel.location}, {channel.way}"


def frame_plane(axes: Axes, names: tuple[str, str], unit: str, text: str) -> None:
    """Give the axes y and z one scale, label them with names of sensors or of `planes_of`, and write a text inside."""
    for axis, way, name in zip((axes.xaxis, axes.yaxis), "yz", names, strict=True):
        axis.set_label_text(f"{name if ' of ' in name else f'{way}: {name}'}, {unit}")
    axes.axhline(0, color=GREY, linewidth=0.6)
    axes.axvline(0, color=GREY, linewidth=0.6)
    axes.set_aspect("equal")
    axes.text(
        0.02, 0.985, text, transform=axes.transAxes, ha="left", va="top", fontsize=8, color=INK, bbox=PLATE, zorder=6
    )


def rotation_text(direction: int) -> str:
    """Sense of rotation in words, as seen with y to the right and z up."""
    return "rotation " + ("y to z, counter-clockwise here ↺" if direction > 0 else "z to y, clockwise here ↻")


def rpm(speed_rad_s: float) -> str:
    """Speed in words."""
    if not np.isfinite(speed_rad_s):
        return "speed not measured"
    return f"{abs(speed_rad_s) * 30 / np.pi:.0f} rpm"


def speeds_text(speed_rad_s: FloatArray) -> str:
    """Range of speeds in words."""
    low, high = float(np.min(np.abs(speed_rad_s))), float(np.max(np.abs(speed_rad_s)))
    return rpm(low) if not np.isfinite(low) or high - low < 0.005 * high else f"{rpm(low)} to {rpm(high)}"


def along_path(speed_rad_s: FloatArray, time_ns: npt.NDArray[np.int64]) -> tuple[FloatArray, str]:
    """Labels of the points of a path and their unit: speeds if the speed changes, else times after the start."""
    if np.isfinite(speed_rad_s).all() and not steady(speed_rad_s):
        return np.abs(speed_rad_s) * 30 / np.pi, "speed, rpm"
    seconds = (time_ns - time_ns[0]) / 1e9
    unit, length = next((unit, length) for unit, length in _UNITS if seconds[-1] >= 2 * length or length == 1)
    return seconds / length, f"time after the start, {unit}"


def spread_marks(along: FloatArray, places: npt.NDArray[Any], apart: float) -> list[int]:
    """Indices of points to be labelled: the ends, and points nearest to round values of `along`, at least `apart`."""
    step = next(one for one in _ROUND if np.ptp(along) / one <= _MOST_MARKS)
    off = np.abs(along - step * np.round(along / step))
    passed = [int(at) for at in np.flatnonzero(np.diff(np.floor(along / step)))]
    chosen: list[int] = []
    for at in (0, along.size - 1, *(at + int(np.argmin(off[at : at + 2])) for at in passed)):
        if all(abs(places[at] - places[one]) > apart for one in chosen):
            chosen.append(at)
    return chosen


def as_dates(time_ns: npt.NDArray[np.int64]) -> FloatArray:
    """Nanoseconds since 1970 as matplotlib dates."""
    counted = date2num(time_ns.astype("datetime64[ns]"))  # type: ignore[no-untyped-call]  # stub without types
    return np.asarray(counted, dtype=np.float64)


def as_date(time_ns: int) -> float:
    """Nanoseconds since 1970 as a matplotlib date."""
    return float(as_dates(np.array([time_ns], dtype=np.int64))[0])


def time_axis(axes: Axes, *, vertical: bool = False) -> None:
    """Label an axis with UTC clock times."""
    axis = axes.yaxis if vertical else axes.xaxis
    locator = AutoDateLocator(tz="UTC", minticks=4, maxticks=9)  # type: ignore[no-untyped-call]  # stub without types
    axis.set_major_locator(locator)
    axis.set_major_formatter(ConciseDateFormatter(locator, tz="UTC", show_offset=not vertical))  # type: ignore[no-untyped-call]
    axis.set_label_text("time, UTC")


def skip_gaps(axes: Axes, end_ns: npt.NDArray[np.int64], longest_ns: int) -> bool:
    """Narrow the gaps between times that are longer than `longest_ns` to grey bands, if they take most of the axis.

    So recordings of a few minutes that are days apart stay readable; each is labelled with its beginning. Returns
    whether there are such gaps.
    """
    ends = np.flatnonzero(np.diff(end_ns) > longest_ns)
    if not ends.size or np.diff(end_ns)[ends].sum() < np.ptp(end_ns) / 2:
        return False
    first, last = axes.get_xlim()
    knots = np.concatenate([[first], as_dates(end_ns[np.sort([*ends, *(ends + 1)])]), [last]])
    widths = np.diff(knots)
    widths[1::2] = _GAP_WIDTH * widths[::2].sum()
    places = np.append(0.0, np.cumsum(widths))
    axes.set_xscale(
        "function", functions=(lambda t: np.interp(t, knots, places), lambda u: np.interp(u, places, knots))
    )
    begins = knots[::2][:: math.ceil(len(knots) / 2 / _MOST_BEGINS)]
    axes.set_xticks(begins, [f"{num2date(at):%H:%M\n%d %b %Y}" for at in begins])  # type: ignore[no-untyped-call]
    for panel in axes.get_shared_x_axes().get_siblings(axes):
        for begin, end in zip(knots[1:-1:2], knots[2:-1:2], strict=True):
            panel.axvspan(begin, end, color=SKIPPED, linewidth=0)
    return True


def alarm_text(alarm: AlarmEventData) -> str:
    """An alarm event in two words."""
    return f"{alarm.name} cleared" if alarm.kind == "cleared" else f"{alarm.severity} {alarm.name}"


def alarm_lines(axes: Axes, alarms: Iterable[AlarmEventData], *, vertical: bool = False) -> None:
    """Draw a line at each alarm event: solid if raised or escalated, dashed if cleared."""
    for alarm in sorted(alarms, key=lambda event: event.severity):  # danger is drawn over alert
        at = as_date(alarm.time_ns)
        colour = SEVERITY_COLOURS.get(alarm.severity, INK)
        dashes = "--" if alarm.kind == "cleared" else "-"
        if not vertical:
            axes.axvline(at, color=colour, linewidth=1.3, linestyle=dashes, zorder=1.5)
            continue
        axes.axhline(at, color=colour, linewidth=1.3, linestyle=dashes, zorder=250)  # over the lines of a cascade
        axes.annotate(
            alarm_text(alarm), (0.0, at), xycoords=("axes fraction", "data"), xytext=(4, 3),
            textcoords="offset points", fontsize=8, color=INK, zorder=251, bbox=PLATE,
        )  # fmt: skip
