"""The equation table against exact theory: each equation sees its own parameters and nothing else."""

import numpy as np
import pytest

from models.diagnosis.networks.equations import EQUATIONS, Equation, StatisticsView, SynchronousEquation, missing
from models.diagnosis.networks.relation import Network
from models.machine import Machine, load_machine
from models.physics.excitation import Source, expanded_A, expanded_B
from models.physics.response import stationary_covariance, synchronous_response
from models.physics.rotor import PARAMETERS, STATES, changed
from models.signals.block import FloatArray
from tests.windows import correlation

LAGS_S = np.arange(60, 126, 3) / 1000  # beyond the memory of a 150 Hz excitation: e^-40
SOURCES = tuple(
    Source(cutoff_hz=150, direction=direction, force_rms_N=level)
    for direction, level in (((1, 0.3, 0.01, 0, 0.2, 0), 4.0), ((0, 1, 0, 0.5, 1, -0.02), 2.0))
)


def theory(machine: Machine, changes: dict[str, float], speed_ratio: float) -> StatisticsView:
    """Exact correlations of a changed rotor."""
    rotor, W = changed(machine.rotor, changes), machine.operation.speed_rad_s * speed_ratio
    A, B = expanded_A(rotor, W, SOURCES), expanded_B(SOURCES)
    R0 = stationary_covariance(A, B)
    R = np.stack([correlation(A, R0, lag)[:12, :12] for lag in LAGS_S])
    q1, q2 = synchronous_response(rotor, W)
    return StatisticsView(STATES, R, q1 - 1j * q2, W)


def linear_relation(equation: Equation | SynchronousEquation, machine: Machine) -> FloatArray:
    """The fixed combination of the inputs that a perfect network would learn, from healthy theory."""
    rows = [equation.rows(theory(machine, {}, ratio), machine) for ratio in (0.85, 0.95, 1.0, 1.1, 1.2)]
    inputs, target = np.concatenate([row.inputs for row in rows]), np.concatenate([row.target for row in rows])
    scale = np.sqrt(np.mean(inputs**2, axis=0))
    return np.asarray(np.linalg.lstsq(inputs / scale, target, rcond=1e-14)[0] / scale, dtype=np.float64)


@pytest.mark.parametrize("name", ["lab", "heavy"])
@pytest.mark.parametrize("equation", EQUATIONS, ids=lambda equation: equation.number)
def test_an_equation_reads_its_own_parameters_alone(equation: Equation | SynchronousEquation, name: str) -> None:
    machine = load_machine(name)
    weights = linear_relation(equation, machine)
    for changed_name in PARAMETERS:
        own = changed_name in equation.parameters
        if changed_name in equation.kept_nominal and not own:
            continue  # the shaft enters equation 29 too; nothing is claimed then
        for size in (-0.2, 0.1):
            rows = equation.rows(theory(machine, {changed_name: size}, 1.05), machine)
            read = np.linalg.lstsq(rows.signatures, rows.target - rows.inputs @ weights, rcond=None)[0]
            expected = [size if parameter == changed_name else 0.0 for parameter in equation.parameters]
            np.testing.assert_allclose(read, expected, atol=0.012 if equation.number == "29" else 1e-4)


@pytest.mark.parametrize("name", ["lab", "heavy"])
def test_a_shaft_change_taken_for_unbalance_has_the_predicted_size(name: str) -> None:
    machine, equation = load_machine(name), EQUATIONS[1]
    assert isinstance(equation, SynchronousEquation)
    weights = linear_relation(equation, machine)
    rows = equation.rows(theory(machine, {"EI": 0.01}, 1.0), machine)
    read = np.linalg.lstsq(rows.signatures, rows.target - rows.inputs @ weights, rcond=None)[0]
    assert 0.01 * equation.taken_for(machine)["EI"] == pytest.approx(float(read[0]), rel=0.15)


def test_the_missing_states_of_each_equation_are_listed() -> None:
    lab = load_machine("lab").descriptor.states
    absent = {equation.number: missing(equation, lab) for equation in EQUATIONS}
    assert absent == {"28": (), "29": (), "30": ("psi_dot", "psi", "phi_dot"), "31": ()}
    assert missing(EQUATIONS[1], tuple(name for name in lab if name != "theta")) == ("theta",)


def test_targets_and_inputs_are_taken_at_the_same_lag() -> None:
    """A network that saw neighbouring lags could differentiate its inputs and would be blind to every fault."""
    machine = load_machine("lab")
    view = theory(machine, {}, 1.0)
    permuted = StatisticsView(view.states, view.correlation[::-1], view.synchronous, view.speed_rad_s)
    for equation in EQUATIONS:
        if isinstance(equation, Equation):
            straight, reversed_ = equation.rows(view, machine), equation.rows(permuted, machine)
            shape = (LAGS_S.size, 4)
            np.testing.assert_array_equal(straight.target.reshape(shape)[::-1], reversed_.target.reshape(shape))
            np.testing.assert_array_equal(
                straight.inputs.reshape(*shape, -1)[::-1], reversed_.inputs.reshape(*shape, -1)
            )


def test_a_network_computes_its_perceptron_for_inputs_of_any_size() -> None:
    rng = np.random.default_rng(20260701)
    scale, W1, b1 = rng.uniform(1, 2, 4), rng.normal(size=(4, 15)), rng.normal(size=15)
    W2, b2 = rng.normal(size=15), rng.normal(size=1)
    size = np.array([1e-3, 1.0, 1e4])[:, None]
    inputs = rng.normal(size=(3, 50, 4)) * size[..., None]
    expected = np.tanh(inputs / scale @ W1 + b1) @ W2 + b2[0]
    left = np.abs(Network(scale, W1, b1, W2, b2)(inputs) - expected)
    assert np.all(left < 1e-14 * np.maximum(1, size))  # a sum is rounded relative to its terms
