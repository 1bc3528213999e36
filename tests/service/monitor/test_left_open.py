"""What a machine file leaves open: the sense of its gyroscopic moments, and the angle of its heavy spot.

The physical sense of gyroscopic moments is opposite to that of the theory's equations.
"""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from models.commissioning.commissioned import Installed, in_sense
from models.machine import Machine, MachineFile, load_machine_file
from models.physics.rotor import PARAMETERS, system_A
from models.signals.block import SampleBlock
from rotorwatch.records.health import HealthState
from rotorwatch.records.windows import Parameter
from service.monitor.evaluators import evaluator_for
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event
from tests.commissioning.rotor_kit import LAB, PARTIAL, blind, commissioned, recording, windows_of, without_angle
from tests.service.rig.watching import at_once, feed, named, resumed
from tests.sure import sure
from tests.windows import healthy_blocks

SEED = 4_900_001


@cache
def stream(duration_s: float, seed: int, *events: Event) -> tuple[SampleBlock, ...]:
    return healthy_blocks(in_sense(LAB, "opposite"), duration_s, seed, *events)


def test_forward_whirl_rises_with_speed_only_in_the_opposite_sense() -> None:
    """Physically, the frequency of forward whirl, from y to z, rises with speed; with equal y and z it is a circle."""
    forward: dict[float, list[float]] = {}
    for machine in (LAB, in_sense(LAB, "opposite")):
        rotor = machine.rotor.model_copy(update={"k_bz_N_per_m": machine.rotor.k_by_N_per_m})
        rotor = rotor.model_copy(update={"c_by_N_s_per_m": 1e-3, "c_bz_N_s_per_m": 1e-3})
        for speed_rad_s in (1.0, 300.0):
            roots, shapes = np.linalg.eig(system_A(rotor, speed_rad_s))
            turning = [root.imag for root, shape in zip(roots, shapes.T, strict=True) if (shape[4] / shape[1]).imag < 0]
            forward.setdefault(rotor.I2p_kg_m2, []).append(max(turning))
    assert forward[LAB.rotor.I2p_kg_m2][1] < forward[LAB.rotor.I2p_kg_m2][0]
    assert forward[-LAB.rotor.I2p_kg_m2][1] > forward[-LAB.rotor.I2p_kg_m2][0]


def test_a_healthy_machine_of_the_opposite_sense_is_healthy() -> None:
    installed = Installed(at_once(LAB))
    going = MachineMonitor(installed)
    windows, events = feed(going, stream(75.0, SEED)[:700])
    assert not events
    full = [window for window in windows if window.filled == 1.0]
    assert {window.state for window in full} == {HealthState.HEALTHY}
    assert max(abs(one.relative_change or 0.0) for one in full[-1].parameters) < 0.05
    assert {window.gyroscopic for window in full} == {"opposite"}
    assert '"gyroscopic":"opposite"' in full[-1].model_dump_json()
    rest = stream(75.0, SEED)[700:]
    assert feed(resumed(going, installed), rest) == feed(going, rest)


def test_a_change_from_the_beginning_is_named_in_the_opposite_sense() -> None:
    softer = Event(at_s=0.0, parameter="k_by", relative_change=-0.2)
    windows, events = feed(MachineMonitor(Installed(at_once(LAB))), stream(70.0, SEED + 1, softer))
    assert [event.alarm.name for event in events if not event.alarm.name.startswith("level:")] == ["k_by"]
    assert sure(windows[-1].misfit_z) < 4.0


@pytest.mark.parametrize("machine", [LAB, pytest.param(PARTIAL, marks=pytest.mark.long), blind(LAB)])
def test_commissioning_finds_the_sense(machine: MachineFile) -> None:
    """With a shaft angle, or without one, where the size of the unbalance is identified."""
    seen = stream(75.0, SEED + 2)
    seen = seen if "theta" in machine.descriptor.states else tuple(without_angle(seen))
    recorded = recording(machine, seen)
    made = commissioned(machine, recorded)
    installed = Installed(machine, None, sure(made.commissioned))
    assert sure(made.commissioned).gyroscopic == "opposite"
    assert "rise with the speed" in made.report.notes[-1]
    assert sure(installed.known).rotor.I2p_kg_m2 == -LAB.rotor.I2p_kg_m2
    (window,) = windows_of(recorded)
    assert evaluator_for(installed).evaluate(window).gyroscopic == "opposite"


def test_the_sense_is_found_despite_a_disturbance_in_the_first_window() -> None:
    disturbed = [
        replace(block, samples=block.samples * np.float32(4.0)) if 20 <= number < 60 else block
        for number, block in enumerate(stream(80.0, SEED))
    ]
    windows, events = feed(MachineMonitor(Installed(LAB)), disturbed)
    assert sure(windows[-1].misfit_z) < 4.0
    assert not [event.alarm.name for event in events if event.alarm.name in PARAMETERS]


def with_heavy_spot(phase_rad: float) -> Machine:
    operation = LAB.operation.model_copy(update={"unbalance_phase_rad": phase_rad})
    return LAB.model_copy(update={"operation": operation})


@cache
def spotted(duration_s: float, phase_rad: float, *events: Event) -> tuple[SampleBlock, ...]:
    return healthy_blocks(with_heavy_spot(phase_rad), duration_s, 4_910_001, *events)


def e_of(parameters: tuple[Parameter, ...]) -> float:
    (found,) = (one.relative_change for one in parameters if one.name == "e")
    return sure(found)


@pytest.mark.parametrize(
    ("phase_rad", "angle", "backward"),
    [
        (2.5, True, False),
        (2.5, False, True),
        *(pytest.param(*one, False, marks=pytest.mark.long) for one in ((0.15, True), (2.5, False))),
    ],
)
def test_without_an_unbalance_phase_in_the_file_any_heavy_spot_angle_is_healthy(
    phase_rad: float, angle: bool, backward: bool
) -> None:
    """With a shaft angle or without, after a restart, in either sense of rotation; a mirror image turns backwards."""
    sensors = tuple(one for one in LAB.sensors if angle or one.name != "theta")
    mirror = np.array([-1.0 if backward and one.direction == "z" else 1.0 for one in sensors], dtype=np.float32)
    larger = Event(at_s=45.0, parameter="e", relative_change=0.5)
    parts = [replace(one, samples=one.samples[:, : len(sensors)] * mirror) for one in spotted(80.0, phase_rad, larger)]
    shorter = LAB.window.model_copy(update={"length_s": 30.0, "max_span_s": 60.0})
    installed = Installed(LAB.model_copy(update={"sensors": sensors, "window": shorter}))
    going = MachineMonitor(installed)
    windows, events = feed(going, parts[:430])
    assert not events
    assert abs(e_of(windows[-1].parameters)) < 0.05
    windows, events = feed(resumed(going, installed), parts[430:])
    assert [name for kind, name in named(events) if kind == "raised"] == ["e"]
    assert e_of(windows[-1].parameters) == pytest.approx(0.5, abs=0.1)
    assert angle or all(one.vector is None for one in windows[-1].parameters)  # which needs an angle


def test_with_an_unbalance_phase_in_the_file_another_angle_is_a_change() -> None:
    windows, events = feed(MachineMonitor(Installed(at_once(with_heavy_spot(0.0)))), spotted(63.0, 2.5))
    assert [(event.alarm.name, event.alarm.severity) for event in events] == [("e", "alert")]  # its size is as before
    assert "turned by 143°: the heavy spot has moved, or the zero of the shaft angle" in events[0].text
    assert e_of(windows[-1].parameters) == pytest.approx(2 * math.sin(2.5 / 2), abs=0.1)


def test_loading_a_file_keeps_whether_the_unbalance_phase_was_set() -> None:
    given = "unbalance_phase_rad"
    assert given not in LAB.operation.model_fields_set
    assert given not in load_machine_file("lab").operation.model_fields_set  # type: ignore[union-attr]
    said = load_machine_file("lab", "[operation]\nspeed_rpm = 1320.0\nunbalance_phase_rad = 0.0\n")
    assert isinstance(said, Machine)
    assert given in said.operation.model_fields_set
