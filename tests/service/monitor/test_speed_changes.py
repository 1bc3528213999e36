"""A healthy machine with known parameters whose speed changes faster than its rotation can be removed."""

from functools import cache

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
from tests.service.rig.watching import at_once, feed
from tests.sure import sure

LAB = load_machine("lab")
RPM = LAB.operation.speed_rpm
WITHOUT_ANGLE = LAB.model_copy(update={"sensors": tuple(one for one in LAB.sensors if one.name != "theta")})


def watched(machine: Machine, moving: Machine, duration_s: float, change: Event) -> tuple[list[Report], set[str]]:
    """Reports, and alarms apart from levels, with one force, which shows residuals of the rotation best."""
    direction = np.array([[0.5, 0.7, 0.0, -0.4, 0.6, 0.0]])
    scenario = Scenario(
        machine="lab", seed=5_280_031, duration_s=duration_s, sources=sources_along(direction, 70.0, 0.3),
        sensors=Sensors(noise_relative=0.01, noise_corner_hz=300.0), events=(change,),
    )  # fmt: skip
    shown = [block for block, _ in blocks(scenario, moving)]
    windows, events = feed(MachineMonitor(Installed(machine)), shown)
    return windows, {event.alarm.name for event in events if not event.alarm.name.startswith(LEVEL)}


STEP = "% of nominal from one hop to the next, evaluation limit 1.4 %"


@pytest.mark.parametrize(
    ("machine", "duration_s", "change", "told"),
    [
        (LAB, 79.0, Event(at_s=65.0, speed_rpm=0.65 * RPM, ramp_s=14.0), [""]),  # switched off
        (LAB, 68.0, Event(at_s=63.5, speed_rpm=1.04 * RPM), [STEP]),
        (
            WITHOUT_ANGLE, 98.0, Event(at_s=65.0, speed_rpm=1.35 * RPM, ramp_s=30.0),
            ["5 of 12 hops, evaluation limit 50%", "the speed left 1056 to 1584 rpm"],
        ),
        pytest.param(
            WITHOUT_ANGLE, 95.0, Event(at_s=65.0, speed_rpm=0.3 * RPM, ramp_s=14.0),
            ["5 of 12 hops, evaluation limit 50%"], marks=pytest.mark.long,
        ),
    ],
)  # fmt: skip
def test_a_rotation_that_cannot_be_removed_is_not_evaluable_and_no_misfit(
    machine: Machine, duration_s: float, change: Event, told: list[str]
) -> None:
    windows, alarms = watched(at_once(machine), machine, duration_s, change)
    assert not alarms
    for text, window in zip(told, windows[-len(told) :], strict=True):
        assert window.state is HealthState.NOT_EVALUABLE
        assert text in window.reason


@pytest.mark.parametrize(
    ("machine", "to"), [pytest.param(WITHOUT_ANGLE, 0.97, marks=pytest.mark.long), (at_once(WITHOUT_ANGLE), 1.12)]
)
def test_without_a_phase_reference_a_drive_is_judged_at_each_set_point(machine: Machine, to: float) -> None:
    """While a window holds both, on the hops before or after the change; at 0.97 one window misfits at first."""
    change = Event(at_s=66.0, speed_rpm=to * RPM, ramp_s=3.0)
    windows, alarms = watched(machine, WITHOUT_ANGLE, 113.0, change)
    states = [window.state for window in windows if window.filled == 1.0]
    assert not alarms
    # Only later data show that the newest hop had a part of the change.
    assert states.count(HealthState.HEALTHY) >= len(states) - 1


def test_without_a_phase_reference_a_slight_ramp_is_no_misfit() -> None:
    change = Event(at_s=66.0, speed_rpm=0.992 * RPM, ramp_s=3.0)
    windows, alarms = watched(at_once(WITHOUT_ANGLE), WITHOUT_ANGLE, 83.0, change)
    assert not alarms
    assert {window.state for window in windows if window.filled == 1.0} == {HealthState.HEALTHY}


def test_without_a_phase_reference_a_ramp_is_no_delay_of_a_sensor() -> None:
    rotor = {
        "m1_kg": 22.1, "m2_kg": 18.3, "I2_kg_m2": 0.00321, "I2p_kg_m2": 0.00642, "shaft_length_m": 0.14,
        "shaft_diameter_m": 0.0226, "k_by_N_per_m": 1.6e5, "k_bz_N_per_m": 1.43e5, "c_by_N_s_per_m": 406.0,
        "c_bz_N_s_per_m": 499.0, "e_m": 4.16e-5,
    }  # fmt: skip
    machine = WITHOUT_ANGLE.model_copy(
        update={
            "rotor": LAB.rotor.model_copy(update=rotor),
            "operation": LAB.operation.model_copy(update={"speed_rpm": 2220.0}),
        }
    )
    change = Event(at_s=67.0, speed_rpm=1.02 * 2220.0, ramp_s=8.0)
    windows, alarms = watched(at_once(machine), machine, 83.0, change)
    assert not alarms
    assert not [fault for window in windows for fault in window.sensors]


def drive(seed: int, *events: Event, duration_s: float = 75.0) -> list[SampleBlock]:
    scenario = load_scenario("healthy")[0].model_copy(update={"seed": seed, "events": events, "duration_s": duration_s})
    return [block for block, _ in blocks(scenario, WITHOUT_ANGLE)]


@cache
def commissioned_at_both_speeds() -> Installed:
    machine = NOTHING.model_copy(update={"operation": LAB.operation, "sensors": WITHOUT_ANGLE.sensors})
    healthy = [
        recording(machine, drive(5_290_010 + n, Event(at_s=0.0, speed_rpm=part * RPM)), f"{n}.mcap")
        for n, part in enumerate((1.0, 1.15))
    ]
    return Installed(machine, None, sure(commissioned(machine, *healthy).commissioned))


def test_at_level_none_a_drive_is_judged_at_each_set_point() -> None:
    """A bearing that changes while the window holds both is still named."""
    changes = [Event(at_s=63.0, speed_rpm=1.15 * RPM, ramp_s=6.0), Event(at_s=120.0, speed_rpm=RPM)]
    changes += [Event(at_s=80.0, parameter="k_by", relative_change=-0.25)]
    monitor = MachineMonitor(commissioned_at_both_speeds())
    windows, events = feed(monitor, drive(5_290_020, *changes, duration_s=143.0))
    raised = {event.alarm.name for event in events if not event.alarm.name.startswith(LEVEL)}
    assert raised == {"k_by"}
    assert {window.state for window in windows if window.filled == 1.0} >= {HealthState.HEALTHY}
    assert all(window.speed_rad_s is not None for window in windows if window.filled == 1.0)


def test_without_a_phase_reference_another_rotor_is_outside_the_model() -> None:
    """At a steady speed, and once its rotation is lost."""
    other = LAB.rotor.model_copy(update={"m2_kg": 1.3 * LAB.rotor.m2_kg})
    moving = WITHOUT_ANGLE.model_copy(update={"rotor": other})
    _, alarms = watched(at_once(WITHOUT_ANGLE), moving, 73.0, Event(at_s=63.0, speed_rpm=1.05 * RPM))
    assert alarms == {MODEL}
