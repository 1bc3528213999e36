"""What ``rotortrain train`` does (simulate, train, calibrate, write the bundle), and ``calibrate``: its second half."""

import platform
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from models.diagnosis.networks.amortised import NEAR, AmortisedNetworks, NearNetworks
from models.diagnosis.networks.bundle import Training, load_bundle, save_bundle
from models.diagnosis.networks.calibration import Held, calibrate, calibrate_networks
from models.diagnosis.networks.equations import EQUATIONS, Equation, SynchronousEquation, missing
from models.diagnosis.networks.features import ForceFeatures
from models.diagnosis.networks.relation import EquationNetwork
from models.machine import Machine
from models.physics.rotor import PARAMETERS
from rotorwatch import __version__
from simulator.commands import bars
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, windows, with_tilt
from simulator.training.spectral_draws import LOG_RATIO, FeatureDraws, batches

_CONDITIONS_PER_BATCH = 480
# Calibration windows of each layout over the training windows of a relation network: with everything changed, for each
# relation network; and healthy or changed, for the amortised networks.
_CHANGED_SHARE, _AMORTISED_SHARE = 0.75, 4.0
_AMORTISED_STREAM, _CHANGED_STREAM = 20, 30


def train_for(machine: Machine, out: Path, n_windows: int, n_draws: int, seed: int, processes: int) -> None:
    """Train every equation's relation network and amortised network for the machine and write the bundle.

    `n_windows` are simulated for the training of each relation network, and a number in proportion for the calibration.
    `n_draws` random machines and conditions train the first reading of the amortised networks, half as many the second.
    """
    from models.diagnosis.networks.training import train_network  # noqa: PLC0415  # needs torch, calibration does not

    networks: list[EquationNetwork] = []
    with bars(remaining=True) as bar:
        for stream, equation in enumerate(EQUATIONS):
            rig = _rig_for(machine, equation)
            absent = missing(equation, rig.descriptor.states)
            if absent:
                bar.console.print(f"({equation.number}) {equation.title}: left out, not measured: {', '.join(absent)}")
                continue
            label = f"({equation.number}) {equation.title}"
            simulating = bar.add_task(f"{label}: simulating", total=n_windows)
            draw = Draw(rig, seed, Purpose.TRAINING, stream, equation.kept_nominal)
            training = list(windows(draw, range(n_windows), processes, partial(bar.advance, simulating)))
            fitting = bar.add_task(f"{label}: training", total=1.0)
            networks.append(train_network(equation, training, rig, seed, partial(_complete, bar, fitting)))
        amortised = None
        if not networks or "theta" not in machine.descriptor.states:
            # Without a phase reference the rotation's line stays in the spectra, which the drawn ones do not have.
            why = "they need a phase reference (theta) and a measured equation"
            bar.console.print(f"amortised networks: left out: {why}")
        else:
            amortised = _train_amortised(machine, n_draws, seed, processes, bar, near=False)
            near = _train_amortised(machine, n_draws // 2, seed, processes, bar, near=True)  # a simpler task
            basis = replace(near.basis, precision_factor=near.basis.precision_factor[:, :0])
            amortised = replace(amortised, near=NearNetworks(basis, near.networks))
    versions = {name: version(name) for name in ("numpy", "torch")} | {
        "rotorwatch": __version__,
        "python": platform.python_version(),
    }
    made = Training(
        seed=seed, training_windows=n_windows, calibration_windows=0, drawn_conditions=n_draws, versions=versions
    )
    _calibrate_for(machine, tuple(networks), amortised, made, out, processes)


def _train_amortised(
    machine: Machine, n_draws: int, seed: int, processes: int, bar: Progress, near: bool
) -> AmortisedNetworks:
    """Amortised networks of all equations, trained on windows drawn as spectra by the worker processes."""
    from models.diagnosis.networks.training import train_networks  # noqa: PLC0415  # needs torch

    per_batch = min(_CONDITIONS_PER_BATCH, max(1, n_draws // 8))
    n_batches = max(1, n_draws // per_batch)
    draws, features = FeatureDraws.for_machine(machine, seed, per_batch, near), ForceFeatures(machine)
    label = f"amortised, {'second' if near else 'first'} reading: drawing and training"
    task = bar.add_task(label, total=n_batches * draws.windows)
    return train_networks(
        machine,
        features.states,
        (draws.mean, draws.directions),
        draws.n_common,
        batches(draws, n_batches, processes),
        n_batches * draws.windows,
        np.array([NEAR[name] for name in PARAMETERS]) if near else LOG_RATIO,
        seed,
        partial(bar.advance, task),
    )


def calibrate_again(machine: Machine, bundle: str, out: Path, processes: int) -> None:
    """Calibrate trained networks anew, with the same weights."""
    trained = load_bundle(bundle, machine)
    _calibrate_for(machine, trained.networks, trained.amortised, trained.manifest.training, out, processes)


def _complete(bar: Progress, task: TaskID, done: float) -> None:
    bar.update(task, completed=done)


def _calibrate_for(
    machine: Machine,
    networks: tuple[EquationNetwork, ...],
    amortised: AmortisedNetworks | None,
    made: Training,
    out: Path,
    processes: int,
) -> None:
    """Calibrate networks of a machine, with the seed and number of windows of their training, and write the bundle."""
    n_windows, seed = made.training_windows, made.seed
    n_healthy, n_changed = max(1, n_windows // 2), max(1, round(_CHANGED_SHARE * n_windows))
    n_amortised = max(1, round(_AMORTISED_SHARE * n_windows / 2))
    calibrated = []
    with bars(remaining=True) as bar:
        for trained in networks:
            equation = trained.equation
            rig, stream = _rig_for(machine, equation), [one.number for one in EQUATIONS].index(equation.number)
            assumed = tuple(name for name in equation.kept_nominal if name not in equation.parameters)
            task = bar.add_task(f"({equation.number}) {equation.title}: calibrating", total=n_healthy + 2 * n_changed)
            step, held = partial(bar.advance, task), []
            for layout in Layout:
                own = _CHANGED_STREAM + 2 * stream + layout
                changed = Draw(rig, seed, Purpose.CALIBRATION, own, assumed, layout=layout)
                held.append(_held_out(changed, n_changed, processes, step))
            healthy = Draw(rig, seed, Purpose.CALIBRATION, stream, equation.kept_nominal)
            calibrated.append(calibrate(trained, windows(healthy, range(n_healthy), processes, step), held, rig))
        if amortised is not None:
            amortised = _calibrated(machine, amortised, n_amortised, seed, processes, bar)
    numbers = {
        "calibration_windows": n_healthy + 2 * n_changed,
        "network_calibration_windows": 0 if amortised is None else 2 * n_amortised * len(Layout),
    }
    bundle = save_bundle(out, machine, tuple(calibrated), made.model_copy(update=numbers), amortised)
    title = f"bundle {bundle.identity}"
    table = Table("equation", "parameter", "healthy spread per window", "residual (MSD)", title=title)
    for equation, found in ((one.equation, one.healthy) for one in calibrated if one.healthy is not None):
        for parameter, spread in zip(equation.parameters, found.spread, strict=True):
            table.add_row(f"({equation.number}) {equation.title}", parameter, f"{spread:.2%}", f"{found.msd:.2g}")
    Console().print(table)
    typer.echo(f"written to {out}")


def _rig_for(machine: Machine, equation: Equation | SynchronousEquation) -> Machine:
    """The machine, with tilt simulated where an equation needs it and it is not measured.

    So the same bundle serves the machine once it has tilt probes.
    """
    return with_tilt(machine) if missing(equation, machine.descriptor.states) else machine


def _calibrated(
    machine: Machine, amortised: AmortisedNetworks, count: int, seed: int, processes: int, bar: Progress
) -> AmortisedNetworks:
    """Calibrate on simulated windows of either layout, half of them healthy, half with everything changed."""
    task = bar.add_task("amortised: calibrating", total=2 * count * len(Layout))

    def held(layout: Layout) -> Iterator[Held]:
        for varied, kept in enumerate((PARAMETERS, ())):
            stream = _AMORTISED_STREAM + 2 * layout + varied
            draw = Draw(machine, seed, Purpose.CALIBRATION, stream, kept, layout=layout)
            yield from _held_out(draw, count, processes, partial(bar.advance, task))

    return calibrate_networks(machine, amortised, held(Layout.ONE_SOURCE), held(Layout.INDEPENDENT))


def _held_out(draw: Draw, count: int, processes: int, progress: Callable[[int], None]) -> Iterator[Held]:
    """Windows with their true relative changes."""
    for number, window in enumerate(windows(draw, range(count), processes, progress)):
        drawn = [(event.parameter, event.relative_change) for event in draw_condition(draw, number).events]
        yield window, {name: change for name, change in drawn if name is not None and change is not None}
