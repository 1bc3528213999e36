"""A rotor with the physical sense of gyroscopic moments, opposite to that of the theory's equations."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from models.commissioning.commissioned import Installed, in_sense
from models.machine import MachineFile
from models.physics.rotor import PARAMETERS, system_A
from models.signals.block import SampleBlock
from rotorwatch.records.health import HealthState
from service.monitor.evaluators import evaluator_for
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event
from tests.commissioning.rotor_kit import LAB, PARTIAL, blind, commissioned, recording, windows_of, without_angle
from tests.service.rig.watching import at_once, feed, resumed
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
    assert windows[-1].misfit_z is not None
    assert windows[-1].misfit_z < 4.0


@pytest.mark.parametrize("machine", [LAB, pytest.param(PARTIAL, marks=pytest.mark.long), blind(LAB)])
def test_commissioning_finds_the_sense(machine: MachineFile) -> None:
    """With a shaft angle, or without one, where the size of the unbalance is identified."""
    seen = stream(75.0, SEED + 2)
    seen = seen if "theta" in machine.descriptor.states else tuple(without_angle(seen))
    recorded = recording(machine, seen)
    made = commissioned(machine, recorded)
    assert made.commissioned is not None, made.report.summary
    assert made.commissioned.gyroscopic == "opposite"
    assert "rise with the speed" in made.report.notes[-1]
    known = Installed(machine, None, made.commissioned).known
    assert known is not None
    assert known.rotor.I2p_kg_m2 == -LAB.rotor.I2p_kg_m2
    (window,) = windows_of(recorded)
    assert evaluator_for(Installed(machine, None, made.commissioned)).evaluate(window).gyroscopic == "opposite"


def test_the_sense_is_found_despite_a_disturbance_in_the_first_window() -> None:
    disturbed = [
        replace(block, samples=block.samples * np.float32(4.0)) if 20 <= number < 60 else block
        for number, block in enumerate(stream(80.0, SEED))
    ]
    windows, events = feed(MachineMonitor(Installed(LAB)), disturbed)
    assert windows[-1].misfit_z is not None
    assert windows[-1].misfit_z < 4.0
    assert not [event.alarm.name for event in events if event.alarm.name in PARAMETERS]
