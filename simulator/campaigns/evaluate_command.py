"""What ``rotortrain evaluate`` does: evaluate the cells, keep every window, sum up, and write the results page."""

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import typer
from pydantic import BaseModel
from rich.console import Console
from rich.progress import TaskID
from rich.table import Table

from models.diagnosis.networks.bundle import load_bundle
from models.errors import RecordingError
from models.machine import load_machine
from models.physics.parameters import PARAMETERS
from simulator.campaigns.evaluation import RATES, WindowRecord, evaluate_cells, read_records
from simulator.campaigns.evaluation_cells import EvaluationCell, Topic, cells_for
from simulator.campaigns.evaluation_goals import LAYOUT_TEXT, anomaly_text, excitation_text, goals, percent
from simulator.campaigns.evaluation_summary import Campaign, Summary, summarise
from simulator.campaigns.rates import Rate
from simulator.campaigns.results_page import page as results_page
from simulator.campaigns.results_plots import draw_results
from simulator.campaigns.written import read_numbers, writing
from simulator.training.draws import Anomaly, Excitation
from simulator.training.progress import bars

__all__ = ["evaluate", "read_summaries", "write_page"]

_QUICK = 4
_CAMPAIGN, _SUMMARY = ".campaign.json", ".summary.json"
_PEERS = "peers.json"
"""What `rotortrain peers` wrote, if it is put beside the summaries."""


def evaluate(
    name: str,
    bundle_name: str | None,
    out: Path,
    *,
    windows: int,
    fault: float,
    seed: int,
    processes: int,
    full: bool,
    quick: bool,
    page: Path | None,
) -> None:
    """Evaluate a machine; carries on where an interrupted evaluation stopped.

    Parameters
    ----------
    name : str
        Machine file or shipped machine.
    bundle_name : str or None
        Without a bundle only the likelihood is evaluated.
    out : Path
        Folder of the records, one file per machine, and of the summaries.
    windows : int
        Per cell of weight one.
    fault : float
        Relative size of the large changes.
    seed, processes : int
    full : bool
        All topics instead of the short plan.
    quick : bool
        At most four windows per cell.
    page : Path or None
        Results page to write from all summaries in `out`; its figures go to ``figures/`` beside it.

    Raises
    ------
    RotorwatchError
        If machine or bundle cannot be used, `out` holds windows of another campaign, or a file cannot be written.
    """
    machine = load_machine(name)
    bundle = None if bundle_name is None else load_bundle(bundle_name, machine)
    plan = cells_for(fault, full=full)
    campaign = Campaign(
        machine=machine.name,
        physics=machine.physics_hash,
        bundle="" if bundle is None else bundle.identity,
        bundle_name=bundle_name or "",
        seed=seed,
        windows=min(windows, _QUICK) if quick else windows,
        fault=fault,
        full=full,
        plan=_digest(plan),
    )
    records = out / f"{machine.name}.jsonl"
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        _same_campaign(out / f"{machine.name}{_CAMPAIGN}", campaign, records)
        with _Lines(plan, campaign.windows) as lines:
            evaluate_cells(
                machine,
                bundle,
                plan,
                n_windows=campaign.windows,
                seed=seed,
                processes=processes,
                kept=records,
                progress=lines.progress,
            )
        summary = summarise(_asked_for(read_records(records), plan, campaign.windows), campaign)
        _write(out / f"{machine.name}{_SUMMARY}", summary)
    Console().print(_overview(summary))
    typer.echo(f"written: {records}, {out / f'{machine.name}{_SUMMARY}'}")
    if page is not None:
        for path in write_page(out, page):
            typer.echo(f"written: {path}")


def write_page(out: Path, page: Path) -> list[Path]:
    """Write the results page and its figures from all summaries in a folder; returns what was written.

    ``peers.json`` and Markdown files in the folder become sections of their own.

    Raises
    ------
    RecordingError
        If there is no summary, a file is damaged, or the page cannot be written.
    """
    summaries = read_summaries(out)
    figures = page.parent / "figures"
    with writing(page):
        figures.mkdir(parents=True, exist_ok=True)
        drawn = [path for summary in summaries for path in draw_results(summary, figures)]
        sections = [path.read_text(encoding="utf-8") for path in sorted(out.glob("*.md"))]
        if (out / _PEERS).exists():
            from simulator.campaigns.results_peers import peers_section  # noqa: PLC0415  # the peers are an extra of their own

            section, figure = peers_section(out / _PEERS, figures)
            sections.insert(0, section)
            drawn.append(figure)
        page.write_text(results_page(summaries, sections), encoding="utf-8")
    return [page, *drawn]


def read_summaries(out: Path) -> list[Summary]:
    """Read the summaries of all machines in a folder.

    Raises
    ------
    RecordingError
        If there are none, or one is damaged.
    """
    found = [read_numbers(Summary, path) for path in sorted(out.glob(f"*{_SUMMARY}"))]
    if not found:
        raise RecordingError(f"{out}: no summaries (*{_SUMMARY}), expected those of at least one machine")
    return found


def _same_campaign(path: Path, campaign: Campaign, records: Path) -> None:
    """Refuse to mix windows of different campaigns; more or fewer windows of the same one are welcome."""
    if records.exists():
        if not path.exists():
            raise RecordingError(f"{records}: holds windows of an unknown campaign, {path.name} is missing")
        kept = read_numbers(Campaign, path)
        for field in ("physics", "bundle", "seed", "fault", "full", "plan"):
            before, now = getattr(kept, field), getattr(campaign, field)
            if before != now:
                raise RecordingError(
                    f"{records}: holds windows of another campaign, {field} is {before!r} there, expected {now!r}; "
                    "choose another --out or remove the file"
                )
    _write(path, campaign)


def _digest(plan: list[EvaluationCell]) -> str:
    """What the cells are, apart from their numbers of windows: records know their cell by its place in the plan."""
    cells = [(c.topic, sorted(c.faults.items()), c.layout, c.excitation, c.anomaly, c.length_s) for c in plan]
    return hashlib.sha256(repr(cells).encode()).hexdigest()[:12]


def _write(path: Path, model: BaseModel) -> None:
    """Write it whole or not at all."""
    part = path.with_name(f"{path.name}.part")
    part.write_text(model.model_dump_json() + "\n", encoding="utf-8")
    os.replace(part, path)


def _asked_for(records: Iterator[WindowRecord], plan: list[EvaluationCell], windows: int) -> Iterator[WindowRecord]:
    """Leave out what an earlier, longer evaluation of the same campaign has beyond this one."""
    return (record for record in records if record.number < plan[record.cell].count(windows))


def _cell_text(cell: EvaluationCell) -> str:
    parts: list[str] = [cell.topic.value]
    if cell.faults:
        parts.append(", ".join(f"{name} {change:+.0%}" for name, change in cell.faults.items()))
    if cell.excitation is not Excitation.SECOND_ORDER:
        parts.append(excitation_text(cell.excitation))
    if cell.anomaly is not Anomaly.NONE:
        parts.append(anomaly_text(cell.anomaly))
    if cell.length_s is not None:
        parts.append(f"{cell.length_s:g} s")
    if cell.layout is not None:
        parts.append(LAYOUT_TEXT[cell.layout])
    return ": ".join((parts[0], ", ".join(parts[1:]))) if parts[1:] else parts[0]


class _Lines:
    """A line for every cell that is done, bars for the running one and for all."""

    def __init__(self, plan: list[EvaluationCell], windows: int) -> None:
        self._bar = bars()
        self._all = self._bar.add_task("all windows", total=sum(cell.count(windows) for cell in plan))
        self._running: tuple[EvaluationCell, TaskID] | None = None
        self._before = 0

    def __enter__(self) -> "_Lines":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def progress(self, cell: EvaluationCell, done: int, total: int) -> None:
        """Take note of a cell's progress."""
        if self._running is None or self._running[0] is not cell:
            self._running = cell, self._bar.add_task(_cell_text(cell), total=total)
        self._bar.update(self._running[1], completed=done)
        self._bar.update(self._all, completed=self._before + done)
        if done >= total:
            self._bar.console.print(f"{_cell_text(cell)}: {total} windows", highlight=False)
            self._bar.remove_task(self._running[1])
            self._running = None
            self._before += total


def _overview(summary: Summary) -> Table:
    """Healthy windows on the terminal, and the goals that were missed."""
    made = summary.campaign
    columns = ("force", "by", "parameter", "spread", "std. error", "95 % covers", f"named at {100 * RATES[0]:g} %")
    missed = [goal for goal in goals(summary) if goal.met is False]
    table_of = Table(
        *columns,
        title=f"{made.machine}, healthy {summary.length_s:g} s windows, seed {made.seed}",
        caption=f"{len(missed)} declared goals missed; changes and everything else: the summary, or --page",
    )
    for cell in summary.of(Topic.HEALTHY):
        for by in summary.diagnosticians:
            opinion = cell.opinions.get(by)
            for name in PARAMETERS:
                one = None if opinion is None else opinion.parameter(name)
                if one is not None:
                    table_of.add_row(
                        LAYOUT_TEXT[cell.layout],
                        by,
                        name,
                        "–" if one.spread is None else percent(one.spread.value, 3),
                        percent(one.standard_error, 3),
                        _short(one.covered),
                        _short(one.mistaken[0]),
                    )
        table_of.add_section()
    return table_of


def _short(rate: Rate) -> str:
    return f"{100 * rate.rate:.3g} ({100 * rate.low:.3g}–{100 * rate.high:.3g}) %"
