"""Baselines of several speeds, conditions and time scales: storage as JSON and self-consistency."""

import json
import math
import re
from dataclasses import replace
from functools import cache, reduce
from operator import getitem

import numpy as np
import pytest
from pydantic import ValidationError

from benchmarks.finite_elements.rotor import changed_rotor
from models.commissioning.commissioned import ConditionBaseline, OperatingRange
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician, gain_suspicion
from models.diagnosis.baseline.learned import disagreements, learn_baseline, undetermined, unsuitable
from models.diagnosis.baseline.rows import ROWS, learned_rows
from models.diagnosis.baseline.stored import Baseline
from models.diagnosis.readings import Diagnosis, parameter_reading
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.mistakes import mistakes
from tests.diagnosis.baseline.fe_rotor import OTHER, ROTOR, Excitation, recorded
from tests.sure import sure

FAST = replace(ROTOR, speed_rad_s=2 * np.pi * 33.0)


@cache
def baseline() -> Baseline:
    return learn_baseline(
        [*recorded(ROTOR, Excitation(), 81, 2), *recorded(FAST, OTHER, 82, 2)], conditions=["slow"] * 2 + ["fast"] * 2
    )


@pytest.mark.slow
def test_each_commissioned_speed_has_its_own_unbalance_and_conditions_may_agree() -> None:
    assert [round(one.speed_rad_s / 2 / np.pi) for one in baseline().rotations] == [24, 33]
    monitor = BaselineDiagnostician(baseline())
    for seed, rotor in ((83, ROTOR), (84, FAST)):
        heavier = changed_rotor(rotor, {"e": 0.6})
        e = monitor.diagnose(*recorded(heavier, Excitation(), seed, 1)).evaluable[-1]
        assert e.name == "e"
        assert abs(sure(e.relative_change) - 0.6) < 3 * sure(e.standard_error)
    between = replace(ROTOR, speed_rad_s=2 * np.pi * 28.0)
    found = {one.name: one.reason for one in monitor.diagnose(*recorded(between, OTHER, 85, 1)).parameters}
    assert (found["e"], found["k_by"]) == ("speed 1680 rpm, the baseline was learned at 1440, 1980 rpm", "")
    assert {one.condition for one in baseline().consistency} == {"slow", "fast"}
    assert max(abs(each.z) for one in baseline().consistency for each in one.agreements) < 4
    assert disagreements(baseline()) == ()
    assert undetermined(baseline()) == ("", "")


def test_a_condition_with_another_bearing_is_found_and_widens_later_intervals() -> None:
    softer = recorded(changed_rotor(ROTOR, {"k_by": -0.15}), OTHER, 86, 2)
    mixed = learn_baseline([*recorded(ROTOR, Excitation(), 81, 2), *softer], conditions=["a", "a", "b", "b"])
    assert any("bearing stiffness, horizontal" in sentence for *_, sentence in disagreements(mixed))
    horizontal, vertical = mixed.relations
    assert sure(horizontal).allowance > 5
    assert sure(vertical).allowance < 3


@pytest.mark.slow
def test_an_unphysical_vague_or_foreign_relation_is_not_determined() -> None:
    first, second = map(sure, baseline().relations)
    heavy_bearing = first.coefficients.copy()
    heavy_bearing[2] = 3 * heavy_bearing[1]
    doubtful = baseline().model_copy(update={"relations": (replace(first, coefficients=heavy_bearing), second)})
    reason, none = undetermined(doubtful)
    assert re.search("3.0 times the disc.*record a second condition", reason)
    assert none == ""
    vague = baseline().model_copy(update={"relations": (replace(first, covariance=first.covariance * 400), second)})
    assert "damping, horizontal is known to" in undetermined(vague)[0]
    foreign = baseline().model_copy(update={"relations": (replace(first, misfit=5.5), second)})
    assert undetermined(foreign) == ("", "")  # two conditions agree
    one_condition = tuple(replace(one, condition="a") for one in foreign.consistency)
    reason, _ = undetermined(foreign.model_copy(update={"consistency": one_condition}))
    assert "the remainder is 5.5 times what chance leaves" in reason


def test_one_condition_must_be_given_per_window() -> None:
    with pytest.raises(EstimationError, match="2 conditions are given for 1 healthy windows"):
        learn_baseline(recorded(ROTOR, Excitation(), 81, 2)[:1], conditions=["a", "b"])


def test_a_restored_baseline_reads_the_same_to_the_last_bit() -> None:
    text = baseline().model_dump_json()
    again = Baseline.model_validate_json(text)
    assert again.model_dump_json() == text
    (window,) = recorded(changed_rotor(ROTOR, {"c_by": -0.3}), OTHER, 87, 1)
    one, other = (BaselineDiagnostician(each).diagnose(window) for each in (baseline(), again))
    assert (one.parameters, one.misfit_z) == (other.parameters, other.misfit_z)
    for a, b in ((one.covariance, other.covariance), (one.common, other.common)):
        assert np.array_equal(sure(a), sure(b))


def test_a_baseline_with_a_number_that_is_not_finite_is_not_stored() -> None:
    learned, conditions = baseline(), OperatingRange.of(recorded(ROTOR, Excitation(), 81, 2))
    stored = ConditionBaseline(conditions=conditions, baseline=learned)
    assert stored.baseline == learned
    first, second = learned.relations
    for damage in (
        {"relations": (replace(sure(first), misfit=math.nan), second)},
        {"relations": (replace(sure(first), coefficients=sure(first).coefficients * np.inf), second)},
        {"covariance": learned.covariance * np.nan},
    ):
        with pytest.raises(ValidationError, match="finite number"):
            ConditionBaseline(conditions=conditions, baseline=learned.model_copy(update=damage))


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        ("relations/0/coefficients/0", math.nan, "relations.0.coefficients.0: expected a finite number (found nan)"),
        ("relations/0/coefficients/0", "1.0", "relations.0.coefficients.0: expected a number (found '1.0')"),
        ("relations/0/covariance/1", [0.0] * 3, "relations.0.covariance: not 4 by 4"),
        ("relations/0/code", "import os", "relations.0.code: unknown"),
        ("relations/0/misfit", None, "relations.0.misfit: missing"),
        ("reasons/0", "not measured", "a relation is there, or a reason why not; never both or neither"),
        ("force", [[[1.0, 0.0], [0.0, 1.0]], [[1.0]]], "force: a band is 1 by 1, the first 2 by 2"),
    ],
)
def test_a_damaged_baseline_is_refused(path: str, value: object, told: str) -> None:
    record = json.loads(baseline().model_dump_json())
    *outer, last = (int(part) if part.isdecimal() else part for part in path.split("/"))
    place = reduce(getitem, outer, record)
    place[last] = value
    if value is None:
        del place[last]
    with pytest.raises(ValidationError) as refused:
        Baseline.model_validate_json(json.dumps(record))
    assert [text for _, text in mistakes(refused.value, Baseline)] == [told]


def suspected(k: float, c: float, states: tuple[str, ...] = ("y1", "y2")) -> str:
    errors = np.array([0.005, 0.02])
    readings = tuple(
        parameter_reading(name, "baseline", value, float(error))
        for name, value, error in zip(("k_by", "c_by"), (k, c), errors, strict=True)
    )
    first, _ = baseline().relations
    relations = (replace(sure(first), states=states), None)
    diagnosis = Diagnosis("baseline", readings, covariance=np.diag(errors**2))
    z, sentence = gain_suspicion(diagnosis, learned_rows(ROWS), relations)
    return f"{sentence} {z > 5}" if sentence else ""


def test_equal_changes_of_stiffness_and_damping_raise_suspicion_of_a_gain() -> None:
    assert suspected(-0.1, -0.1) == "gain of y1 or of y2 True"
    assert suspected(0.2, 0.19) == "gain of y1 or of y2 True"
    assert suspected(-0.1, 0.0) == ""
    assert suspected(0.0, -0.3) == ""
    assert suspected(-0.1, -0.3) == suspected(0.001, 0.01) == ""
    both = ("y1", "y1_dot", "y2", "y2_dot")
    assert suspected(-0.1, -0.1, both) == "gain of y1 and y1_dot or of y2 and y2_dot True"
    assert suspected(-0.1, 0.0, both) == ""


_TIMES = 5.0


def faster(window: WindowStatistics) -> WindowStatistics:
    """The window of a machine that makes the same motion in a fifth of the time."""
    rates = np.array([_TIMES if name.endswith("_dot") else 1.0 for name in window.states])
    both, (slowest, fastest) = np.outer(rates, rates), window.speed_range
    return replace(
        window, lags_s=window.lags_s / _TIMES, correlation=window.correlation * both,
        hop_correlation=window.hop_correlation * both, spectrum=window.spectrum * both / _TIMES,
        frequencies_hz=window.frequencies_hz * _TIMES, synchronous=sure(window.synchronous) * rates,
        hop_synchronous=sure(window.hop_synchronous) * rates, speed_rad_s=window.speed_rad_s * _TIMES,
        speed_range=(slowest * _TIMES, fastest * _TIMES), hop_speed_rad_s=window.hop_speed_rad_s * _TIMES,
        duration_s=window.duration_s / _TIMES, time_scale=1 / _TIMES,
    )  # fmt: skip


def test_a_machine_five_times_as_fast_reads_the_same() -> None:
    healthy = recorded(ROTOR, Excitation(), 71, 2) + recorded(ROTOR, OTHER, 72, 1)
    later = recorded(changed_rotor(ROTOR, {"k_by": -0.2, "c_bz": 0.5}), Excitation(), 73, 1)[0]
    conditions = ["one", "one", "two"]
    usual = BaselineDiagnostician(learn_baseline(healthy, conditions)).diagnose(later)
    fast = BaselineDiagnostician(learn_baseline([faster(one) for one in healthy], conditions)).diagnose(faster(later))
    assert len(usual.evaluable) >= 5
    for one, other in zip(usual.parameters, fast.parameters, strict=True):
        error, near = sure(one.standard_error), 0.03 if one.name == "e" else 1e-3  # its error has numeric derivatives
        assert abs(sure(one.relative_change) - sure(other.relative_change)) < near * error, one.name
        assert abs(error / sure(other.standard_error) - 1) < near, one.name


def test_lags_are_judged_relative_to_the_time_scale() -> None:
    window = recorded(ROTOR, Excitation(), 71, 2)[0]
    fast = faster(window)
    assert unsuitable(window) == unsuitable(fast) == ""
    assert unsuitable(replace(fast, time_scale=1.0)) == "correlations reach 0.025 s, 0.1 s are needed"
    assert unsuitable(replace(window, time_scale=0.2)) == "lags are 1 ms apart, at most 0.252 ms are needed"
