"""Levels against absolute limits, zones, and the reference of a healthy machine."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from models.levels.bands import BandLevels
from models.levels.judgement import LevelJudge, channel_state
from models.levels.limits import all_rounded
from models.levels.measures import COMPARED, WindowLevels, level_plan
from models.levels.reference import FirstWindows, LevelReference, learn_levels
from models.levels.settings import ZONES, LevelSettings, zone_of
from models.signals.channels import Channel
from rotorwatch.records.levels import LEVEL_MEASURES, ChannelLevels, LevelLimits

CASING = Channel(name="DE-H", quantity="velocity", location="DE", direction="horizontal", unit="mm/s")
CASING_G = Channel.model_validate(CASING.model_dump() | {"name": "DE-A", "quantity": "acceleration", "unit": "g"})
SHAFT = Channel(name="XE-1", quantity="displacement", location="bearing", direction="y", unit="um")
SPEED = 2 * np.pi * 25


def window(
    error: float = 0.0, speed_rad_s: float | None = SPEED, x1: complex | None = None, **si: float
) -> WindowLevels:
    """Levels of one channel; all that are not given are unknown."""
    values = {name: np.array([si.get(name, np.nan)]) for name in LEVEL_MEASURES}
    vectors = None
    if x1 is not None:
        values["x1"] = np.array([2 * abs(x1)])
        vectors = np.zeros((4, 1), dtype=np.complex128)
        vectors[1] = x1
    errors = {name: np.array([error]) for name in COMPARED}
    silent = BandLevels(np.array([1.0, 2.0]), np.zeros((1, 1)), np.zeros((1, 1)), np.ones(1))
    return WindowLevels(values, errors, vectors, silent, speed_rad_s)


def judged(
    channel: Channel, levels: WindowLevels, reference: LevelReference | None = None, **settings: Any
) -> ChannelLevels:
    sizes = level_plan([channel], 10_000.0, (10.0, 1000.0))
    (found,) = LevelJudge(sizes, [channel], LevelSettings.model_validate(settings)).judge(levels, reference)
    return found


def limits(levels: ChannelLevels) -> dict[str, LevelLimits]:
    return {one.measure: one for one in levels.limits}


@pytest.mark.parametrize(
    ("rms_mm_s", "zone", "state"),
    [(1.3, "A", "normal"), (2.7, "B", "normal"), (2.9, "C", "alert"), (4.4, "C", "alert"), (4.6, "D", "danger")],
)
@pytest.mark.parametrize("channel", [CASING, CASING_G])
def test_zones_follow_the_boundaries_of_the_standard(channel: Channel, rms_mm_s: float, zone: str, state: str) -> None:
    measure = "overall" if channel is CASING else "velocity"
    found = judged(channel, window(**{measure: rms_mm_s * 1e-3}), zones=["ISO 20816-3 group 2 rigid"])
    assert found.zone == zone
    assert limits(found)[measure].state == state
    assert (limits(found)[measure].alert, limits(found)[measure].danger) == (2.8, 4.5)
    if state == "danger":
        assert "DE horizontal" in limits(found)[measure].text
        assert "4.6 mm/s rms, danger limit 4.5" in limits(found)[measure].text


def test_zones_of_a_shaft_depend_on_the_speed() -> None:
    settings: dict[str, Any] = {"zones": ["ISO 20816-3 shaft"]}
    at_3000 = judged(SHAFT, window(speed_rad_s=100 * np.pi, overall=170e-6), **settings)
    assert limits(at_3000)["overall"].alert == pytest.approx(9000 / np.sqrt(3000), rel=1e-4)
    assert at_3000.zone == "C"
    assert judged(SHAFT, window(speed_rad_s=None, overall=170e-6), **settings).limits == ()


@pytest.mark.parametrize("name", ZONES)
def test_zone_boundaries_ascend(name: str) -> None:
    first, second, third = ZONES[name].boundaries
    assert 0 < first < second < third
    assert [zone_of(value, (first, second, third)) for value in (first, second, third, 2 * third)] == list("ABCD")


def test_own_limits_are_in_the_unit_that_is_shown() -> None:
    own = [{"channel": "DE-A", "alert": 0.5, "danger": 0.8}, {"channel": "DE-A", "measure": "crest", "alert": 6.0}]
    found = judged(CASING_G, window(overall=0.6 * 9.80665, crest=5.0), limits=own)
    assert found.overall == pytest.approx(0.6)
    assert (limits(found)["overall"].state, limits(found)["crest"].state) == ("alert", "normal")


def reference(*levels: WindowLevels, channel: Channel = CASING) -> LevelReference:
    return learn_levels("commissioned", [channel.name], levels)


STEADY, VARIED = (0.98, 1.0, 1.02), (0.5, 1.0, 2.0)


@pytest.mark.parametrize(
    ("healthy", "error", "overall", "hops", "state"),
    [
        *((STEADY, 0.0, *one) for one in ((0.45, 16, "alert"), (0.55, 16, "normal"), (1.5, 16, "normal"))),
        *((STEADY, 0.0, *one) for one in ((1.7, 16, "alert"), (2.6, 16, "danger"))),
        # A window that is not full may scatter more.
        *((STEADY, 0.1, *one) for one in ((3.0, 16, "danger"), (3.0, 1, "normal"))),
        # What varied in the healthy windows may vary.
        *((VARIED, 0.0, *one) for one in ((2.4, 16, "normal"), (0.41, 16, "normal"), (2.6, 16, "alert"))),
        # A window that fills scatters about the loudest healthy one too.
        *((VARIED, 0.058, *one) for one in ((2.6, 16, "alert"), (2.6, 8, "normal"), (2.8, 8, "alert"))),
        *((VARIED, 0.058, *one) for one in ((0.35, 16, "alert"), (0.35, 8, "normal"))),
    ],
)
def test_levels_are_judged_relative_to_those_of_the_healthy_machine(
    healthy: tuple[float, ...], error: float, overall: float, hops: int, state: str
) -> None:
    windows = [replace(window(error=1e-3 * error * one, overall=1e-3 * one), hops=16) for one in healthy]
    found = judged(CASING, replace(window(overall=1e-3 * overall), hops=hops), reference(*windows))
    assert limits(found)["overall"].state == state
    assert channel_state(found).beyond == (state != "normal")


@pytest.mark.parametrize("speed_rad_s", [SPEED, None, np.nan])
def test_running_and_standstill_are_each_compared_with_their_own_reference(speed_rad_s: float | None) -> None:
    still = [window(overall=0.1e-3, speed_rad_s=None) for _ in range(3)]
    ran = [window(overall=2e-3, speed_rad_s=SPEED) for _ in range(2)]
    level = 2e-3 if speed_rad_s == SPEED else 0.1e-3
    for healthy in (reference(*still, *ran), reference(*still[:1], *ran)):
        for factor, state in ((1.0, "normal"), (1.7, "alert"), (0.4, "alert")):
            found = judged(CASING, window(overall=factor * level, speed_rad_s=speed_rad_s), healthy)
            assert limits(found)["overall"].state == state
    only = reference(*ran)  # where one of them was not commissioned, the other is all there is
    assert limits(judged(CASING, window(overall=2e-3, speed_rad_s=None), only))["overall"].state == "normal"
    assert limits(judged(CASING, window(overall=0.1e-3), reference(*still)))["overall"].state == "normal"


@pytest.mark.parametrize(
    ("healthy", "overall", "x2", "state"),
    [
        *(((1e-5, 2e-5, 1.5e-5), np.nan, *one) for one in ((6e-5, "normal"), (9e-5, "alert"))),
        *(((3e-5,) * 3, 1e-3, *one) for one in ((5e-5, "normal"), (1.1e-4, "alert"), (2.4e-4, "alert"))),
        ((3e-5,) * 3, 1e-3, 2.6e-4, "danger"),
    ],
)
def test_a_line_once_within_noise_must_stand_out_and_is_danger_only_if_large(
    healthy: tuple[float, ...], overall: float, x2: float, state: str
) -> None:
    was = reference(*(window(error=1e-5, overall=overall, x2=value) for value in healthy))
    assert limits(judged(CASING, window(overall=overall, x2=x2), was))["x2"].state == state


def test_a_1x_vector_that_turns_leaves_its_acceptance_region_at_the_same_size() -> None:
    healthy = reference(*(window(x1=10e-6 * np.exp(1j * turn)) for turn in (-0.05, 0.0, 0.05)), channel=SHAFT)
    near, turned = (limits(judged(SHAFT, window(x1=10e-6 * np.exp(1j * turn)), healthy))["x1"] for turn in (0.3, 1.0))
    assert near.state == "normal"
    assert (turned.state, turned.source) == ("alert", "1x vector")
    assert turned.text.endswith("1x 20 µm pp, phase lag 303°: outside its acceptance region around 20 µm at 0°")
    assert [one.source for one in turned.bounds] == ["commissioned"]
    without_reference_of_phase = judged(SHAFT, replace(window(x1=-10e-6), vectors=None), healthy)
    assert limits(without_reference_of_phase)["x1"].state == "normal"
    opposite = window(x1=-10e-6)
    for side in (0.0, np.inf):  # whichever way its size was rounded
        rounded_size = {"x1": np.nextafter(opposite.values["x1"], side)}
        found = limits(judged(SHAFT, replace(opposite, values={**opposite.values, **rounded_size}), healthy))["x1"]
        assert (found.state, found.source) == ("alert", "1x vector")


def test_a_1x_vector_is_compared_in_the_sense_of_rotation_in_which_it_was_learned() -> None:
    healthy = reference(*(window(x1=10e-6 * np.exp(1j * turn)) for turn in (-0.05, 0.0, 0.05)), channel=SHAFT)
    reversed_ = limits(judged(SHAFT, window(x1=-10e-6, speed_rad_s=-SPEED), healthy))["x1"]
    assert (reversed_.state, reversed_.source) == ("normal", "commissioned")
    louder = limits(judged(SHAFT, window(x1=-17e-6, speed_rad_s=-SPEED), healthy))["x1"]
    assert louder.state == "alert"


def test_levels_are_shown_in_five_digits_as_python_formats_them() -> None:
    values = np.random.default_rng(20261125).standard_normal((100, 30)) * 10.0 ** np.arange(-14, 16)
    values[0, :4] = 0.0, np.nan, np.inf, -np.inf
    shown = [[float(f"{one:.5g}") if np.isfinite(one) else None for one in row] for row in values.tolist()]
    assert all_rounded(values) == shown


def fast_and_slow(healthy: LevelReference, speeds: list[float], overall: float) -> str:
    """State of an overall level in a window through which the speed has passed from the first to the last."""
    hops = replace(window(speed_rad_s=float(np.mean(speeds)) * SPEED, overall=overall), hops=len(speeds))
    found = judged(CASING, replace(hops, speeds_rad_s=SPEED * np.array([*speeds, np.nan])), healthy)
    return limits(found)["overall"].state


def test_every_operating_state_has_levels_of_its_own() -> None:
    healthy = reference(
        *(window(speed_rad_s=SPEED, overall=value) for value in (1e-3, 1.1e-3)),
        *(window(speed_rad_s=-2 * SPEED, overall=value) for value in (4e-3, 4.1e-3)),
    )
    assert [state.windows for state in healthy.states] == [2, 2]
    fast, slow, between = (
        limits(judged(CASING, window(speed_rad_s=times * SPEED, overall=4.5e-3), healthy))["overall"]
        for times in (2.0, 1.0, 1.3)
    )
    assert (fast.state, slow.state, between.state) == ("normal", "danger", "alert")
    assert between.source == "commissioned at another speed"
    assert fast_and_slow(healthy, [2.0, 1.5, 0.5], 4.5e-3) == "normal"  # as loud as it was at its first speed
    assert fast_and_slow(healthy, [2.0, 1.5, 0.5], 7e-3) == "alert"
    assert fast_and_slow(healthy, [1.1, 1.0, 0.9], 4.5e-3) == "danger"
    assert fast_and_slow(healthy, [2.0, 2.0, 1.0, 1.0], 1.2e-3) == "normal"  # not silent
    # A machine that runs down through unknown speeds has not fallen silent.
    healthy = reference(*(window(speed_rad_s=SPEED, overall=value) for value in (1e-3, 1.1e-3)))
    quiet = (limits(judged(CASING, window(speed_rad_s=speed, overall=1e-4), healthy)) for speed in (SPEED, SPEED / 2))
    assert [one["overall"].state for one in quiet] == ["alert", "normal"]


def test_every_limit_that_applies_to_a_level_is_listed() -> None:
    own = [{"channel": "DE-H", "alert": 3.0}, {"channel": "DE-H", "measure": "crest", "alert": 6.0}]
    healthy = reference(*(window(overall=1e-3) for _ in range(3)))
    level = window(overall=1.5e-3, crest=4.0)
    several = limits(judged(CASING, level, healthy, zones=["ISO 20816-3 group 2 rigid"], limits=own))
    assert (several["overall"].alert, several["overall"].danger) == (1.6, 2.5)
    assert [(one.source, one.zones, one.alert, one.danger, one.fall) for one in several["overall"].bounds] == [
        ("own limit", None, 3.0, None, None),
        ("ISO 20816-3 group 2 rigid", (1.4, 2.8, 4.5), 2.8, 4.5, None),
        ("commissioned", None, 1.6, 2.5, 0.5),
    ]
    assert several["crest"].bounds == ()
    assert "bounds" not in several["crest"].model_dump()


def test_a_level_beyond_all_numbers_reaches_only_limits_that_are_there() -> None:
    own = [{"channel": "DE-H", "measure": "overall", "alert": 4.0}]
    found = limits(judged(CASING, window(overall=np.inf), limits=own))["overall"]
    assert (found.state, found.danger) == ("alert", None)
    assert found.text.endswith("inf mm/s rms, alert limit 4 (own limit)")


def test_a_channel_beyond_several_limits_is_named_once_in_plain_figures() -> None:
    own = [{"channel": "DE-H", "alert": 1000.0, "danger": 2000.0}, {"channel": "DE-H", "measure": "peak", "alert": 3.0}]
    text = channel_state(judged(CASING, window(overall=2.345, peak=4e-3), limits=own)).text
    assert text == (
        "DE-H (DE horizontal) overall 2345 mm/s rms, danger limit 2000 (own limit); "
        "peak 4 mm/s peak, alert limit 3 (own limit)"
    )


def test_a_channel_clears_only_below_the_deadband() -> None:
    settings: dict[str, Any] = {"limits": [{"channel": "DE-H", "alert": 10.0}]}
    for level, beyond, small in ((10.5, True, False), (9.5, False, False), (8.9, False, True)):
        state = channel_state(judged(CASING, window(overall=level * 1e-3), **settings))
        assert (state.beyond, state.small) == (beyond, small), level


def test_the_first_windows_become_the_reference_and_survive_a_restart() -> None:
    first = FirstWindows(["DE-H"], 3)
    for number in range(5):  # each overlaps the one before by half
        assert first.progress == f"{(number + 1) // 2} of 3 first windows, so no limit is relative to this machine yet"
        first.take(number * 30, number * 30 + 60, window(overall=1e-3 * (1 + number), x1=1e-6j))
        again = FirstWindows(["DE-H"], 3)
        again.restore(first.checkpoint())
        first = again
    assert first.reference is not None
    level = first.reference.states[0].levels["DE-H"]["overall"]
    assert (level.low, level.high) == (1e-3, 5e-3)
    assert first.reference.source == "the first windows"
    assert first.progress == "levels are compared with the first windows, until 1970-01-01T00:00:00Z"


@pytest.mark.parametrize(("times", "learned"), [(3.0, [True]), (5.0, [True, False])])
def test_a_machine_at_standstill_in_the_first_windows_is_learned_anew(times: float, learned: list[bool]) -> None:
    """But not one that has become louder, and turns visibly: it may have turned all the time."""
    first = FirstWindows(["DE-H"], 2, turns=True, since="May, new bearing")
    for number in range(8):
        size, speed_rad_s = (1e-3, None) if number < 4 else (1e-3 * times, 150.0)
        first.take(number * 60, number * 60 + 60, window(overall=size, speed_rad_s=speed_rad_s))
    assert first.reference is not None
    assert [one.speed_rad_s is None for one in first.reference.states] == learned
    assert first.reference.source == "the first windows since May, new bearing"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"zones": ["ISO 20816-3 group 3"]}, "did you mean"),
        ({"zones": ["ISO 20816-3 group 1 rigid", "ISO 20816-3 group 2 rigid"]}, "one for the casing"),
        ({"limits": [{"channel": "DE-H"}]}, "neither alert nor danger"),
        ({"limits": [{"channel": "DE-H", "alert": 3, "danger": 2}]}, "must be below"),
        ({"limits": [{"channel": "DE-H", "measure": "rsm", "alert": 3}]}, "is not one of"),
        ({"band_hz": [1000, 10]}, "from < to"),
        ({"alert_ratio": 3}, "must be below danger_ratio"),
    ],
)
def test_mistakes_in_the_settings_are_named(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        LevelSettings.model_validate(settings)
