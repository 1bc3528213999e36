"""Bearings that couple the two planes or stiffen with displacement, and relations that do not hold elsewhere."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.scenes import COMMISSIONED, SourceLayout, drawn_condition
from benchmarks.studies.subjects.machines import subject_named
from models.commissioning.levels import learned_baseline
from models.diagnosis.baseline.conditions import Growth
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician, impossible
from models.diagnosis.baseline.learned import learn_baseline, planes_coupled
from models.diagnosis.baseline.rows import COUPLED_ROWS, ROWS
from models.diagnosis.baseline.stored import Baseline
from models.diagnosis.readings import Diagnosis, parameter_reading
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray
from tests.diagnosis.baseline.fe_rotor import windows_under
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
    for relation, across in zip(map(sure, learned.relations), (0.09, -0.07), strict=True):
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
        alone, two = (sure(next(each.standard_error for each in one.evaluable if each.name == name)) for one in found)
        assert floor / np.sqrt(2) < two < alone
    common = sure(found[0].common)
    assert np.all(np.sqrt(np.diag(common))[:4] > (0.0045, 0.025, 0.0045, 0.025))  # more windows do not lower it


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


def in_commissioning(name: str, commissioning: int, number: int) -> tuple[Baseline, WindowStatistics]:
    """The baseline of a commissioning, and a healthy window after it."""
    subject = subject_named(name)
    learned = learned_baseline(subject.healthy(6101, commissioning, 3), ["one"] * 3)
    return learned, subject.later(6101, commissioning, 0, number, {})[0]


def test_expected_stiffness_growth_is_the_growth_seen_or_up_to_two_per_cent() -> None:
    grown, chance, falls = Growth(4e-12, 0.03, 0.005), Growth(4e-12, 0.01, 0.03), Growth(4e-12, -0.03, 0.005)
    assert grown.seen_variance(4e-12) == grown.unseen_variance(4e-12) == 0
    shown = 0.03**2 - 4 * 0.005**2
    assert grown.seen_variance(2e-12) == pytest.approx(shown / 4)
    assert grown.seen_variance(16e-12) == pytest.approx(9 * shown)
    assert Growth(4e-12, 0.0, 0.01).unseen_variance(2e-12) == pytest.approx((0.01**2 - 0.005**2) * np.log(2) ** 2)
    assert chance.seen_variance(400e-12) == falls.seen_variance(400e-12) == 0
    assert np.sqrt(chance.unseen_variance(400e-12)) == pytest.approx(0.02, rel=0.05)
    assert falls.unseen_variance(1e-14) == 0


@pytest.mark.slow
@pytest.mark.long
def test_stiffening_of_a_bearing_under_another_force_is_no_change() -> None:
    learned, window = in_commissioning("stiffening", 1, 4)
    assert all(one is not None and one.slope > 2 * one.standard_error for one in learned.growth)
    diagnosis = BaselineDiagnostician(learned).diagnose(window)
    reading = next(one for one in diagnosis.evaluable if one.name == "k_by")
    assert sure(reading.relative_change) < -0.02  # the weaker motion meets a softer bearing
    assert isolate_window(diagnosis, 0.01).changed == ()


@pytest.mark.slow
def test_a_window_in_which_the_relations_do_not_hold_names_nothing() -> None:
    # With one source in both planes, the commissioning could not see that the film couples them.
    learned, window = in_commissioning("fluid-film", 4, 3)
    diagnosis = BaselineDiagnostician(learned).diagnose(window)
    assert sure(diagnosis.misfit_z) > 8
    assert "(then record a healthy condition like this one)" in diagnosis.unexplained
    verdict = isolate_window(diagnosis, 0.01)
    assert verdict.outside
    assert verdict.changed == ()


@cache
def with_a_force_that_hides_a_plane() -> tuple[Baseline, tuple[WindowStatistics, ...]]:
    """A baseline of two conditions, and later windows of the one that hardly determines the horizontal plane."""
    rotor, scene = rotor_named("plain-bearings"), replace(COMMISSIONED, cutoff_hz=(130.0, 130.0))

    def windows(layout: SourceLayout, count: int, seed: int) -> list[WindowStatistics]:
        run = drawn_condition(rotor, layout, scene, {}, np.random.default_rng(1))
        return windows_under(rotor, run, count, seed)

    healthy = [*windows(SourceLayout.ONE_SOURCE, 3, 2), *windows(SourceLayout.INDEPENDENT, 3, 101)]
    learned = learn_baseline(healthy, ["one"] * 3 + ["other"] * 3, COUPLED_ROWS)
    return learned, tuple(windows(SourceLayout.ONE_SOURCE, 4, 7))


def test_parameters_that_a_window_does_not_determine_make_no_sensor_suspect() -> None:
    learned, later_windows = with_a_force_that_hides_a_plane()
    # A growth as an earlier version may have stored it makes no sensor suspect either.
    steep = tuple(one and replace(one, slope=9.0, standard_error=1.0) for one in learned.growth)
    grown = learned.model_copy(update={"growth": steep})
    for baseline_ in (learned, grown):
        monitor = BaselineDiagnostician(baseline_)
        for window in later_windows:
            diagnosis = monitor.diagnose(window)
            reasons = {one.name: one.reason for one in diagnosis.parameters}
            assert "does not determine it" in reasons["k_by"]
            assert reasons["k_by"] == reasons["c_by"]
            assert not reasons["k_bz"]
            assert not diagnosis.unexplained
            assert not diagnosis.suspect
            assert sure(diagnosis.misfit_z) < 3
    horizontal = sure(learned.growth[0])
    assert abs(horizontal.slope) < min(2.0, 2 * horizontal.standard_error)


def test_growth_widens_the_stiffness_of_another_motion_and_survives_its_record() -> None:
    learned, (window, *_) = with_a_force_that_hides_a_plane()
    vertical = sure(learned.growth[1])
    growth = (None, replace(vertical, slope=0.2, standard_error=0.01, power=vertical.power / 4))
    grown, older = (learned.model_copy(update={"growth": each}) for each in (growth, ()))
    again = Baseline.model_validate_json(grown.model_dump_json())
    assert again.growth == grown.growth
    assert "growth" not in older.model_dump(mode="json")  # as before growth was recorded
    assert older.growth == ()
    found = [BaselineDiagnostician(one).diagnose(window) for one in (again, older)]
    assert found[0].parameters == BaselineDiagnostician(grown).diagnose(window).parameters
    now, before = (next(one for one in each.evaluable if one.name == "k_bz") for each in found)
    assert now.relative_change == before.relative_change
    assert sure(now.standard_error) > 2 * sure(before.standard_error)


def test_a_reversed_sensor_is_suspected_even_in_a_hardly_determined_plane() -> None:
    learned, _ = with_a_force_that_hides_a_plane()
    rotor = rotor_named("plain-bearings")
    run = drawn_condition(rotor, SourceLayout.INDEPENDENT, COMMISSIONED, {}, np.random.default_rng(1))

    def reversed_(samples: FloatArray) -> None:
        samples[:, 0] *= -1

    diagnosis = BaselineDiagnostician(learned).diagnose(*windows_under(rotor, run, 1, 99, reversed_))
    assert "swapped, reversed or delayed" in diagnosis.unexplained


@pytest.mark.parametrize(
    ("change", "error", "misfit_z", "told"),
    [(-0.02, 0.54, 4.0, False), (-0.02, 0.54, 9.0, True), (-2.0, 36.0, 3.9, True), (-0.97, 0.005, 0.0, True)],
)
def test_a_stiffness_that_a_new_force_does_not_determine_is_not_called_impossible(
    change: float, error: float, misfit_z: float, *, told: bool
) -> None:
    """A random finite-element rotor under a force in another direction than the recorded ones; a reversed sensor."""
    diagnosis = Diagnosis("baseline", (parameter_reading("k_by", "baseline", change, error),), misfit_z=misfit_z)
    assert ("swapped, reversed or delayed" in impossible(diagnosis, {"k_by": error**2})) is told
