"""Thresholds against what Gaussian test values really do."""

import numpy as np
import pytest

from models.diagnosis.verdict.calibration import (
    MONTH_S,
    crossing_rate,
    month_thresholds,
    overshoot_correction,
    window_thresholds,
)

SEED = 88_001


@pytest.mark.parametrize("rate", [1e-2, 1e-3])
def test_window_rate_is_kept_over_all_parameters(rate: float) -> None:
    """400 000 healthy windows of six independent parameters."""
    rng = np.random.default_rng(SEED)
    largest = np.abs(rng.standard_normal((400_000, 6))).max(axis=1)
    counted = int((largest > window_thresholds(rate, 6).first).sum())
    expected = 400_000 * rate
    assert abs(counted - expected) < 4 * expected**0.5


def moving_averages(hops: int, overlap: int, seed: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    total = np.concatenate([[0.0], np.cumsum(np.random.default_rng(seed).standard_normal(hops + overlap - 1))])
    return np.asarray((total[overlap:] - total[:-overlap]) / overlap**0.5)


@pytest.mark.parametrize("overlap", [2, 4, 12, 48, 192])
@pytest.mark.parametrize("threshold", [3.0, 3.6])
def test_new_crossings_of_a_sliding_window(overlap: int, threshold: float) -> None:
    """Four million hops; an exceedance is new if none came in the window's length before it."""
    hops = 4_000_000
    above = np.flatnonzero(np.abs(moving_averages(hops, overlap, SEED + overlap)) > threshold)
    fresh = 1 + int((np.diff(above) > overlap).sum())
    expected = 2 * crossing_rate(threshold, overlap) * hops
    # The rate is asymptotic in the threshold; crossings of one window's noise sometimes come in two groups.
    assert fresh == pytest.approx(expected, rel=0.12, abs=4 * expected**0.5)


def test_windows_that_do_not_overlap_cross_with_their_tail_probability() -> None:
    assert crossing_rate(3.0, 1) == pytest.approx(1.3499e-3, rel=1e-4)


def test_overshoot_correction_has_its_known_limits() -> None:
    assert overshoot_correction(1e-9) == 1.0
    assert overshoot_correction(0.2) == pytest.approx(np.exp(-0.583 * 0.2), rel=0.01)  # Siegmund's expansion
    assert overshoot_correction(12.0) == pytest.approx(2 / 12.0**2, rel=0.01)


@pytest.mark.parametrize("overlap", [1, 2, 12, 768])
def test_month_thresholds_have_the_declared_rate(overlap: int) -> None:
    found = month_thresholds(0.5, 5.0, overlap, 6, 9)
    hops = MONTH_S / 5.0
    assert 2 * 6 * 9 * hops * crossing_rate(found.first, overlap) == pytest.approx(0.5)
    assert hops * crossing_rate(found.outside, overlap) == pytest.approx(0.5)
    assert found.further > found.first > 3.5


def test_rates_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="rate is 0 for 6 parameters"):
        window_thresholds(0, 6)
    with pytest.raises(ValueError, match="expected positive numbers"):
        month_thresholds(-1, 5.0, 12, 6)
    assert month_thresholds(1e9, 5.0, 12, 6).first == 1.0  # more often than that nothing is crossed
