"""The choice among sets of changed parameters, agreement of two diagnosticians, and invalid readings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from benchmarks.studies.reporting.opinions import restricted
from models.diagnosis.misfit import Rival
from models.diagnosis.readings import Z95, Diagnosis, no_reading, parameter_reading, possible_reading
from models.diagnosis.verdict.calibration import agreements, beside, month_thresholds, window_thresholds
from models.diagnosis.verdict.isolation import Isolation, isolate, isolate_window, outside_confidence, rival_of
from models.diagnosis.verdict.stretch import added, from_scale, slope, stretch_of, to_scale
from models.errors import EstimationError
from models.levels.judgement import Foreign
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from service.monitor.evaluation import Evaluation
from tests.sure import sure

SEED = 88_100


def covariance(rng: np.random.Generator, n: int = 6) -> FloatArray:
    """Standard errors from 0.1 % to 5 %, correlations from weak to strong."""
    factor = rng.standard_normal((n, n)) * 0.5 + np.eye(n) * rng.uniform(1, 2)
    raw = factor @ factor.T
    unit = raw / np.sqrt(np.outer(np.diag(raw), np.diag(raw)))
    errors = np.exp(rng.uniform(np.log(0.001), np.log(0.05), n))
    return np.asarray(unit * np.outer(errors, errors))


def window(values: FloatArray, cov: FloatArray, misfit_z: float | None = None) -> Diagnosis:
    """A diagnosis whose estimates are `values` in the scale of the errors."""
    slopes = np.array([slope(name, value) for name, value in zip(PARAMETERS, values, strict=True)])
    errors = np.sqrt(np.diag(cov)) * slopes
    readings = tuple(
        parameter_reading(name, "likelihood", from_scale(name, float(value)), float(error))
        for name, value, error in zip(PARAMETERS, values, errors, strict=True)
    )
    return Diagnosis("likelihood", readings, covariance=cov * np.outer(slopes, slopes), misfit_z=misfit_z)


def draw(rng: np.random.Generator, changed: int, rate: float, smallest: float) -> tuple[set[str], Isolation]:
    cov = covariance(rng)
    errors = np.sqrt(np.diag(cov))
    true = np.zeros(6)
    at = rng.choice(6, changed, replace=False)
    true[at] = rng.choice([-1, 1], changed) * rng.uniform(smallest, 2 * smallest, changed) * errors[at]
    values = rng.multivariate_normal(true, cov)
    return {PARAMETERS[i] for i in at}, isolate_window(window(values, cov), rate)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "windows"), [(0.05, 1_000), pytest.param(0.01, 20_000, marks=pytest.mark.long)])
def test_a_healthy_window_is_called_changed_at_the_declared_rate(rate: float, windows: int) -> None:
    rng = np.random.default_rng(SEED)
    called = sum(bool(draw(rng, 0, rate, 0.0)[1].changed) for _ in range(windows))
    expected = rate * windows
    # The bound of independent tests: with strongly correlated parameters the true rate is a little lower.
    assert 0.75 * expected - 3 * expected**0.5 < called < expected + 3 * expected**0.5


@pytest.mark.slow
@pytest.mark.parametrize("changed", [1, 2])
def test_one_or_two_faults_are_named_exactly(changed: int) -> None:
    """Faults of 6 to 12 of their free standard errors, at 1 % false alarms per window."""
    rng = np.random.default_rng(SEED + changed)
    windows, exact, wrong = 400, 0, 0
    sure: list[float] = []
    for _ in range(windows):
        true, verdict = draw(rng, changed, 0.01, 6.0)
        exact += set(verdict.changed) == true
        wrong += bool(set(verdict.changed) - true)
        sure.append(verdict.confidence)
    assert exact / windows >= 0.995
    assert wrong / windows <= 0.005
    assert float(np.mean(sure)) < exact / windows + 0.002  # the confidence is not overstated


@pytest.mark.parametrize("changed", [3, 6])
def test_more_than_two_changes_can_be_named(changed: int) -> None:
    rng = np.random.default_rng(SEED + changed)
    hits = [true == set(found.changed) for true, found in (draw(rng, changed, 0.01, 9.0) for _ in range(150))]
    assert np.mean(hits) > 0.98


@pytest.mark.slow
def test_the_confidence_is_calibrated_near_the_limit() -> None:
    """Single faults of 2 to 4 standard errors: verdicts given with 60 to 90 % are right about as often or more."""
    rng = np.random.default_rng(SEED + 50)
    drawn = [draw(rng, 1, 0.01, 2.5) for _ in range(700)]
    named = [(true == set(found.changed), found.confidence) for true, found in drawn if found.changed]
    middle = [(right, sure) for right, sure in named if 0.6 < sure < 0.9]
    assert len(middle) > 60
    assert np.mean([right for right, _ in middle]) > np.mean([sure for _, sure in middle]) - 0.05


def test_changes_that_hide_each_other_in_single_tests_are_found_together() -> None:
    """Two changes along the ridge of a strong correlation: neither alone explains anything, both together do."""
    cov = np.diag(np.full(6, 1e-4))
    cov[0, 1] = cov[1, 0] = 0.9e-4
    J = np.linalg.inv(cov)
    true = np.zeros(6)
    true[0] = 0.1
    true[1] = -J[0, 0] / J[0, 1] * 0.1  # the restricted estimate of k_by is zero
    found = isolate_window(window(true, cov), 0.01)
    assert found.changed == ("k_by", "c_by")


@pytest.mark.parametrize(("first", "second", "found"), [(4.7, 4.7, True), (4.7, 4.0, False)])
def test_two_changes_below_the_single_threshold_may_pass_jointly(first: float, second: float, found: bool) -> None:
    thresholds = month_thresholds(1.0, 5.0, 12, len(PARAMETERS), 10)
    assert first < thresholds.first
    seen = window(1e-3 * np.array([0.0, first, 0.0, second, 0.0, 0.0]), np.diag(np.full(6, 1e-6)))
    isolation = isolate(stretch_of(seen, 0, 0).complete().believed(), thresholds)
    assert bool(isolation.changed) is found
    likeliest = np.argsort(isolation.probability)[-2:]
    assert {PARAMETERS[i] for i in likeliest} == {"c_by", "c_bz"}


def test_the_restricted_estimate_is_more_precise_and_unbiased() -> None:
    rng = np.random.default_rng(SEED + 60)
    cov = np.diag(np.full(6, 1e-4))
    cov[0, 1] = cov[1, 0] = 0.8e-4
    z = []
    for _ in range(500):
        seen = window(rng.multivariate_normal([-0.3, 0, 0, 0, 0, 0], cov), cov)
        found = isolate_window(seen, 0.01)
        (reading,) = (one for one in restricted(stretch_of(seen, 0, 0), found.changed, seen.by) if one.name == "k_by")
        change, error = sure(reading.relative_change), sure(reading.standard_error)
        z.append((to_scale("k_by", change) + 0.3) / (error / (1 + change)))
        if len(found.changed) == 1:
            assert error < 0.65 * 0.01 * (1 + change)
    assert float(np.std(z)) == pytest.approx(1.0, abs=0.1)
    assert abs(float(np.mean(z))) < 0.2


def test_outside_the_model_is_a_separate_verdict() -> None:
    cov = np.diag(np.full(6, 1e-4))
    quiet, loud = (isolate_window(window(np.zeros(6), cov, misfit_z=z), 0.01) for z in (1.0, 5.0))
    assert (quiet.outside, quiet.low_confidence) == (False, False)
    assert (loud.outside, loud.low_confidence, loud.changed) == (True, True, ())
    assert sure(loud.outside_confidence) > 0.9999
    assert outside_confidence(-3.0) == 0.5
    assert outside_confidence(2.326) == pytest.approx(1 / (1 + np.e * 0.01 * np.log(100)), rel=1e-3)


def test_parameters_without_a_reading_take_no_part() -> None:
    cov = np.diag(np.full(6, 1e-4))
    full = window(np.array([0.2, 0, 0, 0, 0, 0]), cov)
    missing = tuple(
        no_reading(one.name, one.by, "not measured") if one.name == "c_bz" else one for one in full.parameters
    )
    found = isolate_window(Diagnosis("network", missing, covariance=np.delete(np.delete(cov, 3, 0), 3, 1)), 0.01)
    assert (found.changed, found.probability[3]) == (("k_by",), 0.0)
    assert isolate_window(Diagnosis("network"), 0.01).changed == ()


def test_stretches_add_by_inverse_variance() -> None:
    rng = np.random.default_rng(SEED + 70)
    cov = covariance(rng)
    parts = [stretch_of(window(rng.multivariate_normal(np.zeros(6), cov), cov, 1.5), n, n + 1) for n in range(4)]
    together = added(parts)
    mean, spread = together.estimate
    np.testing.assert_allclose(spread, cov / 4, rtol=1e-6)
    np.testing.assert_allclose(mean, np.mean([part.estimate[0] for part in parts], axis=0), atol=1e-9)
    assert together.misfit_z == pytest.approx(3.0)
    assert (together.start_ns, together.end_ns) == (0, 4)
    np.testing.assert_allclose(together.blurred(0.01).estimate[1], cov / 4 + 1e-4 * np.eye(6), rtol=1e-6)


def diagnosis(by: str, **changes: tuple[float, float]) -> Diagnosis:
    return Diagnosis(by, tuple(parameter_reading(name, by, *value) for name, value in changes.items()))


def test_agreement_disagreement_and_only_one() -> None:
    first = diagnosis("likelihood", k_by=(-0.25, 0.01), c_by=(0.01, 0.01), EI=(0.0, 0.002))
    second = diagnosis("network", k_by=(-0.24, 0.02), c_by=(0.30, 0.02), e=(0.1, 0.02))
    found = {one.name: one for one in agreements(first, second)}
    assert (list(found), found["k_by"].verdict) == (["k_by", "c_by", "e", "EI"], "agree")
    assert found["k_by"].between == ("likelihood", "network")
    assert found["k_by"].difference_z == pytest.approx(0.01 / 5**0.5 / 0.01)
    assert found["c_by"].verdict == "disagree"
    assert found["c_by"].difference_z == pytest.approx(0.29 / 5**0.5 / 0.01)
    assert found["e"].verdict == found["EI"].verdict == "only-one"
    assert found["e"].difference_z is None
    assert agreements(Diagnosis("likelihood"), Diagnosis("network")) == ()


@pytest.mark.parametrize("common", [1, 6])
def test_two_unbiased_estimators_disagree_once_in_a_thousand_windows(common: int) -> None:
    """Over all parameters together, if their readings are independent."""
    limit = float(norm.isf((1 - 0.999 ** (1 / common)) / 2)) * np.hypot(0.01, 0.03)
    for apart, verdict in ((0.999 * limit, "agree"), (1.001 * limit, "disagree")):
        one, other = (dict.fromkeys(PARAMETERS[:common], reading) for reading in ((0.0, 0.01), (apart, 0.03)))
        found = agreements(diagnosis("likelihood", **one), diagnosis("network", **other))
        assert [each.verdict for each in found] == [verdict] * common


@pytest.mark.parametrize("freedom", [3.0, 12.0, 100.0])
def test_few_degrees_of_freedom_do_not_raise_the_rate_of_disagreement(freedom: float) -> None:
    """Whatever the tails, one in a thousand lies beyond; the standard error gives the 95 % interval."""
    scale = 0.03 * norm.isf(0.025) / student.isf(0.025, freedom)
    limit = float(student.isf(0.0005, freedom)) * scale
    for apart, verdict in ((0.999 * limit, "agree"), (1.001 * limit, "disagree")):
        second = replace(diagnosis("relation", k_by=(apart, 0.03)), freedom={"k_by": freedom})
        (found,) = agreements(diagnosis("likelihood", k_by=(0.0, 1e-6)), second)
        assert found.verdict == verdict
        # If the error of the likelihood is much larger, tails are normal.
        (wide,) = agreements(diagnosis("likelihood", k_by=(0.0, 3.0)), second)
        assert wide.difference_z == pytest.approx(apart / 3.0, rel=1e-3)


@pytest.mark.parametrize("rate", [0.01, 0.001])
def test_few_degrees_of_freedom_do_not_raise_the_rate_of_changed_windows(rate: float) -> None:
    """Approximately, as errors are small, on the scale in which changes of k and of 1/k weigh the same."""
    limit = float(student.isf(rate / 2, 5.0)) * 1e-4 * norm.isf(0.025) / student.isf(0.025, 5.0)
    for apart, named in ((0.99 * limit, ()), (1.01 * limit, ("k_by",))):
        one = replace(diagnosis("network", k_by=(apart, 1e-4)), freedom={"k_by": 5.0})
        assert isolate_window(one, rate).changed == named


def test_a_reading_confused_by_another_change_is_withdrawn_and_only_then() -> None:
    second = replace(diagnosis("relation", e=(0.2, 0.01), k_by=(0.0, 0.01)), taken_for={"e": {"EI": -2.0}})
    changed = diagnosis("likelihood", e=(0.0, 0.01), k_by=(0.0, 0.01), EI=(-0.1, 0.002))
    told = {one.name: one for one in beside(changed, second).parameters}
    assert told["e"].relative_change is None
    assert told["e"].reason == "not told from the change of EI that the likelihood reads"
    assert told["k_by"] == second.parameters[1]
    verdicts = {one.name: one.verdict for one in agreements(changed, beside(changed, second))}
    assert verdicts == {"k_by": "agree", "e": "only-one", "EI": "only-one"}
    for EI in ((-0.1, 0.05), (-0.004, 0.0001)):  # not sure to have changed; sure, and too little to be seen in e
        kept = diagnosis("likelihood", e=(0.0, 0.01), k_by=(0.0, 0.01), EI=EI)
        assert beside(kept, second).parameters == second.parameters


@pytest.mark.parametrize("change", [np.nan, np.inf, -np.inf])
def test_a_non_finite_number_is_no_reading(change: float) -> None:
    reading = possible_reading("k_by", "relation", change, 0.1)
    assert (reading.relative_change, reading.standard_error, reading.interval_95) == (None, None, None)
    assert reading.reason
    with pytest.raises(EstimationError, match="k_by"):
        parameter_reading("k_by", "likelihood", change, 0.1)


def test_a_reading_without_an_error_has_no_interval() -> None:
    reading = parameter_reading("e", "likelihood", 0.1, np.inf)
    assert (reading.relative_change, reading.standard_error, reading.interval_95, reading.z) == (0.1, None, None, None)
    sharp = parameter_reading("e", "likelihood", 0.1, 0.0)
    assert (sharp.interval_95, sharp.z) == ((0.1, 0.1), None)


def test_z95_is_the_97_5_per_cent_quantile_of_the_normal_distribution() -> None:
    assert pytest.approx(norm.ppf(0.975), abs=1e-6) == Z95


@pytest.mark.parametrize(("c_by", "rivals"), [(0.0, True), (-0.14, False)])
def test_parameters_rival_a_wrong_gain_where_damping_or_1x_allows_it(c_by: float, *, rivals: bool) -> None:
    """A wrong gain at a place changes stiffness and damping by the same factor."""
    readings = (parameter_reading("k_by", "baseline", -0.14, 0.004), parameter_reading("c_by", "baseline", c_by, 0.07))
    evaluation = Evaluation(Diagnosis("baseline", readings, covariance=np.diag([0.004, 0.07]) ** 2), {}, (), (), None)
    gain = Foreign("gain of y1: 1.16 times", hides=True, direction="y")
    assert evaluation.rivals(gain) == (("k_by", "c_by") if rivals else ())
    assert evaluation.rivals(gain._replace(unlike=30.0)) == ("k_by", "c_by")
    assert evaluation.rivals(gain._replace(direction="z")) == ()
    assert evaluation.rivals(Foreign("a line", hides=True)) == ()


@pytest.mark.parametrize(
    ("reading", "held", "doubted"), [(-0.14, True, False), (None, True, True), (None, False, False)]
)
def test_a_wrong_gain_is_not_blamed_alone_where_no_reading_excludes_the_bearing(
    reading: float | None, *, held: bool, doubted: bool
) -> None:
    """A bearing well below its resonance moves inversely to its stiffness at every frequency, as with a gain."""
    k_by = (
        no_reading("k_by", "shape", "no equation") if reading is None else parameter_reading("k_by", "x", reading, 0.1)
    )
    readings, gain = (k_by, parameter_reading("c_by", "x", 0.1, 0.1)), Foreign("gain of y1", direction="y", held=held)
    evaluation = Evaluation(Diagnosis("x", readings, covariance=0.01 * np.eye(2)), {}, (), (), None)
    text = evaluation.doubted(gain).text
    assert text.startswith("gain of y1")
    assert ("the stiffness there has changed" in text) == doubted


def test_a_cause_is_a_rival_of_the_parameters_only_if_it_explains_as_much() -> None:
    """Readings with errors of 2 %, uncorrelated; the cause lowers all of them alike."""
    cov, limits = 0.02**2 * np.eye(6), window_thresholds(1e-6, 6)
    alike = Rival("the disc's mass", -np.ones(6), 0.0, 0.0)

    def rivals(values: FloatArray, names: tuple[str, ...], cause: Rival = alike) -> str:
        return rival_of(stretch_of(window(values, cov), 0, 1), names, [cause], limits)

    one, every = np.array([-0.2, 0, 0, 0, 0, 0]), np.full(6, -0.1)
    assert not rivals(one, ("k_by",))
    assert rivals(every, ("k_by",)) == "the disc's mass"
    assert rivals(every, PARAMETERS) == "the disc's mass"  # one unknown in place of six
    assert not rivals(0 * every, ())
    # Where the spectra would show the cause, and do not, it is none.
    shown = 1e6
    assert not rivals(every, PARAMETERS, Rival("the disc's mass", -np.ones(6), shown, 0.0))
    assert rivals(every, PARAMETERS, Rival("the disc's mass", -np.ones(6), shown, 0.1 * shown)) == "the disc's mass"
    # Large changes are not as the slopes of the cause say: it may miss some of them, but not all.
    assert rivals(np.array([-0.5, -0.5, -0.5, -0.5, -0.5, -0.4]), PARAMETERS) == "the disc's mass"
    assert not rivals(np.array([-0.5, -0.5, 0, 0, 0, 0]), ("k_by", "c_by"))
    assert not rivals(np.full(6, 1.2), PARAMETERS)  # nothing of a cause twice as large as itself is linear
