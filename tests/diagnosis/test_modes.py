"""Natural frequencies found in the vibration, and whether one has moved."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.finite_elements.assembly import assemble, modes
from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.observed import WindowSizes, plan, sampled, windows_of
from benchmarks.finite_elements.rotor import changed_rotor
from benchmarks.finite_elements.scenes import SceneRange, SourceLayout, drawn_condition
from models.diagnosis.modes import CONFIRMED, HealthyModes, learn_modes, modes_of
from models.diagnosis.window.statistics import WindowStatistics
from tests.sure import sure

ROTOR = rotor_named("asymmetric")
PROBES = ("y1", "y2", "z1", "z2")
SIZES = WindowSizes(length_s=30.0)
RATE = 1e-5


@cache
def recorded(condition: int, count: int, **changes: float) -> tuple[WindowStatistics, ...]:
    """Windows of one recording under a force of its own."""
    rng = np.random.default_rng([83, condition])
    layout = SourceLayout.ONE_SOURCE if condition % 2 else SourceLayout.INDEPENDENT
    drawn = drawn_condition(ROTOR, layout, replace(SceneRange(), speed_relative=(1.0, 1.0)), changes, rng)
    samples = sampled(ROTOR, drawn, count * SIZES.length_s + 2.6, [83, condition, len(changes)], PROBES)
    return tuple(windows_of(samples, plan(ROTOR, SIZES, PROBES)))


@cache
def learned() -> HealthyModes:
    return sure(learn_modes([window for number in range(3) for window in recorded(number, 4)], PROBES))


def judged(windows: tuple[WindowStatistics, ...]) -> list[list[str]]:
    """Verdicts of the modes in each of some windows without common data, one after the other."""
    found, beyond_ns = [], (0,) * len(learned().modes)
    for window in windows:
        one, beyond_ns = learned().judge(window, beyond_ns, RATE)
        found.append([mode.verdict for mode in one])
    return found


def test_frequency_and_damping_are_those_of_the_rotor() -> None:
    theory = [(one.frequency_hz, one.damping) for one in modes(assemble(ROTOR, ROTOR.speed_rad_s))]
    assert len(learned().modes) >= 3
    for mode in learned().modes:
        frequency_hz, damping = min(theory, key=lambda one: abs(one[0] - mode.frequency_hz))
        assert mode.frequency_hz == pytest.approx(frequency_hz, rel=0.015)
        assert mode.damping == pytest.approx(damping, rel=0.3)
        assert mode.spread < 0.02


@pytest.mark.parametrize("changes", [{}, {"c_by": -0.35}, {"e": 0.5}])
@pytest.mark.parametrize("condition", [3, 4])
def test_another_force_damping_and_unbalance_leave_them_where_they_are(
    changes: dict[str, float], condition: int
) -> None:
    found = judged(recorded(condition, 3, **changes))
    assert all(verdict != "changed" for window in found for verdict in window)
    assert all("not changed" in window for window in found)


@pytest.mark.parametrize("condition", [5, 6])
def test_a_change_of_stiffness_is_reported_when_a_second_window_confirms_it(condition: int) -> None:
    windows = recorded(condition, 3, k_by=-0.3)
    first, *later = judged(windows)
    assert "changed" not in first
    assert all("changed" in window for window in later)
    found, _ = learned().judge(windows[0], (0,) * len(learned().modes), RATE)
    moved = [one for one in found if "confirms it" in one.text]
    assert moved
    theory = [one.frequency_hz for one in modes(assemble(changed_rotor(ROTOR, {"k_by": -0.3}), ROTOR.speed_rad_s))]
    assert all(min(abs(sure(one.hz) / hz - 1) for hz in theory) < 0.05 for one in moved)


def test_a_mode_that_is_no_longer_found_has_not_come_back() -> None:
    window = recorded(5, 3, k_by=-0.3)[0]
    beyond_ns = (CONFIRMED, window.end_ns, 0)
    other_speed = replace(window, speed_rad_s=1.2 * window.speed_rad_s)
    found, after = learned().judge(other_speed, beyond_ns, RATE)
    assert after == beyond_ns
    assert [one.verdict for one in found] == ["changed", "not evaluable"]
    assert all("commissioned at" in one.text for one in found)
    assert all(one.hz is None and one.change is None for one in found)


def test_a_mode_that_is_damped_much_is_not_watched() -> None:
    assert [one.damping > 0.06 for one in learned().modes] == [False, False, True]
    assert [mode for mode, _ in learned().limits(RATE)] == list(learned().modes[:2])


def test_limits_are_wider_where_a_window_moves_more_or_less_than_recorded() -> None:
    window, none = recorded(0, 4)[0], (0,) * len(learned().modes)

    def limit(factor: float) -> float:
        moved = replace(
            window, correlation=window.correlation * factor**2, synchronous=sure(window.synchronous) * factor
        )
        return learned().judge(moved, none, RATE)[0][0].limit

    assert limit(1.0) == pytest.approx(learned().limits(RATE)[0][1])
    assert limit(30.0) - limit(10.0) == pytest.approx(0.05 * np.log(3))
    assert limit(1 / 30.0) - limit(1 / 10.0) == pytest.approx(0.05 * np.log(3))


def test_few_windows_have_wide_limits() -> None:
    few, many = (learned().modes[0].model_copy(update={"windows": count, "spread": 0.005}) for count in (4, 12))
    assert few.limit(RATE) > 3 * many.limit(RATE)
    assert many.limit(RATE) > 0.025


def test_a_motion_that_stands_still_has_no_modes() -> None:
    window = recorded(0, 4)[0]
    still = window.spectrum.copy()
    still[:, :, 0] = still[:, 0, :] = 0.0
    assert modes_of(replace(window, spectrum=still), PROBES) == []
    twice = window.spectrum[:, [0, 0, 2, 2]][:, :, [0, 0, 2, 2]]
    assert len(modes_of(replace(window, spectrum=twice), PROBES)) < 20  # two sensors of one motion


def test_what_was_learned_is_kept_and_nothing_is_learned_from_too_little() -> None:
    assert HealthyModes.model_validate_json(learned().model_dump_json()) == learned()
    assert learn_modes(recorded(0, 4)[:3], PROBES) is None
    assert learn_modes(recorded(0, 4), PROBES[:1]) is None
