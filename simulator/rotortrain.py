"""``rotortrain``: commission a real machine, or train the networks of a machine file."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from models.errors import RotorwatchError
from simulator.commands import Commands, VersionOption, finite

app = typer.Typer(
    name="rotortrain",
    cls=Commands,
    help="Commission a machine from recordings of it while it was healthy, or train networks from its machine file.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_TRAIN = ("torch", "matplotlib", "jinja2", "markupsafe")  # what the extra "train" brings
_SEED = 20260101
_CORES = os.cpu_count() or 1
_WINDOWS, _DRAWS = 160, 150_000
MachineOption = Annotated[
    str, typer.Option("--machine", "-m", help='Machine file (TOML), or a shipped machine: "lab", "heavy".')
]
ProcessesOption = Annotated[int, typer.Option(min=1, help="Worker processes.")]
WindowsOption = Annotated[int, typer.Option(min=20, help="Simulated training windows per relation network.")]
DrawsOption = Annotated[
    int,
    typer.Option(min=2000, help="Machines and conditions drawn for the amortised networks, plus half as many again."),
]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]


@app.callback()
def _program(_version: VersionOption = False) -> None:
    pass


@app.command()
def train(
    machine: MachineOption,
    out: Annotated[Path, typer.Option("--out", "-o", file_okay=False, help="Directory of the bundle to write.")],
    windows: WindowsOption = _WINDOWS,
    draws: DrawsOption = _DRAWS,
    seed: SeedOption = _SEED,
    processes: ProcessesOption = _CORES,
) -> None:
    """Train two networks for every equation and write a bundle.

    The relation network of an equation is trained on simulated windows in which its own parameters are as in the
    machine file and everything else is random. The amortised network learns its own parameters from windows drawn as
    spectra, everything random. Both are calibrated on further simulated windows. The bundle holds weights, calibration,
    and what is needed to make it again; the monitor refuses it for any other machine.

    Example: rotortrain train --machine lab --out lab-bundle
    """
    with _running():
        from models.machine import load_machine  # noqa: PLC0415  # start-up stays free of numpy and torch

        known = load_machine(machine)  # fails before torch is imported, which takes seconds
        from simulator.training.command import train_for  # noqa: PLC0415

        train_for(known, out, windows, draws, seed, processes)


@app.command()
def calibrate(
    machine: MachineOption,
    bundle: Annotated[str, typer.Option("--bundle", "-b", help="Directory of a bundle, or a shipped one by name.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", file_okay=False, help="Directory of the bundle to write; may be the same.")
    ],
    processes: ProcessesOption = _CORES,
) -> None:
    """Calibrate the networks of a bundle anew, on simulated windows; they are not trained again.

    For a bundle made by an earlier version: the readings of its networks and their stated errors are compared with the
    truth in some three thousand windows.

    Example: rotortrain calibrate --machine lab --bundle lab-bundle --out lab-bundle
    """
    with _running():
        from models.machine import load_machine  # noqa: PLC0415  # start-up stays free of numpy
        from simulator.training.command import calibrate_again  # noqa: PLC0415

        calibrate_again(load_machine(machine), bundle, out, processes)


@app.command()
def commission(
    machine: Annotated[
        str, typer.Option("--machine", "-m", help="Machine file (TOML). What it leaves out of [rotor] is learned.")
    ],
    healthy: Annotated[
        list[Path],
        typer.Option(
            exists=True, dir_okay=False, help="Recording of the healthy machine; may be repeated, or followed by more."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", file_okay=False, help="Directory of the bundle and the report.")],
    more: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[REC]...", exists=True, dir_okay=False, help="Further healthy recordings: --healthy A.mcap B.mcap."
        ),
    ] = None,
    first: Annotated[
        float | None,
        typer.Option(
            min=1.0, callback=finite, metavar="SECONDS", help="Use only the first seconds of every recording."
        ),
    ] = None,
    wish: Annotated[
        float | None,
        typer.Option(
            min=0.001, max=0.9, callback=finite, help="Relative change to be detected; the alarm limit if left out."
        ),
    ] = None,
    why: Annotated[str, typer.Option(help="Why the machine is commissioned again; kept in the bundle.")] = "",
    networks: Annotated[
        bool, typer.Option(help="Also train the networks, if the parameters are known (a quarter of an hour).")
    ] = True,
    windows: WindowsOption = _WINDOWS,
    draws: DrawsOption = _DRAWS,
    seed: SeedOption = _SEED,
    processes: ProcessesOption = _CORES,
) -> None:
    """Make a calibrated monitor of a real machine from recordings of it while it was healthy.

    With all parameters in the machine file (level full) the recordings are checked against theory and the networks
    trained. With masses and shaft alone (partial) stiffness, damping and unbalance are identified. With nothing but
    channels and sampling (none) the relations between bearing and disc are learned, and changes are relative to them.
    The report states what can be read, how precisely, and what to record if that is not enough. Recordings that are
    too short, not steady or faulty are refused (exit code 3).

    Example: rotortrain commission --machine pump.toml --healthy monday.mcap --healthy friday.mcap --out pump-bundle
    """
    with _running():
        from simulator.commission.command import commission_machine  # noqa: PLC0415  # start-up stays free of numpy and torch

        made = commission_machine(
            machine,
            [*healthy, *(more or ())],
            out,
            first_s=first,
            wished=wish,
            why=why,
            networks=networks,
            n_windows=windows,
            n_draws=draws,
            seed=seed,
            processes=processes,
        )
        if not made:
            raise typer.Exit(3)


@contextmanager
def _running() -> Iterator[None]:
    """Run a command's work, with linear algebra on one thread since workers are processes; report errors in a sentence.

    The number of threads takes effect only before numpy is first imported, so the command imports its work inside.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    try:
        yield
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        if name not in _TRAIN:
            raise
        typer.echo(f"rotortrain: {name} is not installed: pip install 'rotorwatch[train]'", err=True)
        raise typer.Exit(2) from error
    except RotorwatchError as error:
        typer.echo(f"rotortrain: {error}", err=True)
        raise typer.Exit(2) from error


if __name__ == "__main__":
    app()
