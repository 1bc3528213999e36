"""What ``rotortrain calibrate`` does, and ``train`` at its end: calibrate networks on simulated windows."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from models.diagnosis.networks.amortised import AmortisedNetworks
from models.diagnosis.networks.bundle import Training, load_bundle, save_bundle
from models.diagnosis.networks.calibration import Held, calibrate, calibrate_networks
from models.diagnosis.networks.equations import EQUATIONS, Equation, SynchronousEquation, missing
from models.diagnosis.networks.relation import EquationNetwork
from models.machine import Machine
from models.physics.rotor import PARAMETERS
from simulator.commands import bars
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, windows, with_tilt

# Calibration windows of each layout over the training windows of a relation network: with everything changed, for each
# relation network; and healthy or changed, for the amortised networks.
_CHANGED_SHARE, _AMORTISED_SHARE = 0.75, 4.0
_AMORTISED_STREAM, _CHANGED_STREAM = 20, 30


def calibrate_again(machine: Machine, bundle: str, out: Path, processes: int) -> None:
    """Calibrate trained networks anew, with the same weights.

    Raises
    ------
    BundleError
        If the bundle is damaged or of another machine.
    """
    trained = load_bundle(bundle, machine)
    calibrate_for(machine, trained.networks, trained.amortised, trained.manifest.training, out, processes)


def calibrate_for(
    machine: Machine,
    networks: tuple[EquationNetwork, ...],
    amortised: AmortisedNetworks | None,
    made: Training,
    out: Path,
    processes: int,
) -> None:
    """Calibrate networks of a machine, with the seed and number of windows of their training, and write the bundle.

    Raises
    ------
    RotorwatchError
        If the bundle directory is not usable.
    """
    n_windows, seed = made.training_windows, made.seed
    n_healthy, n_changed = max(1, n_windows // 2), max(1, round(_CHANGED_SHARE * n_windows))
    n_amortised = max(1, round(_AMORTISED_SHARE * n_windows / 2))
    calibrated = []
    with bars(remaining=True) as bar:
        for trained in networks:
            equation = trained.equation
            rig, stream = rig_for(machine, equation), [one.number for one in EQUATIONS].index(equation.number)
            assumed = tuple(name for name in equation.kept_nominal if name not in equation.parameters)
            task = bar.add_task(f"({equation.number}) {equation.title}: calibrating", total=n_healthy + 2 * n_changed)
            step = partial(bar.advance, task)
            healthy = Draw(rig, seed, Purpose.CALIBRATION, stream, equation.kept_nominal)
            changed = (
                Draw(rig, seed, Purpose.CALIBRATION, _CHANGED_STREAM + 2 * stream + layout, assumed, layout=layout)
                for layout in Layout
            )
            held = [_held_out(draw, n_changed, processes, step) for draw in changed]
            still = windows(healthy, range(n_healthy), processes, step)
            calibrated.append(calibrate(trained, still, held, rig))
        if amortised is not None:
            amortised = _calibrated(machine, amortised, n_amortised, seed, processes, bar)
    numbers = {
        "calibration_windows": n_healthy + 2 * n_changed,
        "network_calibration_windows": 0 if amortised is None else 2 * n_amortised * len(Layout),
    }
    bundle = save_bundle(out, machine, tuple(calibrated), made.model_copy(update=numbers), amortised)
    table = Table(
        "equation", "parameter", "healthy spread per window", "residual (MSD)", title=f"bundle {bundle.identity}"
    )
    for trained in calibrated:
        if trained.healthy is not None:
            for parameter, spread in zip(trained.equation.parameters, trained.healthy.spread, strict=True):
                number = f"({trained.equation.number}) {trained.equation.title}"
                table.add_row(number, parameter, f"{spread:.2%}", f"{trained.healthy.msd:.2g}")
    Console().print(table)
    typer.echo(f"written to {out}")


def rig_for(machine: Machine, equation: Equation | SynchronousEquation) -> Machine:
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
    for number, window in enumerate(windows(draw, range(count), processes, progress)):
        yield window, _changes(draw, number)


def _changes(draw: Draw, number: int) -> dict[str, float]:
    """True relative changes of a drawn window."""
    return {
        event.parameter: event.relative_change
        for event in draw_condition(draw, number).events
        if event.parameter is not None and event.relative_change is not None
    }
