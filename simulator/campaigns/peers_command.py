"""What ``rotortrain peers`` does: compare with what a user would otherwise pick; numbers and a figure."""

from pathlib import Path

import matplotlib as mpl
import typer
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from models.diagnosis.networks.bundle import load_bundle
from models.machine import load_machine
from simulator.campaigns.peers_campaign import SETTINGS, Comparison, ComparisonCell, ComparisonPlan, compare
from simulator.campaigns.study_plots import COLOURS, MARKERS, METHOD_TEXT, STYLE, save_figure
from simulator.campaigns.written import writing
from simulator.training.progress import labelled_bars

__all__ = ["compare_peers", "draw_comparison"]


def compare_peers(
    name: str,
    bundle_name: str,
    out: Path,
    *,
    windows: int,
    healthy: int,
    false_alarm_rate: float,
    seed: int,
    processes: int,
) -> None:
    """Run the comparison, print it, and write numbers and figure.

    Raises
    ------
    RotorwatchError
        If machine or bundle cannot be used, a file cannot be written, or there are too few healthy windows.
    """
    machine = load_machine(name)
    plan = ComparisonPlan(machine, load_bundle(bundle_name, machine), seed, windows, healthy, false_alarm_rate)
    with labelled_bars() as progress:
        comparison = compare(plan, processes, progress)
    Console().print(_table(comparison))
    with writing(out):
        out.write_text(comparison.model_dump_json(indent=1) + "\n", encoding="utf-8")
        figure = draw_comparison(comparison, out.with_suffix(".png"))
    typer.echo(f"written: {out}, {figure}")


def draw_comparison(comparison: Comparison, path: Path) -> Path:
    """Draw detection and exact naming over the changes, for both settings."""
    methods = tuple(comparison.cells[0].methods)
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]  # the stub wants literal keys
        figure = Figure(figsize=(9.6, 9.6), layout="constrained")
        panels = figure.subplots(len(SETTINGS), 2, sharex=True, sharey=True)
        for row, setting in zip(panels, SETTINGS, strict=True):
            cells = [cell for cell in comparison.cells if cell.setting == setting]
            for axes, what in zip(row, ("detected", "exact"), strict=True):
                for n, method in enumerate(methods):
                    offset = 0.13 * (n - (len(methods) - 1) / 2)
                    for y, cell in enumerate(cells):
                        rate = getattr(cell.methods[method], what)
                        if rate is not None:
                            axes.errorbar(
                                100 * rate.rate,
                                y + offset,
                                xerr=[[100 * (rate.rate - rate.low)], [100 * (rate.high - rate.rate)]],
                                color=COLOURS[n],
                                marker=MARKERS[n],
                                markersize=5,
                                linewidth=1,
                                linestyle="",
                            )
                for border in range(1, len(cells)):
                    axes.axhline(border - 0.5, color="#dddddd", linewidth=0.6)
                axes.grid(visible=False, axis="y")
                axes.set_yticks(range(len(cells)), [_label(cell) for cell in cells])
                title = "something is said to have changed" if what == "detected" else "exactly the right set is named"
                axes.set_title(f"{setting}: {title}", loc="left")
            row[0].tick_params(length=0)
        panels[0, 0].invert_yaxis()  # shared by all
        for axes in panels[-1]:
            axes.set_xlabel("windows, %")
        handles = [
            axes.plot([], [], linestyle="", marker=MARKERS[n], color=COLOURS[n], label=METHOD_TEXT.get(method, method))[
                0
            ]
            for n, method in enumerate(methods)
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=len(methods))
        return save_figure(figure, path)


def _label(cell: ComparisonCell) -> str:
    return ", ".join(f"{name} {change:+.0%}" for name, change in cell.faults.items()) or "healthy"


def _table(comparison: Comparison) -> Table:
    methods = tuple(comparison.cells[0].methods)
    table = Table(
        "setting",
        "true change",
        *(METHOD_TEXT.get(method, method) for method in methods),
        title=f"detected (named exactly), {comparison.windows} windows per cell, "
        f"{comparison.false_alarm_rate:.2%} false alarms declared, seed {comparison.seed}",
    )
    for cell in comparison.cells:
        texts = []
        for method in methods:
            rates = cell.methods[method]
            texts.append(f"{rates.detected.rate:.0%}" + ("" if rates.exact is None else f" ({rates.exact.rate:.0%})"))
        table.add_row(cell.setting, _label(cell), *texts, end_section=cell is comparison.cells[-1])
    return table
