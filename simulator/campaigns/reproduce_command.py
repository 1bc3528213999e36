"""What ``rotortrain reproduce`` does: run the paper's study, write its numbers, figures and page."""

from pathlib import Path

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from models.diagnosis.networks.bundle import load_bundle
from models.errors import RecordingError
from models.machine import load_machine, validation_text
from simulator.campaigns.study import Study, run_study
from simulator.campaigns.study_page import study_page
from simulator.campaigns.study_plots import draw_study
from simulator.campaigns.study_windows import CUTOFFS_HZ, NOISE_LEVELS, StudyPlan

__all__ = ["read_study", "reproduce_study", "write_study"]

_NUMBERS = "reproduction.json"


def reproduce_study(
    name: str,
    bundle_name: str,
    out: Path,
    *,
    windows: int,
    calibration: int,
    false_alarm_rate: float,
    seed: int,
    processes: int,
    quick: bool,
    redraw: bool,
) -> None:
    """Run the study, or read the one that is there, and write numbers, figures and page.

    Raises
    ------
    RotorwatchError
        If machine, bundle or an existing study cannot be used, or there are too few calibration windows.
    """
    if redraw:
        study = read_study(out)
    else:
        machine = load_machine(name)
        plan = StudyPlan(
            machine,
            load_bundle(bundle_name, machine),
            seed,
            2 if quick else windows,
            9 if quick else calibration,
            0.1 if quick else false_alarm_rate,
            CUTOFFS_HZ[1:3] if quick else CUTOFFS_HZ,
            NOISE_LEVELS[::4] if quick else NOISE_LEVELS,
        )
        with _progress() as bar:
            tasks: dict[str, TaskID] = {}

            def progress(label: str, done: int, total: int) -> None:
                if label not in tasks:
                    tasks[label] = bar.add_task(label, total=total)
                bar.update(tasks[label], completed=done)

            study = run_study(plan, processes, progress)
    for path in write_study(study, out):
        typer.echo(f"written: {path}")


def write_study(study: Study, out: Path) -> list[Path]:
    """Write numbers, figures and page into a folder; returns what was written.

    Raises
    ------
    RecordingError
        If the folder cannot be written.
    """
    figures, page = out / "figures", out / "reproduction.md"
    try:
        figures.mkdir(parents=True, exist_ok=True)
        (figures / _NUMBERS).write_text(study.model_dump_json() + "\n", encoding="utf-8")
        drawn = draw_study(study, figures)
        page.write_text(study_page(study), encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{out}: cannot be written ({error.strerror})") from error
    return [figures / _NUMBERS, *drawn, page]


def read_study(out: Path) -> Study:
    """Read the numbers of an earlier run.

    Raises
    ------
    RecordingError
        If there are none, or they are damaged.
    """
    path = out / "figures" / _NUMBERS
    try:
        return Study.model_validate_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}); run without --redraw first") from error
    except ValidationError as error:
        raise RecordingError(validation_text(path, error)) from error


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
