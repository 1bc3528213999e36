"""Time to detection: the bound's time by simulation, and streams that end as they must."""

from pathlib import Path

import numpy as np
import pytest

from models.errors import RecordingError
from models.machine import load_machine
from simulator.campaigns.delay_command import delay_table, draw_delays, time_detection
from simulator.campaigns.delay_study import (
    DelayPlan,
    DelayResult,
    bound_time_s,
    run_delay_study,
    settings_for,
    with_hop,
)

LAB = load_machine("lab")


def test_a_test_of_the_bounds_length_finds_the_change_in_95_of_100_trials() -> None:
    """200 000 normal estimates of e, whose errors are normal in the change itself; seed 3."""
    length_s = bound_time_s(0.03, 60.0, "e", 0.2, 4.0)
    error = 0.03 * np.sqrt(60.0 / length_s)
    z = np.random.default_rng(3).normal(0.2 / error, 1, 200_000)
    assert np.mean(z > 4.0) == pytest.approx(0.95, abs=0.003)


def test_the_bounds_time_falls_with_the_square_of_the_change() -> None:
    assert bound_time_s(0.01, 60, "e", 0.1, 4) == pytest.approx(4 * bound_time_s(0.01, 60, "e", 0.2, 4))
    # A loss of damping is a larger step in the logarithm than a gain.
    assert bound_time_s(0.01, 60, "c_by", -0.2, 4) < bound_time_s(0.01, 60, "c_by", 0.2, 4)


def test_another_hop_keeps_the_window() -> None:
    machine = with_hop(LAB, 2.5)
    assert machine.window.hops == 24
    assert settings_for(machine, 1.0).window_hops == 24
    with pytest.raises(ValueError, match="multiple of half of segment_s"):
        with_hop(LAB, 1.5)


@pytest.fixture(scope="module")
def result() -> DelayResult:
    plan = DelayPlan(LAB, 51, 2, 1, gaussian_trials=4, hops_s=(5.0,), after_s=20.0, changes=(("k_by", -0.2),))
    return run_delay_study(plan, 1, lambda *_: None)


@pytest.mark.long
def test_a_large_loss_of_stiffness_is_found_within_two_hops_of_data_and_named(result: DelayResult) -> None:
    streams = [cell for cell in result.cells if cell.source == "stream" and cell.layout == "independent"]
    assert [cell.rate for cell in streams] == ["machine file", "1 % per window"]
    for cell in streams:
        assert len(cell.detected_s) + cell.early == 2
        assert cell.quantile_s(0.95) <= 15.0
        assert cell.quantile_s(0.95, named=True) <= 20.0
        assert all(0 < time < 10 for time in cell.bound_s)
    strict, lenient = streams
    assert strict.threshold > lenient.threshold > 3
    assert max(strict.bound_s) > max(lenient.bound_s)


def test_gaussian_hops_at_the_bound_are_found_sooner_with_a_shorter_hop(result: DelayResult) -> None:
    at_bound = {
        (cell.hop_s, cell.short_hops): cell.quantile_s(0.95)
        for cell in result.cells
        if cell.source == "bound" and cell.rate == "machine file"
    }
    assert at_bound[2.5, (2, 4, 7)] < at_bound[5.0, (2, 4, 7)] <= 15.0


def test_numbers_can_be_read_back_and_drawn(result: DelayResult, tmp_path: Path) -> None:
    out = tmp_path / "delay.json"
    out.write_text(result.model_dump_json(), encoding="utf-8")
    assert DelayResult.model_validate_json(out.read_text(encoding="utf-8")) == result
    assert "| k_by -20% | machine file (1/month) |" in delay_table(result)
    assert draw_delays(result, tmp_path / "delay.svg").read_text(encoding="utf-8").startswith("<?xml")
    with pytest.raises(RecordingError, match="run without --redraw first"):
        time_detection("lab", tmp_path / "none.json", trials=2, others=2, seed=1, processes=1, redraw=True)
