"""Training of one equation's network, and its calibration on windows of its own.

The training windows keep the equation's own parameters nominal and draw everything else at random: the residual becomes
blind to other faults and to the operating condition by construction.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch

from models.diagnosis.networks.equations import Equation, SynchronousEquation
from models.diagnosis.networks.relation import HIDDEN, EquationNetwork, Healthy, Network, read_equation, window_view
from models.diagnosis.readings import Z95
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.signals.block import FloatArray

__all__ = ["calibrate", "train_network"]

_ROUNDS = 40
_STEPS_PER_ROUND = 25

_LEVELS = [0.9, 0.95]
_NORMAL = np.array([[1.644854], [Z95]])
"""Quantiles of |z| that calibrate the standard errors, and the normal distribution's: two scatter less than one."""
_MAD = 1.4826
"""Median absolute deviation to standard deviation."""


def train_network(
    equation: Equation | SynchronousEquation,
    windows: Sequence[WindowStatistics],
    machine: Machine,
    seed: int,
    progress: Callable[[float], None] = lambda _: None,
) -> EquationNetwork:
    """Fit the network of one equation.

    Parameters
    ----------
    windows : sequence of WindowStatistics
        Own parameters nominal, everything else random.
    seed : int
        Of the initial weights.
    progress : callable
        Called with the fraction done.

    Returns
    -------
    EquationNetwork
        Not calibrated yet.

    Raises
    ------
    EstimationError
        If the fit does not come out finite.
    """
    rows = [equation.rows(window_view(window, machine), machine) for window in windows]
    inputs = np.concatenate([row.inputs / row.norm for row in rows])
    target = np.concatenate([row.target / row.norm for row in rows])
    scale = np.sqrt(np.mean(inputs**2, axis=0))
    x, t = torch.from_numpy(inputs / scale), torch.from_numpy(target)
    generator = torch.Generator().manual_seed(seed)
    n_inputs = inputs.shape[1]
    # Small first-layer weights: the relation is nearly linear, and tanh is too near zero.
    W1 = torch.randn(n_inputs, HIDDEN, generator=generator, dtype=torch.float64) * 0.1 / n_inputs**0.5
    W2 = torch.randn(HIDDEN, generator=generator, dtype=torch.float64) / HIDDEN**0.5
    weights = [W1, torch.zeros(HIDDEN, dtype=torch.float64), W2, torch.zeros(1, dtype=torch.float64)]
    for weight in weights:
        weight.requires_grad_(True)
    optimiser = torch.optim.LBFGS(
        weights,
        lr=1.0,
        max_iter=_STEPS_PER_ROUND,
        history_size=30,
        line_search_fn="strong_wolfe",
        tolerance_grad=1e-12,
        tolerance_change=1e-15,
    )

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        output = torch.tanh(x @ weights[0] + weights[1]) @ weights[2] + weights[3]
        value = torch.mean((output - t) ** 2)
        value.backward()  # type: ignore[no-untyped-call]  # torch annotates it only in part
        return value

    for done in range(_ROUNDS):
        optimiser.step(loss)  # type: ignore[no-untyped-call]  # the stub asks for a closure returning float
        progress((done + 1) / _ROUNDS)
    arrays = [_array(weight) for weight in weights]
    if not all(np.all(np.isfinite(array)) for array in arrays):
        raise EstimationError(f"{machine.name}: training of equation {equation.number} diverged")
    return EquationNetwork(equation, Network(scale, *arrays), healthy=None)


def calibrate(trained: EquationNetwork, windows: Sequence[WindowStatistics], machine: Machine) -> EquationNetwork:
    """Measure the healthy spread on windows that training did not see.

    Parameters
    ----------
    windows : sequence of WindowStatistics
        Healthy in the equation's own parameters, at least ten, from seeds of their own.
    """
    readings = [
        read_equation(EquationNetwork(trained.equation, trained.network, None), window, machine) for window in windows
    ]
    change = np.array([[reading.relative_change for reading in one.parameters] for one in readings], dtype=np.float64)
    error = np.array([[reading.standard_error for reading in one.parameters] for one in readings], dtype=np.float64)
    z = change / error
    healthy = Healthy(
        windows=len(windows),
        msd=float(np.mean([reading.msd for reading in readings])),
        z_scale=tuple(float(value) for value in np.mean(np.quantile(np.abs(z), _LEVELS, axis=0) / _NORMAL, axis=0)),
        spread=tuple(float(value) for value in np.median(np.abs(change), axis=0) * _MAD),
    )
    return EquationNetwork(trained.equation, trained.network, healthy)


def _array(weight: torch.Tensor) -> FloatArray:
    return np.asarray(weight.detach().numpy(), dtype=np.float64)
