"""Figures of the paper's study, after its Figs. 4-7."""

from io import BytesIO
from pathlib import Path

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from models.physics.excitation import unit_spectrum
from models.signals.block import FloatArray
from simulator.campaigns.study import REALISATIONS, Realisation, Study, StudyCell
from simulator.campaigns.study_windows import CONDITIONS, EQUATIONS, own_equations

__all__ = ["COLOURS", "MARKERS", "METHOD_TEXT", "STYLE", "draw_study", "save_figure"]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""After Okabe and Ito: told apart with any colour vision."""
MARKERS = ("o", "s", "^", "D", "v", "P")
STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.hashsalt": "rotorwatch",  # the same numbers make the same file
}

METHOD_TEXT = {
    "paper": "as printed",
    "relation": "equations' networks",
    "network": "amortised networks",
    "likelihood": "likelihood",
}
REALISATION_TEXT = {"shared": "shared realisations", "independent": "independent realisations"}


def draw_study(study: Study, folder: Path) -> list[Path]:
    """Draw all figures into a folder; returns their paths.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]  # the stub wants literal keys
        return [
            save_figure(_excitation(study), folder / "reproduction-excitation.svg"),
            *(
                save_figure(_deviations(study, realisation), folder / f"reproduction-msd-{realisation}.png")
                for realisation in REALISATIONS
            ),
            save_figure(_location(study), folder / "reproduction-location.png"),
            save_figure(_noise(study), folder / "reproduction-noise.png"),
        ]


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure without a time stamp in it."""
    if path.suffix == ".svg":
        figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
    else:
        drawn = BytesIO()
        figure.savefig(drawn, format="png", dpi=130, bbox_inches="tight")
        with Image.open(drawn) as image:  # few colours, few bytes
            image.convert("RGB").quantize(48, dither=Image.Dither.NONE).save(path, optimize=True)
    return path


def _excitation(study: Study) -> Figure:
    """Fig. 4: how the force is distributed over frequency."""
    figure = Figure(figsize=(5.2, 2.9))
    axes = figure.subplots()
    frequency = np.linspace(1, 400, 800)
    for n, (cutoff, force) in enumerate(study.force_rms_N.items()):
        density = force**2 * 2 * unit_spectrum(frequency, float(cutoff))
        axes.semilogy(frequency, density, color=COLOURS[n], label=f"cutoff {cutoff} Hz, {force:.3g} N rms")
    axes.axvline(study.speed_rpm / 60, color="#888888", linewidth=0.8, linestyle=":")
    axes.annotate(
        "1×", (study.speed_rpm / 60, 1), xycoords=("data", "axes fraction"), ha="center", va="bottom", color="#555555"
    )
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel("force density, N²/Hz")
    axes.legend(fontsize=8)
    return figure


def _deviations(study: Study, realisation: Realisation) -> Figure:
    """Figs. 5 and 6: MSD of every equation's network over the cutoff, for every fault condition."""
    figure = Figure(figsize=(9.6, 7.6), layout="constrained")
    panels = figure.subplots(3, 3, sharex=True, sharey=True)
    for axes, condition in zip(panels.ravel(), CONDITIONS, strict=True):
        cells = study.cells(realisation, condition.number)
        own = own_equations(condition)
        for n, equation in enumerate(EQUATIONS):
            ratios = [_over_limit(study, cell, equation) for cell in cells]
            _interval(axes, np.arange(len(cells)) + 0.14 * (n - 1.5), ratios, n, equation in own)
        axes.axhline(1, color="black", linewidth=0.9, linestyle="--")
        axes.set_yscale("log")
        axes.set_xticks(range(len(cells)), [f"{cell.cutoff_hz:g}" for cell in cells])
        title = "healthy" if condition.number == 0 else f"{condition.number}: {condition.name} changed by 20 %"
        axes.set_title(title, loc="left")
    figure.supxlabel("cutoff of the excitation, Hz", fontsize=9)
    figure.supylabel("MSD over the healthy limit (above 1: named)", fontsize=9)
    handles = [
        axes.plot([], [], linestyle="", marker=MARKERS[n], color=COLOURS[n], label=f"equation {equation}")[0]
        for n, equation in enumerate(EQUATIONS)
    ]
    handles.append(axes.plot([], [], "k--", linewidth=0.9, label="healthy limit")[0])
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=5,
        title=f"Networks as printed, {REALISATION_TEXT[realisation]}: median and 5-95 % of {study.windows} windows; "
        "filled: contains a changed parameter",
    )
    return figure


def _over_limit(study: Study, cell: StudyCell, equation: str) -> FloatArray:
    return np.array(cell.msd["paper"][equation]) / study.limits[cell.realisation][equation]


def _interval(
    axes: Axes,
    x: npt.NDArray[np.floating],
    values: list[FloatArray],
    n: int,
    filled: bool,
) -> None:
    low, middle, high = (np.array([np.quantile(one, q) for one in values]) for q in (0.05, 0.5, 0.95))
    axes.errorbar(
        x,
        middle,
        yerr=[middle - low, high - middle],
        color=COLOURS[n],
        marker=MARKERS[n],
        markerfacecolor=COLOURS[n] if filled else "white",
        markersize=6 if filled else 4.5,
        linestyle="",
        linewidth=1.1,
        capsize=2,
    )


def _location(study: Study) -> Figure:
    """Which equations each method names under each fault condition."""
    figure = Figure(figsize=(2.35 * len(study.methods) + 1.2, 8.2), layout="constrained")
    panels = figure.subplots(2, len(study.methods), sharey=True, squeeze=False)
    blues = LinearSegmentedColormap.from_list("share", ["#ffffff", "#0072B2"])
    for row, realisation in zip(panels, REALISATIONS, strict=True):
        for axes, method in zip(row, study.methods, strict=True):
            share = np.array(
                [
                    [study.naming(realisation, condition.number, method, equation).rate for equation in EQUATIONS]
                    for condition in CONDITIONS
                ]
            )
            axes.imshow(share, cmap=blues, vmin=0, vmax=1, aspect="auto")
            for (y, x), value in np.ndenumerate(share):
                axes.text(x, y, f"{value:.0%}", ha="center", va="center", fontsize=8, color=_ink(value))
                if EQUATIONS[x] in own_equations(CONDITIONS[y]):
                    axes.add_patch(
                        Rectangle((x - 0.46, y - 0.44), 0.92, 0.88, fill=False, edgecolor="#D55E00", linewidth=1.8)
                    )
            exact = study.exact(realisation, method)
            axes.set_title(
                f"{METHOD_TEXT[method]}\nexact in {exact.rate:.0%} ({exact.low:.0%}-{exact.high:.0%})", loc="left"
            )
            axes.set_xticks(range(len(EQUATIONS)), EQUATIONS)
            axes.set_yticks(range(len(CONDITIONS)), [condition.name for condition in CONDITIONS])
            axes.grid(visible=False)
            axes.tick_params(length=0)
        row[0].set_ylabel(REALISATION_TEXT[realisation])
    figure.supxlabel("equation named", fontsize=9)
    of = study.naming("independent", 0, "paper", "28").of
    figure.suptitle(
        f"Share of windows in which an equation is named, {of} windows per row; framed: contains a changed parameter",
        fontsize=10,
    )
    return figure


def _ink(value: float) -> str:
    return "white" if value > 0.6 else "black"


def _noise(study: Study) -> Figure:
    """Fig. 7: MSD on the healthy machine over the noise in the output."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    shown: tuple[tuple[str, Realisation], ...] = (
        ("paper", "shared"),
        ("paper", "independent"),
        ("relation", "independent"),
    )
    for axes, (method, realisation) in zip(figure.subplots(1, 3, sharey=True), shown, strict=True):
        cells = [cell for cell in study.noise if cell.realisation == realisation]
        for n, equation in enumerate(EQUATIONS):
            if all(equation in cell.msd[method] for cell in cells):
                x = np.array([100 * cell.noise_relative for cell in cells]) + 0.1 * (n - 1.5)
                _interval(axes, x, [np.array(cell.msd[method][equation]) for cell in cells], n, filled=True)
                axes.plot([], [], linestyle="", marker=MARKERS[n], color=COLOURS[n], label=f"equation {equation}")
        axes.set_yscale("log")
        axes.set_xticks([100 * cell.noise_relative for cell in cells])
        axes.set_title(f"{METHOD_TEXT[method]}, {REALISATION_TEXT[realisation]}", loc="left")
        axes.set_xlabel("coloured noise in the output, % of rms")
    figure.axes[0].set_ylabel("MSD, of the target's mean square")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure
