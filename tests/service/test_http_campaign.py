"""Slow, silent and too many callers of every kind, a few dozen of each, against a monitor with few files to open."""

import subprocess
import sys

from tests.service.live import ROOT


def test_a_monitor_at_work_bears_callers_of_every_kind() -> None:
    ran = subprocess.run(
        [sys.executable, "benchmarks/http_campaign.py", "--small"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, f"{ran.stdout}\n{ran.stderr}"
    assert ran.stdout.count("\n| ") == 6
