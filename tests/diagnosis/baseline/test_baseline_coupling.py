"""Bearings that couple the two planes, and the error of a relation under other conditions."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.studies.subjects.machines import subject_named
from models.commissioning.levels import learned_baseline
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.learned import planes_coupled, undetermined
from models.diagnosis.baseline.rows import COUPLED_ROWS, ROWS
from models.diagnosis.baseline.stored import Baseline
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from tests.sure import sure

SEED = 6301


@cache
def healthy(name: str) -> tuple[WindowStatistics, ...]:
    return subject_named(name).healthy(SEED, 0, 4)


@cache
def baseline(name: str) -> Baseline:
    return learned_baseline(healthy(name), ["one"] * 4)


def later(name: str, changes: dict[str, float], number: int) -> WindowStatistics:
    return subject_named(name).later(SEED, 0, 0, number, changes)[0]


@pytest.mark.slow
def test_plane_coupling_of_an_oil_film_is_learned_and_changes_are_named() -> None:
    learned = baseline("fluid-film")
    again = Baseline.model_validate_json(learned.model_dump_json())
    assert learned.rows == again.rows == COUPLED_ROWS
    assert learned.force.size
    assert np.array_equal(again.force, learned.force)
    for relation, across in zip(learned.relations, (0.09, -0.07), strict=True):
        assert relation is not None
        assert relation.misfit < 1.5
        # -k_yz/k_y of the bearing and of what else holds the shaft
        assert relation.coefficients[4] == pytest.approx(-across, abs=0.03)
    monitor = BaselineDiagnostician(again)
    assert [isolate_window(monitor.diagnose(later("fluid-film", {}, n)), 0.01).changed for n in range(2)] == [()] * 2
    softer = isolate_window(monitor.diagnose(later("fluid-film", {"k_by": -0.1}, 1)), 0.01)
    assert softer.changed == ("k_by",)


def test_agreement_of_several_conditions_lowers_the_error_in_others() -> None:
    learned, window = baseline("overhung"), later("overhung", {}, 0)
    assert not planes_coupled(healthy("overhung"))
    assert learned.rows == ROWS
    half = tuple(replace(one, condition=str(one.window % 2)) for one in learned.consistency)
    found = [
        BaselineDiagnostician(each).diagnose(window)
        for each in (learned, learned.model_copy(update={"consistency": half}))
    ]
    assert found[0].unexplained == ""  # although the force is another one
    for name, floor in (("k_by", 0.005), ("c_by", 0.03)):
        alone, two = (next(each.standard_error for each in one.evaluable if each.name == name) for one in found)
        assert two is not None
        assert floor < two * np.sqrt(2)
        assert two < sure(alone)
    common = sure(found[0].common)
    assert np.all(np.sqrt(np.diag(common))[:4] > (0.0045, 0.025, 0.0045, 0.025))  # more windows do not lower it


def test_a_relation_with_a_large_remainder_is_undetermined() -> None:
    first, second = baseline("overhung").relations
    foreign = baseline("overhung").model_copy(update={"relations": (replace(sure(first), misfit=5.5), second)})
    reason, none = undetermined(foreign)
    assert "the remainder is 5.5 times what chance leaves" in reason
    assert none == ""


def test_a_plane_left_undetermined_is_believed_in_the_other_only_with_two_conditions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second = baseline("overhung").relations
    heavy_bearing = sure(first).coefficients.copy()
    heavy_bearing[2] = 3 * heavy_bearing[1]
    doubtful = baseline("overhung").model_copy(
        update={"relations": (replace(sure(first), coefficients=heavy_bearing), second)}
    )
    monkeypatch.setattr("models.commissioning.levels.learn_baseline", lambda *_: doubtful)
    with pytest.raises(EstimationError, match="horizontal: what moves with the bearing comes out at"):
        learned_baseline(healthy("overhung"), ["one"] * 4)
    assert learned_baseline(healthy("overhung"), ["one"] * 2 + ["another"] * 2).relations == (None, second)


@pytest.mark.slow
@pytest.mark.long
def test_a_single_recording_with_one_undetermined_plane_is_refused() -> None:
    windows = subject_named("geared").healthy(5301, 4, 6)
    with pytest.raises(EstimationError, match="horizontal: what moves with the bearing comes out at"):
        learned_baseline(windows, ["one"] * 6)
    first, second = learned_baseline(windows, ["one"] * 3 + ["another"] * 3).relations
    assert first is None
    assert second is not None
