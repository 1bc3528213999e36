"""Errors that apply only under other conditions, and the lag from which a relation holds."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.observed import RunCondition
from benchmarks.finite_elements.rotor import Disc, changed_rotor
from benchmarks.finite_elements.scenes import COMMISSIONED, SourceLayout, drawn_condition
from models.commissioning.levels import learned_baseline
from models.diagnosis.baseline import relation
from models.diagnosis.baseline.conditions import alike
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.learned import learn_baseline
from models.diagnosis.baseline.stored import Baseline
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import ComplexArray, FloatArray
from tests.diagnosis.baseline.fe_rotor import Excitation, recorded, windows_under
from tests.sure import sure

ROTOR = rotor_named("overhung")


def condition(seed: int, **changes: float) -> RunCondition:
    return drawn_condition(ROTOR, SourceLayout.ONE_SOURCE, COMMISSIONED, changes, np.random.default_rng(seed))


def windows(run: RunCondition, count: int, seed: int) -> list[WindowStatistics]:
    return windows_under(ROTOR, run, count, seed)


@cache
def baseline(seed: int) -> Baseline:
    return learned_baseline(windows(condition(seed), 4, 1), ["one"] * 4)


def test_alike_forces_agree_in_level_spectrum_and_direction() -> None:
    rng = np.random.default_rng(5)
    factor = rng.standard_normal((6, 2, 2)) + 1j * rng.standard_normal((6, 2, 2))
    spectra = factor @ factor.conj().transpose(0, 2, 1)

    def packed(matrices: ComplexArray) -> FloatArray:
        return np.asarray(np.triu(matrices.real) + np.tril(matrices.imag, -1), dtype=np.float64)

    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    healthy = packed(spectra)
    assert alike(healthy, healthy)
    assert alike(healthy, 1.15 * healthy)
    assert not alike(healthy, 2.0 * healthy)
    assert not alike(healthy, healthy * np.linspace(0.5, 1.5, 6)[:, None, None])
    assert not alike(healthy, packed(turn @ spectra @ turn.T))
    assert not alike(healthy, packed(spectra.conj()))
    assert not alike(np.zeros((0, 0, 0)), healthy)
    assert not alike(healthy, healthy[:3])


@pytest.mark.slow
def test_damping_is_more_precise_under_the_commissioned_force() -> None:
    monitor = BaselineDiagnostician(baseline(3))
    (same,), (other,) = (windows(condition(seed, c_by=-0.2, e=0.2), 1, 7) for seed in (3, 4))
    here, there = monitor.diagnose(same), monitor.diagnose(other)
    assert here.elsewhere["c_by"] == 0 < there.elsewhere["c_by"]
    assert here.elsewhere["k_by"] > 0
    reading = next(one for one in here.evaluable if one.name == "c_by")
    assert abs(sure(reading.relative_change) + 0.2) < 3 * sure(reading.standard_error)


@pytest.mark.parametrize("change", [-0.3, 0.3])
def test_interval_of_a_changed_stiffness_allows_for_what_the_relation_omits(change: float) -> None:
    (window,) = windows(condition(3, k_by=change), 1, 3230900)
    found = BaselineDiagnostician(baseline(3)).diagnose(window)
    reading = next(one for one in found.evaluable if one.name == "k_by")
    assert abs(sure(reading.relative_change) - change) < 2 * sure(reading.standard_error)
    assert isolate_window(found, 1e-6).changed == ("k_by",)
    # the other reading has no error of size, as it has not changed
    other = next(one for one in found.evaluable if one.name == "k_bz")
    assert sure(other.standard_error) < 0.02


def test_large_change_is_read_where_hardly_any_force_acts_at_the_bearing() -> None:
    healthy, c = rotor_named("between"), 0.6 * 20**0.5
    bearings = tuple(
        replace(one, k_y=20 * one.k_y, k_z=20 * one.k_z, c_y=c * one.c_y, c_z=c * one.c_z, housing_kg=2.0)
        for one in healthy.bearings
    )
    disc = Disc(node=3, mass_kg=4.0, radius_m=0.08, unbalance_kg_m=4e-5)
    stiff = replace(healthy, bearings=bearings, discs=(disc,), diameter_m=0.03)

    def at_the_disc(cutoff_hz: float) -> Excitation:
        return Excitation(cutoff_hz, ((0.1, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.1, 0), (0, 0, 0, 0.7)))

    learned = [recorded(stiff, at_the_disc(cutoff_hz), seed, 2) for cutoff_hz, seed in ((140, 3230011), (100, 3230012))]
    monitor = BaselineDiagnostician(learn_baseline([*learned[0], *learned[1]], ["one", "one", "two", "two"]))
    window = recorded(changed_rotor(stiff, {"k_by": 0.4}), at_the_disc(120.0), 3230013, 2)[0]
    found = monitor.diagnose(window)
    assert found.unexplained == ""
    reading = next(one for one in found.evaluable if one.name == "k_by")
    assert abs(sure(reading.relative_change) - 0.4) < 2 * sure(reading.standard_error) < 0.25
    assert isolate_window(found, 0.01).changed == ("k_by",)


def test_only_one_condition_has_a_force_and_records_without_one_omit_it() -> None:
    both = [*windows(condition(3), 2, 1), *windows(condition(4), 2, 2)]
    assert baseline(3).force.shape == (18, 2, 2)
    assert learn_baseline(both, ["one", "one", "two", "two"]).force.size == 0
    record = baseline(3).without_force.model_dump(mode="json")
    assert "force" not in record
    assert Baseline.model_validate_json(json.dumps(record | {"force": []})).force.shape == (0, 0, 0)
    assert all("lag_from_s" not in relation for relation in record["relations"])
    assert baseline(3).model_dump(mode="json")["force"]


@pytest.mark.slow
def test_relations_that_do_not_fit_use_longer_lags(monkeypatch: pytest.MonkeyPatch) -> None:
    healthy = windows(condition(4), 4, 1)
    longer = learn_baseline(healthy)
    monkeypatch.setattr(relation, "_LONGER_LAGS_S", ())
    before = learn_baseline(healthy)
    for one, other in zip(map(sure, longer.relations), map(sure, before.relations), strict=True):
        assert other.lag_from_s == 0
        if one.lag_from_s:
            assert one.misfit < other.misfit
    assert any(one is not None and one.lag_from_s for one in longer.relations)
    again = Baseline.model_validate_json(longer.model_dump_json())
    lags = [None if one is None else one.lag_from_s for one in longer.relations]
    assert [None if one is None else one.lag_from_s for one in again.relations] == lags


def test_underestimating_the_memory_of_the_force_causes_no_misfit(monkeypatch: pytest.MonkeyPatch) -> None:
    remembers = replace(COMMISSIONED, cutoff_hz=(25.0, 25.0))
    run = drawn_condition(ROTOR, SourceLayout.ONE_SOURCE, remembers, {}, np.random.default_rng(1))
    judge = BaselineDiagnostician(learned_baseline(windows(run, 4, 1), ["one"] * 4))
    (window,) = windows(run, 1, 2)
    monkeypatch.setattr(relation, "lag_beyond_memory", lambda *_: 0.014)  # the shortest there is
    found = judge.diagnose(window)
    assert found.evaluable
    assert sure(found.misfit_z) < 3
    assert not found.suspect
