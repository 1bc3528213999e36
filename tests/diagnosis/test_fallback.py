"""Shapes of correlation functions against their healthy spread: changed or not, at a declared rate, without a cause."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.stats import binomtest, norm

from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.observed import WindowSizes, plan, sampled, windows_of
from benchmarks.finite_elements.scenes import COMMISSIONED, SceneRange, SourceLayout, drawn_condition
from models.diagnosis.shape import FEWEST_WINDOWS, HealthyShape, learn_shape
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.physics.rotor import PARAMETERS
from tests.sure import sure

PROBES = ("y1", "z1", "y2_ddot")
LENGTH_S = 20.0


@cache
def recorded(seed: int, count: int, change: float = 0.0, condition: int = 1) -> tuple[WindowStatistics, ...]:
    """One recording; `condition` 1 is that of commissioning, others have a cutoff of their own."""
    rotor = rotor_named("overhung")
    limits = COMMISSIONED if condition == 1 else replace(SceneRange(), speed_relative=(1.0, 1.0))
    changes = {"k_by": change} if change else {}
    rng = np.random.default_rng([71, condition])
    drawn = drawn_condition(rotor, SourceLayout.ONE_SOURCE, limits, changes, rng)
    samples = sampled(rotor, drawn, count * LENGTH_S + 2.6, [seed, condition], PROBES)
    return tuple(windows_of(samples, plan(rotor, WindowSizes(length_s=LENGTH_S), PROBES)))


def healthy_windows() -> tuple[WindowStatistics, ...]:
    """Six of one recording, enough to learn from."""
    return recorded(1, 11)[:6]


@pytest.mark.slow
@pytest.mark.parametrize("healthy", [4, pytest.param(12, marks=pytest.mark.long)])
def test_false_alarms_stay_at_the_declared_rate_whatever_the_number_of_healthy_windows(healthy: int) -> None:
    rate = 0.05
    z = []
    any_changed = 0
    for commissioning in range(3):
        windows = recorded(100 + commissioning, healthy + 10)
        shape = learn_shape(windows[:healthy])
        for window in windows[healthy:]:
            judged = shape.judge(window, rate)
            z.append([one.z for one in judged])
            any_changed += any(one.verdict == "changed" for one in judged)
    values = np.array(z, dtype=float)
    assert binomtest(any_changed, len(z), rate, alternative="greater").pvalue > 0.005
    for channel in values.T:
        assert binomtest(int(np.sum(channel > norm.isf(rate))), len(z), rate, alternative="greater").pvalue > 0.005
        assert 0.2 < np.mean(channel > 0) < 0.8  # neither blind nor crying wolf


def test_a_20_per_cent_loss_of_stiffness_is_detected_but_not_named() -> None:
    shape = learn_shape(healthy_windows())
    for window in recorded(2, 8, change=-0.2):
        judged = shape.judge(window)
        assert judged[0].verdict == "changed"
        assert sure(judged[0].z) > judged[0].limit
        for one in judged:
            said = one.text.replace(one.state, "")
            assert not any(name in said.split() for name in (*PARAMETERS, "bearing", "disc", "stiffness", "damping"))
    assert [one.state for one in shape.judge(healthy_windows()[0])] == ["y1", "z1", "y2_ddot"]


@pytest.mark.slow
def test_learning_under_varied_excitation_widens_the_healthy_spread() -> None:
    one_colour = learn_shape(healthy_windows())
    other_colours = [recorded(7, 1, condition=number)[0] for number in range(2, 26)]
    assert sum(any(one.verdict == "changed" for one in one_colour.judge(window)) for window in other_colours) > 12
    colours = learn_shape(other_colours[:12])
    # Scatter of the healthy windows over that of sampling alone: 1 where the excitation did not vary.
    assert all(one.variance / len(one.directions) > 2**2 for one in colours.channels)
    assert all(one.variance / len(one.directions) < 1.6**2 for one in one_colour.channels)
    flagged = sum(any(one.verdict == "changed" for one in colours.judge(window, 0.05)) for window in other_colours[12:])
    assert binomtest(flagged, 12, 0.05, alternative="greater").pvalue > 0.005


def test_fewer_healthy_windows_or_a_shorter_window_lower_the_z_value() -> None:
    healthy, (changed, *_) = healthy_windows(), recorded(2, 8, change=-0.2)
    shape = learn_shape(healthy)
    known = sure(shape.judge(changed)[0].z)
    fewer = sure(replace_windows(shape, FEWEST_WINDOWS).judge(changed)[0].z)
    shorter = sure(shape.judge(replace(changed, duration_s=7.0))[0].z)
    assert fewer < known
    assert shorter < known


def replace_windows(shape: HealthyShape, count: int) -> HealthyShape:
    return HealthyShape.model_validate(shape.model_dump() | {"windows": count})


def test_shapes_do_not_depend_on_the_level() -> None:
    shape, (window, *_) = learn_shape(healthy_windows()), recorded(9, 6)
    louder = replace(window, correlation=9.0 * window.correlation)
    assert [one.z for one in shape.judge(louder)] == pytest.approx([one.z for one in shape.judge(window)])


def test_a_channel_that_cannot_be_compared_is_not_evaluable_with_a_reason() -> None:
    shape, (window, *_) = learn_shape(healthy_windows()), recorded(9, 6)
    still = replace(window, correlation=0 * window.correlation)
    cases = {
        "it does not move": still,
        "not measured": replace(window, states=("psi", "z1", "y2_ddot")),
        "commissioned at": replace(window, speed_rad_s=1.5 * window.speed_rad_s),
        "its speed is not known": replace(window, speed_rad_s=float("nan")),
        "its lags differ from the 126 lags up to 0.125 s": replace(window, lags_s=window.lags_s[:50]),
    }
    for reason, case in cases.items():
        judged = shape.judge(case)[0]
        assert (judged.verdict, judged.z) == ("not evaluable", None)
        assert reason in judged.text


def test_learning_from_too_little_data_is_refused() -> None:
    windows = healthy_windows()
    with pytest.raises(EstimationError, match=r"^3 healthy windows: 4 .* six or more are advised"):
        learn_shape(windows[:3])
    with pytest.raises(EstimationError, match="healthy window 4: its lags differ"):
        learn_shape([*windows[:4], replace(windows[4], lags_s=windows[4].lags_s[:50])])
    with pytest.raises(EstimationError, match="no channel moves"):
        learn_shape([replace(window, correlation=0 * window.correlation) for window in windows])
    with pytest.raises(EstimationError, match="lag zero alone"):
        learn_shape([replace(window, lags_s=window.lags_s[:1]) for window in windows])


def test_a_shape_round_trips_through_json_and_damaged_json_is_refused() -> None:
    shape = learn_shape(healthy_windows())
    text = shape.model_dump_json()
    again = HealthyShape.model_validate_json(text)
    assert again == shape
    assert again.model_dump_json() == text
    for damaged in (
        text.replace('"windows":6', '"windows":3'),
        text.replace('"windows":6', '"windows":"6"'),
        text.replace('"window_s"', '"extra":1,"window_s"'),
        text.replace('"lags_s":[0.0,', '"lags_s":['),
    ):
        assert damaged != text
        with pytest.raises(ValidationError):
            HealthyShape.model_validate_json(damaged)


@pytest.mark.parametrize("growth", [1.5, 2.0, 3.0, 8.0])
def test_noise_is_detected_above_the_stated_growth_and_not_far_below(growth: float) -> None:
    """White noise is added to windows until a channel is `growth` times as loud."""
    shape, others = learn_shape(recorded(1, 11)), recorded(9, 6)
    powers = shape.powers(1e-4)
    for number, name in enumerate(PROBES):
        found = 0
        for window in others:
            correlation = window.correlation.copy()
            correlation[0, number, number] *= growth**2
            judged = {one.state: one for one in shape.judge(replace(window, correlation=correlation), 1e-4)}
            found += judged[name].verdict == "changed"
        if growth >= powers[name].growth:
            assert found == len(others)
        elif growth < 0.6 * powers[name].growth:
            assert found < len(others)


def test_too_few_healthy_windows_have_no_power_and_state_how_many_suffice() -> None:
    """If the excitation varies, windows scatter by more than their own errors."""
    rate, measured = 3e-6, learn_shape(recorded(1, 11))  # one alarm a month at hops of 5 s
    calm, few = (replace_windows(measured, count).powers(rate) for count in (11, 5))
    assert all(few[name].growth > calm[name].growth for name in PROBES)
    spread = {"variance": 7 * measured.channels[0].variance, "freedom": 1.5}
    varies = measured.model_copy(update={"channels": (measured.channels[0].model_copy(update=spread),)})
    growths = {count: replace_windows(varies, count).powers(rate)["y1"].growth for count in range(4, 12)}
    assert growths[5] == np.inf
    assert growths[11] < 8
    (told,), (silent,) = (replace_windows(varies, count).judge(recorded(9, 1)[0], rate) for count in (11, 5))
    assert told.verdict == "not changed"
    assert silent.verdict == "not evaluable"
    assert "with 5 healthy windows not even noise that makes it 8 times as loud" in silent.text
    needed = sure(varies.powers(rate)["y1"].windows)
    assert 5 < needed <= 11
    assert growths[needed] <= 8 < growths[needed - 1]


def test_added_noise_never_shows_in_a_channel_that_is_already_white() -> None:
    shape = learn_shape(healthy_windows())
    white = [0.0] * len(shape.lags_s)
    white[0] = 1.0
    channels = tuple(one.model_copy(update={"mean": tuple(white)}) for one in shape.channels)
    found = shape.model_copy(update={"channels": channels}).powers(1e-4)
    assert all(one.growth == np.inf and one.windows is None for one in found.values())
