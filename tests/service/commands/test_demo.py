"""The demo as a new user runs it: separate programs on loopback, faults and seeds not used in training."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from service.commands.demo import FAULTS, Outcome
from simulator.scenario import load_scenario
from tests.service.rig.live import ROOT, Program, program, until
from tests.service.rig.preloaded import ran

WHOLE, QUICK = ("service", "demo"), ("tests.service.commands.quick_demo",)


def children_of(pid: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended meanwhile
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


@contextmanager
def demo(folder: Path, *arguments: str) -> Iterator[Program]:
    """A demo, which leaves no temporary file."""
    (folder / "tmp").mkdir()
    paced = ("--http-port", "0", "--pace", "20")
    with program(folder, *arguments, *paced, TMPDIR=str(folder / "tmp"), COLUMNS="100") as one:
        yield one
    assert list((folder / "tmp").iterdir()) == []


def none_is_left(processes: list[int]) -> None:
    until(lambda: not any(Path(f"/proc/{process}").exists() for process in processes), "the end of all", 120)


def check_lines(output: str) -> None:
    for line in output.splitlines():
        assert len(line.rstrip()) <= 100
        assert not ("healthy" in line and "changed" in line)
        assert not re.search(r"(?<!\S)-\d", line)  # the page and programs print the true minus sign
        assert "stream lost" not in line


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("seed", "fault"), list(enumerate([*FAULTS, "none"], 101)))
def test_the_demo_names_exactly_the_injected_fault(fault: str, seed: int, tmp_path: Path) -> None:
    with demo(tmp_path, *WHOLE, "--fault", fault, "--seed", str(seed), "--once") as one:
        assert one.process.wait(600) == 0, one.output()
    output = one.output()
    check_lines(output)
    if fault == "none":
        assert "injected nothing; named nothing" in output
        assert "ALERT" not in output
        return
    assert re.search(rf"ALERT: .*\({fault}\) changed by", output)
    assert f"/alarms: {fault} raised" in output
    assert "demo passed" in output
    assert output.count(" healthy\n") >= 10  # one line per window, the healthy stretch among them


@pytest.mark.slow
def test_watch_and_status_follow_a_demo_that_repairs_and_breaks_the_machine(tmp_path: Path) -> None:
    with demo(tmp_path, *QUICK, "--fault", "c_bz") as one:
        one.wait_for("found")
        lines = one.output().splitlines()
        printed = [line.split()[1:] for line in lines if re.match(r"  \S*rotorwatch.* (watch|status) --", line)]
        assert [command[0] for command in printed] == ["watch", "status"]
        with program(tmp_path, "service", *printed[0]) as watch:
            one.wait_for("c_bz raised")
            status = ran("service", *printed[1], "--json")
            alarms = {one["name"]: one["raised"] for one in json.loads(status.stdout)["machines"][0]["alarms"]}
            assert "c_bz" in alarms
            # The demo goes on: on a busy computer the machine may be repaired before the response comes.
            assert status.returncode == int(any(alarms.values())), status.stdout
            one.wait_for("(e) changed by")
            watch.stop(signal.SIGINT)
        assert "(c_bz) changed by" in watch.output()
        children = children_of(one.process.pid)
        os.kill(min(children), signal.SIGKILL)
        assert one.process.wait(300) == 1
        assert "the monitor was killed (SIGKILL)" in one.errors()
        none_is_left(children)
    output = one.output()
    check_lines(output)
    assert output.index("c_bz by −30%") < output.index("demo passed") < output.index("repaired") < output.index("e by")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code", "running"),
    [
        (signal.SIGINT, 130, 1),
        *(
            pytest.param(number, code, 2, marks=pytest.mark.long)
            for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -signal.SIGKILL))
        ),
    ],
)
def test_a_demo_always_leaves_nothing_behind(number: signal.Signals, code: int, running: int, tmp_path: Path) -> None:
    """While the monitor starts, and later beside the simulator."""
    with demo(tmp_path, *WHOLE) as one:
        until(lambda: len(children_of(one.process.pid)) == running, "programs")
        children = children_of(one.process.pid)
        one.process.send_signal(number)
        assert one.process.wait(300) == code, one.output()
        none_is_left(children)


def test_the_demo_prints_before_importing_heavy_modules() -> None:
    code = (
        "import sys\nfrom service.commands.rotorwatch import app\n"
        "class Told:\n"
        "    def write(self, text):\n"
        "        if not text.strip():\n            return\n"
        "        heavy = {'numpy', 'zenoh', 'pydantic_core'} & set(sys.modules)\n"
        "        sys.__stdout__.write(f'{text.strip()} {sorted(heavy)}')\n"
        "        sys.__stdout__.flush()\n"
        "        sys.exit(0)\n"
        "    def flush(self): pass\n"
        "sys.stdout = Told()\napp(['demo'])"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60, check=True
    )
    assert "starting" in found.stdout
    assert "numpy" not in found.stdout
    assert "zenoh" not in found.stdout


def test_the_demos_faults_are_those_of_the_shipped_scenarios() -> None:
    for name, change in FAULTS.items():
        events = load_scenario(name)[0].events
        assert [(event.parameter, event.relative_change) for event in events] == [(name, change)]


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
