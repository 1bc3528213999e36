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
from models.errors import EstimationError
from models.machine import Machine, load_machine
from simulator.training.draws import Draw, Layout, Purpose, simulate_window, with_tilt

pytestmark = pytest.mark.slow

_SEED = 4711


@pytest.fixture(scope="module")
def rig() -> Machine:
    """With windows of a third of the usual length: most of the time goes into simulating them."""
    lab = load_machine("lab")
    return with_tilt(lab.model_copy(update={"window": lab.window.model_copy(update={"length_s": 20.0})}))


def _windows(rig: Machine, numbers: range) -> list[WindowStatistics]:
    """One operating condition for all, as in the paper; the realisations differ by number."""
    draw = Draw(rig, _SEED, Purpose.TRAINING, layout=Layout.ONE_SOURCE, fixed_condition=True)
    return [simulate_window(draw, number) for number in numbers]


@pytest.fixture(scope="module")
def training(rig: Machine) -> list[WindowStatistics]:
    return _windows(rig, range(3))


@pytest.fixture(scope="module")
def healthy(rig: Machine) -> list[WindowStatistics]:
    return _windows(rig, range(10, 16))


@pytest.fixture(scope="module")
def networks(rig: Machine, training: list[WindowStatistics]) -> list[PaperNetwork]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.studies.methods.paper._STEPS", 25)
        return [train_paper_network(equation, training, rig, seed=1) for equation in PAPER_EQUATIONS]


def test_rows_are_the_papers_from_lag_zero(rig: Machine, training: list[WindowStatistics]) -> None:
    for equation, n_inputs in zip(PAPER_EQUATIONS, (3, 3, 2, 3), strict=True):
        inputs, target = paper_rows(equation, training[0], rig)
        assert inputs.shape == (training[0].lags_s.size, n_inputs)
        assert training[0].lags_s[0] == 0
        assert target.shape == (training[0].lags_s.size,)


def test_training_fits_its_own_windows_and_is_repeatable(
    rig: Machine, networks: list[PaperNetwork], training: list[WindowStatistics], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = networks[0]
    monkeypatch.setattr("benchmarks.studies.methods.paper._STEPS", 25)
    again = train_paper_network(PAPER_EQUATIONS[0], training, rig, seed=1)
    assert np.array_equal(first.network.W1, again.network.W1)
    assert np.mean([first.deviation(window) for window in training]) < 0.05


def test_a_reading_names_equations(rig: Machine, networks: list[PaperNetwork], healthy: list[WindowStatistics]) -> None:
    paper = PaperDiagnostician.calibrated(networks, healthy, false_alarm_rate=0.2)
    # As calibrated: of the six windows exactly the largest score is at the limit, none above it.
    assert not any(paper.flagged(paper.deviations(window)) for window in healthy)
    changed = Draw(rig, _SEED, Purpose.TRAINING, faults={"k_by": -0.6}, layout=Layout.ONE_SOURCE, fixed_condition=True)
    deviations = paper.deviations(simulate_window(changed, 50))
    assert list(deviations) == ["28", "29", "30", "31"]
    assert "28" in paper.flagged(deviations)


def test_equations_without_channels_are_not_read(networks: list[PaperNetwork], healthy: list[WindowStatistics]) -> None:
    paper = PaperDiagnostician.calibrated(networks, healthy, false_alarm_rate=0.2)
    window = simulate_window(Draw(load_machine("lab"), _SEED, Purpose.EVALUATION), 0)
    assert list(paper.deviations(window)) == ["28", "29", "31"]
    without_angle = replace(window, synchronous=None, hop_synchronous=None)
    assert list(paper.deviations(without_angle)) == ["28", "31"]


def test_too_few_windows_for_a_rate_are_refused(networks: list[PaperNetwork], healthy: list[WindowStatistics]) -> None:
    with pytest.raises(EstimationError, match="expected at least 99"):
        PaperDiagnostician.calibrated(networks[:1], healthy, false_alarm_rate=0.01)
