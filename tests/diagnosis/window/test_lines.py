"""Lines beside the rotation against noise, resonances and bursts, and which of them are new."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from models.commissioning.checks import check_lines
from models.commissioning.healthy import HealthyRecording, healthy_from_blocks, known_lines
from models.diagnosis.window.lines import LatestLines, Line, new_line, steady_lines
from models.diagnosis.window.statistics import window_statistics
from models.machine import MachineFile
from models.signals.block import FloatArray, SampleBlock
from tests.commissioning.rotor_kit import NOTHING
from tests.sure import sure

RATE_HZ, SPEED_HZ = NOTHING.rate_hz, 22.0
N = round(70 * RATE_HZ)
T = np.arange(N) / RATE_HZ
MACHINE = NOTHING.model_copy(update={"sensors": (*NOTHING.sensors[:2], NOTHING.sensors[-1])})
"""The rotor kit with only two of its probes, and its shaft angle."""


@cache
def noise(seed: int) -> FloatArray:
    return np.random.default_rng([20261130, seed]).standard_normal(N)


def line(hz: float, amplitude: float = 0.5) -> FloatArray:
    return np.asarray(amplitude * np.sin(2 * np.pi * hz * T + 0.3))


def slow(hz: float) -> FloatArray:
    return np.asarray(np.cos(2 * np.pi * hz * T))


def recording(
    of_y1: FloatArray, turns: int = 1, *, machine: MachineFile = MACHINE, speed_hz: float = SPEED_HZ
) -> HealthyRecording:
    """Noise and a strong 1x in every channel, and `of_y1` added to the first; `turns` is the direction."""
    samples = np.column_stack([noise(n) + line(speed_hz, 3.0) for n in range(len(machine.sensors))])
    samples[:, 0] += of_y1
    samples[:, -1] = np.mod(turns * 2 * np.pi * speed_hz * T, 2 * np.pi)
    size = round(RATE_HZ)
    found = [
        SampleBlock(1_767_225_600_000_000_000 + n * 10**9, n, 1, RATE_HZ, part.astype(np.float32))
        for n, part in enumerate(np.split(samples, N // size))
    ]
    made = healthy_from_blocks("r", machine, found)
    assert not made.refused
    return made


def with_segments(segment_s: float) -> MachineFile:
    window = MACHINE.window.model_copy(update={"segment_s": segment_s})
    return MACHINE.model_copy(update={"window": window})


def lines(of_y1: FloatArray, turns: int = 1) -> tuple[Line, ...]:
    return lines_of(recording(of_y1, turns))


def lines_of(made: HealthyRecording) -> tuple[Line, ...]:
    return steady_lines(made.plan, made.hops, window_statistics(made.plan, made.hops, lagged=False))


@cache
def healthy() -> tuple[tuple[float, float], ...]:
    """A machine that has a line at 30 Hz."""
    known = known_lines([recording(line(30.0))])
    assert known
    return known


def test_a_line_is_found_with_its_share_and_kept_by_frequency_and_order() -> None:
    (found,) = lines(line(30.0))
    assert (found.state, found.certain) == ("y1", True)
    assert found.frequency_hz == pytest.approx(30.0, abs=0.2)
    assert found.share == pytest.approx(0.125 / 1.125, rel=0.1)
    assert found.known(2 * np.pi * SPEED_HZ) == pytest.approx((30.0, 30.0 / 22.0), abs=0.01)


def test_orders_pulsations_resonances_and_bursts_are_no_lines() -> None:
    assert lines(line(2 * SPEED_HZ)) == lines(line(2 * SPEED_HZ), turns=-1) == ()
    root = np.exp(2 * np.pi * (-0.003 + 1j) * 40 / RATE_HZ)  # damped by 0.3 %
    resonance = lfilter([1.0], [1, -2 * root.real, abs(root) ** 2], noise(20))
    assert not any(one.certain for one in lines(resonance / resonance.std()))
    assert not any(one.certain for one in lines(line(30.0, 5.0) * (T // 5 == 4)))
    assert not lines(line(SPEED_HZ, 1.5) * slow(0.48))


def taken(latest: LatestLines, made: HealthyRecording, after: float) -> tuple[Line, ...]:
    """Lines taken from the recording's window, moved by `after` windows."""
    window = window_statistics(made.plan, made.hops, lagged=False)
    later_ns = round(after * (window.end_ns - window.start_ns))
    window = replace(window, start_ns=window.start_ns + later_ns, end_ns=window.end_ns + later_ns)
    return latest.take(steady_lines(made.plan, made.hops, window), window)


@pytest.mark.parametrize(
    ("apart", "second_hz", "certain"),
    [(1.0, 30.0, True), (0.9999, 30.0, True), (0.9, 30.0, False), (1.0, 33.0, False), (2.1, 30.0, False)],
)
def test_a_line_too_faint_for_one_window_is_certain_in_two(apart: float, second_hz: float, certain: bool) -> None:
    latest, found = LatestLines(), tuple[Line, ...]()
    for number, hz in enumerate((30.0, second_hz)):
        made = recording(noise(30 + number) + line(hz, 0.09))
        found = tuple(one for one in taken(latest, made, number * apart) if one.state == "y1")
        assert [one.likely for one in found] == [True]
        assert number or not found[0].certain
        restored = LatestLines()
        restored.restore(latest.checkpoint())
        latest = restored
    assert found[0].certain is certain


def test_lines_from_before_a_clock_was_set_back_are_forgotten() -> None:
    latest, made = LatestLines(), recording(noise(30) + line(30.0, 0.09))
    for _ in range(3):  # a recording that is sent again and again
        for after in (0.0, 0.1, 0.2):
            taken(latest, made, after)
    assert len(latest.checkpoint()["lines"]) == 3


@pytest.mark.parametrize("damping", [0.0, 0.003])
def test_one_impact_or_burst_in_each_window_is_no_line(damping: float) -> None:
    """It is coherent while it lasts, but a line lasts for more than a few segments."""
    machine, latest = with_segments(2.0), LatestLines()
    for number, at_s in enumerate((20.3, 41.7)):
        since = np.clip(T - at_s, 0.0, None)
        rings = 10 * np.exp(-2 * np.pi * 12.0 * damping * since) * np.sin(2 * np.pi * 12.0 * since)
        made = recording(rings if damping else rings * (since < 5.0), machine=machine)
        assert new_line(taken(latest, made, number), (), 2 * np.pi * SPEED_HZ) is None
        assert check_lines(machine, [made]).verdict == "passed"


@pytest.mark.parametrize("segment_s", [2.0, 10.0])
def test_a_narrow_resonance_that_noise_excites_is_no_line(segment_s: float) -> None:
    """It rings through several segments of 2 s; compared with the second next, it was taken for a line in 3 of 8.

    Of 10 s, there are so few that their powers may be alike by chance.
    """
    machine = with_segments(segment_s)
    pole = np.exp((-0.006 + 1j) * 2 * np.pi * 8.3 / RATE_HZ)
    for seed in range(8):
        rings = lfilter(
            [1.0], [1.0, -2 * pole.real, abs(pole) ** 2], np.random.default_rng([8, seed]).standard_normal(2 * N)
        )
        made = recording(3.0 * rings[N:] / rings[N:].std(), machine=machine)
        assert check_lines(machine, [made]).verdict == "passed"


@pytest.mark.parametrize(
    ("hz", "amplitude", "speed_hz", "new"),
    [
        (30.0, 0.5, SPEED_HZ, False), (30.4, 0.5, SPEED_HZ, False), (33.0, 0.5, SPEED_HZ, True),
        (33.0, 0.1, SPEED_HZ, False), (33.0, 0.5, 1.1 * SPEED_HZ, False),
    ],
)  # fmt: skip
def test_a_new_line_stands_out_at_another_frequency_and_order(
    hz: float, amplitude: float, speed_hz: float, new: bool
) -> None:
    assert (new_line(lines(line(hz, amplitude)), healthy(), 2 * np.pi * speed_hz) is not None) is new


@pytest.mark.parametrize(("hz", "beside"), [(21.55, 1), (22.08, 1), (65.9, 3)])
def test_a_line_that_beats_with_a_multiple_of_the_speed_is_found_beside_it(hz: float, beside: int) -> None:
    (found,) = lines(line(hz))
    (backwards,) = lines(line(hz), turns=-1)
    assert backwards.beside == beside
    assert backwards.frequency_hz == pytest.approx(found.frequency_hz)
    assert (found.state, found.certain, found.beside) == ("y1", True, beside)
    assert found.frequency_hz == pytest.approx(hz, abs=0.01)
    assert found.share == pytest.approx(0.125 / 1.125, rel=0.2)
    speed_rad_s = 2 * np.pi * SPEED_HZ
    assert new_line([found], healthy(), speed_rad_s) is found
    assert new_line([found], healthy(), speed_rad_s, beside=False) is None
    assert new_line([found], [found.known(speed_rad_s)], speed_rad_s) is None


@pytest.mark.parametrize("off_hz", [-0.85, 0.85])
def test_bins_that_a_multiple_reaches_are_not_noise_of_a_line_beside_it(off_hz: float) -> None:
    """In segments of 2 s the two lines fill most of the bins in which noise is measured."""
    speed_hz = 22.2
    made = recording(line(speed_hz + off_hz), machine=with_segments(2.0), speed_hz=speed_hz)
    (found,) = lines_of(made)
    assert found.certain
    assert found.frequency_hz == pytest.approx(speed_hz + off_hz, abs=0.02)


def test_a_beat_of_the_healthy_machine_is_not_new_and_a_drifting_1x_hides_none() -> None:
    beats, drifts = line(22.08), line(SPEED_HZ, 6.0) * T / T[-1]
    found, speed_rad_s = lines(beats), 2 * np.pi * SPEED_HZ
    for healthy_y1, new in ((beats, False), (drifts, True)):
        known = sure(known_lines([recording(healthy_y1)]))
        assert (new_line(found, known, speed_rad_s) is not None) is new


DRIFT = np.cumsum(np.random.default_rng(3).standard_normal((2, N)), axis=1) / np.sqrt(N)


CHANGES = ("step", "slope", "drift", "pulsation", "fast pulsation", "resonance")


@pytest.mark.parametrize(
    ("how", "segment_s"),  # few segments in a window, and many
    [
        *zip(CHANGES, (5.0, 2.0) * 3, strict=True),
        *(pytest.param(*one, marks=pytest.mark.long) for one in zip(CHANGES, (2.0, 5.0) * 3, strict=True)),
    ],
)
def test_a_multiple_that_changes_has_no_line_beside_it(how: str, segment_s: float) -> None:
    root = np.exp(2 * np.pi * (-0.003 + 1j) * SPEED_HZ / RATE_HZ)
    resonance = lfilter([1.0], [1, -2 * root.real, abs(root) ** 2], noise(21))
    more = {
        "step": line(SPEED_HZ, 3.0) * (T > 33.0),
        "slope": line(SPEED_HZ, 6.0) * T / T[-1],
        "drift": 4 * np.real((DRIFT[0] + 1j * DRIFT[1]) * np.exp(2j * np.pi * SPEED_HZ * T)),
        "pulsation": line(SPEED_HZ, 1.5) * slow(0.11),
        "fast pulsation": line(SPEED_HZ, 1.5) * slow(0.2),  # segments of 5 s show one side of it and the other in turn
        "resonance": resonance / resonance.std(),
    }
    made = recording(more[how], machine=with_segments(segment_s))
    assert not any(one.beside or one.certain for one in lines_of(made))
    assert check_lines(MACHINE, [made]).verdict == "passed"


@pytest.mark.parametrize(("speed_hz", "segment_s"), [(2.2, 5.0), (3.3, 1.0)])
def test_multiples_of_a_slow_machine_are_no_lines_beside_each_other(speed_hz: float, segment_s: float) -> None:
    orders = np.asarray(sum(line(order * speed_hz, order + 2.0) for order in range(2, 9)))
    made = recording(orders, machine=with_segments(segment_s), speed_hz=speed_hz)
    assert not any(one.certain for one in lines_of(made))
