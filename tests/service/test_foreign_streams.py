"""Streams of something that is no such rotor: said to be outside the model, and no parameter is blamed."""

import pytest

from models.alarm_names import DATA, MODEL
from models.commissioning.commissioned import install
from models.machine import load_machine
from models.physics.rotor import PARAMETERS
from rotorwatch.records.alarms import EventKind
from rotorwatch.records.health import HealthState, Report
from service.monitor.monitor import MachineMonitor
from tests.service.foreign import FOREIGN, Foreign, as_blocks, foreign

DURATION_S = 74.0
SEED = 7_730_001


def watched(name: str, kind: Foreign, seed: int) -> tuple[list[Report], set[str]]:
    """Reports of full windows, and the alarms that were raised."""
    machine = load_machine(name)
    alarms = machine.alarms.model_copy(update={"on_delay_s": machine.window.hop_s})
    machine = machine.model_copy(update={"alarms": alarms})
    monitor = MachineMonitor(install(machine, None))
    windows, raised = [], set()
    for block in as_blocks(machine, foreign(machine, kind, seed, DURATION_S)):
        report = monitor.step(block)
        windows += [one for one in report.windows if one.filled == 1]
        raised |= {event.alarm.name for event in report.events if event.kind is EventKind.RAISED}
    return windows, raised


def judge(name: str, kind: Foreign, seed: int) -> None:
    windows, raised = watched(name, kind, seed)
    assert len(windows) >= 3
    assert not raised & set(PARAMETERS)
    assert raised
    assert all(alarm == MODEL or alarm.startswith(DATA) for alarm in raised)
    for window in windows:
        assert window.state not in {HealthState.HEALTHY, HealthState.DANGER}
        assert window.reason
        assert not window.suspect
        assert all(reading.relative_change is None for reading in window.parameters)
        assert window.verdict is None or not window.verdict.changed


@pytest.mark.parametrize("kind", FOREIGN)
def test_no_parameter_is_blamed_for_what_is_no_rotor(kind: Foreign) -> None:
    judge("lab", kind, SEED)


# One sine far from every mode of the lightly damped machine passes for the one resonance of a softer shaft.
CASES = [
    pytest.param(name, kind, marks=pytest.mark.slow if (name, kind) == ("light", "sines") else pytest.mark.long)
    for name in ("heavy", "light")
    for kind in FOREIGN
]


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_no_parameter_is_blamed_on_other_machines(name: str, kind: Foreign) -> None:
    judge(name, kind, SEED + 2)
