"""A few thousand messages that no machine sends, against a monitor that is at work."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.live import ROOT


@pytest.mark.slow
def test_a_monitor_at_work_bears_whatever_is_sent(tmp_path: Path) -> None:
    result = tmp_path / "result.json"
    ran = subprocess.run(
        [sys.executable, "benchmarks/wire_fuzz.py", "--small", "--json", str(result)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, f"{ran.stdout}\n{ran.stderr}"
    found = json.loads(result.read_text(encoding="utf-8"))
    assert found["messages"] == 3000
    assert len(found["kinds"]) == 10
    assert found["unsendable"] == 0
    assert found["others"]["demo/second"]["windows"] > 10
    assert sum(found["refused"].values()) > 100
