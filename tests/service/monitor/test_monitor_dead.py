"""A machine with known parameters is diagnosed without its dead sensors."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from models.commissioning.commissioned import Installed, install
from models.diagnosis.window.moments import plan_for
from models.physics.rotor import PARAMETERS
from models.signals.block import SampleBlock
from rotorwatch.records.health import HealthState
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event, parse_fault
from tests.commissioning.rotor_kit import commissioned, factored, recording, with_sensors
from tests.service.rig.live import LAB, scenario_blocks
from tests.service.rig.watching import feed, held, raised, resumed
from tests.sure import sure

KIT = LAB.model_copy(update={"window": LAB.window.model_copy(update={"length_s": 30.0, "max_span_s": 60.0})})
DEAD_S, CHANGE_S, END_S = 35.0, 50.0, 83.0


def dying(
    columns: list[int], value: float, *changes: Event, dead_s: float = DEAD_S, end_s: float = END_S
) -> list[SampleBlock]:
    return held(scenario_blocks(end_s, *changes), columns, value, dead_s)


@pytest.mark.parametrize(("columns", "value"), [([0], 12e-6), pytest.param([2, 5], np.nan, marks=pytest.mark.long)])
def test_a_change_is_named_without_the_dead_sensors(columns: list[int], value: float) -> None:
    installed = install(KIT, None)
    monitor = MachineMonitor(installed, remembered=True)
    stream = dying(columns, value, parse_fault(f"k_by=-0.2@{CHANGE_S}"))
    reports, _ = feed(monitor, stream[:495])
    dead = [one for one in reports if one.filled == 1 and one.sensors]
    assert len(dead) == 3
    assert {one.state for one in dead[2:]} == {HealthState.DATA_HEALTH}
    for report in dead:
        assert "nothing has changed" in sure(report.verdict).text
        assert None not in {one.relative_change for one in report.parameters}
        assert all(one.text.endswith("; the machine is diagnosed without it") for one in report.sensors)
    again = resumed(monitor, installed, remembered=True)
    (reports, _), (same, _) = feed(monitor, stream[495:]), feed(again, stream[495:650])
    assert same == reports[:3]
    assert sure(monitor.window)().lines == ()  # the rounding noise of a dead channel has lines anywhere
    assert {name for name in raised(monitor) if not name.startswith("data-")} == {"k_by"}
    change = {one.name: one for one in reports[-1].parameters}["k_by"]
    assert abs((change.relative_change or 0.0) + 0.2) < 4 * (change.standard_error or 0.0) < 0.1


@pytest.mark.parametrize("columns", [[0, 1, 2, 3], [0, 8]])
def test_nothing_is_read_if_half_of_the_sensors_or_the_shaft_angle_is_dead(columns: list[int]) -> None:
    reports, _ = feed(MachineMonitor(install(KIT, None)), dying(columns, np.nan, end_s=55.0))
    dead = [one for one in reports if one.filled == 1 and one.sensors]
    assert len(dead) == 4
    assert not any(one.parameters for one in dead)
    assert dead[-1].reason == "; ".join(one.text for one in dead[-1].sensors)


@pytest.mark.parametrize("why", ["this computer cannot keep up", "off 1980 rpm"])
def test_a_dead_sensor_keeps_state_data_health_when_windows_are_not_evaluated(why: str) -> None:
    skips, speed = "keep up" in why, LAB.operation.speed_rpm
    fast = LAB.operation.model_copy(update={"speed_rpm": speed if skips else 1.5 * speed})
    installed = install(KIT.model_copy(update={"operation": fast}), None)
    reports, _ = feed(MachineMonitor(installed, lambda _: skips), dying([0], np.nan, end_s=55.0))
    dead = [one for one in reports if one.filled == 1 and one.sensors]
    assert len(dead) == 4
    assert {one.state for one in dead} == {HealthState.DATA_HEALTH}
    assert all(why in one.reason for one in dead)
    assert not (skips and any("is diagnosed" in fault.text for one in dead for fault in one.sensors))


def test_a_dead_sensor_is_not_a_suspect_for_a_misfit() -> None:
    heavier = Event(at_s=0.0, anomaly="added_mass", size=0.25)
    reports, _ = feed(MachineMonitor(install(KIT, None)), dying([0], 500.0, heavier, dead_s=31.0, end_s=38.0))
    suspects = {one.suspect for one in reports if one.filled == 1 and one.sensors}
    assert suspects - {""}
    assert not any(suspect.startswith("y1 ") for suspect in suspects)


@cache
def identified() -> Installed:
    return Installed(KIT, None, commissioned(KIT, recording(KIT, scenario_blocks(END_S)[:700])).commissioned)


def test_an_identified_machine_is_diagnosed_without_a_dead_sensor() -> None:
    monitor = MachineMonitor(identified())
    reports, _ = feed(monitor, dying([1], np.nan, end_s=68.0))
    assert {one.state for one in reports[-6:]} == {HealthState.DATA_HEALTH}
    assert raised(monitor) == {"data-missing"}
    assert [one.name for one in reports[-1].parameters if one.relative_change is not None] == list(PARAMETERS)


@pytest.mark.parametrize(
    "gains",
    [
        {"y1": 1.03},
        *(pytest.param(one, marks=pytest.mark.long) for one in ({"y1_dot": 0.97}, {"y2": 0.96, "z1_dot": 0.96})),
    ],
)
def test_a_change_is_named_although_a_gain_has_drifted(gains: dict[str, float]) -> None:
    """Without the one of two sensors that has drifted, the theory explains the window."""
    monitor = MachineMonitor(identified(), remembered=True)
    stream = factored(KIT, scenario_blocks(103.0, parse_fault("k_by=-0.2@70"))[300:], **gains)
    reports, _ = feed(monitor, stream[:395])
    full = [one for one in reports if one.filled == 1]
    assert len(full) == 2
    assert {one.state for one in full} == {HealthState.DATA_HEALTH}
    assert all("is diagnosed without " in fault.text for one in full for fault in one.sensors)
    again = resumed(monitor, identified(), remembered=True)
    (reports, _), (same, _) = feed(monitor, stream[395:]), feed(again, stream[395:550])
    assert same == reports[:3]
    assert raised(monitor) == {"data-gain", "k_by"}
    for reading in reports[-1].parameters:
        change = sure(reading.relative_change) + 0.2 * (reading.name == "k_by")
        assert abs(change) < 4 * sure(reading.standard_error) < 0.1


def test_errors_are_larger_where_the_theory_does_not_tell_which_gain_has_drifted() -> None:
    """At the bearing alone, a gain of both sensors in one plane reads as forces, and an unbalance, of another size."""
    machine, healthy = with_sensors(KIT, scenario_blocks(END_S)[:700], lambda sensor: sensor.location != "disc")
    installed = Installed(machine, None, commissioned(machine, recording(machine, healthy)).commissioned)
    read = []
    for gain in (1.0, 1.05):
        reports, _ = feed(monitor := MachineMonitor(installed), factored(machine, healthy[:450], y1=gain))
        assert raised(monitor) == ({"data-gain"} if gain > 1 else set())
        read.append(next(one for one in reports[-2].parameters if one.name == "e"))
    (before, plain), (now, wide) = ((sure(one.relative_change), sure(one.standard_error)) for one in read)
    assert 0.01 < abs(now - before) < 2 * (wide**2 - plain**2) ** 0.5


def test_without_one_of_two_angled_probes_both_planes_are_left_out() -> None:
    plan = plan_for(LAB)
    assert plan.states_without(["z1"]) == tuple(state for state in plan.states if state != "z1")
    turn = np.eye(len(plan.states))
    turn[np.ix_([0, 1], [0, 1])] = [[1, 1], [-1, 1]]
    angled = replace(plan, turn=turn, angled=("bearing@45", "bearing@135", *plan.states[2:]))
    assert angled.states_without(["bearing@135"]) == plan.states[2:]
    assert angled.states_without([plan.states[3]]) == (*plan.states[:3], *plan.states[4:])
