"""Whether recordings were excited in different ways, or in one."""

from dataclasses import replace
from functools import cache

from models.commissioning.checks import Check, check_sources
from models.diagnosis.window.statistics import WindowStatistics
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_scenario
from tests.commissioning.rotor_kit import LAB

DRAW = Draw(LAB, 7_700_077, Purpose.EVALUATION, stream=0, layout=Layout.ONE_SOURCE)


@cache
def window(condition: int, seed: int) -> WindowStatistics:
    scenario = draw_condition(DRAW, condition)
    found = simulate_scenario(scenario.overridden(seed=seed), LAB)
    return replace(found, speed_rad_s=LAB.operation.speed_rad_s)


def checked(*recordings: WindowStatistics) -> Check:
    return check_sources({f"{number}.mcap": [one] for number, one in enumerate(recordings)})


def test_recordings_of_one_condition_are_one_way_of_excitation() -> None:
    assert "in the only recording" in checked(window(0, 1)).text
    alike = checked(window(0, 1), window(0, 2))
    assert alike.verdict == "limited"
    assert "in the same way in all 2 recordings" in alike.text


def test_another_source_or_another_speed_is_another_way() -> None:
    faster = replace(window(0, 2), speed_rad_s=1.1 * LAB.operation.speed_rad_s)
    for other in (window(1, 3), faster):
        assert checked(window(0, 1), other).verdict == "passed"
