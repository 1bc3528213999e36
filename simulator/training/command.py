"""What ``rotortrain train`` does: simulate, train, calibrate, write a bundle."""

import platform
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from models.diagnosis.networks.amortised import AmortisedNetworks
from models.diagnosis.networks.bundle import Training, save_bundle
from models.diagnosis.networks.equations import EQUATIONS, missing
from models.diagnosis.networks.features import ForceFeatures
from models.diagnosis.networks.relation import EquationNetwork
from models.diagnosis.networks.training import calibrate, calibrate_networks, train_network, train_networks
from models.diagnosis.window import WindowStatistics
from models.machine import Machine
from models.physics.rotor import PARAMETERS
from rotorwatch import __version__
from simulator.commands import bars
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, windows, with_tilt
from simulator.training.spectral_draws import LOG_RATIO, FeatureDraws, batches

_CONDITIONS_PER_BATCH = 480
# Windows of either layout that calibrate the amortised networks, per training window of a relation network.
_CALIBRATION_SHARE = 3
_CALIBRATION_STREAM = 20


def train_for(machine: Machine, out: Path, n_windows: int, n_draws: int, seed: int, processes: int) -> None:
    """Train every equation's relation network and amortised network for the machine and write the bundle.

    Parameters
    ----------
    n_windows : int
        Simulated training windows per relation network; half as many for calibration.
    n_draws : int
        Random machines and conditions for the amortised networks.

    Raises
    ------
    RotorwatchError
        If the bundle directory is not usable.
    """
    networks: list[EquationNetwork] = []
    with bars(remaining=True) as bar:
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
        amortised = None
        if not networks or "theta" not in machine.descriptor.states:
            # Without a phase reference the rotation's line stays in the spectra, which the drawn ones do not have.
            bar.console.print(
                "amortised networks: left out: they need a phase reference (theta) and a measured equation"
            )
        else:
            amortised = _train_amortised(machine, n_draws, seed, processes, bar)
            amortised = _calibrate_amortised(machine, amortised, n_windows, seed, processes, bar)
    versions = {name: version(name) for name in ("numpy", "torch")} | {
        "rotorwatch": __version__,
        "python": platform.python_version(),
    }
    training_record = Training(
        seed=seed,
        training_windows=n_windows,
        calibration_windows=n_windows // 2,
        network_calibration_windows=_CALIBRATION_SHARE * n_windows * len(Layout),
        drawn_conditions=n_draws,
        versions=versions,
    )
    bundle = save_bundle(out, machine, tuple(networks), training_record, amortised)
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


def _train_amortised(machine: Machine, n_draws: int, seed: int, processes: int, bar: Progress) -> AmortisedNetworks:
    """Amortised networks of all equations, trained on windows drawn as spectra by the worker processes."""
    per_batch = min(_CONDITIONS_PER_BATCH, max(1, n_draws // 8))
    n_batches = max(1, n_draws // per_batch)
    draws, features = FeatureDraws.for_machine(machine, seed, per_batch), ForceFeatures(machine)
    task = bar.add_task("amortised: drawing and training", total=n_batches * draws.windows)
    return train_networks(
        machine,
        features.states,
        (draws.mean, draws.directions),
        draws.n_common,
        batches(draws, n_batches, processes),
        n_batches * draws.windows,
        LOG_RATIO,
        seed,
        partial(bar.advance, task),
    )


def _calibrate_amortised(
    machine: Machine, amortised: AmortisedNetworks, n_windows: int, seed: int, processes: int, bar: Progress
) -> AmortisedNetworks:
    """Calibrate on simulated windows of either layout, half of them healthy, half with everything changed."""
    count = _CALIBRATION_SHARE * n_windows
    task = bar.add_task("amortised: calibrating", total=count * len(Layout))
    draws = [
        [
            Draw(machine, seed, Purpose.CALIBRATION, _CALIBRATION_STREAM + 2 * layout + varied, kept, layout=layout)
            for varied, kept in enumerate((PARAMETERS, ()))
        ]
        for layout in Layout
    ]
    groups = [
        chain.from_iterable(_held_out(draw, count // 2, processes, partial(bar.advance, task)) for draw in pair)
        for pair in draws
    ]
    return calibrate_networks(machine, amortised, groups)


def _held_out(
    draw: Draw, count: int, processes: int, progress: Callable[[int], None]
) -> Iterator[tuple[WindowStatistics, dict[str, float]]]:
    for number, window in enumerate(windows(draw, range(count), processes, progress)):
        yield window, _changes(draw, number)


def _changes(draw: Draw, number: int) -> dict[str, float]:
    """True relative changes of a drawn window."""
    events = draw_condition(draw, number).events
    return {
        event.parameter: event.relative_change
        for event in events
        if event.parameter is not None and event.relative_change is not None
    }


def _complete(bar: Progress, task: TaskID, done: float) -> None:
    bar.update(task, completed=done)
