"""The commands report five scenarios as before, from a simulated recording to lines of JSON."""

from pathlib import Path

import pytest

from tests.pins.pinned import differences
from tests.service.rig.preloaded import ran

FURTHER = (pytest.param(change, marks=pytest.mark.long) for change in ("c_by=0.4", "k_bz=-0.2"))
CHANGES = ("healthy", "k_by=-0.25", "e=0.5", *FURTHER)


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES)
def test_a_scenario_is_reported_as_pinned(change: str, tmp_path: Path) -> None:
    name = change.partition("=")[0]
    fault = () if change == "healthy" else ("--fault", f"{change}@62")
    recording, lines = tmp_path / "stream.mcap", tmp_path / "lines.jsonl"
    made = ran("simulator.rotorsim", "record", "healthy", recording, "--duration", "85", "--seed", "881", *fault)
    assert made.returncode == 0, made.stderr
    found = ran("service", "replay", recording, "--offline", "--machine", "lab@lab", "--out", lines)
    assert found.returncode == 0, found.stderr
    assert differences(name, lines.read_text(encoding="utf-8").splitlines()) == []
