"""Pictures of the healthy recordings themselves: spectra of every channel, speed and level over time."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from models.commissioning.healthy import HealthyRecording, foreign_lines
from models.diagnosis.window.lines import Line
from models.diagnosis.window.statistics import WindowStatistics, window_statistics
from models.signals.block import FloatArray
from simulator.commission.plots import BAND, COLOURS, GREY, INK, WIDTH_IN
from simulator.commission.verdict import channel_text, channel_unit

_PANEL_IN = 1.6
_STYLES = ("-", "--", ":")
_BEYOND_BAND = 0.04
_NEAR, _LINE = 0.04, 0.003  # of the width of the picture: speeds that share a mark, and a mark that is drawn as a line
_PLACES = ("y1", "z1", "y2", "z2", "psi", "phi")
_ORDERS = ("", "dot", "ddot")
_RPM = 30 / np.pi


@dataclass(frozen=True, slots=True)
class Portrait:
    """What the pictures show of one recording."""

    number: int  # its number on the page, from 1
    statistics: WindowStatistics  # of all its hops
    density: FloatArray  # (n_bins, n), amplitude spectral density with the rotation in it, one-sided, SI/√Hz
    time_s: FloatArray  # (n_hops,), middle of each hop from the beginning of the recording
    broken: np.ndarray[tuple[int], np.dtype[np.bool_]]  # (n_hops,), whether a gap lies before the hop
    lines: tuple[Line, ...]  # steady lines that do not belong to the rotation

    @property
    def speed_hz(self) -> float:
        """Mean speed, NaN if unknown."""
        return self.statistics.speed_rad_s / (2 * np.pi)

    @property
    def levels(self) -> FloatArray:
        """Rms of the random part hop by hop, shape (n_hops, n), SI."""
        powers = np.diagonal(self.statistics.hop_correlation[:, 0], axis1=1, axis2=2)
        return np.asarray(np.sqrt(np.maximum(powers, 0.0)), dtype=np.float64)


def portrait(number: int, recording: HealthyRecording) -> Portrait | None:
    """Statistics of a whole recording; None if it holds no usable data."""
    hops = recording.hops
    if not hops:
        return None
    statistics = window_statistics(recording.plan, hops, lagged=False).as_mounted
    n = len(recording.plan.states)
    every = np.concatenate([hop.segments[:, :, :n] for hop in hops], dtype=np.complex128)
    if recording.plan.equaliser is not None:
        every /= recording.plan.equaliser.response(recording.plan.frequencies_hz)
    power = np.mean(np.abs(every) ** 2, axis=0)
    starts = np.array([hop.start_ns for hop in hops], dtype=np.int64)
    broken = np.zeros(len(hops), dtype=np.bool_)
    broken[np.cumsum([len(stretch) for stretch in recording.stretches])[:-1]] = True
    density = np.asarray(np.sqrt(2 * power), dtype=np.float64)
    time_s = (starts - starts[0]) / 1e9 + recording.plan.hop / recording.plan.rate_hz / 2
    return Portrait(number, statistics, density, time_s, broken, foreign_lines(recording))


def ordered(states: Iterable[str]) -> list[str]:
    """Bearing before disc, displacement before velocity, the two planes side by side."""

    def rank(state: str) -> tuple[int, int, int]:
        place, _, ending = state.partition("_")
        at = _number(place)
        return at // 2, _ORDERS.index(ending), at % 2

    return sorted(states, key=rank)


def _number(place: str) -> int:
    """Rank by place and plane; sensors at an angle rank as those in the nearer plane."""
    location, at, angle_deg = place.partition("@")
    if not at:
        return _PLACES.index(place)
    return (0 if location == "bearing" else 2) + (float(angle_deg) % 180 >= 90)


def draw_spectra(portraits: Sequence[Portrait]) -> Figure:
    """Draw the spectra of every channel, each with all recordings, at least one."""
    states = ordered(portraits[0].statistics.states)
    columns = min(2, len(states))
    rows = -(-len(states) // columns)
    figure = Figure(figsize=(WIDTH_IN, 0.6 + _PANEL_IN * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for axes, state in zip(panels, states, strict=False):
        _spectrum(axes, state, portraits)
    for axes in panels[len(states) :]:
        axes.set_visible(False)
    for axes in panels[max(0, len(states) - columns) : len(states)]:
        axes.xaxis.set_tick_params(labelbottom=True)
    figure.supxlabel("frequency, Hz", fontsize=9)
    if len(portraits) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=min(6, len(portraits)))
    return figure


def _spectrum(axes: Axes, state: str, portraits: Sequence[Portrait]) -> None:
    unit, scale = channel_unit(state)
    frequencies = portraits[0].statistics.frequencies_hz
    axes.axvspan(float(frequencies[0]), float(frequencies[-1]), facecolor=BAND, edgecolor="none", zorder=0)
    for one in portraits:
        column = one.statistics.states.index(state)
        density = scale * one.density[:, column]
        if density.max() > 0:
            axes.semilogy(frequencies, density, label=f"recording {one.number}", **_line(one.number))
    _mark_rotation(axes, portraits, float(frequencies[-1]))
    for one in portraits:
        for line in one.lines:
            if line.state == state:
                axes.annotate(
                    f"{line.frequency_hz:.1f} Hz", (line.frequency_hz, 1), xycoords=("data", "axes fraction"),
                    xytext=(3, -11), textcoords="offset points", ha="left", va="top", fontsize=8, color=COLOURS[1],
                )  # fmt: skip
    axes.set_xlim(0, float(frequencies[-1]) * (1 + _BEYOND_BAND))
    axes.set_title(channel_text(state))
    axes.set_ylabel(f"{unit}/√Hz")


def _line(number: int) -> dict[str, str | float]:
    at = number - 1
    style = _STYLES[at // len(COLOURS) % len(_STYLES)]
    return {"color": COLOURS[at % len(COLOURS)], "linestyle": style, "linewidth": 0.9}


def _mark_rotation(axes: Axes, portraits: Sequence[Portrait], highest_hz: float) -> None:
    """Mark once and twice the speed: by a line, or a stripe for speeds that are near each other."""
    speeds = sorted(one.speed_hz for one in portraits if np.isfinite(one.speed_hz))
    groups: list[list[float]] = []
    for speed in speeds:
        if groups and speed - groups[-1][-1] < _NEAR * highest_hz:
            groups[-1].append(speed)
        else:
            groups.append([speed])
    for low, high in ((order * group[0], order * group[-1]) for group in groups for order in (1, 2)):
        if high - low < _LINE * highest_hz:
            axes.axvline((low + high) / 2, color=GREY, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1)
        else:
            axes.axvspan(low, high, facecolor=GREY, alpha=0.3, edgecolor="none", zorder=1)
    labels = [(order, order * group[-1]) for group in groups for order in ((1, 2) if len(groups) == 1 else (1,))]
    for order, at_hz in labels:
        if at_hz < highest_hz:
            axes.annotate(
                f"{order}×", (at_hz, 1), xycoords=("data", "axes fraction"), xytext=(2, -1),
                textcoords="offset points", ha="left", va="top", fontsize=8, color=INK,
            )  # fmt: skip


def draw_levels(portraits: Sequence[Portrait]) -> Figure:
    """Draw speed and level of random vibration hop by hop, the recordings, at least one, one after the other."""
    speeds_known = any(np.isfinite(one.statistics.hop_speed_rad_s).any() for one in portraits)
    heights = [1.0, 1.8] if speeds_known else [1.8]
    figure = Figure(figsize=(WIDTH_IN, 0.7 + 1.4 * sum(heights)), layout="constrained")
    panels = figure.subplots(len(heights), 1, squeeze=False, sharex=True, height_ratios=heights)[:, 0]
    states = ordered(portraits[0].statistics.states)
    columns = [portraits[0].statistics.states.index(state) for state in states]
    reference = np.median(np.concatenate([one.levels for one in portraits]), axis=0)
    total_s = sum(float(one.time_s[-1]) for one in portraits)
    unit_s, unit = (60.0, "min") if total_s > 300 else (1.0, "s")
    space_s = 0.02 * total_s
    start_s = 0.0
    for one in portraits:
        half_s = float(one.time_s[0])
        x = (start_s + one.time_s) / unit_s
        if start_s:
            for axes in panels:
                axes.axvline((start_s - space_s / 2) / unit_s, color=GREY, linewidth=0.7, linestyle=":")
        if len(portraits) > 1:
            panels[0].annotate(
                str(one.number), (float(x[0] + x[-1]) / 2, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2),
                textcoords="offset points", ha="center", va="bottom", fontsize=8, color=INK,
            )  # fmt: skip
        if speeds_known:
            rpm = _RPM * one.statistics.hop_speed_rad_s
            panels[0].plot(*_pieces(x, rpm, one.broken), color=INK, marker=".", markersize=3)
        for state, column in zip(states, columns, strict=True):
            ratio = one.levels[:, column] / max(float(reference[column]), np.finfo(float).tiny)
            panels[-1].plot(*_pieces(x, ratio, one.broken), label=channel_text(state), **_channel_line(state))
        start_s += float(one.time_s[-1]) + half_s + space_s
    if speeds_known:
        rpm = _RPM * np.concatenate([one.statistics.hop_speed_rad_s for one in portraits])
        low, high = float(np.nanmin(rpm)), float(np.nanmax(rpm))
        middle, reach = (low + high) / 2, (high - low) / 2
        reach = max(1.2 * reach, 0.01 * abs(middle), 0.1)  # a steady speed must look steady
        panels[0].set_ylabel("speed, rpm")
        panels[0].set_ylim(middle - reach, middle + reach)
    ratios = np.concatenate([one.levels for one in portraits]) / np.maximum(reference, np.finfo(float).tiny)
    seen = ratios[np.isfinite(ratios) & (ratios > 0)]
    low, high = (float(seen.min()), float(seen.max())) if seen.size else (1.0, 1.0)
    panels[-1].set_ylabel("level (rms) over its median")
    panels[-1].set_yscale("log", base=2)
    panels[-1].set_ylim(min(0.45, low / 1.2), max(2.2, high * 1.2))
    panels[-1].yaxis.set_major_formatter(lambda value, _: f"{value:g}×")
    panels[-1].set_xlabel(f"time from the beginning of each recording, one after the other, {unit}")
    handles, labels = panels[-1].get_legend_handles_labels()
    kept = dict(zip(labels, handles, strict=True))
    figure.legend(kept.values(), kept.keys(), loc="outside lower left", ncols=3, fontsize=8)
    return figure


def _pieces(
    x: FloatArray, y: FloatArray, broken: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> tuple[FloatArray, FloatArray]:
    """The same points with NaN inserted wherever data are missing, which breaks the line there."""
    at = np.flatnonzero(broken)
    return np.insert(x, at, np.nan), np.insert(y, at, np.nan)


def _channel_line(state: str) -> dict[str, str | float]:
    place, _, ending = state.partition("_")
    line = {"color": COLOURS[_number(place)], "linestyle": _STYLES[_ORDERS.index(ending)]}
    return {**line, "marker": ".", "markersize": 3, "linewidth": 1.0}
