"""Several healthy recordings: whether their excitation differs, and one baseline for all or one per speed."""

from dataclasses import replace
from functools import cache

import pytest

from models.commissioning.checks import Check, check_recordings, check_sources
from models.commissioning.commission import Commissioning
from models.commissioning.commissioned import Installed
from models.commissioning.healthy import HealthyRecording
from models.diagnosis.window.statistics import WindowStatistics
from rotorwatch.records.windows import Parameter
from service.monitor.evaluation import Evaluation
from service.monitor.evaluators import evaluator_for
from simulator.scenario import Event
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_scenario
from tests.commissioning.rotor_kit import LAB, NOTHING, commissioned, recording, stream, told_of, windows_of
from tests.sure import sure

SLOW = LAB.operation.speed_rpm
FAST = 1.15 * SLOW
LENGTH_S = 40.0


@cache
def recorded(name: str, seed: int, *events: Event) -> HealthyRecording:
    return recording(NOTHING, stream(LENGTH_S, seed, *events), name)


def made_of(*conditions: tuple[str, int, tuple[Event, ...]]) -> Commissioning:
    return commissioned(NOTHING, *(recorded(name, seed, *events) for name, seed, events in conditions))


def at(speed_rpm: float) -> Event:
    return Event(at_s=0.0, speed_rpm=speed_rpm)


def evaluated(made: Commissioning, seed: int, *events: Event) -> Evaluation:
    """A later window as the monitor evaluates it."""
    (window,) = windows_of(recording(NOTHING, stream(66.0, seed, *events)))
    return evaluator_for(Installed(NOTHING, None, made.commissioned)).evaluate(window)


def reading(found: Evaluation, name: str) -> Parameter:
    return next(one for one in found.deciding.parameters if one.name == name)


@pytest.mark.slow
def test_two_speeds_of_one_machine_make_one_baseline() -> None:
    made = made_of(("slow.mcap", 91, (at(SLOW),)), ("fast.mcap", 92, (at(FAST),)))
    assert told_of(made, "recordings agree")[0] == "passed"
    (baseline,) = sure(made.commissioned).baselines
    low, high = sure(baseline.conditions.speed_rpm)
    assert abs(low / SLOW - 1) < 0.001
    assert abs(high / FAST - 1) < 0.001
    between = evaluated(made, 93, at((SLOW + FAST) / 2))
    assert all(abs(reading(between, name).z or 99.0) < 4 for name in ("k_by", "c_by", "k_bz", "c_bz"))
    assert abs(reading(evaluated(made, 94, at(FAST)), "e").z or 99.0) < 4


@pytest.mark.slow
def test_a_speed_dependent_bearing_gets_one_baseline_per_speed() -> None:
    stiffer = Event(at_s=0.0, parameter="k_by", relative_change=0.3)
    made = made_of(("slow.mcap", 91, (at(SLOW),)), ("fast.mcap", 92, (at(FAST), stiffer)))
    verdict, text, _ = told_of(made, "recordings agree")
    assert verdict == "limited"
    assert "bearing stiffness, horizontal" in text
    assert "a baseline is kept for each speed" in text
    assert len(sure(made.commissioned).baselines) == 2
    assert abs(reading(evaluated(made, 94, at(FAST), stiffer), "k_by").z or 99.0) < 4
    assert abs(reading(evaluated(made, 95, at(SLOW)), "k_by").z or 99.0) < 4
    lost = reading(evaluated(made, 96, at(FAST)), "k_by")  # the stiffness of the slow machine, at the high speed
    assert abs(sure(lost.relative_change) - (1 / 1.3 - 1)) < 0.05


@pytest.mark.slow
def test_recordings_that_differ_at_one_speed_are_refused() -> None:
    softer = Event(at_s=0.0, parameter="k_by", relative_change=-0.3)
    made = made_of(("slow.mcap", 91, (at(SLOW),)), ("friday.mcap", 92, (at(SLOW), softer)))
    assert made.commissioned is None
    verdict, text, _ = told_of(made, "recordings agree")
    assert verdict == "refused"
    assert "at one speed" in text


@pytest.mark.parametrize(
    ("differing", "verdict"),
    [
        ({"k_by": -0.03}, "passed"),
        ({"k_by": 0.03}, "passed"),
        ({"k_by": -0.04}, "refused"),
        ({"k_by": -0.2, "c_by": 0.3}, "refused"),
        ({"c_by": 2.4, "k_by": 0.01}, "limited"),
    ],
)
def test_a_difference_is_a_reason_to_refuse_only_if_it_matters_and_stiffness_differs(
    differing: dict[str, float], verdict: str
) -> None:
    """With one source a difference of one per cent may be four standard errors; k_by is reported from 10 % on."""
    at_one_speed = {"monday.mcap": 138.2, "friday.mcap": 138.2}
    found = [(name, by, f"friday.mcap: {name} differs") for name, by in differing.items()]
    check = sure(check_recordings(NOTHING, found, at_one_speed))
    assert check.verdict == verdict
    assert check.text.startswith("friday.mcap: ")


DRAW = Draw(LAB, 7_700_077, Purpose.EVALUATION, stream=0, layout=Layout.ONE_SOURCE)


@cache
def window(condition: int, seed: int) -> WindowStatistics:
    scenario = draw_condition(DRAW, condition)
    found = simulate_scenario(scenario.overridden(seed=seed), LAB)
    return replace(found, speed_rad_s=LAB.operation.speed_rad_s)


def checked(*recordings: WindowStatistics) -> Check:
    return check_sources({f"{number}.mcap": [one] for number, one in enumerate(recordings)})


def test_recordings_of_one_condition_count_as_one_excitation() -> None:
    assert "in the only recording" in checked(window(0, 1)).text
    alike = checked(window(0, 1), window(0, 2))
    assert alike.verdict == "limited"
    assert "in the same way in all 2 recordings" in alike.text


def test_another_source_or_speed_counts_as_a_second_excitation() -> None:
    faster = replace(window(0, 2), speed_rad_s=1.1 * LAB.operation.speed_rad_s)
    for other in (window(1, 3), faster):
        assert checked(window(0, 1), other).verdict == "passed"
