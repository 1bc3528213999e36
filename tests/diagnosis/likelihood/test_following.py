"""Following a sliding window gives the readings of a new search, and changes are noticed."""

from contextlib import suppress
from functools import lru_cache

import numpy as np
import pytest

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.likelihood.lengths import LengthFits
from models.diagnosis.readings import Diagnosis
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import UnexplainedError
from models.machine import load_machine
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from simulator.scenario import Event
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_window
from tests.service.rig.foreign import Foreign, as_blocks, foreign
from tests.sure import sure
from tests.windows import full_windows, last_window

LAB = load_machine("lab")
SEED = 61


@lru_cache
def slid(layout: Layout, step: tuple[str, float] | None = None) -> tuple[SlidingWindow, tuple[WindowStatistics, ...]]:
    """The sliding window after a minute and six hops, and all full windows; a step comes three hops before the end."""
    draw = Draw(LAB, SEED, Purpose.EVALUATION, 7, layout=layout)
    faults = [] if step is None else [Event(at_s=77.5, parameter=step[0], relative_change=step[1])]
    scenario = draw_condition(draw, 0).overridden(duration_s=92.6, faults=faults)
    window = SlidingWindow(plan_for(LAB))
    return window, tuple(full_windows(window, (block for block, _ in blocks(scenario, LAB, block_s=1.0))))


def values(diagnosis: Diagnosis) -> tuple[FloatArray, FloatArray]:
    read = diagnosis.evaluable
    return np.array([one.relative_change or 0.0 for one in read]), np.array([one.standard_error or 0.0 for one in read])


@pytest.mark.slow
@pytest.mark.parametrize("layout", [Layout.ONE_SOURCE, pytest.param(Layout.INDEPENDENT, marks=pytest.mark.long)])
def test_following_and_glancing_agree_with_a_full_search(layout: Layout) -> None:
    sliding, windows = slid(layout)
    assert len(windows) == 7
    following, searching = LikelihoodFit(LAB, follow=True), LikelihoodFit(LAB)
    for window in windows:
        (followed, followed_error), (searched, error) = (values(fit.diagnose(window)) for fit in (following, searching))
        assert np.all(np.abs(followed - searched) < 0.7 * error)  # each is converged to 0.15 errors
        np.testing.assert_allclose(followed_error, error, rtol=0.1)
    for hops in (2, 4, 7):
        stretch = sure(sliding.statistics(hops))
        seen = sure(following.glance(stretch))
        assert seen.misfit_z is None
        near = LikelihoodFit(LAB)
        near.start_near(following, anew=True)
        (glanced, glanced_error), (searched, error) = values(seen), values(near.diagnose(stretch))
        assert np.all(np.abs(glanced - searched) < 0.8 * error)
        np.testing.assert_allclose(glanced_error, error, rtol=0.15)


def test_after_windows_that_misfit_a_better_maximum_is_searched_from_scratch() -> None:
    """Searches that begin where the last one ended may stay near a wrong maximum, as after a change.

    One that begins where following ended may do so at once, without a change.
    """
    draw = Draw(LAB, SEED, Purpose.EVALUATION, 20, layout=Layout.INDEPENDENT, faults={"c_bz": -0.3})
    window, fit = simulate_window(draw, 0), LikelihoodFit(LAB)
    right, remembered = fit.diagnose(window), fit.checkpoint()
    remembered["last"][4] += 0.8
    found = []
    for followed, misfits in ((0, 0), (0, 3), (12, 0)):
        remembered["followed"][1:3] = followed, misfits
        fit.restore(remembered)
        found.append(fit.diagnose(window))
    assert sure(found[0].misfit_z) > 4
    assert found[1].parameters == found[2].parameters == right.parameters


def test_a_glance_is_refused_after_a_change_and_before_the_first_search() -> None:
    window, windows = slid(Layout.INDEPENDENT, ("k_by", -0.2))
    fits, fit = LengthFits(LAB), LikelihoodFit(LAB, follow=True)
    for full in windows:
        fits.window(full)
        fit.diagnose(full)
    stretch = sure(window.statistics(2))
    assert fit.glance(stretch) is None
    change, error = values(fits.short(2, stretch))
    assert abs(change[0] + 0.2) < 4 * error[0] < 0.2
    assert LikelihoodFit(LAB, follow=True).glance(stretch) is None


@pytest.mark.parametrize("stream", [38, pytest.param(41, marks=pytest.mark.long)])
def test_stretches_of_a_machine_that_has_changed_fit_although_the_window_mixes_two(stream: int) -> None:
    """With one source on a machine that rings, searches from the window's forces ended at a misfit of 9 to 17."""
    damped = {"c_by_N_s_per_m": 9.0, "c_bz_N_s_per_m": 9.0}
    ringing = LAB.model_copy(update={"rotor": LAB.rotor.model_copy(update=damped)})
    draw = Draw(ringing, SEED, Purpose.EVALUATION, stream, layout=Layout.ONE_SOURCE)
    step = Event(at_s=67.5, parameter="k_bz", relative_change=0.23)
    scenario = draw_condition(draw, 0).overridden(duration_s=92.6, faults=[step])
    sliding, fits, found = SlidingWindow(plan_for(ringing)), LengthFits(ringing), []
    stream_of_blocks = (block for block, _ in blocks(scenario, ringing, block_s=1.0))
    for hops, full in zip((0, 0, 0, 0, 2, 2, 4), full_windows(sliding, stream_of_blocks), strict=True):
        with suppress(UnexplainedError):
            fits.window(full)
        if hops:
            found.append(fits.short(hops, sure(sliding.statistics(hops)), closely=True))
    for one in found:
        assert sure(one.misfit_z) < 3
        assert values(one)[0][PARAMETERS.index("k_bz")] == pytest.approx(0.23, abs=0.01)


@pytest.mark.parametrize("step", [None, ("k_by", -0.2), pytest.param(("EI", -0.1), marks=pytest.mark.long), ("e", 0.3)])
def test_the_latest_hops_have_news_only_after_a_change(step: tuple[str, float] | None) -> None:
    sliding, windows = slid(Layout.INDEPENDENT, step)
    fits = LengthFits(LAB)
    fits.window(windows[-1])
    assert all(fits.has_news(sliding, windows[-1], (hops,)) == (step is not None) for hops in (2, 4, 7))


@pytest.mark.parametrize("kind", ["drift", pytest.param("late copy", marks=pytest.mark.long)])
def test_an_unexplained_window_does_not_affect_the_next(kind: Foreign) -> None:
    """After a window of something else, the next one is read as if it were the first."""
    strange = last_window(plan_for(LAB), as_blocks(LAB, foreign(LAB, kind, SEED, 70.0)))
    fit = LikelihoodFit(LAB, follow=True)
    with suppress(UnexplainedError):
        assert fit.diagnose(strange).unexplained
    ours = slid(Layout.ONE_SOURCE)[1][0]
    np.testing.assert_array_equal(values(fit.diagnose(ours)), values(LikelihoodFit(LAB, follow=True).diagnose(ours)))
