"""A known machine whose speed changes faster than its rotation can be taken out of the window: healthy all the same."""

import numpy as np
import pytest

from models.alarm_names import LEVEL, MODEL
from models.commissioning.commissioned import Installed
from models.machine import Machine, load_machine
from models.signals.block import SampleBlock
from rotorwatch.records.health import HealthState, Report
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event, Scenario, Sensors, load_scenario
from simulator.stream import blocks
from tests.commissioning.rotor_kit import NOTHING, commissioned, recording
from tests.diagnosis.sensors.test_sensor_checks import sources_along
from tests.service.rig.watching import feed
from tests.sure import sure

LAB = load_machine("lab")
RPM = LAB.operation.speed_rpm
WITHOUT_ANGLE = LAB.model_copy(update={"sensors": tuple(one for one in LAB.sensors if one.name != "theta")})


def watched(machine: Machine, moving: Machine, duration_s: float, change: Event) -> tuple[list[Report], set[str]]:
    """Reports, and alarms apart from levels, of one force, which shows most of what is left of the rotation."""
    direction = np.array([[0.5, 0.7, 0.0, -0.4, 0.6, 0.0]])
    scenario = Scenario(
        machine="lab", seed=5_280_031, duration_s=duration_s, sources=sources_along(direction, 70.0, 0.3),
        sensors=Sensors(noise_relative=0.01, noise_corner_hz=300.0), events=(change,),
    )  # fmt: skip
    windows, events = feed(MachineMonitor(Installed(machine, None)), [block for block, _ in blocks(scenario, moving)])
    return windows, {event.alarm.name for event in events if not event.alarm.name.startswith(LEVEL)}


def test_a_machine_that_is_switched_off_raises_nothing_that_nobody_could_clear() -> None:
    windows, alarms = watched(LAB, LAB, 79.0, Event(at_s=65.0, speed_rpm=0.65 * RPM, ramp_s=14.0))
    assert ({window.state for window in windows[-2:]}, alarms) == ({HealthState.NOT_EVALUABLE}, set())


@pytest.mark.parametrize("to", [1.04, 0.95])
def test_a_step_of_the_speed_is_no_misfit(to: float) -> None:
    windows, alarms = watched(LAB, LAB, 75.0, Event(at_s=66.0, speed_rpm=to * RPM))
    assert (windows[-1].state, alarms) == (HealthState.NOT_EVALUABLE, set())
    assert "% of nominal from one hop to the next, evaluation limit 1.4 %" in windows[-1].reason


@pytest.mark.parametrize(
    "change", [Event(at_s=65.0, speed_rpm=1.35 * RPM, ramp_s=40.0), Event(at_s=65.0, speed_rpm=0.3 * RPM, ramp_s=14.0)]
)
def test_without_a_phase_reference_a_rotation_that_was_lost_is_no_misfit(change: Event) -> None:
    windows, alarms = watched(WITHOUT_ANGLE, WITHOUT_ANGLE, 130.0 if change.ramp_s > 30 else 95.0, change)
    assert (windows[-1].state, alarms) == (HealthState.NOT_EVALUABLE, set())
    told = "of 12 hops, evaluation limit all of them: the speed left 1056 to 1584 rpm"
    assert told in windows[-1].reason or "steady in 5 of 12 hops, evaluation limit 50%" in windows[-1].reason


@pytest.mark.parametrize("to", [0.97, 1.12])
def test_without_a_phase_reference_a_drive_is_judged_at_each_set_point(to: float) -> None:
    """While a window holds both, on the hops before and after the change."""
    change = Event(at_s=66.0, speed_rpm=to * RPM, ramp_s=3.0)
    windows, alarms = watched(WITHOUT_ANGLE, WITHOUT_ANGLE, 130.0, change)
    states = [window.state for window in windows if window.filled == 1.0]
    assert not alarms
    # Only what comes after it tells that the newest hop had a part of the change.
    assert states.count(HealthState.HEALTHY) >= len(states) - 1


@pytest.mark.parametrize("parameter", ["", "k_by"])
def test_at_level_none_a_drive_is_judged_at_each_set_point(parameter: str) -> None:
    """Commissioned at both; a bearing that changes while the window holds both is named all the same."""
    machine = NOTHING.model_copy(update={"operation": LAB.operation, "sensors": WITHOUT_ANGLE.sensors})
    scenario = load_scenario("healthy")[0].overridden(duration_s=100.0)

    def stream(seed: int, *events: Event, duration_s: float = 130.0) -> list[SampleBlock]:
        changes = {"seed": seed, "events": events, "duration_s": duration_s}
        return [block for block, _ in blocks(scenario.model_copy(update=changes), WITHOUT_ANGLE)]

    speeds = (Event(at_s=0.0, speed_rpm=part * RPM) for part in (1.0, 1.15))
    healthy = [recording(machine, stream(5_290_010 + n, one), f"{n}.mcap") for n, one in enumerate(speeds)]
    made = sure(commissioned(machine, *healthy).commissioned)
    changes = [Event(at_s=67.0, speed_rpm=1.15 * RPM, ramp_s=6.0), Event(at_s=170.0, speed_rpm=RPM)]
    changes += [Event(at_s=100.0, parameter=parameter, relative_change=-0.25)] if parameter else []
    monitor = MachineMonitor(Installed(machine, None, made))
    windows, events = feed(monitor, stream(5_290_020, *changes, duration_s=225.0))
    raised = {event.alarm.name for event in events if not event.alarm.name.startswith(LEVEL)}
    assert raised == ({parameter} if parameter else set())
    assert {window.state for window in windows if window.filled == 1.0} >= {HealthState.HEALTHY}
    assert all(window.speed_rad_s is not None for window in windows if window.filled == 1.0)


def test_without_a_phase_reference_another_rotor_is_outside_the_model() -> None:
    """At a steady speed, and once its rotation is lost."""
    other = LAB.rotor.model_copy(update={"m2_kg": 1.3 * LAB.rotor.m2_kg})
    moving = WITHOUT_ANGLE.model_copy(update={"rotor": other})
    _, alarms = watched(WITHOUT_ANGLE, moving, 95.0, Event(at_s=86.0, speed_rpm=1.05 * RPM))
    assert alarms == {MODEL}
