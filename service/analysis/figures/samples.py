"""Pictures of samples: waveforms over time, and orbits, unfiltered and at 1x, both with keyphasor pulses marked."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from models.errors import MachineFileError, RotorwatchError
from models.signals.channels import Channel
from service.analysis.figures.style import COLOURS, GREY, Look, frame_plane, heading, place_text, rotation_text, rpm
from service.analysis.orbit import Orbit, Orbits, phase_lag_deg, read_orbits
from service.analysis.recorded import Recorded
from service.analysis.revolutions import pulses
from service.analysis.spectrum import unit_shown

_REVOLUTIONS = 8
_USUAL_S = 0.5
_SOON_S = 10.0
_BLANK = 0.07
"""Gap before the keyphasor dot, as a fraction of the ellipse's long axis."""


def waveform(look: Look, data: Recorded, names: Sequence[str], window_s: float | None) -> Figure:
    """The latest samples of channels, each about its mean; without `window_s`, over 8 revolutions."""
    channels = data.chosen(names)
    length_s = window_s or _usual_s(data, channels)
    found = data.latest(channels, length_s + _SOON_S)
    if not found:
        raise RotorwatchError(f"{data.place}: no sample blocks of {data.name} in this stretch of time")
    if length_s * found[-1].rate_hz < 2:
        raise MachineFileError(
            f"--window is {length_s:g} s, expected at least {2 / found[-1].rate_hz:g} s, two samples"
        )
    begin_ns = found[-1].end_ns - round(length_s * 1e9)
    cut = [one.part(max(0, round((begin_ns - one.start_ns) / 1e9 * one.rate_hz)), len(one.samples)) for one in found]
    found = [one for one in cut if len(one.samples)]
    figure = Figure(figsize=look.size_in or (9.5, 1.3 + 1.6 * len(channels)), layout="constrained")
    panels = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    start_ns = found[0].start_ns
    everything = np.concatenate([stretch.samples for stretch in found])
    scale, unit = (1e3, "ms") if (found[-1].end_ns - start_ns) / 1e9 < 2 else (1.0, "s")
    for number, (axes, channel) in enumerate(zip(panels, channels, strict=True)):
        shown, factor = unit_shown(channel)
        mean = float(everything[:, number].mean())
        for stretch in found:
            values = factor * (stretch.samples[:, number] - mean)
            begin = (stretch.start_ns - start_ns) / 1e9
            axes.plot(scale * (begin + np.arange(values.size) / stretch.rate_hz), values, color=COLOURS[0], lw=0.9)
            at = pulses(stretch.angle_rad)[1]
            axes.plot(
                scale * (begin + at / stretch.rate_hz), np.interp(at, np.arange(values.size), values), "o",
                color=COLOURS[1], markersize=5, markeredgecolor="white", markeredgewidth=0.6,
            )  # fmt: skip
        axes.axhline(0, color=GREY, linewidth=0.6)
        axes.set_title(f"{channel.name}   {place_text(channel)}", fontweight="bold")
        across, rms = factor * np.ptp(everything[:, number]), factor * np.std(everything[:, number])
        axes.set_title(
            f"{across:.4g} {shown} pp     {rms:.3g} {shown} rms     about a mean of {factor * mean:.4g} {shown}",
            loc="right", color=GREY,
        )  # fmt: skip
        axes.set_ylabel(shown)
    panels[-1].set_xlim(0, scale * (found[-1].end_ns - start_ns) / 1e9)
    panels[-1].set_xlabel(f"time, {unit}")
    if any(pulses(stretch.angle_rad)[1].size for stretch in found):
        pulse = Line2D([], [], marker="o", linestyle="", color=COLOURS[1], label="keyphasor pulse")
        figure.legend(handles=[pulse], loc="outside lower center")
    lengths = [stretch.length_s for stretch in found]
    speed_rad_s = float(np.average([stretch.speed_rad_s for stretch in found], weights=lengths))
    span, text = (start_ns, found[-1].end_ns), f"{found[0].rate_hz:g} samples per second"
    heading(figure, look, f"{data.name}: waveform", span, rpm(speed_rad_s), text)
    return figure


def _usual_s(data: Recorded, channels: Sequence[Channel]) -> float:
    """Duration of 8 revolutions, or 0.5 s if fewer than two keyphasor pulses are found."""
    marked = [pulses(stretch.angle_rad)[1] / stretch.rate_hz for stretch in data.latest(channels[:1], _SOON_S)[-1:]]
    if not marked or marked[0].size < 2:
        return _USUAL_S
    return _REVOLUTIONS * float(marked[0][-1] - marked[0][-2])


def orbit(look: Look, data: Recorded, revolutions: int) -> Figure:
    """Orbits of the latest revolutions, a row for each location: unfiltered, and 1×."""
    found = read_orbits(data, revolutions)
    rows = len(found.orbits)
    figure = Figure(figsize=look.size_in or (7.6, 1.0 + 4.2 * rows), layout="constrained")
    for row, orbit in zip(figure.subplots(rows, 2, squeeze=False), found.orbits, strict=True):
        _raw(row[0], orbit)
        _running_speed(row[1], orbit, found)
    text = "keyphasor pulse (on 1×, the gap comes before it)"
    pulse = Line2D([], [], marker="o", linestyle="", color=COLOURS[1], label=text)
    figure.legend(handles=[pulse], loc="outside lower center")
    span, title = (found.start_ns, found.end_ns), f"{data.name}: orbits of {found.revolutions} revolutions"
    heading(figure, look, title, span, rpm(found.speed_rad_s), rotation_text(found.direction))
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
    frame_plane(axes, orbit.names, "µm", "\n".join(lines))
    reach = 1.12 * max(float(np.max(np.abs(path))), 1e-6)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, 1.35 * reach)
