"""Segments of a window: what is a change of the load, and which bins hold a line that says nothing of the machine."""

from collections.abc import Sequence

import numpy as np
import pytest

from models.diagnosis.moments import ComplexArray
from models.diagnosis.stationarity import KnownLine, excluded_lines, segment_levels, summed
from models.signals.block import FloatArray

BINS, SEGMENTS = 736, 24
STEP: FloatArray = np.repeat([1.0, 9.0], (18, 6))


def segments(level: FloatArray, *, sources: int = 4) -> ComplexArray:
    """Of four motions that some sources make, with a little noise of each; coloured from bin to bin."""
    rng = np.random.default_rng(5100)

    def white(channels: int) -> ComplexArray:
        pair = rng.standard_normal((2, BINS, SEGMENTS, channels))
        return np.asarray(pair[0] + 1j * pair[1], dtype=np.complex128)

    mixing = rng.standard_normal((sources, 4)) / np.linspace(1, 5, BINS)[:, None, None]
    return np.asarray((np.sqrt(level)[:, None] * white(sources)) @ mixing + 0.01 * white(4), dtype=np.complex128)


def levels_of(found: ComplexArray) -> FloatArray | None:
    return segment_levels(found, summed(found), range(4))


def test_a_load_that_steps_is_read_from_the_segments() -> None:
    found = levels_of(segments(STEP))
    assert found is not None
    np.testing.assert_allclose(found, STEP / STEP.mean(), rtol=0.15)
    assert found.mean() == pytest.approx(1)


def test_a_steady_load_is_left_alone() -> None:
    assert levels_of(segments(np.ones(SEGMENTS))) is None


@pytest.mark.parametrize("kind", ["line", "a tenth of the band", "dead channels", "too large"])
def test_what_is_not_the_load(kind: str) -> None:
    found = segments(np.ones(SEGMENTS))
    if kind == "line":
        found[100, 18:] += 1000.0
    elif kind == "a tenth of the band":
        found[660:, 18:] *= 3
    elif kind == "dead channels":
        found[:] = 0
    else:
        found[:, 5] = np.nan
    assert levels_of(found) is None


STEP_HZ, EVERY_S = 0.2, 2.5
FREQUENCIES_HZ: FloatArray = np.linspace(3, 150, BINS)


def with_line(hz: float, size: float = 0.3, wander_hz: float = 0.0) -> ComplexArray:
    """One source, and in each channel a line of its own phase, of 30 times the noise that channels do not share."""
    found = segments(np.ones(SEGMENTS), sources=1)
    at_s = EVERY_S * np.arange(SEGMENTS)
    turns = hz * at_s + wander_hz * 47 / (2 * np.pi) * np.sin(2 * np.pi * at_s / 47)
    off = (FREQUENCIES_HZ - hz) / STEP_HZ
    lobe = np.sinc(off) / np.where(np.abs(np.abs(off) - 1) < 1e-9, 1.0, 1 - off**2)
    line = lobe[:, None, None] * np.exp(2j * np.pi * turns)[:, None] * np.exp(1j * np.array([0.0, 2.0, 4.0, 5.0]))
    return np.asarray(found + size * line, dtype=np.complex128)


def lines_of(found: ComplexArray, speed_hz: float = 22.0, known: Sequence[KnownLine] | None = ()) -> list[float]:
    lines = excluded_lines(found, summed(found), FREQUENCIES_HZ, 2 * np.pi * speed_hz, known)
    return [round(line.frequency_hz, 1) for line in lines]


@pytest.mark.parametrize("hz", [50.04, 59.93, 100.1, 149.97])
def test_mains_hum_is_found_though_no_channel_alone_shows_it(hz: float) -> None:
    found = with_line(hz, wander_hz=0.02)
    alone = np.abs(found[:, :, 0]) ** 2
    at = int(np.abs(FREQUENCIES_HZ - hz).argmin())
    assert alone[at].mean() < 8 * alone[at - 8 : at + 9].mean()
    assert lines_of(found) == [round(float(FREQUENCIES_HZ[at]), 1)]


def test_other_lines_are_left_out_where_the_healthy_machine_had_them() -> None:
    found = with_line(37.3)
    assert not lines_of(found)
    assert not lines_of(found, known=[(41.0, 41 / 22)])
    assert lines_of(found, known=None) == lines_of(found, known=[(37.2, 37.2 / 22)])
    assert lines_of(found, 20.0, [(41.0, 37.2 / 20)])  # it follows the speed, of a gear


def test_a_multiple_of_the_speed_is_no_hum_but_may_be_known() -> None:
    found = with_line(50.0)
    assert not lines_of(found, 25.0)
    assert lines_of(found, 25.0, [(50.0, 2.0)]) == lines_of(found, 25.0, None) == [50.0]
    assert not lines_of(found, 50.0, None)  # the rotation itself has regressors of its own
    assert not lines_of(found, np.nan)


def test_the_louder_a_line_the_further_it_reaches() -> None:
    faint, loud = (with_line(50.1, size) for size in (0.3, 30.0))
    (near,), (far,) = (excluded_lines(found, summed(found), FREQUENCIES_HZ, 138.0) for found in (faint, loud))
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
