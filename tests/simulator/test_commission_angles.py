"""A machine with probes at an angle is commissioned as one with probes in y and z, and its report names them."""

import json
from functools import cache
from pathlib import Path

import pytest

from models.commissioning.commission import Commissioning
from models.commissioning.healthy import HealthyRecording, healthy_from_blocks
from models.machine import Machine, MachineFile
from simulator.commission.page import JSON, write_report
from simulator.scenario import load_scenario
from simulator.stream import blocks
from tests.commissioning.rotor_kit import LAB, commissioned, mounted
from tests.sure import sure

TURNED = mounted(LAB, dict.fromkeys(("y1", "y2", "y1_dot", "y2_dot"), (45, 135)))


@cache
def kit(*, mounted: bool, full: bool) -> tuple[Commissioning, HealthyRecording, MachineFile]:
    machine: MachineFile = TURNED if mounted else LAB
    scenario, _ = load_scenario("healthy")
    sensors = scenario.sensors.model_copy(update={"noise_relative": 1e-6})
    scenario = scenario.model_copy(update={"duration_s": 100.0, "seed": 77_205, "sensors": sensors})
    assert isinstance(machine, Machine)
    stream = [(block, "") for block, _ in blocks(scenario, machine, 1.0)]
    if not full:
        without = machine.model_dump(exclude={"rotor", "operation", "condition"})
        machine = MachineFile.model_validate(without)
    recording = healthy_from_blocks("healthy.mcap", machine, stream)
    return commissioned(machine, recording), recording, machine


@pytest.mark.parametrize("full", [True, pytest.param(False, marks=pytest.mark.long)])
def test_probes_at_an_angle_are_commissioned_as_probes_in_y_and_z(
    full: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, *_ = kit(mounted=False, full=full)
    turned, recording, machine = kit(mounted=True, full=full)
    assert turned.report.verdict == plain.report.verdict != "refused"
    for one, other in zip(plain.report.parameters, turned.report.parameters, strict=True):
        assert other.name == one.name
        if one.window_error is None:
            assert other.window_error is None
        else:
            assert other.window_error == pytest.approx(one.window_error, rel=0.05)
    assert turned.commissioned is not None
    sensors = sure(turned.commissioned.sensors)
    assert {"bearing@45", "bearing@135_dot"} <= {one.state for one in sensors.channels}
    assert {(one.first, one.second) for one in sensors.pairs} >= {("disc@45", "disc@45_dot")}
    assert set(sure(turned.commissioned.levels).states[0].levels) == {one.name for one in LAB.sensors[:-1]}
    for picture in ("draw_readings", "draw_budget", "draw_levels"):  # they take long and name no channel
        monkeypatch.setattr(f"simulator.commission.page.{picture}", lambda *_: None)
    page = write_report(tmp_path, turned.report, [recording], machine=machine, commissioned=turned.commissioned)
    assert json.loads((tmp_path / JSON).read_text())["verdict"] == turned.report.verdict
    assert "bearing, at 135°, velocity" in page.read_text(encoding="utf-8")
