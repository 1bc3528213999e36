"""Levels in narrow bands against closed forms, and growth in one of them against a reference."""

import numpy as np
import pytest
import scipy.signal

from models.levels.bands import BandReference
from models.levels.judgement import LevelJudge
from models.levels.measures import LevelPlan, WindowLevels, level_plan
from models.levels.reference import FirstWindows, LevelReference, learn_levels
from models.levels.settings import LevelSettings
from models.signals.block import FloatArray
from models.signals.channels import Channel
from rotorwatch.records.levels import ChannelLevels
from tests.levels.test_measures import taken
from tests.sure import sure

RATE_HZ, HOP_S, HOPS = 2560.0, 5.0, 4
DE = Channel(name="DE", quantity="acceleration", location="DE", direction="axial", unit="m/s2")
PLAN: LevelPlan = level_plan([DE], RATE_HZ, (10.0, 1000.0))
T = np.arange(round(HOPS * HOP_S * RATE_HZ)) / RATE_HZ


def window(samples: FloatArray, count: int = HOPS) -> WindowLevels:
    """Levels of the first hops of a machine of unknown speed."""
    return taken(PLAN, samples[: count * samples.size // HOPS, None], count)


def noise(seed: int) -> FloatArray:
    return np.random.default_rng([20261122, seed]).standard_normal(T.size)


def line(hz: float, amplitude: float) -> FloatArray:
    return np.asarray(amplitude * np.sin(2 * np.pi * hz * T + 0.3))


def reference(*samples: FloatArray) -> LevelReference:
    return learn_levels("commissioned", ["DE"], [window(each) for each in samples])


def judged(samples: FloatArray, healthy: LevelReference | None) -> ChannelLevels:
    (found,) = LevelJudge(PLAN, [DE], LevelSettings()).judge(window(samples), healthy)
    return found


def grown(samples: FloatArray, healthy: LevelReference) -> tuple[str, str]:
    """State and words of the growth in bands."""
    limits = sure(judged(samples, healthy).limit("growth"))
    return limits.state, limits.text


def test_bands_hold_the_rms_of_lines_and_noise_within_them() -> None:
    bands = sure(window(noise(1) + line(97.3, 4.0)).bands)
    low, high = bands.edges_hz[:-1], bands.edges_hz[1:]
    within = (low < 97.3) & (high > 97.3)
    assert bands.rms[within, 0] == pytest.approx(4 / np.sqrt(2), rel=0.01)
    far = (low > 200) & (high < 900)
    density = 1 / (RATE_HZ / 2)
    assert bands.rms[far, 0] == pytest.approx(np.sqrt(density * (high - low)[far]), rel=0.15)
    assert np.all(np.diff(bands.edges_hz) > 0)
    assert bands.edges_hz[-1] == pytest.approx(0.8 * RATE_HZ / 2, rel=0.06)


HEALTHY = reference(*(noise(seed) + line(48.7, 1.0) + line(97.4, 0.3) for seed in range(5)))


@pytest.mark.parametrize("hz", [24.35, 48.7, 97.4, 130.0, 613.0])
def test_a_line_that_doubles_or_appears_is_found_at_any_frequency(hz: float) -> None:
    healthy = noise(11) + line(48.7, 1.0) + line(97.4, 0.3)
    assert grown(healthy, HEALTHY)[0] == "normal"
    state, text = grown(healthy + line(hz, 1.0 if hz < 200 else 2.0), HEALTHY)
    assert state == "alert"
    low, high = (float(part) for part in text.split(" Hz")[0].split(") ")[1].split(" to "))
    assert low * 0.99 <= hz <= high * 1.01
    assert "times the reference, alert limit" in text
    assert "(commissioned)" in text


def test_healthy_windows_raise_nothing() -> None:
    """100 windows of 110 bands; at six standard errors chance raises none."""
    raised = sum(grown(noise(1000 + n) + line(48.7, 1.0) + line(97.4, 0.3), HEALTHY)[0] != "normal" for n in range(100))
    assert raised == 0
    # Nor do lines that move with the speed, nor growth in all bands alike, which the overall level shows.
    assert grown(noise(12) + line(50.2, 1.0) + line(100.4, 0.3), HEALTHY)[0] == "normal"
    assert grown(1.55 * noise(13) + line(48.7, 1.0) + line(97.4, 0.3), HEALTHY)[0] == "normal"


def test_a_band_may_vary_as_much_as_it_did_at_commissioning() -> None:
    varied = reference(*(noise(seed) + line(48.7, level) for seed, level in enumerate((0.5, 1.0, 2.0))))
    assert grown(noise(11) + line(48.7, 2.4), varied)[0] == "normal"
    assert grown(noise(11) + line(48.7, 3.0), varied)[0] == "alert"


def test_a_resonance_that_was_loud_in_one_condition_may_be_as_loud_while_a_window_fills() -> None:
    """A shaft mode of 500 Hz whose level has few independent averages in a hop, four times as large in one window."""

    def resonance(seed: int, level: float) -> FloatArray:
        radius, omega = 0.9997, 2 * np.pi * 500.0 / RATE_HZ
        found = scipy.signal.lfilter([1.0], [1.0, -2 * radius * np.cos(omega), radius**2], noise(seed))
        return np.asarray(level * found / found.std())

    varied = reference(*(noise(seed) + resonance(100 + seed, level) for seed, level in enumerate((1.0, 1.0, 4.0))))
    judge, states = LevelJudge(PLAN, [DE], LevelSettings()), []
    for seed in range(200, 300):
        (found,) = judge.judge(window(noise(seed) + resonance(100 + seed, 4.0), 1), varied)
        states.append(found.limit("growth"))
    assert sum(one is not None and one.state != "normal" for one in states) == 0


def test_without_a_reference_or_with_one_of_other_bands_nothing_has_grown() -> None:
    found = judged(noise(1), None)
    assert found.growth is None
    assert found.limit("growth") is None
    (state,) = HEALTHY.states
    wider = BandReference(edges_hz=(1.0, 2.0), mean=(1.0,), high=(1.0,), error=(0.0,), freedom=(9.0,))
    other = HEALTHY.model_copy(update={"states": (state.model_copy(update={"bands": {"DE": wider}}),)})
    assert judged(noise(1), other).limit("growth") is None


def test_bands_of_the_first_windows_survive_a_restart() -> None:
    first = FirstWindows(["DE"], 3)
    first.take(0, 1, window(noise(1)))
    again = FirstWindows(["DE"], 3)
    again.restore(first.checkpoint())
    for one in (first, again):
        for number in (2, 3):
            one.take(number, number + 1, window(noise(number)))
    assert first.reference == again.reference
    assert sure(first.reference).states[0].bands["DE"].mean
