"""A heavy spot at another angle than assumed, with and without its angle in the machine file."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from models.commissioning.commissioned import Installed
from models.machine import Machine, load_machine, load_machine_file
from models.signals.block import SampleBlock
from rotorwatch.records.windows import Parameter
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event
from tests.service.rig.watching import at_once, feed, named, resumed
from tests.windows import healthy_blocks

LAB = load_machine("lab")
SEED = 4_910_001


def with_heavy_spot(phase_rad: float) -> Machine:
    operation = LAB.operation.model_copy(update={"unbalance_phase_rad": phase_rad})
    return LAB.model_copy(update={"operation": operation})


@cache
def stream(duration_s: float, phase_rad: float, *events: Event) -> tuple[SampleBlock, ...]:
    return healthy_blocks(with_heavy_spot(phase_rad), duration_s, SEED, *events)


def e_of(parameters: tuple[Parameter, ...]) -> float:
    (found,) = (one.relative_change for one in parameters if one.name == "e")
    assert found is not None
    return found


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
    parts = [replace(one, samples=one.samples[:, : len(sensors)] * mirror) for one in stream(80.0, phase_rad, larger)]
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
    windows, events = feed(MachineMonitor(Installed(at_once(with_heavy_spot(0.0)))), stream(63.0, 2.5))
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
