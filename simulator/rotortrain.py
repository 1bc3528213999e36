"""``rotortrain``: train a machine's networks, and evaluate what they and the likelihood find."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from models.errors import RotorwatchError
from simulator.commands import Commands
from simulator.version import VersionOption

__all__ = ["app"]

app = typer.Typer(
    name="rotortrain",
    cls=Commands,
    help="Train the networks of a machine from its machine file, and evaluate them on windows they never saw.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_EXTRAS = {
    "train": ("torch", "matplotlib", "jinja2", "markupsafe"),
    "peers": ("pyoma2", "sklearn"),
}
_SEED = 20260101
_CORES = os.cpu_count() or 1
_WINDOWS, _DRAWS = 160, 150_000
MachineOption = Annotated[
    str, typer.Option("--machine", "-m", help='Machine file (TOML), or a shipped machine: "lab", "heavy".')
]
BundleOption = Annotated[
    str | None,
    typer.Option("--bundle", "-b", help="Bundle directory or shipped bundle; the machine's name if left out."),
]
ProcessesOption = Annotated[int, typer.Option(min=1, help="Worker processes.")]
WindowsOption = Annotated[int, typer.Option(min=20, help="Simulated training windows per relation network.")]
DrawsOption = Annotated[
    int, typer.Option(min=2000, help="Random machines and conditions drawn for the amortised networks.")
]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]


@app.callback()
def _program(_version: VersionOption = False) -> None:
    pass


@app.command()
def train(
    machine: MachineOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory of the bundle to write.")],
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
        from simulator.training.command import train_bundle  # noqa: PLC0415  # start-up stays free of numpy and torch

        train_bundle(machine, out, windows, draws, seed, processes)


@app.command()
def evaluate(
    machine: MachineOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory of the windows' records and the summaries.")],
    bundle: Annotated[
        str | None,
        typer.Option("--bundle", "-b", help='Bundle directory, or a shipped bundle: "lab". Without: likelihood only.'),
    ] = None,
    windows: Annotated[int, typer.Option(min=2, help="Windows per cell.")] = 500,
    fault: Annotated[float, typer.Option(min=0.001, max=0.9, help="Relative size of the large changes.")] = 0.2,
    seed: SeedOption = _SEED,
    processes: ProcessesOption = _CORES,
    quick: Annotated[
        bool, typer.Option("--quick", help="At most four windows per cell: a check, not a result.")
    ] = False,
    full: Annotated[
        bool,
        typer.Option(
            "--full",
            help="Also other excitations, cracks, rubs, sensor faults, window lengths, minimum detectable changes.",
        ),
    ] = False,
    page: Annotated[
        Path | None,
        typer.Option("--page", help="Results page (Markdown) to write from all machines in --out, with its figures."),
    ] = None,
) -> None:
    """Evaluate likelihood and networks on healthy and changed machines, in conditions drawn at random.

    A cell is one true change, one kind of excitation or one fault outside the model. Every window of it is a run of its
    own: cutoff, level and distribution of the force, speed and sensor noise are drawn anew, and neither training nor
    calibration saw it. How sharp the readings are, whether their 95 % intervals hold what they promise, what is named
    and how often falsely, is summed up cell by cell and set against the best that any method could do.

    Every window is kept, so an interrupted evaluation carries on where it stopped.

    Example: rotortrain evaluate --machine lab --bundle lab --out evaluation --full --page results.md
    """
    with _running():
        from simulator.campaigns.evaluate_command import evaluate as run  # noqa: PLC0415  # start-up stays free of numpy and torch

        run(
            machine,
            bundle,
            out,
            windows=windows,
            fault=fault,
            seed=seed,
            processes=processes,
            full=full,
            quick=quick,
            page=page,
        )


@app.command()
def reproduce(
    machine: MachineOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the page, the figures and the numbers.")],
    bundle: BundleOption = None,
    windows: Annotated[int, typer.Option(min=2, help="Windows per fault condition, cutoff and kind.")] = 20,
    calibration: Annotated[int, typer.Option(min=9, help="Healthy windows that set the limits of the MSD.")] = 199,
    false_alarms: Annotated[
        float, typer.Option(min=1e-6, max=0.5, help="Declared false-alarm rate per window, all equations together.")
    ] = 0.01,
    seed: SeedOption = _SEED,
    processes: ProcessesOption = _CORES,
    quick: Annotated[bool, typer.Option("--quick", help="Two windows per cell: a check, not a result.")] = False,
    redraw: Annotated[
        bool, typer.Option("--redraw", help="Draw figures and page again from the numbers in --out.")
    ] = False,
) -> None:
    """Do the paper's study again, before the paper's own networks and all diagnosticians.

    Eight fault conditions, four cutoffs, 1 to 5 % noise; once on runs that share their noise realisation with the
    healthy ones, and once on independent runs.

    Example: rotortrain reproduce --machine lab --out reproduction
    """
    with _running():
        from simulator.campaigns.reproduce_command import reproduce_study  # noqa: PLC0415  # start-up stays free of numpy and torch

        reproduce_study(
            machine,
            machine if bundle is None else bundle,
            out,
            windows=windows,
            calibration=calibration,
            false_alarm_rate=false_alarms,
            seed=seed,
            processes=processes,
            quick=quick,
            redraw=redraw,
        )


@app.command()
def peers(
    machine: MachineOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="JSON file for the numbers; the figure goes beside it.")],
    bundle: BundleOption = None,
    windows: Annotated[int, typer.Option(min=2, help="Windows per true change and setting.")] = 100,
    healthy: Annotated[
        int, typer.Option(min=9, help="Healthy windows to learn from; as many again set the limits.")
    ] = 199,
    false_alarms: Annotated[
        float, typer.Option(min=1e-6, max=0.5, help="Declared false-alarm rate per window, for every method.")
    ] = 0.01,
    seed: SeedOption = _SEED,
    processes: ProcessesOption = _CORES,
) -> None:
    """Compare with operational modal analysis and a feature vector, on the same windows.

    Bearing stiffness, bearing damping and unbalance change by 5, 10 and 20 %; once in the laboratory, where nothing
    varies but the realisation, and once with a condition drawn for every window. Needs the extra "peers".

    Example: rotortrain peers --machine lab --out peers.json --windows 100
    """
    with _running():
        from simulator.campaigns.peers_command import compare_peers  # noqa: PLC0415  # start-up stays free of numpy and torch

        compare_peers(
            machine,
            machine if bundle is None else bundle,
            out,
            windows=windows,
            healthy=healthy,
            false_alarm_rate=false_alarms,
            seed=seed,
            processes=processes,
        )


@app.command()
def ablate(
    machine: MachineOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="JSON file for the numbers; the tables go beside it.")],
    bundle: BundleOption = None,
    windows: Annotated[int, typer.Option(min=2, help="Evaluation windows per true change.")] = 100,
    training: Annotated[int, typer.Option(min=4, help="Training windows of each equation.")] = 60,
    calibration: Annotated[int, typer.Option(min=9, help="Healthy windows that set every variant's limit.")] = 199,
    layout: Annotated[
        str, typer.Option(help='Excitation of all windows but the training: "both", "independent", "one_source".')
    ] = "both",
    false_alarms: Annotated[
        float, typer.Option(min=1e-6, max=0.5, help="Declared false-alarm rate per window and equation.")
    ] = 0.01,
    seed: SeedOption = _SEED,
    processes: ProcessesOption = _CORES,
) -> None:
    """Show what each ingredient of the relation networks buys, on the same windows.

    From the networks as printed to the present ones, one ingredient after the other; each one left out in turn; and a
    linear fit, the amortised networks and the likelihood in their place.

    Example: rotortrain ablate --machine lab --out ablation.json --windows 100
    """
    with _running():
        from simulator.campaigns.ablation_command import ablate_networks  # noqa: PLC0415  # start-up stays free of numpy and torch

        ablate_networks(
            machine,
            machine if bundle is None else bundle,
            out,
            windows=windows,
            training=training,
            calibration=calibration,
            layout=layout,
            false_alarm_rate=false_alarms,
            seed=seed,
            processes=processes,
        )


@app.command()
def delay(
    machine: MachineOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="JSON file for the numbers; table and figure go beside it.")],
    trials: Annotated[
        int, typer.Option(min=2, help="Streams per change with independent sources, at the machine's own hop.")
    ] = 60,
    others: Annotated[
        int, typer.Option(min=2, help="Streams per change with one source, and with independent ones at half the hop.")
    ] = 20,
    seed: SeedOption = _SEED,
    processes: ProcessesOption = _CORES,
    redraw: Annotated[bool, typer.Option("--redraw", help="Table and figure again from the numbers in --out.")] = False,
) -> None:
    """Measure how long after a step change the monitor's test finds it, beside the time the Cramér-Rao bound allows.

    Example: rotortrain delay --machine lab --out delay.json
    """
    with _running():
        from simulator.campaigns.delay_command import time_detection  # noqa: PLC0415  # start-up stays free of numpy and torch

        time_detection(machine, out, trials=trials, others=others, seed=seed, processes=processes, redraw=redraw)


@app.command()
def sensors(
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the records and the section.")],
    machine: Annotated[
        list[str] | None, typer.Option("--machine", "-m", help="Shipped machine; all of them if left out.")
    ] = None,
    windows: Annotated[int, typer.Option(min=2, help="Windows per machine, level and fault.")] = 100,
    seed: SeedOption = _SEED + 200,
    processes: ProcessesOption = _CORES,
    page: Annotated[
        Path | None, typer.Option("--page", help="Page of results (Markdown) whose section is to be replaced.")
    ] = None,
) -> None:
    """Put one sensor at fault on a healthy machine, again and again, and count what is said of it.

    Gain, drifting gain, offset, stuck, clipped, late and swapped channels, on machines that were commissioned without
    their parameters and with all of them: named, called a matter of data health, or taken for a fault of the machine.

    Example: rotortrain sensors --machine lab --out sensors
    """
    with _running():
        from simulator.campaigns.sensor_command import break_sensors  # noqa: PLC0415  # start-up stays free of numpy and torch

        break_sensors(machine or (), out, windows=windows, seed=seed, processes=processes, page=page)


@app.command()
def commission(
    machine: Annotated[
        str,
        typer.Option("--machine", "-m", help="Machine file (TOML). What it leaves out of [rotor] is learned."),
    ],
    healthy: Annotated[
        list[Path],
        typer.Option(
            "--healthy",
            exists=True,
            dir_okay=False,
            help="Recording of the healthy machine; may be repeated, or followed by more.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory of the bundle and the report.")],
    more: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[REC]...", exists=True, dir_okay=False, help="Further healthy recordings: --healthy A.mcap B.mcap."
        ),
    ] = None,
    first: Annotated[
        float | None, typer.Option(min=1.0, metavar="SECONDS", help="Use only the first seconds of every recording.")
    ] = None,
    wish: Annotated[
        float | None,
        typer.Option(min=0.001, max=0.9, help="Relative change that shall be found; the alarm limit if left out."),
    ] = None,
    why: Annotated[str, typer.Option(help="Why the machine is commissioned again; kept in the bundle.")] = "",
    networks: Annotated[
        bool, typer.Option(help="Train the networks, too, where the parameters are known (some ten minutes).")
    ] = True,
    windows: WindowsOption = _WINDOWS,
    draws: DrawsOption = _DRAWS,
    seed: SeedOption = _SEED,
    processes: ProcessesOption = _CORES,
) -> None:
    """Make a calibrated monitor of a real machine from recordings of it while it was healthy.

    With all parameters in the machine file (level full) the recordings are checked against theory and the networks
    trained. With masses and shaft alone (partial) stiffness, damping and unbalance are identified. With nothing but
    channels and sampling (none) the relations between bearing and disc are learned, and changes are told relative to
    them. The report says what can be read, how sharply, and what to record where it is not enough. Recordings that are
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


@app.command()
def unknown(
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory of the windows' records, numbers and section.")],
    machine: Annotated[
        list[str] | None,
        typer.Option("--machine", "-m", help="Machine to commission; may be given several times. All if left out."),
    ] = None,
    level: Annotated[
        list[str] | None,
        typer.Option(
            "--level", help='What the machine files tell: "none" (if left out), "partial", "full"; repeatable.'
        ),
    ] = None,
    windows: Annotated[int, typer.Option(min=1, help="Windows per true change and machine.")] = 100,
    commissionings: Annotated[
        int, typer.Option(min=1, help="How often a machine is commissioned from scratch; they share the windows.")
    ] = 5,
    healthy: Annotated[int, typer.Option(min=1, help="Healthy windows of each condition of a commissioning.")] = 6,
    conditions: Annotated[
        int, typer.Option(min=1, max=10, help="Healthy recordings of a commissioning, each in a condition of its own.")
    ] = 1,
    seed: SeedOption = _SEED,
    processes: ProcessesOption = _CORES,
    page: Annotated[
        Path | None, typer.Option("--page", help="Page (Markdown) in which the section is put, or replaced.")
    ] = None,
) -> None:
    """Commission machines without telling all their parameters, and count what is found on them later.

    Rotors of finite elements and the shipped machines. Every window is kept, so an interrupted campaign carries on
    where it stopped; for another version of this program take another directory.

    Example: rotortrain unknown --machine overhung --windows 100 --out unknown
    """
    with _running():
        from simulator.campaigns.unknown_command import watch_unknown  # noqa: PLC0415  # start-up stays free of numpy and torch

        watch_unknown(
            machine or (),
            level or (),
            out,
            windows=windows,
            commissionings=commissionings,
            healthy=healthy,
            conditions=conditions,
            seed=seed,
            processes=processes,
            page=page,
        )


@contextmanager
def _running() -> Iterator[None]:
    """Run a command's work: linear algebra on one thread, the workers are processes; trouble is told in a sentence.

    Takes effect on the linear algebra only before numpy is first imported, so the command imports its work inside.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    try:
        yield
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        extra = next((extra for extra, names in _EXTRAS.items() if name in names), None)
        if extra is None:
            raise
        typer.echo(f"rotortrain: {name} is not installed: pip install 'rotorwatch[{extra}]'", err=True)
        raise typer.Exit(2) from error
    except RotorwatchError as error:
        typer.echo(f"rotortrain: {error}", err=True)
        raise typer.Exit(2) from error


if __name__ == "__main__":
    app()
