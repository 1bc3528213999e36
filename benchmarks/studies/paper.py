"""The paper's own diagnostician: equations (28)-(31) as printed, for comparison.

Reference y1 alone, correlation functions from lag 0 on with the rotation-synchronous part in them, inputs and target at
the same lag, one hidden layer of fifteen, one training row per lag, and the mean squared deviation as the measure. It
names equations, not sizes. What had to be added for independent data stands in `models.diagnosis.networks.equations`
and ``docs/method.md``; how far this variant carries stands in ``docs/reproduction.md``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.diagnosis.networks.relation import Network
from models.diagnosis.readings import Diagnosis, no_reading
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.signals.block import FloatArray
from rotorwatch.records.windows import Equation

_PHASE = "n"
_SCALE_QUANTILE = 0.9


@dataclass(frozen=True, slots=True)
class PaperEquation:
    """One architecture of §3 of the paper.

    Attributes
    ----------
    number, title : str
        The paper's number, and what the equation is about.
    inputs : tuple of (str, str)
        Correlations R_ij as pairs of states; ``n`` stands for the phase reference.
    target : (str, str)
    parameters : tuple of str
        The equation's own parameters.
    """

    number: str
    title: str
    inputs: tuple[tuple[str, str], ...]
    target: tuple[str, str]
    parameters: tuple[str, ...]

    @property
    def channels(self) -> tuple[str, ...]:
        """States it needs; ``theta`` where the phase reference is one of them."""
        names = [name for pair in (*self.inputs, self.target) for name in pair]
        return tuple(dict.fromkeys("theta" if name == _PHASE else name for name in names))


PAPER_EQUATIONS: tuple[PaperEquation, ...] = (
    PaperEquation(
        "28",
        "bearing, horizontal",
        (("y1", "y1"), ("y1", "y2"), ("y1", "y1_dot")),
        ("y1_dot", "y1_dot"),
        ("k_by", "c_by"),
    ),
    PaperEquation(
        "29",
        "disc, horizontal, and unbalance",
        (("y1", "y1"), ("y1", "y2"), ("y1", _PHASE)),
        ("y1_dot", "y2_dot"),
        ("e",),
    ),
    PaperEquation("30", "disc tilt and shaft", (("y1", "y1"), ("y2", "y1")), ("y1_dot", "psi_dot"), ("EI",)),
    PaperEquation(
        "31",
        "bearing, vertical",
        (("y1", "z1"), ("y1", "z2"), ("y1", "z1_dot")),
        ("y1_dot", "z1_dot"),
        ("k_bz", "c_bz"),
    ),
)
"""R11, R12, R17 → R77; R11, R12, R1n → R78; R11, R21 → R79; R14, R15, R1,10 → R7,10, in the paper's state numbers."""


def full_correlation(window: WindowStatistics, reference: str, response: str) -> FloatArray:
    """R_ij(τ) with the rotation-synchronous part (Eqs. 17-18), shape (n_lags,).

    The window holds the stochastic rest; x_n = Re{q e^{jθ}} adds ½ Re{q̄_i q_j e^{jΩτ}}.
    """
    i, j = window.states.index(reference), window.states.index(response)
    rest = window.correlation[:, i, j]
    if window.synchronous is None:
        return rest
    q = window.synchronous
    turn = np.exp(1j * window.speed_rad_s * window.lags_s)
    return np.asarray(rest + 0.5 * np.real(np.conj(q[i]) * q[j] * turn), dtype=np.float64)


def phase_correlation(window: WindowStatistics, reference: str, unbalance_phase_rad: float) -> FloatArray:
    """R_in(τ) = E{x_i(t) n(t+τ)} with n = cos Ωt counted from the heavy spot (Eqs. 6, 23), shape (n_lags,).

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
    """One row per lag, from lag 0 on, SI units.

    Returns
    -------
    inputs : ndarray, shape (n_lags, n_inputs)
    target : ndarray, shape (n_lags,)
    """

    def values(pair: tuple[str, str]) -> FloatArray:
        reference, response = pair
        if response == _PHASE:
            return phase_correlation(window, reference, machine.operation.unbalance_phase_rad)
        return full_correlation(window, reference, response)

    return np.stack([values(pair) for pair in equation.inputs], axis=1), values(equation.target)


@dataclass(frozen=True, slots=True)
class PaperNetwork:
    """A trained network (Eq. 32) with the equation it stands for.

    Attributes
    ----------
    equation : PaperEquation
    network : Network
    target_scale : float
        Root mean square of the training targets: the network's output is in units of it.
    """

    equation: PaperEquation
    network: Network
    target_scale: float

    def output(self, window: WindowStatistics, machine: Machine) -> FloatArray:
        """Output for one window at all lags, SI units, shape (n_lags,)."""
        inputs, _ = paper_rows(self.equation, window, machine)
        return self.network(inputs) * self.target_scale


def mean_squared_deviation(trained: PaperNetwork, window: WindowStatistics, machine: Machine) -> float:
    """MSD between the network's output and the estimated correlation, in units of the latter's mean square.

    Raises
    ------
    EstimationError
        If the target correlation is zero throughout.
    """
    _, target = paper_rows(trained.equation, window, machine)
    power = float(np.mean(target**2))
    if not power > 0:
        raise EstimationError(f"{machine.name}: equation {trained.equation.number}: the target correlation is zero")
    return float(np.mean((trained.output(window, machine) - target) ** 2)) / power


@dataclass(frozen=True, slots=True)
class PaperHealthy:
    """How the networks deviate on healthy windows, and from where on an equation counts as inconsistent.

    Attributes
    ----------
    windows : int
        How many healthy windows that training did not see.
    false_alarm_rate : float
        Declared rate per window, over all equations together.
    mean : tuple of float
        Mean MSD of each equation.
    threshold : tuple of float
        Limit of each equation's MSD.
    """

    windows: int
    false_alarm_rate: float
    mean: tuple[float, ...]
    threshold: tuple[float, ...]


def calibrate_paper(
    networks: Sequence[PaperNetwork], windows: Sequence[WindowStatistics], machine: Machine, false_alarm_rate: float
) -> PaperHealthy:
    """Set every equation's limit from healthy windows.

    Every MSD is divided by its equation's 90 % quantile; the largest of these ratios is the window's score, and the
    ⌈(n+1)(1-α)⌉-th smallest score is the limit. A further healthy window exceeds it with probability α, whatever the
    distribution. An upper quantile as the scale, not a median: operating conditions make some of the MSDs many times
    larger than the rest, and one equation's conditions must not decide the limits of the others.

    Parameters
    ----------
    networks : sequence of PaperNetwork
    windows : sequence of WindowStatistics
        Healthy, from seeds of their own; at least 1/α - 1 of them.
    machine : Machine
    false_alarm_rate : float
        α, per window over all equations together.

    Raises
    ------
    EstimationError
        If there are too few windows for the declared rate.
    """
    n = len(windows)
    rank = int(np.ceil((n + 1) * (1 - false_alarm_rate) - 1e-9))
    if rank > n:
        needed = int(np.ceil(1 / false_alarm_rate - 1e-9)) - 1
        raise EstimationError(
            f"{machine.name}: {n} healthy windows for a false-alarm rate of {false_alarm_rate:g}, expected at least "
            f"{needed}"
        )
    msd = np.array([[mean_squared_deviation(network, window, machine) for network in networks] for window in windows])
    scale = np.maximum(np.quantile(msd, _SCALE_QUANTILE, axis=0), np.finfo(float).tiny)
    limit = float(np.sort((msd / scale).max(axis=1))[rank - 1])
    threshold = scale * limit * (1 + 1e-12)  # the window that sets the limit does not exceed it by rounding
    return PaperHealthy(
        n,
        false_alarm_rate,
        tuple(float(value) for value in msd.mean(axis=0)),
        tuple(float(value) for value in threshold),
    )


class PaperDiagnostician:
    """Says which of the four equations has become inconsistent.

    Parameters
    ----------
    machine : Machine
    networks : sequence of PaperNetwork
    healthy : PaperHealthy
        Of these networks, in the same order.
    """

    def __init__(self, machine: Machine, networks: Sequence[PaperNetwork], healthy: PaperHealthy) -> None:
        if len(networks) != len(healthy.threshold):
            raise EstimationError(
                f"{machine.name}: {len(networks)} networks and {len(healthy.threshold)} thresholds, expected as many"
            )
        self._machine, self._networks, self._healthy = machine, tuple(networks), healthy

    @property
    def by(self) -> str:
        """Name under which it is reported."""
        return "paper"

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        """Judge one window: MSD of every equation; every parameter with the reason why it has no size."""
        equations = tuple(self._read(trained, mean, window) for trained, mean in self._with_means())
        flagged = {reading.equation for reading in equations if self._exceeds(reading)}
        parameters = []
        for trained, reading in zip(self._networks, equations, strict=True):
            verdict = "inconsistent" if reading.equation in flagged else "consistent"
            reason = reading.reason or f"equation {reading.equation} is {verdict}; it gives no size"
            parameters += [no_reading(name, self.by, reason) for name in trained.equation.parameters]
        return Diagnosis(self.by, tuple(parameters), equations)

    def flagged_equations(self, diagnosis: Diagnosis) -> tuple[str, ...]:
        """Numbers of the equations whose MSD exceeds its healthy limit."""
        return tuple(reading.equation for reading in diagnosis.equations if self._exceeds(reading))

    def _with_means(self) -> list[tuple[PaperNetwork, float]]:
        return list(zip(self._networks, self._healthy.mean, strict=True))

    def _read(self, trained: PaperNetwork, mean: float, window: WindowStatistics) -> Equation:
        equation = trained.equation
        measured = window.states if window.synchronous is None else (*window.states, "theta")
        absent = [name for name in equation.channels if name not in measured]
        if absent:
            reason = f"not measured: {', '.join(absent)}"
            return Equation(equation=equation.number, title=equation.title, evaluable=False, reason=reason)
        msd = mean_squared_deviation(trained, window, self._machine)
        return Equation(equation=equation.number, title=equation.title, evaluable=True, msd=msd, msd_healthy=mean)

    def _exceeds(self, reading: Equation) -> bool:
        limits = {
            trained.equation.number: limit
            for trained, limit in zip(self._networks, self._healthy.threshold, strict=True)
        }
        return reading.msd is not None and reading.msd > limits[reading.equation]
