"""A known machine whose speed changes faster than its rotation can be taken out of the window: healthy all the same."""

from collections.abc import Sequence

import numpy as np
import pytest

from models.alarm_names import LEVEL, MODEL
from models.commissioning.commissioned import Installed
from models.machine import load_machine
from rotorwatch.records.health import HealthState, Report
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event, Scenario, Sensors
from simulator.stream import blocks
from tests.diagnosis.sensors.test_sensor_checks import sources_along
from tests.service.monitor.test_monitor import feed

LAB = load_machine("lab")
RPM = LAB.operation.speed_rpm


def watched(duration_s: float, change: Event) -> Sequence[Report]:
    """Full windows of a machine that one force shakes, which shows most of what is left of the rotation."""
    direction = np.array([[0.5, 0.7, 0.0, -0.4, 0.6, 0.0]])
    scenario = Scenario(
        machine="lab", seed=5_280_031, duration_s=duration_s, sources=sources_along(direction, 70.0, 0.3),
        sensors=Sensors(noise_relative=0.01, noise_corner_hz=300.0), events=(change,),
    )  # fmt: skip
    windows, events = feed(MachineMonitor(Installed(LAB, None)), [block for block, _ in blocks(scenario, LAB)])
    assert not [event for event in events if not event.alarm.name.startswith(LEVEL)]
    return [window for window in windows if window.filled == 1.0]


def test_a_machine_that_is_switched_off_raises_nothing_that_nobody_could_clear() -> None:
    last = watched(79.0, Event(at_s=65.0, speed_rpm=0.65 * RPM, ramp_s=14.0))[-2:]
    assert {window.state for window in last} == {HealthState.NOT_EVALUABLE}


@pytest.mark.parametrize("to", [1.04, 0.95])
def test_a_step_of_the_speed_is_no_misfit(to: float) -> None:
    last = watched(75.0, Event(at_s=66.0, speed_rpm=to * RPM))[-1]
    assert last.state is HealthState.NOT_EVALUABLE
    assert "% of nominal from one hop to the next, evaluation limit 1.4 %" in last.reason


def test_without_a_phase_reference_what_does_not_fit_is_outside_the_model() -> None:
    """Speeds that are estimated, or unknown in some hops, have no steps."""
    without = LAB.model_copy(update={"sensors": tuple(one for one in LAB.sensors if one.quantity != "shaft_angle")})
    other = without.rotor.model_copy(update={"m2_kg": 1.3 * without.rotor.m2_kg})
    scenario = Scenario(
        machine="lab", seed=5_280_032, duration_s=75.0,
        sources=sources_along(np.array([[0.5, 0.7, 0.0, -0.4, 0.6, 0.0]]), 70.0, 0.3),
        sensors=Sensors(noise_relative=0.01, noise_corner_hz=300.0), events=(Event(at_s=66.0, speed_rpm=1.05 * RPM),),
    )  # fmt: skip
    stream = blocks(scenario, without.model_copy(update={"rotor": other}))
    windows, events = feed(MachineMonitor(Installed(without, None)), [block for block, _ in stream])
    assert {event.alarm.name for event in events} == {MODEL}
    assert "from one hop to the next" not in windows[-1].reason
