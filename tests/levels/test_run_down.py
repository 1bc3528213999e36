"""A machine that runs down, so that twice its speed passes a resonance that random forces excite."""

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from models.levels.judgement import LevelJudge
from models.levels.measures import WindowLevels, hop_levels, level_plan, window_levels
from models.levels.reference import LevelReference, learn_levels
from models.levels.settings import LevelSettings
from models.signals.channels import Channel
from models.signals.waveform import waveform_of

RATE_HZ, HOP_S, HOPS, SPEED_HZ, RESONANCE_HZ, DAMPING = 1024.0, 5.0, 12, 37.5, 27.0, 0.05
Y = Channel(name="y2", quantity="displacement", location="disc", direction="y", unit="um")
PLAN = level_plan([Y], RATE_HZ, (10.0, 400.0))
TIME_S = np.arange(round(HOPS * HOP_S * RATE_HZ)) / RATE_HZ
RUN_DOWN = [SPEED_HZ] * 6 + [31.0, 25.0, 19.5, 14.5, 10.0, 6.0, 3.0]
STANDS = [25.0, 19.5, 14.5, 10.0, 6.0] + [0.0] * 8
SLOW = [RESONANCE_HZ / 2] * (HOPS + 1)


def window(seed: int, speeds_hz: Sequence[float], *, twice: float = 0.0, times: int = HOPS) -> WindowLevels:
    """The first `times` hops of a window; speeds at their edges, and a true `twice`, in µm."""
    rng = np.random.default_rng([20262822, seed])
    pole = np.exp(2 * np.pi * RESONANCE_HZ / RATE_HZ * (-DAMPING + 1j))
    noise = lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], rng.standard_normal(TIME_S.size))
    speed = np.interp(TIME_S, HOP_S * np.arange(HOPS + 1), speeds_hz)
    angle = 2 * np.pi * np.cumsum(speed) / RATE_HZ
    samples = 2.0 * noise / noise.std() + 5.0 * (speed / SPEED_HZ) ** 2 * np.cos(angle) + twice * np.cos(2 * angle)
    samples = 1e-6 * (samples + 0.02 * rng.standard_normal(samples.size))
    pieces = [np.split(one, HOPS)[:times] for one in (samples, angle)]
    hops = [hop_levels(PLAN, *waveform_of(piece[:, None]), turning) for piece, turning in zip(*pieces, strict=True)]
    speeds = np.array([(turning[-1] - turning[0]) / HOP_S for turning in pieces[1]])
    return window_levels(PLAN, hops, speeds, phase_reference=True)


@cache
def healthy() -> LevelReference:
    return learn_levels("commissioned", ["y2"], [window(number, [SPEED_HZ] * (HOPS + 1)) for number in range(4)])


def judged(levels: WindowLevels, *, own: bool = False) -> str:
    """What is said of the 2x, compared with the machine at its usual speed."""
    limits = {"limits": [{"channel": "y2", "measure": "x2", "alert": 0.001}]} if own else {}
    (channel,) = LevelJudge(PLAN, [Y], LevelSettings.model_validate(limits)).judge(levels, healthy())
    found = channel.limit("x2")
    return "" if found is None else found.text


@pytest.mark.parametrize("seed", range(10, 16))
@pytest.mark.parametrize("speeds_hz", [RUN_DOWN, STANDS, SLOW])
def test_random_vibration_at_a_resonance_that_2x_passes_is_no_2x(seed: int, speeds_hz: list[float]) -> None:
    assert judged(window(seed, speeds_hz)) == ""
    assert judged(window(seed, speeds_hz, times=3)) == ""


@pytest.mark.parametrize("speeds_hz", [RUN_DOWN, [30.0] * (HOPS + 1), list(np.linspace(30.0, 37.5, HOPS + 1))])
def test_a_2x_that_stands_out_of_it_is_still_compared(speeds_hz: list[float]) -> None:
    assert judged(window(20, speeds_hz, twice=2.0)).endswith("(commissioned at another speed)")
    assert "own limit" in judged(window(21, speeds_hz), own=True)
