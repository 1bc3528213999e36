"""``python -m benchmarks.studies``: run studies, and write their pages."""

import os
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.studies.ablation import ablation
from benchmarks.studies.agreement import agreement
from benchmarks.studies.damping import damping
from benchmarks.studies.delay import delay
from benchmarks.studies.evaluate import evaluate
from benchmarks.studies.level_years import level_years
from benchmarks.studies.levels import levels
from benchmarks.studies.other_faults import other_faults
from benchmarks.studies.peers import peers
from benchmarks.studies.reporting.pages import write_page
from benchmarks.studies.reporting.study import Options, read, run, spread_over
from benchmarks.studies.reproduction import reproduction
from benchmarks.studies.sensors import sensors
from benchmarks.studies.unknown import unknown
from models.errors import RotorwatchError

STUDIES = {
    one.__name__: one
    for one in (
        *(evaluate, agreement, peers, unknown, damping, sensors, ablation, delay),
        *(levels, level_years, other_faults, reproduction),
    )
}

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
def main(
    names: Annotated[list[str], typer.Argument(metavar="STUDY...", help=f"Among {', '.join(STUDIES)}; or all.")],
    out: Annotated[Path, typer.Option(help="Folder of the records, one file for each study.")],
    machine: Annotated[list[str] | None, typer.Option(help="Machine; repeatable. The study's own if left out.")] = None,
    windows: Annotated[int | None, typer.Option(min=1, help="Windows per cell: 100, or 2 with --small.")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 20261122,
    processes: Annotated[int, typer.Option(min=1)] = os.cpu_count() or 1,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Use all cores of this Ray cluster instead.")
    ] = None,
    small: Annotated[bool, typer.Option("--small", help="The smallest plan: a check, not a result.")] = False,
    docs: Annotated[Path | None, typer.Option(help="Write the pages of these studies into this folder.")] = None,
) -> None:
    """Run studies on simulated windows; records are kept, and an interrupted study continues where it stopped.

    Example: python -m benchmarks.studies evaluate --machine lab --windows 500 --out studies --docs docs

    Check of everything: python -m benchmarks.studies all --small --out check --docs check
    """
    chosen = list(STUDIES) if names == ["all"] else names
    for name in chosen:
        if name not in STUDIES:
            raise typer.BadParameter(f"{name!r}, expected among {', '.join(STUDIES)}, or all")
    options = Options(tuple(machine or ()), windows or (2 if small else 100), seed, small)
    try:
        with spread_over(processes, ray) as spread:
            for name in chosen:
                study = STUDIES[name](options)
                written = [run(study, options, out, spread)]
                if docs is not None:
                    written += write_page(study, options, read(study, out), docs)
                typer.echo("written: " + ", ".join(map(str, written)))
    except RotorwatchError as error:
        typer.echo(f"studies: {error}", err=True)
        raise typer.Exit(2) from error


if __name__ == "__main__":
    app(prog_name="python -m benchmarks.studies")
