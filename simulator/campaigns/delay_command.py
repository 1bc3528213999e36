"""What ``rotortrain delay`` does: time the detection of step changes, and write numbers, table and figure."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from models.machine import load_machine
from simulator.campaigns.delay_study import DelayCell, DelayPlan, DelayResult, run_delay_study
from simulator.campaigns.study_plots import COLOURS, STYLE, save_figure
from simulator.campaigns.written import read_to_redraw, writing
from simulator.training.progress import labelled_bars

__all__ = ["delay_table", "draw_delays", "time_detection"]

_LAYOUTS = {"independent": "independent sources", "one_source": "one source"}


def time_detection(
    name: str, out: Path, *, trials: int, others: int, seed: int, processes: int, redraw: bool = False
) -> None:
    """Run the study, or read its numbers back, and write numbers (JSON), table (Markdown) and figure (SVG).

    Raises
    ------
    RotorwatchError
        If the machine cannot be used, numbers to redraw from are damaged, or a file cannot be written.
    """
    result = read_to_redraw(DelayResult, out) if redraw else _run(name, trials, others, seed, processes)
    table = delay_table(result)
    typer.echo(table)
    with writing(out):
        out.write_text(result.model_dump_json() + "\n", encoding="utf-8")
        out.with_suffix(".md").write_text(table, encoding="utf-8")
        figure = draw_delays(result, out.with_suffix(".svg"))
    typer.echo(f"written: {out}, {out.with_suffix('.md')}, {figure}")


def _run(name: str, trials: int, others: int, seed: int, processes: int) -> DelayResult:
    machine = load_machine(name)
    own = machine.window.hop_s
    halved = (own / 2,) if (own / machine.window.segment_s).is_integer() else ()  # a hop holds whole half segments
    plan = DelayPlan(machine, seed, trials, others, hops_s=(own, *halved))
    with labelled_bars() as progress:
        return run_delay_study(plan, processes, progress)


def delay_table(result: DelayResult) -> str:
    """Markdown: one row per cell, streams first."""
    heads = [
        "change",
        "declared rate",
        "hop, short stretches",
        "trials",
        "bound's time, fixed / this threshold",
        "delay: median, 95 %",
        "named: median, 95 %",
        "95 % delay over bound's time, fixed / this threshold",
        "within twice",
        "wrong, early",
    ]
    lines = []
    for source, layout in dict.fromkeys((cell.source, cell.layout) for cell in result.cells):
        what = "Simulated streams" if source == "stream" else "Gaussian hops at the bound"
        lines += [f"### {what}, {_LAYOUTS[layout]}", "", f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
        lines += [_line(cell) for cell in result.cells if (cell.source, cell.layout) == (source, layout)] + [""]
    return "\n".join(lines)


def _line(cell: DelayCell) -> str:
    fixed, own = float(np.median(cell.bound_fixed_s)), float(np.median(cell.bound_s))
    delays = np.array([np.inf if delay is None else delay for delay in cell.detected_s])
    within = float(np.mean(delays <= 2 * np.array(cell.bound_s))) if delays.size else np.nan
    fields = [
        f"{cell.parameter} {cell.change:+.0%}",
        f"{cell.rate} ({cell.per_month:g}/month)",
        f"{cell.hop_s:g} s, {'+'.join(f'{hops * cell.hop_s:g}' for hops in cell.short_hops)} s",
        f"{delays.size}",
        f"{fixed:.2g} / {own:.2g} s",
        f"{cell.quantile_s(0.5):.3g}, {cell.quantile_s(0.95):.3g} s",
        f"{cell.quantile_s(0.5, named=True):.3g}, {cell.quantile_s(0.95, named=True):.3g} s",
        f"{cell.ratio_quantile(0.95, fixed=True):.2g} / {cell.ratio_quantile(0.95):.2g}",
        f"{within:.0%}",
        f"{cell.wrong}, {cell.early}",
    ]
    return f"| {' | '.join(fields)} |"


def draw_delays(result: DelayResult, path: Path) -> Path:
    """Draw the distributions of the delay with independent sources: one panel per change and declared rate."""
    cells = [cell for cell in result.cells if cell.layout == "independent"]
    changes = list(dict.fromkeys((cell.parameter, cell.change) for cell in cells))
    rates = list(dict.fromkeys(cell.rate for cell in cells))
    kinds = list(dict.fromkeys((cell.source, cell.hop_s, cell.short_hops) for cell in cells))
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]  # the stub wants literal keys
        figure = Figure(figsize=(11.0, 5.6), layout="constrained")
        panels = figure.subplots(len(rates), len(changes), sharey=True, squeeze=False)
        for row, rate in zip(panels, rates, strict=True):
            for axes, (parameter, change) in zip(row, changes, strict=True):
                own = [cell for cell in cells if (cell.parameter, cell.change, cell.rate) == (parameter, change, rate)]
                axes.set_title(f"{parameter} {change:+.0%}, {rate}", loc="left")
                _panel(axes, own, kinds)
            row[0].set_ylabel("found")
        for axes in panels[-1]:
            axes.set_xlabel("time since the change, s")
        handles = [
            axes.plot([], [], color=COLOURS[n], linestyle=_line_style(kind[0]), label=_kind_text(kind))[0]
            for n, kind in enumerate(kinds)
        ]
        handles.append(axes.axvline(-1, color="black", linewidth=0.9, linestyle=":", label="twice the bound's time"))
        figure.legend(handles=handles, loc="outside upper center", ncols=4)
        for axes in panels.ravel():
            axes.set_xlim(left=0)
        return save_figure(figure, path)


def _panel(axes: Axes, cells: list[DelayCell], kinds: list[tuple[str, float, tuple[int, ...]]]) -> None:
    """Empirical distributions, and twice the bound's time in the median condition."""
    end = 4 * float(np.median(cells[0].bound_s))
    for cell in cells:
        delays = np.sort([np.inf if delay is None else delay for delay in cell.detected_s])
        share = np.arange(1, delays.size + 1) / max(delays.size, 1)
        n = kinds.index((cell.source, cell.hop_s, cell.short_hops))
        axes.step(delays, share, where="post", color=COLOURS[n], linestyle=_line_style(cell.source), linewidth=1.2)
        if cell.source == "stream":
            end = max(end, 1.05 * float(delays[np.isfinite(delays)].max(initial=0.0)))
    axes.axvline(2 * float(np.median(cells[0].bound_s)), color="black", linewidth=0.9, linestyle=":")
    axes.axhline(0.95, color="#999999", linewidth=0.6)
    axes.set_xlim(right=end)
    axes.set_ylim(0, 1.02)


def _line_style(source: str) -> str:
    return "-" if source == "stream" else "--"


def _kind_text(kind: tuple[str, float, tuple[int, ...]]) -> str:
    source, hop_s, short = kind
    lengths = "+".join(f"{hops * hop_s:g}" for hops in short)
    return f"{'stream' if source == 'stream' else 'at the bound'}, hop {hop_s:g} s, short {lengths} s"
