"""What ``rotortrain sensors`` does: sensors at fault on healthy machines, and the section of the results page."""

from collections.abc import Sequence
from pathlib import Path

import typer

from models.commissioning.knowledge import KnowledgeLevel
from models.errors import MachineFileError
from simulator.campaigns.evaluation_goals import percent, rate_text
from simulator.campaigns.results_tables import paragraph, table
from simulator.campaigns.sensor_study import FAULTS, SensorCell, SensorPlan, run_sensors, sensor_cells
from simulator.campaigns.unknown_page import placed
from simulator.campaigns.unknown_subjects import SHIPPED
from simulator.campaigns.written import writing
from simulator.training.progress import labelled_bars

__all__ = ["break_sensors"]

_BEGIN, _END = "<!-- sensors at fault: begin -->", "<!-- sensors at fault: end -->"
_TEXT = {
    "healthy": "none (healthy)",
    "gain": "gain ± 10–30 %",
    "drift": "gain that drifts by ± 10–30 %",
    "offset": "offset of 3–10 rms",
    "stuck": "stuck",
    "clip": "clipped at 1–2 rms",
    "delay": "delay of 1–5 ms",
    "swapped": "swapped with another channel",
}
_LEVELS = (KnowledgeLevel.NONE, KnowledgeLevel.FULL)


def break_sensors(
    machines: Sequence[str], out: Path, *, windows: int, seed: int, processes: int, page: Path | None = None
) -> None:
    """Run the study and write its numbers (JSON lines) and its section (Markdown).

    Raises
    ------
    RotorwatchError
        If a machine is not a shipped one, or a file cannot be written.
    """
    chosen = tuple(dict.fromkeys(machines)) or SHIPPED
    for name in chosen:
        if name not in SHIPPED:
            raise MachineFileError(f"--machine {name}: not among {', '.join(SHIPPED)}")
    if page is not None and not page.is_file():
        raise MachineFileError(f"--page {page}: no such page")
    plan = SensorPlan(chosen, _LEVELS, seed, windows)
    with labelled_bars(remaining=True) as progress:
        records = run_sensors(plan, processes, progress)
    section = _section(plan, sensor_cells(records))
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        (out / "sensors.jsonl").write_text("".join(one.model_dump_json() + "\n" for one in records), encoding="utf-8")
        (out / "sensors.md").write_text(section, encoding="utf-8")
    if page is not None:
        with writing(page):
            page.write_text(placed(page.read_text(encoding="utf-8"), section), encoding="utf-8")
    typer.echo(section)
    typer.echo(f"written: {out / 'sensors.jsonl'}, {out / 'sensors.md'}" + (f", {page}" if page else ""))


def _section(plan: SensorPlan, cells: Sequence[SensorCell]) -> str:
    lines = [
        _BEGIN,
        "## Sensors at fault",
        "",
        *paragraph(
            "One channel of a healthy machine is at fault, from the start of the window or from a time within it.",
            "Channel, size, cutoff, level, layout of the sources and noise are drawn anew in every window of 60 s. The",
            f"machine was commissioned on {plan.healthy} windows of one condition. *Named*: the fault and the channel.",
            "*Data health*: something is found wrong with a sensor, and nothing is said of the machine. *Claimed*: a",
            "bearing, unbalance or shaft fault is named without reserve instead, at",
            f"{percent(plan.rate, 0)} false alarms declared per window. {plan.windows} independent windows per cell,",
            f"seed {plan.seed}; Clopper–Pearson intervals at 95 %.",
        ),
        "",
    ]
    rows = [
        (
            cell.machine,
            cell.level.value,
            _TEXT[cell.fault],
            "" if cell.fault == "healthy" else rate_text(cell.named),
            rate_text(cell.data_health),
            rate_text(cell.claimed),
            rate_text(cell.outside),
        )
        for cell in sorted(cells, key=lambda one: (plan.machines.index(one.machine), FAULTS.index(one.fault)))
    ]
    lines += table(("machine", "level", "fault", "named", "data health", "claimed", "outside the model"), rows)
    command = f"rotortrain sensors --out OUT --windows {plan.windows} --seed {plan.seed} --page docs/results.md"
    return "\n".join([*lines, "", f"`{command}`", _END]) + "\n"
