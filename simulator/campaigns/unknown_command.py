"""What ``rotortrain unknown`` does: commission machines without their parameters, watch them, and write the section."""

from collections.abc import Sequence
from pathlib import Path

import typer

from models.commissioning.knowledge import KnowledgeLevel
from models.errors import MachineFileError
from simulator.campaigns.unknown_page import placed, unknown_section
from simulator.campaigns.unknown_study import UnknownPlan, read_unknown, run_unknown
from simulator.campaigns.unknown_subjects import SUBJECTS, subject_named
from simulator.campaigns.unknown_summary import summarize_unknown
from simulator.campaigns.written import writing
from simulator.training.progress import labelled_bars

__all__ = ["watch_unknown"]

_RECORDS, _NUMBERS, _SECTION = "records.jsonl", "unknown.json", "unknown.md"


def watch_unknown(
    machines: Sequence[str],
    levels: Sequence[str],
    out: Path,
    *,
    windows: int,
    commissionings: int,
    healthy: int,
    conditions: int,
    seed: int,
    processes: int,
    page: Path | None = None,
) -> None:
    """Run what is missing of the campaign, and write its numbers (JSON) and its section (Markdown).

    Raises
    ------
    RotorwatchError
        If a machine or level is not known, records are damaged, or a file cannot be written.
    """
    chosen = tuple(dict.fromkeys(machines)) or SUBJECTS
    for name in chosen:
        if name not in SUBJECTS:
            raise MachineFileError(f"--machine {name}: not among {', '.join(SUBJECTS)}")
    known = [level.value for level in KnowledgeLevel]
    for name in levels:
        if name not in known:
            raise MachineFileError(f"--level {name}: not among {', '.join(known)}")
    asked = tuple(KnowledgeLevel(name) for name in dict.fromkeys(levels)) or (KnowledgeLevel.NONE,)
    if page is not None and not page.is_file():
        raise MachineFileError(f"--page {page}: no such page")
    plan = UnknownPlan(chosen, asked, seed, windows, commissionings, healthy, conditions)
    kept = out / f"{seed}-{healthy}x{conditions}-{_RECORDS}"
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        with labelled_bars(remaining=True) as progress:
            run_unknown(plan, kept, processes, progress)
    descriptions = {name: subject_named(name).description for name in chosen}
    summary = summarize_unknown(plan, list(read_unknown(kept)), descriptions)
    section = unknown_section(summary)
    with writing(out):
        (out / _NUMBERS).write_text(summary.model_dump_json(indent=1) + "\n", encoding="utf-8")
        (out / _SECTION).write_text(section, encoding="utf-8")
    typer.echo(section)
    if page is not None:
        with writing(page):
            page.write_text(placed(page.read_text(encoding="utf-8"), section), encoding="utf-8")
        typer.echo(f"written: {page}")
    typer.echo(f"written: {out / _NUMBERS}, {out / _SECTION}")
