"""Picture of waveforms: samples over time, with keyphasor pulses marked."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from models.errors import MachineFileError, RotorwatchError
from models.signals.channels import Channel
from service.analysis.figures.style import COLOURS, GREY, Look, Paint, heading, place_text, rpm
from service.analysis.recorded import Recorded
from service.analysis.revolutions import Excerpt, pulses
from service.analysis.spectrum import unit_shown

_REVOLUTIONS = 8
_USUAL_S = 0.5
_SOON_S = 10.0


def waveform(data: Recorded, channels: Sequence[str], window_s: float | None) -> Paint:
    """The latest samples of channels; without `window_s`, over 8 revolutions."""
    chosen = data.chosen(channels)
    length_s = window_s or _usual_s(data, chosen)
    found = data.latest(chosen, length_s + _SOON_S)
    if not found:
        raise RotorwatchError(f"{data.place}: no sample blocks of {data.name} in this stretch of time")
    if length_s * found[-1].rate_hz < 2:
        raise MachineFileError(
            f"--window is {length_s:g} s, expected at least {2 / found[-1].rate_hz:g} s, two samples"
        )
    begin_ns = found[-1].end_ns - round(length_s * 1e9)
    cut = [one.part(max(0, round((begin_ns - one.start_ns) / 1e9 * one.rate_hz)), len(one.samples)) for one in found]
    return partial(_paint, [one for one in cut if len(one.samples)], chosen, data.name)


def _usual_s(data: Recorded, chosen: Sequence[Channel]) -> float:
    """Duration of 8 revolutions, or 0.5 s if fewer than two keyphasor pulses are found."""
    marked = [pulses(stretch.angle_rad)[1] / stretch.rate_hz for stretch in data.latest(chosen[:1], _SOON_S)[-1:]]
    if not marked or marked[0].size < 2:
        return _USUAL_S
    return _REVOLUTIONS * float(marked[0][-1] - marked[0][-2])


def _paint(found: Sequence[Excerpt], channels: Sequence[Channel], name: str, look: Look) -> Figure:
    """Draw a panel for each channel, with the mean subtracted and stated in the title."""
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
            f"{across:.4g} {shown} p-p     {rms:.3g} {shown} rms     about a mean of {factor * mean:.4g} {shown}",
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
    heading(figure, look, f"{name}: waveform", span, rpm(speed_rad_s), text)
    return figure
