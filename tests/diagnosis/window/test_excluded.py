"""Lines that are left out of a window because they say nothing about the machine, and changes of its load."""

from collections.abc import Sequence

import numpy as np
import pytest

from models.diagnosis.window.excluded import (
    ExcludedLine,
    KnownLine,
    excluded_lines,
    of_one_level,
    segment_levels,
    summed,
)
from models.signals.block import ComplexArray, FloatArray
from tests.sure import sure

BINS, SEGMENTS = 736, 24
STEP: FloatArray = np.repeat([1.0, 9.0], (18, 6))


def segments(level: FloatArray, *, sources: int = 4) -> ComplexArray:
    """Segments of four motions under some sources, with a little independent noise; coloured over the bins."""
    rng = np.random.default_rng(5100)

    def white(channels: int) -> ComplexArray:
        pair = rng.standard_normal((2, BINS, SEGMENTS, channels))
        return np.asarray(pair[0] + 1j * pair[1], dtype=np.complex128)

    mixing = rng.standard_normal((sources, 4)) / np.linspace(1, 5, BINS)[:, None, None]
    return np.asarray((np.sqrt(level)[:, None] * white(sources)) @ mixing + 0.01 * white(4), dtype=np.complex128)


STEP_HZ, EVERY_S = 0.2, 2.5
FREQUENCIES_HZ: FloatArray = np.linspace(3, 150, BINS)


def with_line(hz: float, size: float = 0.3, wander_hz: float = 0.0) -> ComplexArray:
    """One source, and in each channel a line of its own phase, of 30 times the independent noise."""
    found = segments(np.ones(SEGMENTS), sources=1)
    at_s = EVERY_S * np.arange(SEGMENTS)
    turns = hz * at_s + wander_hz * 47 / (2 * np.pi) * np.sin(2 * np.pi * at_s / 47)
    off = (FREQUENCIES_HZ - hz) / STEP_HZ
    lobe = np.sinc(off) / np.where(np.abs(np.abs(off) - 1) < 1e-9, 1.0, 1 - off**2)
    line = lobe[:, None, None] * np.exp(2j * np.pi * turns)[:, None] * np.exp(1j * np.array([0.0, 2.0, 4.0, 5.0]))
    return np.asarray(found + size * line, dtype=np.complex128)


def lines_of(found: ComplexArray, speed_hz: float = 22.0, known: Sequence[KnownLine] | None = ()) -> list[float]:
    lines = excluded_lines(found, summed(found), FREQUENCIES_HZ, (2 * np.pi * speed_hz,) * 2, known)
    return [round(line.frequency_hz, 1) for line in lines]


@pytest.mark.parametrize("hz", [50.04, 59.93, 100.1, 149.97])
def test_mains_hum_is_found_though_no_channel_alone_shows_it(hz: float) -> None:
    found = with_line(hz, wander_hz=0.02)
    alone = np.abs(found[:, :, 0]) ** 2
    at = int(np.abs(FREQUENCIES_HZ - hz).argmin())
    assert alone[at].mean() < 8 * alone[at - 8 : at + 9].mean()
    assert lines_of(found) == [round(float(FREQUENCIES_HZ[at]), 1)]


@pytest.mark.parametrize("hz", [50.04, 100.1, 149.97])
def test_hum_is_measured_between_the_bins_and_at_the_end_of_the_band(hz: float) -> None:
    # If the phase refers to the start of a segment, neighbouring bins of a line have opposite signs.
    found = with_line(hz, 2.0, wander_hz=0.005) * (-1.0) ** np.arange(BINS)[:, None, None]
    (line,) = excluded_lines(found, summed(found), FREQUENCIES_HZ, (2 * np.pi * 22.0,) * 2, None)
    assert line.centre_hz == pytest.approx(hz, abs=0.02)
    # The amplitudes of a lobe add up to twice that of its middle, and have 0.375 of the power of that sum.
    apart = np.exp(1j * np.array([0.0, 2.0, 4.0, 5.0]))
    true = 2 * STEP_HZ * 0.375 * 4.0**2 * np.outer(apart, apart.conj())
    assert np.abs(sure(line.power) - true).max() < 0.15 * np.abs(true).max()


def test_other_lines_are_left_out_where_the_healthy_machine_had_them() -> None:
    found = with_line(37.3)
    assert not lines_of(found)
    assert not lines_of(found, known=[(41.0, 41 / 22)])
    assert lines_of(found, known=None) == lines_of(found, known=[(37.2, 37.2 / 22)])
    assert lines_of(found, 20.0, [(41.0, 37.2 / 20)])  # as of a gear, it follows the speed


def test_a_multiple_of_the_speed_is_no_hum_but_may_be_known() -> None:
    found = with_line(50.0)
    assert not lines_of(found, 25.0)
    assert lines_of(found, 25.0, [(50.0, 2.0)]) == lines_of(found, 25.0, None) == [50.0]
    assert not lines_of(found, 50.0, None)  # the rotation itself has regressors of its own
    assert not lines_of(found, np.nan)
    assert not lines_of(found, 0.0, None)


@pytest.mark.parametrize("order", [1.5, 2.0, 4.0])
def test_hum_is_distinguished_from_a_multiple_of_the_speed_in_the_same_lobe(order: float) -> None:
    """A motor of four poles at full load runs at 1480 rpm, and twice its speed is 0.7 Hz beside the mains."""
    for multiple_hz in (99.7, 100.25):
        assert lines_of(with_line(100.0), multiple_hz / order) == [100.0]
        assert not lines_of(with_line(multiple_hz), multiple_hz / order)


def test_a_strong_line_at_the_mains_frequency_is_no_hum() -> None:
    """A stator fault, a neighbour at 3000 rpm: if the healthy machine had none, it is treated as any other line."""
    for size, hum in ((0.2, [50.0]), (1.5, [50.0]), (3.0, []), (30.0, [])):
        assert lines_of(with_line(50.0, size)) == hum
        assert lines_of(with_line(50.0, size), known=[(49.7, 2.26)]) == [50.0]


def test_hum_is_found_even_if_it_dominates_one_channel() -> None:
    found = with_line(50.0)
    found[:, :, 3] -= segments(np.ones(SEGMENTS), sources=1)[:, :, 3] * 0.99
    alone = np.abs(found[:, :, 3]) ** 2
    assert alone[234:237].sum() > 0.3 * alone.sum()
    assert lines_of(found) == [50.0]


@pytest.mark.parametrize("order", [0.5, 1.5, 2.5])
def test_a_line_at_a_half_order_of_the_speed_is_no_hum(order: float) -> None:
    found = with_line(50.0)
    assert not lines_of(found, 50 / order)
    assert lines_of(found, 50 / order + 2) == [50.0]


def test_louder_lines_reach_further() -> None:
    faint, loud, known = with_line(50.1, 0.3), with_line(50.1, 30.0), [(50.0, 2.27)]
    (near,) = excluded_lines(faint, summed(faint), FREQUENCIES_HZ, (138.0, 138.0), known)
    (far,) = excluded_lines(loud, summed(loud), FREQUENCIES_HZ, (138.0, 138.0), known)
    assert near.reach_hz < far.reach_hz < 3.0


def test_noise_and_a_narrow_resonance_are_no_lines() -> None:
    for known in ((), None):
        assert not lines_of(segments(np.ones(SEGMENTS)), known=known)
    found, rng = segments(np.ones(SEGMENTS)), np.random.default_rng(5101)
    ring = rng.standard_normal((2, SEGMENTS)) / np.sqrt(2)
    found[234:237] += 5 * (ring[0] + 1j * ring[1])[:, None]
    assert not lines_of(found)
    found[:, :, 3] = 0.0
    assert not lines_of(found)


def test_an_order_of_a_wandering_speed_is_recognised_by_following_the_shaft() -> None:
    at_s = EVERY_S * np.arange(SEGMENTS)
    speed_hz, slowest, fastest = 22 * (1 + 0.005 * np.sin(2 * np.pi * at_s / 20)), 2 * np.pi * 21.89, 2 * np.pi * 22.11
    turned = 2 * np.pi * np.cumsum(speed_hz) * EVERY_S

    def line(order: int) -> ComplexArray:
        off = (FREQUENCIES_HZ[:, None] - order * speed_hz) / STEP_HZ
        lobe = np.sinc(off) / np.where(np.abs(np.abs(off) - 1) < 1e-9, 1.0, 1 - off**2)
        signs = (-1.0) ** np.arange(BINS)[:, np.newaxis]  # of a segment that is transformed from its start
        return np.asarray(signs * lobe * np.exp(1j * order * turned), dtype=np.complex128)

    found = segments(np.ones(SEGMENTS), sources=1) + 0.3 * line(5)[:, :, None] * np.exp(1j * np.arange(4.0))
    told = excluded_lines(found, summed(found), FREQUENCIES_HZ, (slowest, fastest), None, line(1).T)
    assert [round(one.frequency_hz) for one in told] == [110]
    assert told[0].reach_hz > 5 * 0.11 + 2 * STEP_HZ
    without = segments(np.ones(SEGMENTS), sources=1)
    assert not excluded_lines(without, summed(without), FREQUENCIES_HZ, (slowest, fastest), None, line(1).T)
    known = [(110.0, 5.0)]  # what the healthy machine had is left out whether it stands out or not
    (kept,) = excluded_lines(without, summed(without), FREQUENCIES_HZ, (slowest, fastest), known, line(1).T)
    assert kept.frequency_hz == pytest.approx(110)


def test_frequency_and_order_of_a_known_line_are_precise_on_slow_machines() -> None:
    for line_hz, speed_hz in ((0.5349, 1.5), (1.534, 0.75), (119.98, 22.0)):
        kept = ExcludedLine(line_hz, 1.0).known(-2 * np.pi * speed_hz)
        assert kept == pytest.approx((line_hz, line_hz / speed_hz), rel=0.005)


def levels_of(found: ComplexArray) -> FloatArray | None:
    return segment_levels(found, summed(found), range(4))


@pytest.mark.parametrize("sources", [4, 1])  # with one, three of four motions are sensor noise, which does not step
def test_a_load_that_steps_is_read_from_the_segments(sources: int) -> None:
    found = sure(levels_of(segments(STEP, sources=sources)))
    np.testing.assert_allclose(found, STEP / STEP.mean(), rtol=0.15)
    assert found.mean() == pytest.approx(1)


def test_the_most_segments_of_one_level_are_evaluated() -> None:
    for level in (STEP, 1 / STEP):
        found = segments(level)
        np.testing.assert_array_equal(of_one_level(found, level, range(4)), found[:, STEP == 1] / np.sqrt(level[0]))
    assert of_one_level(found, np.geomspace(1.0, 1000.0, SEGMENTS), range(4)).shape[1] == SEGMENTS  # too few are alike


@pytest.mark.parametrize("quiet", [0, 4])  # in some of those of usual level, too, the motion is another
def test_segments_of_another_level_are_evaluated_if_their_motion_is_another(quiet: int) -> None:
    """A rub that comes and goes: it raises the level of some segments, and changes the motion."""
    found, rubs = segments(STEP), np.isin(np.arange(SEGMENTS), [*range(quiet), 21, 22, 23])
    found[:, rubs] = found[:, rubs][:, :, [1, 2, 3, 0]]
    kept = of_one_level(found, STEP, range(4))
    np.testing.assert_allclose(np.angle(kept), np.angle(found[:, rubs | (STEP == 1)]))


@pytest.mark.parametrize("kind", ["line", "a tenth of the band", "dead channels", "too large", "steady"])
def test_changes_that_are_not_of_the_load_give_no_levels(kind: str) -> None:
    found = segments(np.ones(SEGMENTS))
    if kind == "line":
        found[100, 18:] += 1000.0
    elif kind == "a tenth of the band":
        found[660:, 18:] *= 3
    elif kind == "dead channels":
        found[:] = 0
    elif kind == "too large":
        found[:, 5] = np.nan
    assert levels_of(found) is None
