"""What ``rotortrain train`` does: simulate, train, calibrate, and write the bundle."""

import platform
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rich.progress import Progress, TaskID

from models.diagnosis.networks.amortised import NEAR, AmortisedNetworks, NearNetworks
from models.diagnosis.networks.bundle import Training
from models.diagnosis.networks.equations import EQUATIONS, missing
from models.diagnosis.networks.features import ForceFeatures
from models.diagnosis.networks.relation import EquationNetwork
from models.diagnosis.networks.training import train_network, train_networks
from models.machine import Machine
from models.physics.rotor import PARAMETERS
from rotorwatch import __version__
from simulator.commands import bars
from simulator.training.calibration import calibrate_for, rig_for
from simulator.training.draws import Draw, Purpose, windows
from simulator.training.spectral_draws import LOG_RATIO, FeatureDraws, batches

_CONDITIONS_PER_BATCH = 480


def train_for(machine: Machine, out: Path, n_windows: int, n_draws: int, seed: int, processes: int) -> None:
    """Train every equation's relation network and amortised network for the machine and write the bundle.

    `n_windows` are simulated for the training of each relation network, and a number in proportion for the calibration.
    `n_draws` random machines and conditions train the first reading of the amortised networks, half as many the second.

    Raises
    ------
    RotorwatchError
        If the bundle directory is not usable.
    """
    networks: list[EquationNetwork] = []
    with bars(remaining=True) as bar:
        for stream, equation in enumerate(EQUATIONS):
            rig = rig_for(machine, equation)
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
            bar.console.print(
                "amortised networks: left out: they need a phase reference (theta) and a measured equation"
            )
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
    calibrate_for(machine, tuple(networks), amortised, made, out, processes)


def _train_amortised(
    machine: Machine, n_draws: int, seed: int, processes: int, bar: Progress, near: bool
) -> AmortisedNetworks:
    """Amortised networks of all equations, trained on windows drawn as spectra by the worker processes."""
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


def _complete(bar: Progress, task: TaskID, done: float) -> None:
    bar.update(task, completed=done)
