"""A speed that varies slowly within the window: every parameter is read as at a steady one, e hop by hop."""

import pytest

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.readings import Diagnosis
from models.diagnosis.verdict.isolation import isolate_window
from simulator.scenario import Event
from tests.commissioning.rotor_kit import LAB, recording, stream

SEED = 900


def read(seed: int, ramp: float, *events: Event) -> Diagnosis:
    """A window of the rotor kit whose speed rises by a relative amount from start to end."""
    rpm = LAB.operation.speed_rpm
    rise = (
        Event(at_s=0.0, speed_rpm=rpm * (1 - ramp / 2)),
        Event(at_s=0.01, ramp_s=65.9, speed_rpm=rpm * (1 + ramp / 2)),
    )
    (window,) = recording(LAB, stream(66.0, seed, *rise, *events)).windows()
    assert window.removed_by_hop
    assert window.speed_range[1] > window.speed_range[0] * (1 + 0.8 * ramp)
    return LikelihoodFit(LAB).diagnose(window)


@pytest.mark.slow
@pytest.mark.parametrize("ramp", [pytest.param(0.05, marks=pytest.mark.long), 0.15])
def test_a_healthy_machine_reads_healthy(ramp: float) -> None:
    diagnosis = read(SEED, ramp)
    assert len(diagnosis.evaluable) == 6
    assert all(abs(reading.z or 99.0) < 4 for reading in diagnosis.evaluable)
    assert (diagnosis.misfit_z or 0.0) < 3


@pytest.mark.slow
@pytest.mark.parametrize(("name", "change"), [("e", 0.2), ("c_by", -0.2)])
def test_a_change_is_named_alone(name: str, change: float) -> None:
    diagnosis = read(SEED + 1, 0.1, Event(at_s=0.0, parameter=name, relative_change=change))
    assert isolate_window(diagnosis, 0.001).changed == (name,)
    reading = next(one for one in diagnosis.evaluable if one.name == name)
    assert reading.interval_95 is not None
    assert reading.relative_change == pytest.approx(change, abs=4 * (reading.standard_error or 0.0))
