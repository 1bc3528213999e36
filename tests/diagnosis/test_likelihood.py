"""The likelihood: derivatives, and readings of independent windows against the truth."""

import numpy as np
import pytest

from models.diagnosis.likelihood import LikelihoodFit
from models.diagnosis.moments import plan_for
from models.diagnosis.spectral_model import SpectralModel
from models.diagnosis.window import SlidingWindow
from models.errors import EstimationError
from models.machine import load_machine
from simulator.campaign import Draw, Layout, Purpose, simulate_window

SEED = 7_700_001
"""Of this file's windows alone: neither training, calibration nor the shipped scenarios use it."""


def test_derivatives_of_the_spectra() -> None:
    machine, rng = load_machine("lab"), np.random.default_rng(0)
    states = plan_for(machine).states
    scale = np.where([name.endswith("dot") for name in states], 0.04, 2e-4)
    model = SpectralModel(machine, states, np.arange(4.0, 150.0, 7.0), scale, 2.0)
    theta = rng.normal(0, 0.2, model.size)
    theta[model.cutoff_at] = np.log(80)
    theta[model.noise_at] -= 5
    point = model.at(theta, 140.0)
    mixing = rng.normal(size=point.S.shape) + 1j * rng.normal(size=point.S.shape)
    derivatives = model.whitened_derivatives(point, mixing)
    for parameter in range(model.size):
        step = np.zeros(model.size)
        step[parameter] = 1e-5
        difference = (model.at(theta + step, 140.0).S - model.at(theta - step, 140.0).S) / 2e-5
        expected = mixing @ difference @ mixing.conj().swapaxes(1, 2)
        np.testing.assert_allclose(derivatives[:, parameter], expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lab", "heavy"])
@pytest.mark.parametrize("faults", [{}, {"k_by": -0.2}, {"c_bz": -0.3, "e": 0.2}], ids=str)
def test_independent_sources_are_read_without_bias_and_with_honest_errors(name: str, faults: dict[str, float]) -> None:
    """Sixteen independent windows in random conditions.

    With standard errors right within 25 %, the mean of 16 z values stays within 4·1.25/√16 = 1.25 and their rms within
    1.25·(1 + 4/√32) = 2.1, except once in ten thousand; a wrong sign or unit is tens of standard errors.
    """
    draw = Draw(load_machine(name), SEED, Purpose.EVALUATION, len(faults), faults=faults, layout=Layout.INDEPENDENT)
    z = []
    for number in range(16):
        estimate = LikelihoodFit(draw.machine).fit(simulate_window(draw, number))
        truth = np.array([faults.get(parameter, 0.0) for parameter in estimate.names])
        z.append((estimate.change - truth) / estimate.standard_error)
        assert np.all(estimate.standard_error < 0.15)
    assert np.all(np.abs(np.mean(z, axis=0)) < 1.25)
    assert np.all(np.sqrt(np.mean(np.square(z), axis=0)) < 2.1)


@pytest.mark.slow
def test_one_source_of_any_direction_is_read_within_one_percent() -> None:
    """The bound is sensor noise here, a tenth of a percent; what is left is a bias of one standard error in c."""
    faults = {"c_by": -0.2}
    draw = Draw(load_machine("lab"), SEED, Purpose.EVALUATION, 9, faults=faults, layout=Layout.ONE_SOURCE)
    errors = []
    for number in range(12):
        estimate = LikelihoodFit(draw.machine).fit(simulate_window(draw, number))
        errors.append(estimate.change - np.array([faults.get(parameter, 0.0) for parameter in estimate.names]))
    assert np.all(np.median(np.abs(errors), axis=0) < 0.005)
    assert np.max(np.abs(errors)) < 0.05  # below the level at which a parameter is called changed


def test_a_warm_start_ends_where_a_cold_one_does() -> None:
    machine = load_machine("lab")
    draw = Draw(machine, SEED, Purpose.EVALUATION, 20, layout=Layout.INDEPENDENT)
    first, second = simulate_window(draw, 0), simulate_window(draw, 1)
    warm = LikelihoodFit(machine)
    warm.fit(first)
    from_first, cold = warm.fit(second), LikelihoodFit(machine).fit(second)
    assert from_first.steps < 20
    assert np.all(np.abs(from_first.change - cold.change) < 0.1 * cold.standard_error)


def test_a_dead_channel_is_named() -> None:
    machine = load_machine("lab")
    plan, window = plan_for(machine), SlidingWindow(plan_for(machine))
    samples = np.random.default_rng(0).standard_normal((plan.preamble + plan.hops * plan.hop, 9))
    samples[:, 3] = 0.0
    for _ in window.feed(samples, 0):
        pass
    statistics = window.statistics()
    assert statistics is not None
    with pytest.raises(EstimationError, match="lab: no fluctuation in z2"):
        LikelihoodFit(machine).fit(statistics)
