"""The tutorial: every command in it is run, and its statements about the rotor are checked."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.pins.pinned import differences
from tests.service.rig.preloaded import ran

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
_COMMANDS = [line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines() if line]
_PROGRAMS = {"rotorwatch": "service", "rotortrain": "simulator.rotortrain"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example's folder after all commands."""
    first, *commands = _COMMANDS
    assert first == "cd docs/examples/fe_rotor"
    place = tmp_path_factory.mktemp("tutorial") / "fe_rotor"
    shutil.copytree(ROOT / "docs" / "examples" / "fe_rotor", place, ignore=shutil.ignore_patterns("*.mcap"))
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    for command in commands:
        program, *arguments = command.split()
        if program in _PROGRAMS:
            found = ran(_PROGRAMS[program], *arguments, cwd=place, environment=variables)
        else:
            found = subprocess.run(
                [program, *arguments], cwd=place, env=variables, capture_output=True, text=True, check=False
            )
        assert found.returncode == 0, f"{command}: {found.stdout}{found.stderr}"
    return place


def messages(folder: Path, name: str, topic: str) -> list[dict[str, Any]]:
    lines = (folder / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
    return [entry["message"] for entry in map(json.loads, lines) if topic in entry["topic"]]


def full(folder: Path, name: str) -> list[dict[str, Any]]:
    return [report for report in messages(folder, name, "/report") if report["filled"] == 1.0]


def test_the_unseen_healthy_half_raises_no_alarm(folder: Path) -> None:
    found = full(folder, "healthy")
    assert len(found) > 15
    assert {report["state"] for report in found} == {"healthy"}
    assert not messages(folder, "healthy", "/alarm/event")
    assert all(not report["verdict"]["changed"] for report in found)


def test_the_changed_stiffness_is_named_alone_and_at_once(folder: Path) -> None:
    first, second, *rest = full(folder, "changed")
    named = [[finding["name"] for finding in report["verdict"]["changed"]] for report in (first, second, *rest)]
    assert named[1] == ["k_by"]
    assert all(names in ([], ["k_by"]) for names in named)
    for report in (second, *rest):
        by_name = {reading["name"]: reading for reading in report["parameters"]}
        low, high = by_name["k_by"]["interval_95"]
        assert low < high < -0.05
        assert abs(by_name["k_bz"]["z"]) < 3.5
        for name in ("c_by", "c_bz", "e"):  # where they are read at all
            assert abs(by_name[name]["z"] or 0.0) < 3.5, name
    (alarm,) = (one["data"] for one in messages(folder, "changed", "/alarm/event"))
    assert (alarm["name"], alarm["kind"]) == ("k_by", "raised")
    assert alarm["text"] in PAGE


@pytest.mark.parametrize("name", ["healthy", "changed"])
def test_the_output_of_the_tutorial_is_as_pinned(folder: Path, name: str) -> None:
    lines = (folder / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
    assert differences(f"tutorial_{name}", lines) == []


def test_the_page_quotes_the_results_of_the_commissioning(folder: Path) -> None:
    report = json.loads((folder / "bundle" / "report.json").read_text(encoding="utf-8"))
    assert (report["level"], report["verdict"]) == ("none", "limited")
    loss = {one["name"]: one["detectable_loss"] for one in report["parameters"]}
    assert loss["c_by"] is None
    assert f"{-loss['k_by']:.0%}".replace("%", " %") in PAGE
    assert (folder / "bundle" / "report.html").stat().st_size > 10_000
    assert (folder / "changed.png").stat().st_size > 10_000
    assert len((folder / "changed.csv").read_text(encoding="utf-8").splitlines()) > 10_000
