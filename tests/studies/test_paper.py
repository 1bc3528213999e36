"""The paper's own diagnostician on independent windows."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.studies.methods.paper import (
    PAPER_EQUATIONS,
    PaperDiagnostician,
    PaperNetwork,
    paper_rows,
    train_paper_network,
)
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import load_machine
from simulator.training.draws import Draw, Layout, Purpose, simulate_window, with_tilt

pytestmark = pytest.mark.slow

_SEED = 4711


LAB = load_machine("lab")
RIG = with_tilt(LAB.model_copy(update={"window": LAB.window.model_copy(update={"length_s": 20.0})}))
"""With windows of a third of the usual length: most of the time goes into simulating them."""


def _windows(numbers: range) -> list[WindowStatistics]:
    """One operating condition for all, as in the paper; the realisations differ by number."""
    draw = Draw(RIG, _SEED, Purpose.TRAINING, layout=Layout.ONE_SOURCE, fixed_condition=True)
    return [simulate_window(draw, number) for number in numbers]


@pytest.fixture(scope="module")
def training() -> list[WindowStatistics]:
    return _windows(range(3))


@pytest.fixture(scope="module")
def healthy() -> list[WindowStatistics]:
    return _windows(range(10, 16))


@pytest.fixture(scope="module")
def networks(training: list[WindowStatistics]) -> list[PaperNetwork]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.studies.methods.paper._STEPS", 25)
        return [train_paper_network(equation, training, RIG, seed=1) for equation in PAPER_EQUATIONS]


def test_rows_are_the_papers_from_lag_zero(training: list[WindowStatistics]) -> None:
    for equation, n_inputs in zip(PAPER_EQUATIONS, (3, 3, 2, 3), strict=True):
        inputs, target = paper_rows(equation, training[0], RIG)
        assert inputs.shape == (training[0].lags_s.size, n_inputs)
        assert training[0].lags_s[0] == 0
        assert target.shape == (training[0].lags_s.size,)


def test_training_fits_its_own_windows_and_is_repeatable(
    networks: list[PaperNetwork], training: list[WindowStatistics], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = networks[0]
    monkeypatch.setattr("benchmarks.studies.methods.paper._STEPS", 25)
    again = train_paper_network(PAPER_EQUATIONS[0], training, RIG, seed=1)
    assert np.array_equal(first.network.W1, again.network.W1)
    assert np.mean([first.deviation(window) for window in training]) < 0.05


def test_a_changed_stiffness_flags_its_equation(networks: list[PaperNetwork], healthy: list[WindowStatistics]) -> None:
    paper = PaperDiagnostician.calibrated(networks, healthy, false_alarm_rate=0.2)
    # As calibrated: of the six windows exactly the largest score is at the limit, none above it.
    assert not any(paper.flagged(paper.deviations(window)) for window in healthy)
    changed = Draw(RIG, _SEED, Purpose.TRAINING, faults={"k_by": -0.6}, layout=Layout.ONE_SOURCE, fixed_condition=True)
    deviations = paper.deviations(simulate_window(changed, 50))
    assert list(deviations) == ["28", "29", "30", "31"]
    assert "28" in paper.flagged(deviations)


def test_equations_without_channels_are_not_read(networks: list[PaperNetwork], healthy: list[WindowStatistics]) -> None:
    paper = PaperDiagnostician.calibrated(networks, healthy, false_alarm_rate=0.2)
    window = simulate_window(Draw(load_machine("lab"), _SEED, Purpose.EVALUATION), 0)
    assert list(paper.deviations(window)) == ["28", "29", "31"]
    without_angle = replace(window, synchronous=None, hop_synchronous=None)
    assert list(paper.deviations(without_angle)) == ["28", "31"]
