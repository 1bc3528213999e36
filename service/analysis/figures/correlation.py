"""Picture of correlation functions: measured and predicted by the networks, with the residual below."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from models.errors import MachineFileError
from service.analysis.correlation import Panel, correlations_of, latest_window
from service.analysis.figures.style import COLOURS, GREY, INK, Look, heading, rpm
from service.analysis.recorded import Recorded
from service.recordings.replay.offline import choose_machine


def correlation(look: Look, data: Recorded, choice: str | None) -> Figure:
    """Correlation functions of the latest window, with the shipped machine file or ``FILE[@BUNDLE]``.

    There are two panels for each equation.
    """
    installed = choose_machine(data.keys, choice)
    machine, bundle = installed.known, installed.bundle
    if machine is None or bundle is None:
        raise MachineFileError(
            "correlations are compared with what trained networks predict: name a bundle that has networks, as "
            "--machine FILE@BUNDLE (one that was commissioned without the rotor's parameters has none)"
        )
    window = latest_window(data, machine)
    panels = correlations_of(window, machine, bundle)
    figure = Figure(figsize=look.size_in or (11.0, 8.4))
    figure.set_layout_engine("constrained", h_pad=0.03, hspace=0.0)
    rows = (len(panels) + 1) // 2
    grid = figure.add_gridspec(3 * rows - 1, 2, height_ratios=([2.2, 1.0, 0.1] * rows)[:-1])
    for number, panel in enumerate(panels):
        row, column = 3 * (number // 2), number % 2
        upper = figure.add_subplot(grid[row, column])
        upper.set_title(f"({panel.reading.equation})  {panel.reading.title}", fontweight="bold")
        if panel.curves:
            _curves(upper, figure.add_subplot(grid[row + 1, column], sharex=upper), panel)
            continue
        upper.set_axis_off()
        text = f"not evaluable\n{panel.reading.reason}"
        upper.text(0.5, 0.5, text, transform=upper.transAxes, ha="center", va="center", color=GREY, wrap=True)
    figure.legend(
        handles=[
            Line2D([], [], color=INK, linewidth=3.2, alpha=0.35, label="measured in the window"),
            Line2D([], [], color=INK, linewidth=1.2, linestyle=(0, (3, 1.5)), label="network's prediction"),
        ],
        loc="outside lower center",
        ncols=2,
    )
    title, span = f"{data.name}: correlations against the networks' prediction", (window.start_ns, window.end_ns)
    heading(figure, look, title, span, rpm(window.speed_rad_s), f"networks {bundle.identity}")
    return figure


def _curves(upper: Axes, lower: Axes, panel: Panel) -> None:
    factor, x_label = (1e3, "lag, ms") if panel.over == "lag" else (180 / np.pi, "shaft angle, °")
    x = panel.x * factor
    for number, curve in enumerate(panel.curves):
        colour = COLOURS[number]
        label = f"i = {curve.label}" if panel.over == "lag" else curve.label
        upper.plot(x, curve.measured, color=colour, linewidth=3.2, alpha=0.4, label=label)
        upper.plot(x, curve.predicted, color=colour, linewidth=1.2, linestyle=(0, (3, 1.5)))
        lower.plot(x, curve.residual, color=colour, linewidth=1.2)
    upper.legend(loc="upper right", ncols=len(panel.curves), fontsize=8, handlelength=1.3)
    low, high = upper.get_ylim()
    upper.set_ylim(low, high + 0.22 * (high - low))  # room for the legend
    upper.set_ylabel(f"{panel.target} / its rms")
    upper.tick_params(labelbottom=False)
    lower.axhline(0, color=GREY, linewidth=0.8)
    lower.set_ylabel("residual")
    lower.set_xlabel(x_label)
    reading = panel.reading
    reach = max(float(np.max(np.abs(curve.residual))) for curve in panel.curves)
    text = f"MSD {reading.msd:.3g}"
    if reading.msd_healthy is not None:
        healthy = float(np.sqrt(reading.msd_healthy))
        lower.axhspan(-healthy, healthy, color=COLOURS[2], alpha=0.18, linewidth=0)
        reach = max(reach, 1.5 * healthy)
        text += f", healthy {reading.msd_healthy:.3g} (band: ± its root)"
    lower.set_ylim(-1.15 * reach, 1.6 * reach)
    lower.text(0.01, 0.96, text, transform=lower.transAxes, ha="left", va="top", fontsize=8, color=INK)
    if panel.over == "angle":
        lower.set_xlim(0, 360)
        lower.set_xticks(np.arange(0, 361, 90))
