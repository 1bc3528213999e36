"""Levels of the segments of a window: what is a change of the load, and what is not."""

import numpy as np
import pytest

from models.diagnosis.window.moments import ComplexArray
from models.diagnosis.window.stationarity import segment_levels, summed
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
