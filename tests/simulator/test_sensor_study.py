"""The study of sensors at fault, on a few windows."""

from pathlib import Path

import pytest

from models.commissioning.knowledge import KnowledgeLevel
from models.errors import MachineFileError
from simulator.campaigns.sensor_command import break_sensors
from simulator.campaigns.sensor_study import FAULTS, SensorPlan, run_sensors, sensor_cells
from simulator.campaigns.unknown_page import placed

SEED = 88


@pytest.mark.slow
@pytest.mark.long
def test_faults_are_found_and_not_taken_for_the_machines() -> None:
    plan = SensorPlan(("lab",), (KnowledgeLevel.FULL,), SEED, windows=2, healthy=2)
    records = run_sensors(plan, 1, lambda *_: None)
    assert len(records) == 2 * len(FAULTS)
    cells = {cell.fault: cell for cell in sensor_cells(records)}
    assert cells["healthy"].data_health.count == 0
    for fault in ("gain", "offset", "stuck", "clip", "swapped"):
        assert cells[fault].data_health.count == 2, fault
        assert cells[fault].claimed.count == 0, fault
    assert records == run_sensors(plan, 1, lambda *_: None)


def test_only_shipped_machines_and_pages_that_are_there(tmp_path: Path) -> None:
    with pytest.raises(MachineFileError, match="--machine pump: not among lab, heavy, light"):
        break_sensors(["pump"], tmp_path, windows=2, seed=1, processes=1)
    with pytest.raises(MachineFileError, match="no such page"):
        break_sensors(["lab"], tmp_path, windows=2, seed=1, processes=1, page=tmp_path / "none.md")


def test_a_section_replaces_its_own_and_no_other() -> None:
    page = "# Page\n\n<!-- a: begin -->\nold\n<!-- a: end -->\n\n<!-- b: begin -->\nkept\n<!-- b: end -->\n"
    new = placed(page, "<!-- a: begin -->\nnew\n<!-- a: end -->\n")
    assert "old" not in new
    assert "new" in new
    assert "kept" in new
    assert placed("# Page\n", "<!-- c: begin -->\nx\n<!-- c: end -->\n").endswith("x\n<!-- c: end -->\n")
