"""The sequential test on Gaussian hops: declared rate, delays, location, repair, thresholds, detectable changes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats.qmc import MultivariateNormalQMC

from models.diagnosis.readings import Z95
from models.diagnosis.verdict.calibration import (
    MONTH_S,
    crossing_rate,
    detectable_changes,
    length_to_find,
    month_thresholds,
    overshoot_correction,
    window_thresholds,
)
from models.diagnosis.verdict.change_point import read_changes
from models.diagnosis.verdict.isolation import isolate
from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest
from models.diagnosis.verdict.sequential_state import SequentialState
from models.diagnosis.verdict.stretch import Stretch, stretch_of, to_scale
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from tests.diagnosis.verdict.gaussian_hops import GaussianHops, play, true
from tests.diagnosis.verdict.test_isolation import covariance, window
from tests.sure import sure

SEED = 88_300
SETTINGS = SequentialSettings(hop_s=5.0, window_hops=12)
ERRORS = np.array([0.0036, 0.0135, 0.0036, 0.0135, 0.018, 0.002])
"""Standard errors of the rotor kit in 60 s, at the lower bound of any method."""
COVARIANCE = np.diag(ERRORS**2)


def gaussian(seed: int, settings: SequentialSettings = SETTINGS) -> GaussianHops:
    return GaussianHops(settings, COVARIANCE, np.random.default_rng(seed))


def fixed_length_s(name: str, change: float) -> float:
    """Data that a test of one fixed length needs at the same rate, with 95 % power."""
    length_s, stretch = 60.0, stretch_of(window(np.zeros(len(PARAMETERS)), COVARIANCE), 0, 60_000_000_000)
    for _ in range(50):
        thresholds = month_thresholds(1.0, 5.0, max(1, round(length_s / 5.0)), len(PARAMETERS))
        (found,) = (one for one in detectable_changes(stretch, thresholds, 60.0) if one.name == name)
        length_s = length_to_find(found, change)
    return length_s


@pytest.mark.slow
def test_an_error_that_all_windows_share_is_not_averaged_away() -> None:
    """A commissioning off by one standard error must not become a finding after 32 windows."""
    shared = np.zeros((6, 6))
    shared[0, 0] = 0.02**2
    offset = true(k_by=0.02)
    named = {}
    for common in (None, shared):
        hops, test = gaussian(SEED + 40), SequentialTest(SETTINGS)
        for number in range(1, 12 * 32 + 1):
            looks = hops.looks(offset)
            if number % 12 == 0:
                verdict = test.update({12: replace(looks[12], common=common)})  # sums are made of whole windows
        named[common is None] = [finding.name for finding in verdict.changed]
    assert named == {True: ["k_by"], False: []}


@pytest.mark.slow
@pytest.mark.parametrize(("declared", "n_hops"), [(8000.0, 800), pytest.param(4000.0, 10_000, marks=pytest.mark.long)])
def test_false_alarms_come_at_the_declared_rate(declared: float, n_hops: int) -> None:
    """Hours of a healthy machine at 8000 declared false alarms per month: 12 are expected in 800 hops."""
    settings = replace(SETTINGS, false_alarms_per_month=declared, systematic=0.0)
    verdicts = play(SequentialTest(settings), gaussian(SEED, settings), (n_hops, true()))
    last, count = -1000, 0
    for number, verdict in verdicts:
        if verdict.detected:
            # Noise that crosses the threshold at several lengths counts as one alarm.
            count += number - last > 24
            last = number
    expected = declared * n_hops * SETTINGS.hop_s / MONTH_S
    # Lengths overlap, so that their results are correlated: the declared rate is an upper bound.
    assert 0.4 * expected < count < expected + 3 * expected**0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change", "within_s"),
    [
        ("c_by", -0.1, None),
        pytest.param("k_by", -0.25, 10.0, marks=pytest.mark.long),
        *(pytest.param(*one, None, marks=pytest.mark.long) for one in (("k_by", -0.05), ("c_by", -0.2), ("e", 0.2))),
    ],
)
def test_delays_are_within_twice_those_of_a_fixed_length_test(name: str, change: float, within_s: float | None) -> None:
    """19 of 20 changes at a random moment within a hop are named within twice the data of a test made for them."""
    step, named_s = true(**{name: change}), []
    for rng in (np.random.default_rng(child) for child in np.random.SeedSequence(SEED).spawn(20)):
        hops, share = GaussianHops(SETTINGS, COVARIANCE, rng), float(rng.uniform())
        verdicts = play(SequentialTest(SETTINGS), hops, (14, 0 * step), (1, share * step), (23, step))
        assert not any(verdict.detected for number, verdict in verdicts if number < 14)
        found = [((number - 14 + share) * SETTINGS.hop_s, [one.name for one in v.changed]) for number, v in verdicts]
        assert all(names in ([], [name]) for _, names in found)
        named_s.append(min((delay_s for delay_s, names in found if names), default=np.inf))
    assert np.quantile(named_s, 0.95) <= (within_s or 2 * fixed_length_s(name, change))


def test_a_change_that_goes_on_is_read_without_the_data_of_its_course() -> None:
    """Stiffness that falls over 30 s, with the errors of one source, is read right as soon as two hops have passed."""
    hops = GaussianHops(SETTINGS, COVARIANCE / 100, np.random.default_rng(SEED + 3))
    course = [(1, true(k_by=-0.03 * n)) for n in range(1, 6)]
    verdicts = play(SequentialTest(SETTINGS), hops, (24, true()), *course, (12, true(k_by=-0.18)))
    for _, verdict in verdicts[-11:]:
        (read,) = (one for one in verdict.current if one.name == "k_by")
        assert read.relative_change == pytest.approx(-0.18, abs=4 * sure(read.standard_error))


@pytest.mark.parametrize("seed", [SEED + 50, pytest.param(SEED + 51, marks=pytest.mark.long)])
def test_what_only_the_hop_of_a_change_shows_is_forgotten_once_data_since_then_do_not_show_it(seed: int) -> None:
    """A hop that mixes two machines may read as another parameter; that one was named for a minute beside the right."""
    story = ((24, true()), (1, true(k_by=-0.05, e=0.6)), (12, true(k_by=-0.1)))
    names = {n: [one.name for one in v.changed] for n, v in play(SequentialTest(SETTINGS), gaussian(seed), *story)}
    assert names[24] == ["e"]
    assert all(names[number] == ["k_by"] for number in range(27, 37))


def test_a_small_change_accumulates_over_windows() -> None:
    """Damping 4 % down is no more than three standard errors of a window; sums of windows find it."""
    verdicts = play(SequentialTest(SETTINGS), gaussian(SEED + 2), (24, true()), (160, true(c_by=-0.04)))
    number, first = next((n, v) for n, v in verdicts if v.changed)
    (finding,) = first.changed
    assert finding.name == "c_by"
    assert finding.stretch_s >= 120.0
    assert 36 < number < 24 + 120
    assert {f.name for _, verdict in verdicts for f in verdict.changed} == {"c_by"}


def straddling(looks: dict[int, Stretch], since: int, bias: FloatArray) -> dict[int, Stretch]:
    """The looks, but stretches that straddle the change `since` hops ago misread another parameter."""
    return looks | {
        hops: replace(look, vector=look.vector + look.information @ (bias * 4 * (since / hops) * (1 - since / hops)))
        for hops, look in looks.items()
        if since < hops
    }


@pytest.mark.slow
def test_a_bias_of_windows_across_a_change_is_not_named() -> None:
    """k_by drops by 25 %; stretches across the change read c_by up to 7 % too large, five standard errors."""
    for seed in range(3):
        test, hops = SequentialTest(SETTINGS), gaussian(SEED + 100 + seed)
        play(test, hops, (14, true()))
        said: list[tuple[str, ...]] = []
        for since in range(1, 26):  # to where two whole windows have left the change behind
            looks = straddling(hops.looks(true(k_by=-0.25)), since, true(c_by=0.07))
            said.append(tuple(finding.name for finding in test.update(looks).changed))
        assert set(said[1:]) == {("k_by",)}


def test_two_changes_at_once_and_one_after_the_other() -> None:
    both, first = true(k_by=-0.2, c_bz=-0.25), true(k_by=-0.2)
    for story in [((20, true()), (30, both)), ((20, true()), (30, first), (30, both))]:
        verdicts = play(SequentialTest(SETTINGS), gaussian(SEED + 4), *story)
        assert [f.name for f in verdicts[-1][1].changed] == ["k_by", "c_bz"]
        named = {tuple(f.name for f in verdict.changed) for _, verdict in verdicts}
        assert named <= {(), ("k_by",), ("c_bz",), ("k_by", "c_bz")}
    k_by, c_bz = verdicts[-1][1].changed
    assert k_by.since_ns < c_bz.since_ns  # each change has its own date
    assert abs(k_by.since_ns / 5e9 - 20) <= 4
    assert abs(c_bz.since_ns / 5e9 - 50) <= 4


def test_a_change_before_the_first_data_is_dated_to_their_start() -> None:
    """It used to be dated to the newest hops of the first window, ten seconds ago."""
    for change in ({"k_by": -0.25}, {"c_bz": -0.3}, {"e": 1.0}):
        test, hops = SequentialTest(SETTINGS), gaussian(SEED + 61)
        verdicts = play(test, hops, (16, true(**change)))
        assert [[(one.name, one.since_ns) for one in found.changed] for _, found in verdicts] == [
            [(name, 0) for name in change]
        ] * len(verdicts)


def test_readings_follow_a_change_and_its_repair_within_seconds() -> None:
    """While the window still spans both values."""
    story = ((20, true()), (30, true(k_by=-0.25)), (20, true()))
    verdicts = dict(play(SequentialTest(SETTINGS), gaussian(SEED + 5), *story))
    for number, change in ((25, -0.25), (54, 0.0)):
        assert not verdicts[number].settled
        (k_by,) = (reading for reading in verdicts[number].current if reading.name == "k_by")
        assert k_by.relative_change == pytest.approx(change, abs=0.03)
    assert not any(verdict.changed for number, verdict in verdicts.items() if number >= 54)


def test_intervals_of_a_window_across_a_change_hold_the_truth() -> None:
    """With whole windows alone, as without parameters, the first quoted size and date hold the truth."""
    settings, rng = SequentialSettings(hop_s=5.0, window_hops=12, short_hops=()), np.random.default_rng(SEED + 21)
    sizes, dates = [], []
    for trial in range(40):
        name, change = ("k_by", "c_by", "e")[trial % 3], float(rng.choice([-0.25, -0.15, 0.15, 0.3, 0.5]))
        test, hops, share = SequentialTest(settings), gaussian(SEED + 30 + trial, settings), float(rng.uniform())
        mixed = true(**{name: change}) * share
        for number in range(40):
            looks = hops.looks(true() if number < 20 else mixed if number == 20 else true(**{name: change}))
            if not looks:
                continue
            verdict = test.update(looks)
            found = {one.name: one.between_ns for one in verdict.changed}
            quoted = [one.interval_95 for one in verdict.current if one.name == name and name in found]
            if quoted:
                (low, high), (after, before) = quoted[0] or (0.0, 0.0), found[name] or (0, 0)
                sizes.append(low <= change <= high)
                dates.append(after <= (21 - share) * 5e9 <= before < after + 60e9)
                break
    assert len(sizes) == 40
    assert sum(sizes) >= 34  # 95 % of 40 are fewer once in 80
    assert sum(dates) >= 34


def test_a_change_that_windows_of_both_states_misread_is_quoted_with_what_is_not_known() -> None:
    """As of narrow resonances: such a window misfits, and later ones read more than their share of the change."""
    settings, misfits = SequentialSettings(hop_s=5.0, window_hops=12, short_hops=()), range(2, 6)
    test, hops = SequentialTest(settings), gaussian(SEED + 71, settings)
    play(test, hops, (24, true()))
    quoted: list[tuple[int, tuple[float, float]]] = []
    for since in range(1, 13):
        share = since / 12
        size = -0.3 * (share / 2 if since < 6 else 0.7 + 0.6 * (share - 0.5))
        look = hops.looks(true())[12]
        sharp = 100 * look.information
        misfit_z = 6.0 if since in misfits else 0.0
        look = replace(look, vector=sharp @ true(k_by=size), information=sharp, misfit_z=misfit_z)
        quoted += [
            (since, one.interval_95)
            for one in test.update({12: look}).current
            if one.name == "k_by" and one.interval_95 and test.state.findings
        ]
    after = [interval for since, interval in quoted if since not in misfits and since > 1]
    assert len(after) >= 5
    assert all(low <= -0.3 <= high for low, high in after), after


@pytest.mark.parametrize("error", [pytest.param(0.002, marks=pytest.mark.long), 0.0002])
def test_a_precisely_read_change_within_a_hop_keeps_its_size(error: float) -> None:
    """It comes at any moment within a hop; one to eight hops later its size is read within its errors."""
    inside = []
    for trial in range(8):
        rng = np.random.default_rng(SEED + 500 + trial)
        hops, share = GaussianHops(SETTINGS, np.diag(np.where(true(e=1.0) > 0, error, ERRORS) ** 2), rng), rng.uniform()
        looks = [hops.looks(true(e=0.5 * np.clip(number - 16 + share, 0.0, 1.0))) for number in range(25)]
        for number in range(18, 25, 2):
            windows = [found[12] for found in looks[: number + 1] if found]
            values, errors, _ = read_changes(windows, [PARAMETERS.index("e")], 5 * 10**9, windows[-1].end_ns)
            inside.append(abs(values[0] - 0.5) <= Z95 * errors[0])
    assert np.mean(inside) > 0.9


@pytest.mark.parametrize("gap", [10, 25])
def test_a_gap_shifts_only_the_dates_of_later_changes(gap: int) -> None:
    """Older windows span the gap, the latest one does not."""
    hops, told = gaussian(SEED + 24), []
    looks = [hops.looks(true(k_by=-0.2 * (number >= 17))) for number in range(27)]
    for lost in (0, gap):
        ends = np.array([5 * (number + 1) + lost * (number >= 15) for number in range(27)])
        windows = [
            replace(found[12], start_ns=int(ends[at - 11] - 5) * 10**9, end_ns=int(ends[at]) * 10**9)
            for at, found in enumerate(looks)
            if found
        ]
        values, errors, since_ns = read_changes(windows, [0], 5 * 10**9, int(ends[-1]) * 10**9)
        told.append((values, errors, [moment / 1e9 - lost for moment in since_ns or ()]))
    (whole, error, since), (apart, of_apart, later) = told
    assert apart == pytest.approx(whole, abs=0.1 * error[0])
    assert of_apart == pytest.approx(error, rel=0.1)
    assert later == pytest.approx(since, abs=2.5)
    assert since[1] < 85 < since[2]


def test_a_change_too_small_to_be_named_is_not_fixed_at_zero() -> None:
    """Of two correlated parameters, one changed much and the other too little: the first still reads true."""
    rng, cov = np.random.default_rng(SEED + 23), np.diag(np.full(6, 1e-4))
    cov[0, 1] = cov[1, 0] = 0.8e-4
    held = nominal = alone = 0
    for _ in range(100):
        values = rng.multivariate_normal(true(k_by=-0.3) + 0.045 * np.eye(6)[1], cov)
        look = stretch_of(window(values, cov), 0, 60 * 10**9)
        named = [PARAMETERS.index(name) for name in isolate(look, SETTINGS.thresholds(12)).changed]
        alone += named == [0]
        sizes, errors, _ = read_changes([look], named, 5 * 10**9, 0)
        held += bool(abs(sizes[0] - np.log(0.7)) <= Z95 * errors[0])
        covariance = np.linalg.inv(look.information[np.ix_(named, named)])  # with all others held at nominal
        off = (covariance @ look.vector[named])[0] - np.log(0.7)
        nominal += bool(abs(off) <= Z95 * np.sqrt(covariance[0, 0]))
    assert alone > 75
    assert held >= 70 > 20 > nominal  # the probability that the other changed differs between windows


def test_a_foreign_cause_that_one_parameter_rivals_is_not_outside_the_model() -> None:
    test, hops = SequentialTest(SETTINGS), gaussian(SEED + 8)
    for _ in range(20):
        looks = hops.looks(true(k_bz=-0.15))
    for rivals, misfit, outside in [(("k_bz", "c_bz"), 0.0, False), (("k_by",), 0.0, True), (("k_bz",), 8.0, True)]:
        looks = {h: replace(look, misfit_z=misfit) for h, look in looks.items()}
        verdict = test.update(looks, foreign=True, rivals=rivals)
        assert [one.name for one in verdict.changed] == ["k_bz"]
        assert verdict.outside_model == outside
        assert verdict.low_confidence
        assert ("a wrong gain, which explains the data as well" in verdict.text) != outside


def test_the_time_for_which_a_misfit_may_come_from_a_change_counts_down() -> None:
    alone = SequentialTest(replace(SETTINGS, short_hops=()))
    hops, left_s = gaussian(SEED + 48), []
    for number in range(28):
        looks = hops.looks(true())
        if looks:
            alone.update({12: replace(looks[12], misfit_z=8.0 if number >= 14 else 0.0)})
            left_s.append(alone.astride_s)
    assert left_s == [0.0] * 3 + [60.0 - 5.0 * hop for hop in range(12)] + [0.0, 0.0]


@pytest.mark.parametrize(("before", "lasting"), [(13, True), (4, False)])
def test_a_lasting_outside_verdict_is_withdrawn_only_by_a_whole_window(before: int, lasting: bool) -> None:
    """Shorter stretches do not show the misfit; but while a window spans a change, the misfit may come from it."""
    test, hops = SequentialTest(SETTINGS), gaussian(SEED + 47)
    said: list[bool] = []
    for count, values, misfit in ((15, true(), 0.0), (before, true(), 8.0), (11, true(k_by=0.4), 8.0)):
        for _ in range(count):
            looks = {
                h: replace(one, misfit_z=misfit if h == SETTINGS.window_hops else 0.0)
                for h, one in hops.looks(values).items()
            }
            if looks:
                said.append(test.update(looks).outside_model)
    assert all(said[-11 - before : -11])
    assert said[-9:] == [lasting] * 9  # from the second hop on the change shows
    for _ in range(3):
        looks = {h: replace(one, misfit_z=0.0) for h, one in hops.looks(true(k_by=0.4)).items()}
        outside = test.update(looks).outside_model
    assert not outside


def information(error: float, correlation: float) -> FloatArray:
    """That of a window in which the unbalance has this error, correlated with that of damping."""
    found = np.diag(np.array([0.03, 0.07, 0.03, 0.07, error, 0.01]) ** 2)
    c, e = PARAMETERS.index("c_by"), PARAMETERS.index("e")
    found[c, e] = found[e, c] = correlation * 0.07 * error
    return np.asarray(np.linalg.inv(found), dtype=np.float64)


def test_a_window_prevails_over_a_sum_that_names_another_parameter() -> None:
    """The change is gradual: windows from before and after it are summed."""
    window_ns = 60_000_000_000
    test = SequentialTest(replace(SETTINGS, short_hops=()))
    healthy, now, grown = information(0.03, -0.6), information(0.06, 0.75), true(e=0.35)
    for end_ns in range(window_ns, 2 * window_ns, 5_000_000_000):
        test.update({12: Stretch(end_ns - window_ns, end_ns, 0 * grown, healthy)})
    verdict = test.update({12: Stretch(window_ns, 2 * window_ns, now @ grown, now)})
    assert [one.name for one in verdict.changed] == ["e"]


def test_after_a_repair_a_whole_window_prevails_over_sums_that_reach_back() -> None:
    """The force has another direction since, so what windows of both states sum to is no machine's reading."""
    hop_ns, count = 5_000_000_000, 24
    test = SequentialTest(replace(SETTINGS, short_hops=()))
    before, after = information(0.02, -0.6) / 12, information(0.03, 0.75) / 12
    hops = [(before @ true(e=0.35), before)] * 30 + [(0 * true(), after)] * (12 + count)
    verdicts = []
    for end in range(12, len(hops) + 1):
        vectors, informations = (np.array(one) for one in zip(*hops[end - 12 : end], strict=True))
        window = Stretch((end - 12) * hop_ns, end * hop_ns, vectors.sum(axis=0), informations.sum(axis=0))
        verdicts.append(test.update({12: window}))
    assert [one.name for one in verdicts[18].changed] == ["e"]
    assert [(one.text, one.detected) for one in verdicts[-count:]] == [("nothing has changed", False)] * count


def test_sums_do_not_span_a_gap() -> None:
    test, hops = SequentialTest(SETTINGS), gaussian(SEED + 8)
    play(test, hops, (24, true()))
    assert len(test.state.sums[2]) == 1
    shift_ns = 3_600_000_000_000
    looks = hops.looks(true())
    moved = {
        h: replace(look, start_ns=look.start_ns + shift_ns, end_ns=look.end_ns + shift_ns) for h, look in looks.items()
    }
    test.update(moved)
    assert len(test.state.sums[1]) == 1
    assert len(test.state.sums[2]) == 1  # the earlier sum is unchanged
    assert test.state.sums[2][0].end_ns < shift_ns
    test.clear()
    assert test.state == SequentialState()


SEED_OF_CALIBRATION = 88_001


@pytest.mark.parametrize("rate", [1e-2, 1e-3])
def test_window_rate_is_kept_over_all_parameters(rate: float) -> None:
    """400 000 healthy windows of six independent parameters."""
    rng = np.random.default_rng(SEED_OF_CALIBRATION)
    largest = np.abs(rng.standard_normal((400_000, 6))).max(axis=1)
    counted = int((largest > window_thresholds(rate, 6).first).sum())
    expected = 400_000 * rate
    assert abs(counted - expected) < 4 * expected**0.5


@pytest.mark.parametrize("overlap", [2, 12, 192, *(pytest.param(n, marks=pytest.mark.long) for n in (4, 48))])
@pytest.mark.parametrize("threshold", [3.0, 3.6])
def test_new_crossings_of_a_sliding_window_have_the_expected_rate(overlap: int, threshold: float) -> None:
    """Four million hops; an exceedance is new if none came in the window's length before it."""
    hops = 4_000_000
    noise = np.random.default_rng(SEED_OF_CALIBRATION + overlap).standard_normal(hops + overlap - 1)
    total = np.concatenate([[0.0], np.cumsum(noise)])
    above = np.flatnonzero(np.abs(total[overlap:] - total[:-overlap]) / overlap**0.5 > threshold)
    fresh = 1 + int((np.diff(above) > overlap).sum())
    expected = 2 * crossing_rate(threshold, overlap) * hops
    # The rate is asymptotic in the threshold; crossings of one window's noise sometimes come in two groups.
    assert fresh == pytest.approx(expected, rel=0.12, abs=4 * expected**0.5)


def test_crossing_rate_and_overshoot_have_their_known_limits() -> None:
    assert overshoot_correction(1e-9) == 1.0
    assert overshoot_correction(0.2) == pytest.approx(np.exp(-0.583 * 0.2), rel=0.01)  # Siegmund's expansion
    assert overshoot_correction(12.0) == pytest.approx(2 / 12.0**2, rel=0.01)
    assert crossing_rate(3.0, 1) == pytest.approx(1.3499e-3, rel=1e-4)


@pytest.mark.parametrize("overlap", [1, 2, 12, 768])
def test_month_thresholds_have_the_declared_rate(overlap: int) -> None:
    found = month_thresholds(0.5, 5.0, overlap, 6, 9)
    hops = MONTH_S / 5.0
    assert 2 * 6 * 9 * hops * crossing_rate(found.first, overlap) == pytest.approx(0.5)
    assert hops * crossing_rate(found.outside, overlap) == pytest.approx(0.5)
    assert found.further > found.first > 3.5


def test_crossings_cannot_be_more_frequent_than_tests() -> None:
    assert month_thresholds(1e9, 5.0, 12, 6).first == 1.0


SEED_OF_DETECTABLE = 88_200


def healthy(seed: int) -> Stretch:
    cov = covariance(np.random.default_rng(seed))
    return stretch_of(window(np.zeros(6), cov), 0, 60_000_000_000)


def power(cov: FloatArray, name: str, seed: int) -> list[float]:
    """Share of windows in which the minimum detectable loss and gain are named, out of 256 quasi-random ones."""
    thresholds, shares, scatter = window_thresholds(0.01, 6), [], MultivariateNormalQMC(np.zeros(6), cov, rng=seed)
    stretch = stretch_of(window(np.zeros(6), cov), 0, 60_000_000_000)
    (found,) = (one for one in detectable_changes(stretch, thresholds, 60.0) if one.name == name)
    for change in (found.loss, found.gain):
        true = np.zeros(6)
        true[PARAMETERS.index(name)] = to_scale(name, change)
        values = true + scatter.random(256)
        found_in = [isolate(stretch_of(window(value, cov), 0, 1), thresholds).changed for value in values]
        shares.append(float(np.mean([name in one for one in found_in])))
    return shares


@pytest.mark.slow
@pytest.mark.parametrize("name", ["c_by", "e"])
def test_the_detectable_change_is_found_in_95_per_cent_of_windows(name: str) -> None:
    cov = np.diag(np.geomspace(0.001, 0.02, 6) ** 2)
    assert power(cov, name, SEED_OF_DETECTABLE) == pytest.approx([0.95, 0.95], abs=0.025)
    seed = SEED_OF_DETECTABLE + (name == "e")
    assert min(power(covariance(np.random.default_rng(seed)), "k_bz", seed)) > 0.925


def test_detectable_loss_and_gain_are_reciprocal_or_symmetric_for_e() -> None:
    for found in detectable_changes(healthy(1), month_thresholds(1.0, 5.0, 12, 6), 60.0):
        if found.name == "e":
            assert found.loss == -found.gain or found.loss == -1
        else:
            assert (1 + found.loss) * (1 + found.gain) == pytest.approx(1)
        assert -1 <= found.loss < 0 < found.gain


def test_the_length_to_find_a_change_inverts_the_detectable_change() -> None:
    stretch, thresholds = healthy(2), window_thresholds(1e-3, 6)
    found = {one.name: one for one in detectable_changes(stretch, thresholds, 60.0)}
    for one in found.values():
        for change in (one.loss, one.gain):
            assert length_to_find(one, change) == pytest.approx(60.0)
    assert length_to_find(found["e"], 0.05) == pytest.approx(4 * length_to_find(found["e"], 0.10))
