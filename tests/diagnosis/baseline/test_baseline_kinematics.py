"""One quantity per place suffices: displacement, velocity, acceleration or a mixture."""

from functools import cache

import numpy as np
import pytest

from benchmarks.finite_elements.motion import PROBES
from benchmarks.finite_elements.observed import windows_of
from benchmarks.finite_elements.rotor import BeamRotor, changed_rotor
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.lag_moments import gain, kernels, passband_hz, shape_for
from models.diagnosis.baseline.learned import learn_baseline
from models.diagnosis.baseline.rows import (
    ROWS,
    Own,
    Row,
    Source,
    evaluable_rows,
    formation_of,
    not_measured,
    parameters_of,
)
from models.diagnosis.readings import Diagnosis
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import FloatArray
from tests.diagnosis.baseline.fe_rotor import OTHER, ROTOR, Excitation, of_states, plan, simulate
from tests.sure import sure

DISPLACEMENTS = ("y1", "y2", "z1", "z2")
VELOCITIES = tuple(f"{name}_dot" for name in DISPLACEMENTS)
ACCELERATIONS = tuple(f"{name}_ddot" for name in DISPLACEMENTS)
TERMS = tuple(term.motions for term in ROWS[0].terms)


@cache
def sampled(rotor: BeamRotor, excitation: Excitation, seed: int, count: int) -> FloatArray:
    return simulate(rotor, excitation, 60.0 * count + 3, seed)


@cache
def recorded(rotor: BeamRotor, excitation: Excitation, seed: int, count: int) -> tuple[WindowStatistics, ...]:
    return tuple(windows_of(sampled(rotor, excitation, seed, count), plan(states=PROBES)))


def healthy() -> tuple[WindowStatistics, ...]:
    other = Excitation(50.0, ((0.3, 0.8, -0.5, 0.2),))
    return recorded(ROTOR, Excitation(), 71, 2) + recorded(ROTOR, other, 72, 1)


@cache
def monitor_of(*states: str) -> BaselineDiagnostician:
    return BaselineDiagnostician(learn_baseline([of_states(window, states) for window in healthy()]))


def names(diagnosis: Diagnosis) -> tuple[str, ...]:
    return isolate_window(diagnosis, 0.001).changed


@pytest.mark.parametrize(
    ("states", "raised", "deepest"),
    [
        (DISPLACEMENTS + VELOCITIES, 0, 1), (DISPLACEMENTS, 0, 2), (VELOCITIES, 1, 2), (ACCELERATIONS, 2, 2),
        (("y1", "y2_dot"), 1, 3), (("y1_dot", "y2"), 1, 3), (("y1", "y2_ddot"), 2, 4),
    ],
)  # fmt: skip
def test_a_row_uses_as_few_derivatives_as_possible(states: tuple[str, ...], raised: int, deepest: int) -> None:
    formation = formation_of(TERMS, states)
    assert (formation.raised, formation.deepest) == (raised, deepest)


def test_the_quantity_that_needs_no_derivative_is_preferred() -> None:
    formation = formation_of(TERMS, DISPLACEMENTS + VELOCITIES)
    assert formation.terms[:4] == (
        (Source("y1", 0, 1.0),), (Source("y1_dot", 0, 1.0),), (Source("y2_dot", 1, 1.0),), (Source("y1_dot", 1, 1.0),),
    )  # fmt: skip
    assert formation_of(TERMS, (*DISPLACEMENTS, "y2_ddot")).terms[2] == (Source("y2_ddot", 0, 1.0),)


def test_missing_measurements_are_named_by_place_and_direction() -> None:
    assert not_measured(ROWS[0].motions, ("y1", "z1", "z2")) == (
        "not measured: disc, horizontal (displacement, velocity or acceleration)"
    )
    assert not_measured(ROWS[0].motions, ("y1_ddot", "y2")) == ""
    found = {row.name: reason for row, reason in evaluable_rows(("y1", "y2_dot", "z2"), False)}
    assert (found["y"], found["z"]) == ("", "not measured: bearing, vertical (displacement, velocity or acceleration)")
    assert "no phase reference" in found["y 1x"]
    assert found["z 1x"].startswith("not measured: bearing")


@pytest.mark.parametrize("deepest", [1, 2, 3, 4])
def test_kernels_differentiate_within_their_passband(deepest: int) -> None:
    lags = np.arange(0, 0.1255, 0.001)
    shape = shape_for(deepest, 150.0, 1.0)
    over, centres_s = kernels(lags.tobytes(), 0.03, shape, deepest)
    edge = passband_hz(deepest, 150.0, 1.0)
    assert 100 < edge <= 150
    for f in (5.0, 30.0, 0.9 * edge):
        wave = np.exp(2j * np.pi * f * lags)
        at = np.exp(2j * np.pi * f * centres_s)
        for order in range(deepest + 1):
            expected = (2j * np.pi * f) ** order * gain(np.array([f]), shape)[0] * at
            assert np.max(np.abs(over[order] @ wave - expected)) < 0.02 * np.abs(expected[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "states",
    [
        ("y1", "z1", "y2_dot", "z2_dot"),
        *(pytest.param(states, marks=pytest.mark.long) for states in (DISPLACEMENTS, VELOCITIES, ACCELERATIONS)),
    ],
    ids=lambda states: states[-1],
)
def test_one_quantity_per_place_is_enough_to_name_the_change(states: tuple[str, ...]) -> None:
    monitor = monitor_of(*states)
    (same,) = recorded(ROTOR, OTHER, 73, 1)
    assert names(monitor.diagnose(of_states(same, states))) == ()
    (softer,) = recorded(changed_rotor(ROTOR, {"k_by": -0.1}), OTHER, 74, 1)
    diagnosis = monitor.diagnose(of_states(softer, states))
    assert names(diagnosis) == ("k_by",)
    assert diagnosis.evaluable[0].relative_change == pytest.approx(-0.09, abs=0.03)
    (looser,) = recorded(changed_rotor(ROTOR, {"c_bz": -0.4}), OTHER, 75, 1)
    assert names(monitor.diagnose(of_states(looser, states))) == ("c_bz",)


def test_the_common_part_is_part_of_the_covariance() -> None:
    monitor = monitor_of(*DISPLACEMENTS)
    (same,) = recorded(ROTOR, OTHER, 73, 1)
    diagnosis = monitor.diagnose(of_states(same, DISPLACEMENTS))
    common, covariance = sure(diagnosis.common), sure(diagnosis.covariance)
    assert np.all(np.diag(common) > 0)
    unit = 1 / np.sqrt(np.diag(covariance))
    assert np.linalg.eigvalsh((covariance - common) * np.outer(unit, unit))[0] > 0


def test_a_plane_without_a_probe_states_so_and_the_other_is_read() -> None:
    states = ("y1", "y2", "z1")
    monitor = monitor_of(*states)
    (same,) = recorded(ROTOR, OTHER, 73, 1)
    reasons = {reading.name: reading.reason for reading in monitor.diagnose(of_states(same, states)).parameters}
    assert reasons["k_bz"] == "not measured: disc, vertical (displacement, velocity or acceleration)"
    assert reasons["k_by"] == reasons["c_by"] == ""


@pytest.mark.slow
def test_without_a_phase_reference_the_unbalance_is_read_from_the_1x_line() -> None:
    sizes = plan(speed_rad_s=ROTOR.speed_rad_s)
    base = windows_of(sampled(ROTOR, Excitation(), 71, 2), sizes)
    monitor = BaselineDiagnostician(learn_baseline(base))
    heavier = changed_rotor(ROTOR, {"e": 0.5})
    (window,) = windows_of(simulate(heavier, Excitation(), 63, 76), sizes)
    assert window.speed_source == "estimated"
    e = {reading.name: reading for reading in monitor.diagnose(window).parameters}["e"]
    assert abs(sure(e.relative_change) - 0.5) < 3 * sure(e.standard_error)


def test_an_added_row_is_learned_and_read() -> None:
    second = Row("again", "28 + 29", "horizontal once more", ROWS[0].terms, (Own("EI", (0,)),))
    rows = (*ROWS, second)
    base = [of_states(window, DISPLACEMENTS) for window in healthy()]
    monitor = BaselineDiagnostician(learn_baseline(base, rows=rows), rows)
    (softer,) = recorded(changed_rotor(ROTOR, {"k_by": -0.1}), OTHER, 74, 1)
    found = {reading.name: reading for reading in monitor.diagnose(of_states(softer, DISPLACEMENTS)).parameters}
    assert set(found) == {*parameters_of(), "EI"}
    assert found["EI"].relative_change == pytest.approx(-0.09, abs=0.03)
