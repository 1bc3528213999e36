"""The paper's own diagnostician: equations (28)-(31) as printed, for comparison.

It uses reference y1 only, correlation functions from lag 0 on including the synchronous part, inputs and target at the
same lag, one hidden layer of fifteen units, one training row per lag, and the mean squared deviation as the measure. It
names equations, not sizes of changes. For what had to be added for independent data, see
`models.diagnosis.networks.equations` and ``docs/method.md``; for results of this variant, ``docs/reproduction.md``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.studies.reporting.results import limits_of
from models.diagnosis.networks.relation import HIDDEN, Network
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.signals.block import FloatArray

_PHASE = "n"
_STEPS = 1000


@dataclass(frozen=True, slots=True)
class PaperEquation:
    """One architecture of §3 of the paper: inputs and target are correlations R_ij as pairs of states.

    ``n`` stands for the phase reference; `parameters` are the equation's own.
    """

    number: str
    inputs: tuple[tuple[str, str], ...]
    target: tuple[str, str]
    parameters: tuple[str, ...]

    def measured_in(self, window: WindowStatistics) -> bool:
        """Whether a window has all states that the equation needs."""
        names = {name for pair in (*self.inputs, self.target) for name in pair}
        return names <= {*window.states, *(() if window.synchronous is None else (_PHASE,))}


PAPER_EQUATIONS = (
    PaperEquation("28", (("y1", "y1"), ("y1", "y2"), ("y1", "y1_dot")), ("y1_dot", "y1_dot"), ("k_by", "c_by")),
    PaperEquation("29", (("y1", "y1"), ("y1", "y2"), ("y1", _PHASE)), ("y1_dot", "y2_dot"), ("e",)),
    PaperEquation("30", (("y1", "y1"), ("y2", "y1")), ("y1_dot", "psi_dot"), ("EI",)),
    PaperEquation("31", (("y1", "z1"), ("y1", "z2"), ("y1", "z1_dot")), ("y1_dot", "z1_dot"), ("k_bz", "c_bz")),
)
"""R11, R12, R17 → R77; R11, R12, R1n → R78; R11, R21 → R79; R14, R15, R1,10 → R7,10, in the paper's state numbers."""


def full_correlation(window: WindowStatistics, reference: str, response: str) -> FloatArray:
    """R_ij(τ) including the synchronous part (Eqs. 17-18), shape (n_lags,).

    The window holds the stochastic part; the synchronous part x_n = Re{q e^{jθ}} adds ½ Re{q̄_i q_j e^{jΩτ}}.
    """
    i, j = window.states.index(reference), window.states.index(response)
    rest = window.correlation[:, i, j]
    if window.synchronous is None:
        return rest
    q = window.synchronous
    turn = np.exp(1j * window.speed_rad_s * window.lags_s)
    return np.asarray(rest + 0.5 * np.real(np.conj(q[i]) * q[j] * turn), dtype=np.float64)


def phase_correlation(window: WindowStatistics, reference: str, unbalance_phase_rad: float) -> FloatArray:
    """R_in(τ) = E{x_i(t) n(t+τ)} with n = cos Ωt relative to the heavy spot (Eqs. 6, 23), shape (n_lags,).

    Raises
    ------
    EstimationError
        Without a phase reference.
    """
    if window.synchronous is None:
        raise EstimationError("the correlation with the phase reference n(t) needs a shaft angle channel, found none")
    q = window.synchronous[window.states.index(reference)]
    angle = window.speed_rad_s * window.lags_s + unbalance_phase_rad
    return np.asarray(0.5 * np.real(np.conj(q) * np.exp(1j * angle)), dtype=np.float64)


def paper_rows(equation: PaperEquation, window: WindowStatistics, machine: Machine) -> tuple[FloatArray, FloatArray]:
    """Inputs and target, one row per lag, from lag 0 on, SI units: shapes (n_lags, n_inputs) and (n_lags,)."""

    def values(pair: tuple[str, str]) -> FloatArray:
        reference, response = pair
        if response == _PHASE:
            return phase_correlation(window, reference, machine.operation.unbalance_phase_rad)
        return full_correlation(window, reference, response)

    return np.stack([values(pair) for pair in equation.inputs], axis=1), values(equation.target)


@dataclass(frozen=True, slots=True)
class PaperNetwork:
    """A trained network (Eq. 32) with the equation it stands for; its output is in units of `target_scale`."""

    equation: PaperEquation
    machine: Machine
    network: Network
    target_scale: float

    def deviation(self, window: WindowStatistics) -> float:
        """MSD between the network's output and the estimated correlation, in units of the latter's mean square.

        Raises EstimationError if the target correlation is zero throughout.
        """
        inputs, target = paper_rows(self.equation, window, self.machine)
        power = float(np.mean(target**2))
        if not power > 0:
            number = self.equation.number
            raise EstimationError(f"{self.machine.name}: equation {number}: the target correlation is zero")
        return float(np.mean((self.network(inputs) * self.target_scale - target) ** 2)) / power


def train_paper_network(
    equation: PaperEquation, windows: Sequence[WindowStatistics], machine: Machine, seed: int
) -> PaperNetwork:
    """Fit one of the paper's networks to windows of the healthy machine, with random initial weights from a seed.

    Correlations keep their units: no window is normalised. All inputs and the target are divided by their rms over the
    training rows, which only helps the search.

    Raises EstimationError if there is no window, or the fit is not finite.
    """
    import torch  # noqa: PLC0415  # takes seconds, only needed for training

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
    return PaperNetwork(equation, machine, Network(input_scale, W1, b1, W2, b2), target_scale)


@dataclass(frozen=True, slots=True)
class PaperDiagnostician:
    """Names the inconsistent equations, whose MSD exceeds a limit set by healthy windows."""

    networks: Sequence[PaperNetwork]
    limits: Mapping[str, float]

    @classmethod
    def calibrated(
        cls, networks: Sequence[PaperNetwork], healthy: Sequence[WindowStatistics], false_alarm_rate: float
    ) -> "PaperDiagnostician":
        """Set the limits for a false-alarm rate per window, over all equations together.

        Raises EstimationError if there are too few windows for the declared rate.
        """
        undecided = cls(networks, {})
        return cls(networks, limits_of([undecided.deviations(window) for window in healthy], false_alarm_rate))

    def deviations(self, window: WindowStatistics) -> dict[str, float]:
        """MSD of every equation whose states are measured."""
        able = (one for one in self.networks if one.equation.measured_in(window))
        return {one.equation.number: one.deviation(window) for one in able}

    def flagged(self, deviations: Mapping[str, float]) -> tuple[str, ...]:
        """Numbers of the equations that are inconsistent."""
        return tuple(number for number, msd in deviations.items() if msd > self.limits[number])
