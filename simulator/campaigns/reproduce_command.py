"""What ``rotortrain reproduce`` does: run the paper's study, write its numbers, figures and page."""

from pathlib import Path

import typer

from models.diagnosis.networks.bundle import load_bundle
from models.machine import load_machine
from simulator.campaigns.study import Study, run_study
from simulator.campaigns.study_page import study_page
from simulator.campaigns.study_plots import draw_study
from simulator.campaigns.study_windows import CUTOFFS_HZ, NOISE_LEVELS, StudyPlan
from simulator.campaigns.written import read_to_redraw, writing
from simulator.training.progress import labelled_bars

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
        with labelled_bars(remaining=True) as progress:
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
    with writing(out):
        figures.mkdir(parents=True, exist_ok=True)
        (figures / _NUMBERS).write_text(study.model_dump_json() + "\n", encoding="utf-8")
        drawn = draw_study(study, figures)
        page.write_text(study_page(study), encoding="utf-8")
    return [figures / _NUMBERS, *drawn, page]


def read_study(out: Path) -> Study:
    """Read the numbers of an earlier run.

    Raises
    ------
    RecordingError
        If there are none, or they are damaged.
    """
    return read_to_redraw(Study, out / "figures" / _NUMBERS)
