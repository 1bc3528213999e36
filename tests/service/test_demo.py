"""The main job as a stranger runs it: separate programs on loopback, faults and seeds that training never saw."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from service.demo import Outcome
from tests.service.live import endpoint

ROOT = Path(__file__).parents[2]


def start(*arguments: str, cwd: Path = ROOT) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=cwd
    )


def children_of(pid: int) -> list[int]:
    """Processes whose parent is `pid`."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it ended meanwhile
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "seed"), [("k_by", 101), ("c_by", 102), ("k_bz", 103), ("c_bz", 104), ("e", 105)])
def test_the_demo_names_exactly_the_injected_fault(fault: str, seed: int) -> None:
    process = start("service.rotorwatch", "demo", "--fault", fault, "--seed", str(seed), "--pace", "20", "--once")
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    assert re.search(rf"ALERT: .*\({fault}\) changed by", output)
    assert f"/alarms: {fault} raised" in output
    assert "demo passed" in output
    assert output.count(" healthy ") >= 10  # one line per window, the healthy stretch among them


@pytest.mark.slow
def test_interrupting_the_demo_leaves_no_process_behind() -> None:
    process = start("service.rotorwatch", "demo", "--pace", "5")
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if "warming" in line:
            break
    children = children_of(process.pid)
    assert len(children) == 2, lines  # simulator and monitor
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode == 130
    for child in children:
        with pytest.raises(ProcessLookupError):
            os.kill(child, 0)


def test_an_unknown_fault_is_an_error_with_the_reason() -> None:
    process = start("service.rotorwatch", "demo", "--fault", "k11", "--once")
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 1
    assert "the simulator ended with exit code 2" in output
    assert "k11" in output
    assert "Traceback" not in output


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_healthy_hour_at_full_speed_raises_nothing_and_loses_nothing(tmp_path: Path) -> None:
    """An hour over Zenoh, as fast as the monitor takes it; the publisher waits for the monitor, so no block is lost."""
    settings = tmp_path / "batch.toml"
    settings.write_text(
        '[http]\nport = 0\n[access]\nopen_on_loopback = true\n[history]\nurl = "sqlite:///history.sqlite"\n'
        '[queue]\nwhen_full = "wait"\n[[machines]]\nfile = "lab"\nbundle = "lab"\n',
        encoding="utf-8",
    )
    where = endpoint()
    monitor = start("service.rotorwatch", "run", "--config", str(settings), "--listen", where)
    simulator = None
    try:
        assert monitor.stdout is not None
        url = next(line for line in monitor.stdout if line.startswith("HTTP API")).split()[-1]
        simulator = start(
            "simulator.rotorsim", "publish", "healthy", "--seed", "106", "--pace", "max", "--connect", where,
            "--wait-for-subscriber", "60",
        )  # fmt: skip
        output, _ = simulator.communicate(timeout=840)
        assert simulator.returncode == 0, output
        base = f"{url}/api/v1/machines/demo/lab"
        deadline = time.monotonic() + 180
        while (health := httpx.get(f"{base}/health", timeout=180.0).json())["quality"]["accepted_blocks"] < 36_000:
            assert time.monotonic() < deadline, health["quality"]
            time.sleep(0.2)
        quality = health["quality"]
        assert (quality["refused_blocks"], quality["gaps"], quality["queue_dropped_blocks"]) == ({}, 0, 0)
        reports = httpx.get(f"{base}/reports", params={"limit": 1000}, timeout=180.0).json()["reports"]
        assert [report["state"] for report in reports].count("healthy") == 708
        events = httpx.get(f"{base}/alarms/events", timeout=180.0).json()["events"]
        assert [one["data"]["name"] for one in events] in ([], ["stream-lost"])  # the silence after the end
        assert json.loads(httpx.get(f"{base}/alarms", params={"all": True}, timeout=180.0).text)["alarms"]
    finally:
        for process in (monitor, simulator):
            if process is not None and process.poll() is None:
                process.terminate()
                process.communicate(timeout=180)


@pytest.mark.parametrize(
    ("outcome", "reason"),
    [
        (Outcome({"e": 0.3}, {"e": 0.28}, {"e"}, 9), ""),
        (Outcome({}, {}, set(), 9), ""),
        (Outcome({"e": 0.3}, {"e": 0.28}, {"e"}, 0), "no window"),
        (Outcome({"e": 0.3}, {}, set(), 9), "no alarm named e"),
        (Outcome({"e": 0.3}, {"e": 0.3, "k_by": 0.1}, {"e", "k_by"}, 9), "named k_by, which did not change"),
        (Outcome({"e": 0.3}, {"e": 0.15}, {"e"}, 9), "says +15.0%, injected was +30.0%"),
        (Outcome({"e": 0.3}, {"e": -0.3}, {"e"}, 9), "says -30.0%"),
        (Outcome({"e": 0.3}, {"e": 0.3}, set(), 9), "HTTP API did not show the alarm on e"),
    ],
)
def test_the_verdict_fails_for_the_right_reason(outcome: Outcome, reason: str) -> None:
    assert (reason in outcome.verdict()) if reason else outcome.verdict() == ""
