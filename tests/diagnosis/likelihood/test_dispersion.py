"""Forces that are no Gaussian noise of one level: gusts and impacts, on a healthy machine and beside a fault."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.studies.subjects.unusual import Anomaly, UnusualDraw
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.likelihood.goodness import MOST_MISFIT
from models.diagnosis.window.excluded import summed
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import load_machine
from simulator.training.draws import Layout, Purpose, simulate_window
from tests.sure import sure

SEED = 20261131
LAB = load_machine("lab")


def window_of(number: int, layout: Layout, anomaly: Anomaly = Anomaly.NONE) -> WindowStatistics:
    draw = UnusualDraw(LAB, SEED, Purpose.EVALUATION, number, anomaly=anomaly, layout=layout)
    return simulate_window(draw, 0)


def gusty(number: int, anomaly: Anomaly = Anomaly.NONE) -> WindowStatistics:
    """A window in which one source comes in gusts of a segment's length, over a steady background of many sources."""
    gusts, background = window_of(number, Layout.ONE_SOURCE, anomaly), window_of(number, Layout.INDEPENDENT, anomaly)
    rng = np.random.default_rng([SEED, number])
    size = rng.standard_exponential(gusts.n_segments) ** 1.5
    segments = size[:, None] * gusts.segments + 0.1 * background.segments
    return replace(gusts, segments=segments, spectrum=summed(segments) / gusts.n_segments)


@pytest.mark.parametrize("number", [0, *(pytest.param(number, marks=pytest.mark.long) for number in (1, 2))])
def test_gusts_are_no_misfit(number: int) -> None:
    diagnosis = LikelihoodFit(LAB).diagnose(gusty(number))
    assert sure(diagnosis.misfit_z) < MOST_MISFIT
    for one in diagnosis.evaluable:
        assert abs(sure(one.relative_change)) < 6 * sure(one.standard_error)


def test_an_added_mass_is_a_misfit_under_gusts_as_well() -> None:
    assert sure(LikelihoodFit(LAB).diagnose(gusty(0, Anomaly.ADDED_MASS)).misfit_z) > 5


def test_the_mean_of_the_segments_is_the_spectrum_whatever_the_mounting() -> None:
    window = window_of(0, Layout.ONE_SOURCE)
    for seen in (window, window.of(window.states[1:3]), window.turned(np.diag(np.arange(1.0, 9.0))[::-1])):
        np.testing.assert_allclose(summed(seen.segments) / seen.n_segments, seen.spectrum, rtol=1e-9)
