"""Training of the paper's networks: one hidden layer of fifteen, one row per lag, mean squared error."""

from collections.abc import Sequence

import numpy as np

from benchmarks.studies.paper import PaperEquation, PaperNetwork, paper_rows
from models.diagnosis.networks.relation import HIDDEN, Network
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine

_STEPS = 1000


def train_paper_network(
    equation: PaperEquation, windows: Sequence[WindowStatistics], machine: Machine, seed: int
) -> PaperNetwork:
    """Fit one of the paper's networks to healthy windows.

    Correlations stand in their own units: no window is normalised. All inputs are divided by their rms over the
    training rows, and the target by its own, which only helps the search.

    Parameters
    ----------
    equation : PaperEquation
    windows : sequence of WindowStatistics
        Of the healthy machine.
    machine : Machine
    seed : int
        Of the initial weights.

    Raises
    ------
    EstimationError
        If there is no window, or the fit does not come out finite.
    """
    import torch  # noqa: PLC0415  # for whoever trains: it takes seconds

    if not windows:
        raise EstimationError(f"{machine.name}: no training window for equation {equation.number}, expected at least 1")
    rows = [paper_rows(equation, window, machine) for window in windows]
    inputs = np.concatenate([one for one, _ in rows])
    target = np.concatenate([one for _, one in rows])
    input_scale = np.sqrt(np.mean(inputs**2, axis=0))
    target_scale = float(np.sqrt(np.mean(target**2)))
    x, t = torch.from_numpy(inputs / input_scale), torch.from_numpy(target / target_scale)
    generator = torch.Generator().manual_seed(seed)
    n_inputs = inputs.shape[1]
    weights = [
        torch.randn(n_inputs, HIDDEN, generator=generator, dtype=torch.float64) * 0.5 / n_inputs**0.5,
        torch.zeros(HIDDEN, dtype=torch.float64),
        torch.randn(HIDDEN, generator=generator, dtype=torch.float64) / HIDDEN**0.5,
        torch.zeros(1, dtype=torch.float64),
    ]
    for weight in weights:
        weight.requires_grad_(True)
    optimiser = torch.optim.LBFGS(
        weights, max_iter=_STEPS, history_size=30, line_search_fn="strong_wolfe", tolerance_grad=1e-10
    )

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        output = torch.tanh(x @ weights[0] + weights[1]) @ weights[2] + weights[3]
        value = torch.mean((output - t) ** 2)
        value.backward()  # type: ignore[no-untyped-call]  # torch annotates it only in part
        return value

    optimiser.step(loss)  # type: ignore[no-untyped-call]  # the stub asks for a closure returning float
    W1, b1, W2, b2 = (np.asarray(weight.detach().numpy(), dtype=np.float64) for weight in weights)
    if not all(np.all(np.isfinite(array)) for array in (W1, b1, W2, b2)):
        raise EstimationError(f"{machine.name}: training of equation {equation.number} diverged")
    return PaperNetwork(equation, Network(input_scale, W1, b1, W2, b2), target_scale)
