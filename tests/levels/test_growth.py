"""The growth of a level that would raise an alert, as stated in a commissioning and in every report."""

import math
from typing import Any

import numpy as np
import pytest

from models.levels.bands import BandLevels
from models.levels.judgement import LevelJudge, growth_seen
from models.levels.limits import alerts_of
from models.levels.measures import COMPARED, WindowLevels, level_plan
from models.levels.reference import LevelReference, learn_levels
from models.levels.settings import LevelSettings
from models.signals.channels import Channel
from rotorwatch.records.levels import LEVEL_MEASURES, ChannelLevels
from tests.sure import sure

CHANNELS = [
    Channel(name=name, quantity=quantity, location="DE", direction="V", unit=unit)
    for name, quantity, unit in (("A", "acceleration", "g"), ("V", "velocity", "mm/s"), ("D", "displacement", "um"))
]
PLAN = level_plan(CHANNELS, 10_000.0, (10.0, 1000.0))


def window(scale: float = 1.0, speed_rad_s: float | None = 150.0, error: float = 0.01) -> WindowLevels:
    values = {name: np.full(3, np.nan) for name in LEVEL_MEASURES}
    values |= {"overall": scale * np.array([3.0, 2e-3, 40e-6]), "x2": scale * np.array([0.1, 1e-4, 1e-6])}
    values["velocity"] = scale * np.array([1e-3, np.nan, np.nan])
    values["crest"] = np.full(3, 3.0)
    errors = {name: error * values[name] for name in COMPARED}
    silent = BandLevels(np.array([1.0, 2.0]), np.zeros((1, 3)), np.zeros((1, 3)), np.ones(1))
    return WindowLevels(values, errors, None, silent, speed_rad_s, hops=12)


def judged(levels: WindowLevels, reference: LevelReference | None = None, **settings: Any) -> tuple[ChannelLevels, ...]:
    return LevelJudge(PLAN, CHANNELS, LevelSettings.model_validate(settings)).judge(levels, reference)


def reference(*scales: float, speed_rad_s: float = 150.0, error: float = 0.01) -> LevelReference:
    names = [channel.name for channel in CHANNELS]
    return learn_levels("commissioned", names, [window(scale, speed_rad_s, error) for scale in scales])


@pytest.mark.parametrize("scales", [(1.0,), (0.98, 1.0, 1.02), (0.6, 1.0, 1.9)])
@pytest.mark.parametrize("error", [0.01, 0.3])
def test_the_stated_growth_is_the_one_that_raises_an_alert(scales: tuple[float, ...], error: float) -> None:
    healthy, settings = reference(*scales, error=error), LevelSettings()
    stated = list(alerts_of(healthy, CHANNELS, settings, 12))
    assert {(one.channel, one.measure) for one in stated} == {
        ("A", "overall"), ("A", "velocity"), ("A", "x2"), ("V", "overall"), ("V", "x2"), ("D", "overall"), ("D", "x2"),
    }  # fmt: skip
    mean = sum(scales) / len(scales)
    for one in stated:
        assert one.growth is not None
        for factor, state in ((0.999, "normal"), (1.001, "alert")):
            now = judged(window(mean * (1 + one.growth) * factor), healthy)
            (channel,) = [levels for levels in now if levels.channel == one.channel]
            limit = sure(channel.limit(one.measure))
            assert (limit.state == "normal") == (state == "normal")
        assert one.alert == pytest.approx(one.healthy * (1 + one.growth))
    units = {(one.channel, one.measure): one.unit for one in stated}
    assert (units["A", "velocity"], units["D", "x2"]) == ("mm/s rms", "um pp")
    assert next(one for one in stated if one.channel == "D").healthy == pytest.approx(40 * mean)


def test_every_operating_state_has_growths_of_its_own() -> None:
    names = [channel.name for channel in CHANNELS]
    windows = [
        window(scale, speed) for speed in (100.0, 200.0) for scale in ((1.0, 1.1) if speed < 150 else (1.0, 3.0))
    ]
    found = list(alerts_of(learn_levels("commissioned", names, windows), CHANNELS, LevelSettings(), 12))
    overall = [one for one in found if (one.channel, one.measure) == ("V", "overall")]
    assert [one.windows for one in overall] == [2, 2]
    assert [one.growth for one in overall] == pytest.approx([0.6, 1.25 * 3 / 2 - 1])


def test_a_level_of_zero_has_no_growth() -> None:
    (one, *_) = alerts_of(reference(0.0), CHANNELS, LevelSettings(), 12)
    assert one.growth is None


def test_the_least_sensitive_channel_determines_the_growth_that_would_be_seen() -> None:
    of_d = {"channel": "D", "measure": "x2", "alert": 3}
    limits = [{"channel": "A", "alert": 0.6}, {"channel": "V", "alert": 2.8}, of_d]
    seen = growth_seen(judged(window(), limits=limits))
    assert (seen.channel, seen.measure) == ("D", "x2")
    assert seen.growth == pytest.approx(2.0)
    assert seen.text == (
        "growth of 200 % in any channel would have raised an alert; last in D, whose 2x is 1 µm pp with an alert "
        "limit of 3"
    )
    sooner = growth_seen(judged(window(), limits=[*limits, {"channel": "D", "alert": 50}]))
    assert (sooner.channel, sooner.measure) == ("A", "overall")
    assert sooner.growth == pytest.approx(0.6 * 9.80665 / 3.0 - 1, rel=1e-4)


def test_danger_limits_count_for_growth_and_waveform_limits_do_not() -> None:
    limits: list[dict[str, Any]] = [{"channel": name, "danger": 100.0} for name in "AVD"]
    assert growth_seen(judged(window(), limits=limits)).growth == pytest.approx(100 * 9.80665 / 3.0 - 1, rel=1e-4)
    crest = [*limits, {"channel": "A", "measure": "crest", "alert": 3.1}]
    assert growth_seen(judged(window(), limits=crest)).channel == "A"
    assert growth_seen(judged(window(), limits=crest)).measure == "overall"


def test_channels_without_a_limit_are_named() -> None:
    seen = growth_seen(judged(window(), limits=[{"channel": "A", "alert": 0.6}]))
    assert (seen.growth, seen.channel, seen.measure) == (None, "V", "")
    assert seen.text == "no growth of V or D would have raised an alert: they have no limit yet"
    none_yet = growth_seen(judged(window()))
    assert none_yet.text == "no growth of A, V or D would have raised an alert: they have no limit yet"
    still = growth_seen(judged(window(0.0), limits=[{"channel": name, "alert": 1.0} for name in "AVD"]))
    assert still.growth is None
    assert not math.isnan(len(still.text))
