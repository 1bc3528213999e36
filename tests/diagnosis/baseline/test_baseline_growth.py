"""Bearings that stiffen with displacement, and windows in which the relations do not hold."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.scenes import COMMISSIONED, SourceLayout, drawn_condition
from benchmarks.studies.subjects.machines import subject_named
from models.commissioning.levels import learned_baseline
from models.diagnosis.baseline.conditions import Growth
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.learned import learn_baseline
from models.diagnosis.baseline.rows import COUPLED_ROWS
from models.diagnosis.baseline.stored import Baseline
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import FloatArray
from tests.diagnosis.baseline.fe_rotor import windows_under
from tests.sure import sure

_SEED = 6101


@cache
def baseline(name: str, commissioning: int) -> Baseline:
    return learned_baseline(subject_named(name).healthy(_SEED, commissioning, 3), ["one"] * 3)


def later(name: str, commissioning: int, number: int) -> WindowStatistics:
    return subject_named(name).later(_SEED, commissioning, 0, number, {})[0]


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
    learned, window = baseline("stiffening", 1), later("stiffening", 1, 4)
    assert all(one is not None and one.slope > 2 * one.standard_error for one in learned.growth)
    diagnosis = BaselineDiagnostician(learned).diagnose(window)
    reading = next(one for one in diagnosis.evaluable if one.name == "k_by")
    assert sure(reading.relative_change) < -0.02  # the weaker motion meets a softer bearing
    assert isolate_window(diagnosis, 0.01).changed == ()


@pytest.mark.slow
def test_a_window_in_which_the_relations_do_not_hold_names_nothing() -> None:
    # With one source in both planes, the commissioning could not see that the film couples them.
    monitor = BaselineDiagnostician(baseline("fluid-film", 4))
    diagnosis = monitor.diagnose(later("fluid-film", 4, 3))
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
