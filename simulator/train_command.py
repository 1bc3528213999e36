"""What ``rotortrain train`` does: simulate, train, calibrate, write a bundle."""

import platform
from functools import partial
from importlib.metadata import version
from pathlib import Path

import typer
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
from rich.table import Table

from models.diagnosis.bundle import Training, save_bundle
from models.diagnosis.equations import EQUATIONS, missing
from models.diagnosis.training import calibrate, train_network
from models.machine import load_machine
from simulator.campaign import Draw, Purpose, windows, with_tilt

__all__ = ["train_bundle"]


def train_bundle(name: str, out: Path, n_windows: int, seed: int, processes: int) -> None:
    """Train every equation's network for the machine and write the bundle.

    Raises
    ------
    RotorwatchError
        If the machine file or the bundle directory is not usable.
    """
    machine = load_machine(name)
    networks = []
    with _progress() as bar:
        for stream, equation in enumerate(EQUATIONS):
            # Tilt is simulated where it is not measured: the same bundle serves the machine once it has tilt probes.
            rig = with_tilt(machine) if missing(equation, machine.descriptor.states) else machine
            absent = missing(equation, rig.descriptor.states)
            if absent:
                bar.console.print(f"({equation.number}) {equation.title}: left out, not measured: {', '.join(absent)}")
                continue
            label = f"({equation.number}) {equation.title}"
            simulating = bar.add_task(f"{label}: simulating", total=n_windows + n_windows // 2)
            simulated = partial(bar.advance, simulating)
            training, calibration = (
                list(
                    windows(Draw(rig, seed, purpose, stream, equation.kept_nominal), range(count), processes, simulated)
                )
                for purpose, count in ((Purpose.TRAINING, n_windows), (Purpose.CALIBRATION, n_windows // 2))
            )
            fitting = bar.add_task(f"{label}: training", total=1.0)
            trained = train_network(equation, training, rig, seed, partial(_complete, bar, fitting))
            networks.append(calibrate(trained, calibration, rig))
    versions = {name: version(name) for name in ("rotorwatch", "numpy", "torch")} | {
        "python": platform.python_version()
    }
    made = Training(seed=seed, training_windows=n_windows, calibration_windows=n_windows // 2, versions=versions)
    bundle = save_bundle(out, machine, tuple(networks), made)
    table = Table(
        "equation", "parameter", "healthy spread per window", "residual (MSD)", title=f"bundle {bundle.identity}"
    )
    for trained in networks:
        if trained.healthy is not None:
            for parameter, spread in zip(trained.equation.parameters, trained.healthy.spread, strict=True):
                number = f"({trained.equation.number}) {trained.equation.title}"
                table.add_row(number, parameter, f"{spread:.2%}", f"{trained.healthy.msd:.2g}")
    Console().print(table)
    typer.echo(f"written to {out}")


def _complete(bar: Progress, task: TaskID, done: float) -> None:
    bar.update(task, completed=done)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
