"""The unbalance as a vector: size and direction of the change, and the number that alarms decide on."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.readings import UnbalanceVector
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window import WindowStatistics
from models.machine import load_machine
from rotorwatch.records.windows import Parameter
from simulator.training.draws import Draw, Layout, Purpose, simulate_window

SEED = 7_700_021
MACHINE = load_machine("lab")


@cache
def drawn(number: int, e: float = 0.0, layout: Layout = Layout.INDEPENDENT) -> WindowStatistics:
    return simulate_window(Draw(MACHINE, SEED, Purpose.EVALUATION, 0, faults={"e": e}, layout=layout), number)


def turned(window: WindowStatistics, degrees: float) -> WindowStatistics:
    """The same window with the heavy spot elsewhere: what turns with the shaft leads by that much more."""
    turn = np.exp(1j * np.radians(degrees))
    assert window.synchronous is not None
    assert window.hop_synchronous is not None
    return replace(window, synchronous=turn * window.synchronous, hop_synchronous=turn * window.hop_synchronous)


def e_of(window: WindowStatistics) -> tuple[Parameter, UnbalanceVector]:
    diagnosis = LikelihoodFit(MACHINE).diagnose(window)
    assert diagnosis.unbalance is not None
    return diagnosis.parameters[-1], diagnosis.unbalance


@pytest.mark.parametrize("degrees", [-170.0, -90.0, 40.0, 180.0])
@pytest.mark.parametrize("e", [-0.5, 0.0, 1.0])
def test_a_turned_heavy_spot_is_read_as_a_vector_and_never_below_nothing(degrees: float, e: float) -> None:
    reading, vector = e_of(turned(drawn(1, e), degrees))
    assert vector.magnitude_change == pytest.approx(e, abs=4.5 * vector.magnitude_error)
    assert vector.turned_deg is not None
    assert vector.turned_error_deg is not None
    apart = (vector.turned_deg - degrees + 180) % 360 - 180
    assert abs(apart) < 4.5 * vector.turned_error_deg + 0.5
    true = (1 + e) * np.exp(1j * np.radians(degrees)) - 1
    assert vector.change == pytest.approx(abs(true), abs=4.5 * vector.change_error + 0.01)
    assert reading.relative_change is not None
    assert reading.relative_change > -1
    # As much of a change as there is, or of the size where the turn is the lesser part of it.
    assert reading.relative_change == pytest.approx(
        abs(true) if abs(reading.relative_change - e) > 0.05 else e, abs=0.1
    )
    assert reading.interval_95 is not None
    assert reading.interval_95[0] >= -1


@pytest.mark.slow
def test_a_rotor_that_was_balanced_has_lost_its_unbalance_and_no_more() -> None:
    """The difference of two windows' vectors is their noise alone: which side of nothing it is on is chance."""
    draw = Draw(MACHINE, SEED, Purpose.EVALUATION, 0, layout=Layout.INDEPENDENT, fixed_condition=True)
    drawings = [simulate_window(draw, number) for number in range(5)]
    last = drawings.pop()
    for window in drawings:
        assert window.synchronous is not None
        assert last.synchronous is not None
        reading, vector = e_of(replace(window, synchronous=window.synchronous - last.synchronous))
        assert reading.relative_change is not None
        assert -1 < reading.relative_change < -0.8
        assert vector.turned_deg is None


def test_vectors_that_no_unbalance_makes_are_not_read_as_one() -> None:
    window = drawn(2)
    assert window.synchronous is not None
    foreign = np.abs(window.synchronous) * np.exp(1j * np.random.default_rng(5).uniform(0, 6, len(window.states)))
    diagnosis = LikelihoodFit(MACHINE).diagnose(replace(window, synchronous=foreign))
    vector = diagnosis.unbalance
    assert vector is not None
    assert "not what an unbalance makes" in vector.foreign
    verdict = isolate_window(diagnosis, 0.001)
    assert "e" not in verdict.changed
    assert not verdict.outside


@pytest.mark.slow
@pytest.mark.parametrize("layout", [Layout.ONE_SOURCE, pytest.param(Layout.INDEPENDENT, marks=pytest.mark.long)])
def test_the_parts_of_the_vector_have_honest_errors(layout: Layout) -> None:
    """Size and direction of 12 windows: rms of all 24 z within 1 + 4/√48, of each alone within 1 + 4/√24, but for a
    tenth.
    """
    z = []
    for number in range(12):
        _, vector = e_of(turned(drawn(100 + number, 0.3, layout), 60.0))
        assert vector.turned_deg is not None
        assert vector.turned_error_deg is not None
        z.append(
            (
                (vector.magnitude_change - 0.3) / vector.magnitude_error,
                (vector.turned_deg - 60) / vector.turned_error_deg,
            )
        )
    assert np.sqrt(np.mean(np.square(z))) < 1.7
    assert np.all(np.sqrt(np.mean(np.square(z), axis=0)) < 2.0)
    assert np.all(np.abs(np.mean(z, axis=0)) < 4 / np.sqrt(12) * 1.1)
