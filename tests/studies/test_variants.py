"""Variants of the relation networks' equations are what they say."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.studies.paper import full_correlation
from benchmarks.studies.variants import VARIANTS, as_seen, linear_fit, variant_equation
from models.diagnosis.networks.equations import EQUATIONS
from models.diagnosis.networks.relation import window_view
from models.diagnosis.window import WindowStatistics
from models.machine import load_machine
from simulator.training.draws import Draw, Purpose, simulate_window

LAB = load_machine("lab")
SHORT = LAB.model_copy(update={"window": LAB.window.model_copy(update={"length_s": 20.0})})
PRESENT = next(variant for variant in VARIANTS if variant.label.endswith("(the present one)"))


@pytest.fixture(scope="module")
def window() -> WindowStatistics:
    return simulate_window(Draw(SHORT, 41, Purpose.EVALUATION), 0)


@pytest.mark.parametrize("number", ["28", "29", "31"])
def test_the_variant_with_everything_on_is_the_equation_of_the_table(window: WindowStatistics, number: str) -> None:
    equation = next(one for one in EQUATIONS if one.number == number)
    rows = variant_equation(PRESENT, number).rows(window_view(window, SHORT), SHORT)
    expected = equation.rows(window_view(window, SHORT), SHORT)
    for name in ("inputs", "target", "signatures"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(expected, name))


def test_y1_alone_without_tilt_is_the_printed_equation_28(window: WindowStatistics) -> None:
    variant = replace(PRESENT, has=PRESENT.has - {"references", "tilt"})
    view = window_view(window, SHORT)
    rows = variant_equation(variant, "28").rows(view, SHORT)
    R, at = view.correlation, view.states.index
    printed = np.stack([R[:, at("y1"), at(name)] for name in ("y1", "y2", "y1_dot")], axis=1)
    np.testing.assert_array_equal(rows.inputs, printed)
    np.testing.assert_array_equal(rows.target, R[:, at("y1_dot"), at("y1_dot")])
    k_over_m = LAB.rotor.k_by_N_per_m / LAB.rotor.m1_kg
    np.testing.assert_allclose(rows.signatures[:, 0], k_over_m * printed[:, 0])


def test_a_unit_takes_the_place_of_the_norm(window: WindowStatistics) -> None:
    view = window_view(window, SHORT)
    equation = variant_equation(PRESENT, "28")
    rows = equation.rows(view, SHORT)
    in_unit = replace(equation, unit=2 * rows.norm).rows(view, SHORT)  # type: ignore[call-arg]  # 28 has a unit
    assert in_unit.norm == 1
    np.testing.assert_allclose(in_unit.target, rows.target / (2 * rows.norm))


def test_the_synchronous_part_is_put_back_as_the_paper_has_it(window: WindowStatistics) -> None:
    seen = as_seen(replace(PRESENT, has=PRESENT.has - {"synchronous"}), window)
    i, j = window.states.index("y1"), window.states.index("z2")
    np.testing.assert_allclose(seen.correlation[:, i, j], full_correlation(window, "y1", "z2"))
    assert as_seen(PRESENT, window) is window


def test_the_linear_fit_leaves_nothing_that_its_inputs_explain(window: WindowStatistics) -> None:
    equation = variant_equation(PRESENT, "31")
    rows = equation.rows(window_view(window, SHORT), SHORT)
    fit = linear_fit(equation, [window], SHORT)
    residual = rows.target / rows.norm - fit(rows.inputs / rows.norm)
    projected = (rows.inputs / np.linalg.norm(rows.inputs, axis=0)).T @ residual
    assert np.abs(projected).max() < 1e-8
    assert 0 < np.mean(residual**2) < 0.2
