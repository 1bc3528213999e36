"""What ``rotortrain ablate`` does: run the ablation, print it, and write its numbers and its tables."""

from pathlib import Path

import typer

from models.diagnosis.networks.bundle import load_bundle
from models.errors import EstimationError
from models.machine import load_machine
from simulator.campaigns.ablation import Ablation, AblationPlan, AblationRow, run_ablation
from simulator.campaigns.rates import Rate
from simulator.campaigns.written import writing
from simulator.training.draws import Layout
from simulator.training.progress import labelled_bars

__all__ = ["ablate_networks", "ablation_tables"]


def ablate_networks(
    name: str,
    bundle_name: str,
    out: Path,
    *,
    windows: int,
    training: int,
    calibration: int,
    layout: str,
    false_alarm_rate: float,
    seed: int,
    processes: int,
) -> None:
    """Run the ablation and write numbers (JSON) and tables (Markdown, beside them).

    Raises
    ------
    RotorwatchError
        If machine or bundle cannot be used, a file cannot be written, or there are too few calibration windows.
    """
    machine = load_machine(name)
    plan = AblationPlan(
        machine,
        load_bundle(bundle_name, machine),
        seed,
        windows,
        training,
        calibration,
        false_alarm_rate,
        layout=_layout(layout),
    )
    with labelled_bars() as progress:
        ablation = run_ablation(plan, processes, progress)
    tables = ablation_tables(ablation)
    typer.echo(tables)
    with writing(out):
        out.write_text(ablation.model_dump_json(indent=1) + "\n", encoding="utf-8")
        out.with_suffix(".md").write_text(tables, encoding="utf-8")
    typer.echo(f"written: {out}, {out.with_suffix('.md')}")


def _layout(name: str) -> Layout | None:
    known = {one.name.lower(): one for one in Layout}
    if name != "both" and name not in known:
        raise EstimationError(f"ablation: layout is {name!r}, expected both or one of {', '.join(known)}")
    return known.get(name)


def ablation_tables(ablation: Ablation) -> str:
    """One Markdown table per equation."""
    return "\n".join(
        _table(number, [row for row in ablation.rows if row.equation == number])
        for number in dict.fromkeys(row.equation for row in ablation.rows)
    )


def _table(number: str, rows: list[AblationRow]) -> str:
    changes = list(rows[0].detected)
    parameters = list(dict.fromkeys(change.split()[0] for change in changes))
    heads = ["variant", *changes, "false alarms", "elsewhere", *(f"spread {name}" for name in parameters), "reads"]
    lines = [f"### Equation {number}", "", f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    group = ""
    for row in rows:
        if row.group != group:
            group = row.group
            lines.append(f"| *{group}* |{' |' * (len(heads) - 1)}")
        cells = [row.label, *(_rate(row.detected[change]) for change in changes)]
        cells += [_rate(row.false_alarms), _rate(row.elsewhere)]
        cells += [f"{row.spread[name]:.2%}" if name in row.spread else "–" for name in parameters]
        cells.append(", ".join(f"{value:+.1%}" for value in row.reads.values()) or "–")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def _rate(rate: Rate) -> str:
    return f"{100 * rate.rate:.0f} ({100 * rate.low:.0f}–{100 * rate.high:.0f})"
