"""Training of the relation networks, of one equation each, and of the amortised networks.

In the training windows of an equation, its own parameters are nominal and everything else is drawn at random, so that
the residual is insensitive to other faults and to the operating condition.

For the amortised networks, each step uses windows drawn at random from a buffer that is renewed continually. A fixed
set of training windows would be overfitted, and the networks' variances would shrink to the errors on that set. As the
negative log-density of a normal distribution diverges at high learning rates, gradients are clipped and the rate falls
along a half cosine.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

import numpy as np
import torch

from models.diagnosis.networks.amortised import LAYERS, LIMIT, OWN, AmortisedNetwork, AmortisedNetworks
from models.diagnosis.networks.equations import Equation, SynchronousEquation
from models.diagnosis.networks.features import FeatureBasis, fit_basis
from models.diagnosis.networks.relation import HIDDEN, EquationNetwork, Network, window_view
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.physics.rotor import PARAMETERS
from models.signals.block import Float32Array, FloatArray

_ROUNDS = 40
_STEPS_PER_ROUND = 25


def train_network(
    equation: Equation | SynchronousEquation,
    windows: Sequence[WindowStatistics],
    machine: Machine,
    seed: int,
    progress: Callable[[float], None] = lambda _: None,
) -> EquationNetwork:
    """Fit the network of one equation, without calibrating it, to windows that differ in all but its own parameters.

    Raises
    ------
    EstimationError
        If the fitted weights are not finite.
    """
    torch.set_num_threads(1)  # so that sums keep their order, whatever ran before in this process
    rows = [equation.rows(window_view(window, machine), machine) for window in windows]
    inputs = np.concatenate([row.inputs / row.norm for row in rows])
    target = np.concatenate([row.target / row.norm for row in rows])
    scale = np.sqrt(np.mean(inputs**2, axis=0))
    x, t = torch.from_numpy(inputs / scale), torch.from_numpy(target)
    generator = torch.Generator().manual_seed(seed)
    n_inputs = inputs.shape[1]
    # Small first-layer weights: the relation is nearly linear, and so is tanh near zero.
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
    arrays = [weight.detach().numpy().astype(np.float64) for weight in weights]
    if not all(np.all(np.isfinite(array)) for array in arrays):
        raise EstimationError(f"{machine.name}: training of equation {equation.number} diverged")
    return EquationNetwork(equation, Network(scale, *arrays), healthy=None)


_BATCH = 512
_PASSES = 3.0  # average number of times that a window is used
_BUFFER = 160_000
_WARM_UP = 24_000  # windows in the buffer before the first step; the inputs are standardised with them
_RATE, _RATE_RISES_OVER = 2e-3, 100
_WEIGHT_DECAY = 2e-2
_NOVELTY_QUANTILE, _NOVELTY_MARGIN = 0.999, 1.25


class _Learner:
    """One equation's amortised network during training."""

    def __init__(self, equation: str, n_inputs: int, usual: Float32Array, generator: torch.Generator) -> None:
        self.equation = equation
        self.targets = [PARAMETERS.index(name) for name in OWN[equation]]
        self._usual = usual[self.targets]
        self.n_inputs = n_inputs
        p = len(self.targets)
        sizes = (n_inputs, *LAYERS, 1 + 1 if p == 1 else 5)
        self.weights = [torch.randn(a, b, generator=generator) * (0.5 / a**0.5) for a, b in pairwise(sizes)]
        self.weights[-1] *= 0.1
        self.biases = [torch.zeros(b) for b in sizes[1:]]
        self.direct = torch.zeros(n_inputs, p)
        self.parts = [*self.weights, *self.biases, self.direct]
        for part in self.parts:
            part.requires_grad_(True)
        self.optimiser = torch.optim.AdamW(self.parts, lr=_RATE, weight_decay=_WEIGHT_DECAY)

    def step(self, inputs: torch.Tensor, log_ratio: torch.Tensor, rate: float) -> None:
        """Take one step on a batch."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad()
        loss = self._loss(inputs[:, : self.n_inputs], log_ratio[:, self.targets] / torch.from_numpy(self._usual))
        loss.backward()  # type: ignore[no-untyped-call]  # torch annotates it only in part
        torch.nn.utils.clip_grad_norm_(self.parts, 1.0)
        self.optimiser.step()

    def _loss(self, inputs: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Mean negative log-density of the normal distribution, without its constant."""
        hidden = inputs
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = torch.nn.functional.silu(hidden @ weight + bias)
        out = hidden @ self.weights[-1] + self.biases[-1]
        p = len(self.targets)
        error = target - out[:, :p] - inputs @ self.direct
        log_deviation = out[:, p : 2 * p]
        white = error * torch.exp(-log_deviation)
        if p == 2:
            white = torch.stack([white[:, 0], white[:, 1] - out[:, 4] * white[:, 0]], dim=1)
        return torch.mean(torch.sum(white**2 / 2 + log_deviation, dim=1))

    def finished(self) -> AmortisedNetwork:
        """Return the network, with outputs scaled to logarithmic ratios."""
        p = len(self.targets)
        weights = [_array(weight) for weight in self.weights]
        biases = [_array(bias) for bias in self.biases]
        weights[-1][:, :p] *= self._usual
        biases[-1][:p] *= self._usual
        biases[-1][p : 2 * p] += np.log(self._usual)
        return AmortisedNetwork(self.equation, tuple(weights), tuple(biases), _array(self.direct) * self._usual)


def train_networks(
    machine: Machine,
    states: tuple[str, ...],
    principal: tuple[Float32Array, Float32Array],
    n_common: int,
    batches: Iterable[tuple[Float32Array, Float32Array]],
    expected_windows: int,
    log_range: float | FloatArray,
    seed: int,
    progress: Callable[[int], None] = lambda _: None,
) -> AmortisedNetworks:
    """Train the networks of all equations on a stream of batches.

    Parameters
    ----------
    states, principal : tuple
        Measured states that the features were made of; mean and directions with which they were condensed.
    n_common : int
        Number of features that all networks share; the rest are for equation 29.
    batches : iterable of (features, logarithmic ratios)
        Condensed features, shape (n_windows, n_features), and targets, shape (n_windows, 6).
    expected_windows : int
        Number of windows in all batches together, for the schedule of the learning rate.
    log_range : float or ndarray, shape (6,)
        Largest drawn logarithmic ratio of each of `PARAMETERS`.
    seed : int
        For the initial weights and the choice from the buffer.
    progress : callable
        Called with the number of windows of each batch.

    Raises
    ------
    EstimationError
        If the batches hold too few windows to start, or the training diverges.
    """
    torch.set_num_threads(1)  # other processes make the windows, and sums keep their order
    generator = torch.Generator().manual_seed(seed)
    warm_up = min(_WARM_UP, expected_windows // 2)
    buffer = _Buffer(min(_BUFFER, expected_windows))
    total_steps = max(1, int(_PASSES * (expected_windows - warm_up) / _BATCH))
    basis: FeatureBasis | None = None
    learners: list[_Learner] = []
    # Standard deviation of the drawn ratios, the unit of the networks' outputs.
    usual = np.broadcast_to(np.float32(log_range) / np.float32(3**0.5), len(PARAMETERS))
    step = 0
    for features, log_ratio in batches:
        buffer.add(features, log_ratio)
        progress(features.shape[0])
        if buffer.seen < warm_up:
            continue
        if basis is None:
            basis = fit_basis(*principal, buffer.features[: buffer.filled], n_common)
            n_all = features.shape[1]
            equations = [number for number in OWN if number != "29" or n_all > n_common]
            sizes = {number: n_all if number == "29" else n_common for number in equations}
            learners = [_Learner(number, size, usual, generator) for number, size in sizes.items()]
        due = int(_PASSES * (buffer.seen - warm_up) / _BATCH)
        while step < min(due, total_steps):
            chosen = torch.randint(buffer.filled, (_BATCH,), generator=generator).numpy()
            inputs = torch.from_numpy(np.clip(basis.standardised(buffer.features[chosen]), -LIMIT, LIMIT))
            targets = torch.from_numpy(buffer.log_ratio[chosen])
            rate = _RATE * min(1.0, (step + 1) / _RATE_RISES_OVER) * 0.5 * (1 + np.cos(np.pi * step / total_steps))
            for learner in learners:
                learner.step(inputs, targets, rate)
            step += 1
    if basis is None:
        raise EstimationError(f"{machine.name}: {buffer.seen} windows are too few to train on, expected {warm_up}")
    networks = tuple(learner.finished() for learner in learners)
    if not all(np.all(np.isfinite(part)) for network in networks for part in (*network.weights, *network.biases)):
        raise EstimationError(f"{machine.name}: training of the amortised networks diverged")
    novelty = basis.novelty(basis.standardised(buffer.features[: buffer.filled]))
    limit = float(np.quantile(novelty, _NOVELTY_QUANTILE)) * _NOVELTY_MARGIN
    return AmortisedNetworks(states, basis, networks, {}, limit, float(np.max(log_range)))


class _Buffer:
    """Ring buffer of the latest windows of the stream."""

    def __init__(self, size: int) -> None:
        self._size = size
        self.seen = 0
        self.features: Float32Array = np.empty((0, 0), dtype=np.float32)
        self.log_ratio: Float32Array = np.empty((size, len(PARAMETERS)), dtype=np.float32)

    @property
    def filled(self) -> int:
        """Number of windows in the buffer."""
        return min(self.seen, self._size)

    def add(self, features: Float32Array, log_ratio: Float32Array) -> None:
        """Replace the oldest windows by new ones."""
        if not self.seen:
            self.features = np.empty((self._size, features.shape[1]), dtype=np.float32)
        places = (self.seen + np.arange(features.shape[0])) % self._size
        self.features[places], self.log_ratio[places] = features, log_ratio
        self.seen += features.shape[0]


def _array(part: torch.Tensor) -> Float32Array:
    return np.ascontiguousarray(part.detach().numpy(), dtype=np.float32).copy()
