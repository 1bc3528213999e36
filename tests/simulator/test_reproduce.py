"""The paper's study: what shared realisations share, what the diagnosticians name, and what is written."""

from pathlib import Path

import numpy as np
import pytest

from models.diagnosis.networks.bundle import load_bundle
from models.diagnosis.window import WindowStatistics
from models.errors import RecordingError
from models.machine import load_machine
from simulator.campaigns.reproduce_command import read_study, write_study
from simulator.campaigns.study import run_study
from simulator.campaigns.study_windows import CONDITIONS, EQUATIONS, Run, StudyPlan, own_equations, simulate
from simulator.training.draws import Purpose


@pytest.fixture(scope="module")
def plan() -> StudyPlan:
    machine = load_machine("lab")
    return StudyPlan(
        machine, load_bundle("lab", machine), 77, 2, 9, 0.1, cutoffs_hz=(100.0,), noise_levels=(0.01, 0.05)
    )


def test_the_papers_eight_conditions_name_their_equations() -> None:
    assert [own_equations(condition) for condition in CONDITIONS] == [
        (),
        ("28",),
        ("28",),
        ("31",),
        ("29",),
        ("28", "31"),
        ("28", "31"),
        ("29", "31"),
        ("28", "29"),
    ]


def test_shared_realisations_hide_the_scatter_that_independent_ones_have(plan: StudyPlan) -> None:
    def R77(window: WindowStatistics) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        i = window.states.index("y1_dot")
        return np.asarray(window.correlation[:, i, i])

    healthy = R77(simulate(plan, Run(0, 100.0, 0.01, (Purpose.TRAINING, 0, 0))))
    shared = R77(simulate(plan, Run(4, 100.0, 0.01, (Purpose.TRAINING, 0, 0))))
    other = R77(simulate(plan, Run(4, 100.0, 0.01, (Purpose.EVALUATION, 0, 0))))
    # The unbalance does not act on the stochastic part: with the same realisation nothing but its noise level moves.
    assert np.linalg.norm(shared - healthy) < 0.02 * np.linalg.norm(other - healthy)


def test_the_healthy_disc_moves_as_much_stochastically_as_at_1x(plan: StudyPlan) -> None:
    windows = [simulate(plan, Run(0, 100.0, 0.01, (Purpose.EVALUATION, 99, r))) for r in range(2)]
    ratios = []
    for window in windows:
        assert window.synchronous is not None
        disc = [window.states.index(name) for name in ("y2", "z2")]
        stochastic = sum(window.correlation[0, i, i] for i in disc)
        ratios.append(np.sqrt(stochastic / sum(np.abs(window.synchronous[disc]) ** 2 / 2)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
@pytest.mark.long
def test_the_study_counts_every_window_and_writes_numbers_figures_and_page(plan: StudyPlan, tmp_path: Path) -> None:
    done: dict[str, tuple[int, int]] = {}
    study = run_study(plan, 1, lambda label, n, total: done.__setitem__(label, (n, total)))
    assert all(n == total for n, total in done.values())
    assert len(study.faults) == 2 * 9
    assert len(study.noise) == 2 * 2
    assert study.naming("independent", 1, "paper", "28").of == 2
    assert study.exact("independent", "likelihood").of == 16
    assert study.exact("independent", "likelihood").count >= 12
    assert study.found("shared", "paper").of == 2 * 12  # the eight conditions concern twelve equations
    # As calibrated, the shared healthy runs are below their own limit.
    assert study.false_alarms("shared", "paper").count == 0
    for cell in study.faults:
        assert set(cell.msd["paper"]) == set(EQUATIONS)
    written = write_study(study, tmp_path)
    assert all(path.stat().st_size < 150_000 for path in written)
    page = (tmp_path / "reproduction.md").read_text(encoding="utf-8")
    for figure in (path for path in written if path.suffix in (".png", ".svg")):
        assert f"figures/{figure.name}" in page
    assert read_study(tmp_path) == study


def test_redrawing_without_numbers_says_so(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="run without --redraw first"):
        read_study(tmp_path)
