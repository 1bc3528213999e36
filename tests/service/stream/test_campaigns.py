"""Fuzzing a monitor at work: a few thousand hostile messages, and some dozens of HTTP callers."""

import importlib
import json
import sys
import tempfile
from pathlib import Path

import pytest

from tests.service.rig.live import ROOT
from tests.service.rig.preloaded import Preloaded


def started(arguments: list[str], out: Path, err: Path, environment: dict[str, str]) -> Preloaded:
    out.touch()
    err.touch()
    return Preloaded(tuple(arguments), ROOT, out, err, environment)


@pytest.fixture(autouse=True)
def _programs_start_at_once_and_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    monkeypatch.setattr(importlib.import_module("running_monitor"), "started", started)


@pytest.mark.long
def test_a_monitor_survives_hostile_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = tmp_path / "result.json"
    monkeypatch.setattr(sys, "argv", ["wire_fuzz", "--small", "--json", str(result)])
    assert importlib.import_module("wire_fuzz").main() == 0, capsys.readouterr()
    found = json.loads(result.read_text(encoding="utf-8"))
    assert (found["messages"], len(found["kinds"]), found["unsendable"]) == (3000, 10, 0)
    second = found["others"]["demo/second"]
    assert second["windows"] > max(5, second["accepted"] // 15)
    assert sum(found["refused"].values()) > 100


@pytest.mark.long
def test_a_monitor_survives_http_misuse(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["http_campaign", "--small"])
    code = importlib.import_module("http_campaign").main()
    said = capsys.readouterr().out
    assert code == 0, said
    assert said.count("\n| ") == 6
