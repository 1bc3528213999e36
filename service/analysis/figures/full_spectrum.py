"""Picture of a full spectrum: forward precession to the right, reverse to the left."""

from functools import partial

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from service.analysis.figures.spectrum import Lines
from service.analysis.figures.style import COLOURS, INK, Look, Paint, heading, rpm
from service.analysis.orbit import recorded_pairs
from service.analysis.recorded import Recorded
from service.analysis.spectrum import FullSpectrum, lowest_hz, read_full_spectrum

_ORDERS = (1, 2)


def full_spectrum(data: Recorded, place: str | None, lines: Lines, *, orders: bool) -> Paint:
    """Forward and reverse components of pairs of probes in the latest seconds."""
    pairs = recorded_pairs(data, place)
    found = read_full_spectrum(data, pairs, lines.window_s, lines.resolution_hz, orders=orders)
    return partial(_paint, found, data.name, lines)


def _paint(found: FullSpectrum, name: str, lines: Lines, look: Look) -> Figure:
    count = len(found.pairs)
    figure = Figure(figsize=look.size_in or (9.5, 1.2 + 2.4 * count), layout="constrained")
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    known = bool(np.isfinite(found.speed_rad_s))
    to = found.useful
    if lines.to_hz is not None:
        to = lines.to_hz / (abs(found.speed_rad_s) / (2 * np.pi)) if found.orders else lines.to_hz
    shown = np.abs(found.lines) <= to * (1 + 1e-9)
    clear = shown & (np.abs(found.lines) >= lowest_hz(found.resolution) * (1 - 1e-9))
    for axes, pair, values in zip(panels, found.pairs, found.values_um, strict=True):
        axes.plot(found.lines[shown], np.where(clear, values, np.nan)[shown], color=COLOURS[0], linewidth=0.9)
        top = float(values[clear].max()) or 1.0
        axes.axvline(0, color=INK, linewidth=0.8)
        axes.set_title(f"{pair[0].location}   {' and '.join(one.name for one in pair)}", fontweight="bold")
        axes.set_ylabel("µm p-p")
        if lines.log:
            axes.set_yscale("log")
            axes.set_ylim(max(float(values[clear & (values > 0)].min(initial=top)), 1e-4 * top) * 0.7, 2.5 * top)
        else:
            axes.set_ylim(0, 1.22 * top)
        _sides(axes, known=known)
        _marks(axes, found, values, shown)
    panels[-1].set_xlim(-to, to)
    panels[-1].set_xlabel("order" if found.orders else "frequency, Hz")
    text = f"{found.resolution:.3g} {'orders' if found.orders else 'Hz'}, Hann, {found.averages} averages"
    heading(figure, look, f"{name}: full spectrum", (found.start_ns, found.end_ns), rpm(found.speed_rad_s), text)
    return figure


def _sides(axes: Axes, *, known: bool) -> None:
    """Without the shaft angle nobody knows which way it turns, and so not what is forward."""
    for at, side, text in (
        (0.01, "left", "reverse" if known else "z to y"),
        (0.99, "right", "forward" if known else "y to z"),
    ):
        axes.text(at, 0.97, text, transform=axes.transAxes, ha=side, va="top", color=INK, fontstyle="italic")


def _marks(axes: Axes, found: FullSpectrum, values: np.ndarray, shown: npt.NDArray[np.bool_]) -> None:
    """Lines at running speed and twice that on either side, with the height there."""
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
            axes.axvline(sign * order * turns, color=COLOURS[1], linewidth=0.9, linestyle=(0, (3, 2)), zorder=1)
            axes.annotate(
                f"{'−' if sign < 0 else ''}{order}×", (sign * order * turns, 1.0), xycoords=("data", "axes fraction"),
                xytext=(3, -2), textcoords="offset points", ha="left", va="top", fontsize=8, color=COLOURS[1],
            )  # fmt: skip
            heights.append(f"{values[near].max():.3g}")
        if len(heights) == 2:
            texts.append(f"{order}× forward {heights[1]}, reverse {heights[0]} µm p-p")
    axes.set_title("     ".join(texts), loc="right", color=COLOURS[1])
