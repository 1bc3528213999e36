"""Rates, spreads and their intervals, goals judged by them, and tables of groups."""

import csv
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies.results import (
    Estimate,
    Table,
    at_least,
    at_most,
    holding,
    limit_of,
    rate,
    resampled,
    robust,
    spread,
    within,
)


def shares(count: int, of: int) -> Estimate:
    found = rate([True] * count + [False] * (of - count))
    assert found is not None
    return found


def test_rates_have_clopper_pearson_intervals() -> None:
    nothing, some, everything = shares(0, 100), shares(5, 100), shares(100, 100)
    assert (nothing.low, nothing.high) == pytest.approx((0.0, 0.0362), abs=1e-4)
    assert (some.low, some.high) == pytest.approx((0.0164, 0.1128), abs=1e-4)
    assert (everything.low, everything.high) == pytest.approx((0.9638, 1.0), abs=1e-4)
    assert rate([]) is None


def test_intervals_by_resampling_are_those_of_the_normal_distribution() -> None:
    values = np.random.default_rng(99).standard_normal(4000)
    found = resampled(lambda x: np.asarray(np.std(x, axis=-1)), values)
    assert found.low == pytest.approx(found.value * (1 - 1.96 / np.sqrt(8000)), rel=0.01)
    assert found.high == pytest.approx(found.value * (1 + 1.96 / np.sqrt(8000)), rel=0.01)


def test_a_spread_is_robust_and_needs_four_windows() -> None:
    # Median 0.005, distances 0.025, 0.005, 0.005, 0.045 with the median 0.015.
    found = spread([-0.02, 0.0, 0.01, 0.05, None])
    assert found is not None
    assert found.value == pytest.approx(1.4826 * 0.015)
    assert spread([0.1, 0.2, 0.3]) is None
    assert robust(np.array([1.0, 2.0, 1e9])) == pytest.approx(1.4826)


def test_a_goal_is_missed_only_where_the_whole_interval_misses_it() -> None:
    found = shares(80, 100)
    assert at_least("found", found, 0.79).verdict == "met"
    assert at_least("found", found, 0.85).verdict == "within chance"
    assert at_least("found", found, 0.95).verdict == "missed"
    assert at_most("found", found, 0.5).verdict == "missed"
    assert at_most("found", None, 0.5).verdict == "–"
    covered = {"e": shares(94, 100), "k_by": shares(999, 1000)}
    judged = within("covered", covered, 0.93, 0.97)
    assert judged.verdict == "missed"
    assert "1 of 2 inside; worst k_by: 99.9 %" in judged.measured
    assert judged.declared == "93 % to 97 %"
    assert (
        "2 of 2 inside; worst c_by: 97.5 %"
        in within("found", {"k_by": shares(40, 40), "c_by": shares(39, 40)}, 0.95, 1.0).measured
    )


def test_of_many_figures_one_lies_outside_by_chance() -> None:
    off, good = shares(85, 100), shares(95, 100)
    assert within("covered", {"one": off}, 0.93, 0.97).verdict == "missed"
    assert within("covered", {"one": off} | {str(n): good for n in range(20)}, 0.93, 0.97).verdict == "within chance"
    assert holding("false alarms", {"lab": shares(5, 50)}, 0.01).verdict == "missed"


def test_limits_keep_the_declared_rate() -> None:
    """400 repetitions of 99 healthy scores and 50 further ones from a skewed distribution; seed 8."""
    rng = np.random.default_rng(8)
    exceeded = [np.mean(rng.lognormal(size=50) > limit_of(rng.lognormal(size=99), 0.05)) for _ in range(400)]
    assert np.mean(exceeded) == pytest.approx(0.05, abs=0.006)
    with pytest.raises(ValueError, match="expected at least 99"):
        limit_of(np.ones(98), 0.01)


def test_a_table_has_a_row_for_every_group_and_is_written_with_intervals(tmp_path: Path) -> None:
    records = [{"method": by, "named": n < 3, "error": float(n)} for by in ("likelihood", "network") for n in range(4)]
    table = Table(
        "groups",
        ("method",),
        {"named": lambda rows: rate(row["named"] for row in rows), "largest": lambda rows: rows[-1]["error"]},
        lambda rows: (row for row in rows if row["error"]),
    )
    first, second = table.of(records)
    assert (first["method"], first["named"], second["largest"]) == ("likelihood", shares(2, 3), 3.0)
    with table.write(records, tmp_path).open(encoding="utf-8") as written:
        rows = list(csv.DictReader(written))
    assert [row["named windows"] for row in rows] == ["3", "3"]
    assert float(rows[0]["named low"]) == pytest.approx(shares(2, 3).low, rel=1e-4)
