"""Whoever follows an alarm log has every event once and in order, however often it, or the monitor, is killed."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from service.history.records import Retention
from service.history.store import Store
from tests.service.live import ROOT, endpoint, until

KILLS = int(os.environ.get("ROTORWATCH_KILLS", "8"))
MONITOR_KILLS = 1


@contextmanager
def started(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run one of the programs of `tests.service.late_joiner`."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.service.late_joiner", *arguments],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def told(process: subprocess.Popen[str], line: str = "") -> str:
    """Say something to a program, and return what it says next."""
    assert process.stdin is not None
    assert process.stdout is not None
    if line:
        process.stdin.write(line + "\n")
        process.stdin.flush()
    said = process.stdout.readline()
    assert said, "the program has ended"
    return said.strip()


@pytest.mark.slow
def test_follower_killed_again_and_again_has_the_exact_log(tmp_path: Path) -> None:
    """A kill at random moments, also in the middle of a line; the monitor is killed in between. Many more::

    ROTORWATCH_KILLS=1000 python -m pytest tests/service/test_late_joiner.py -s
    """
    address, history, file = endpoint(), tmp_path / "history.sqlite", tmp_path / "followed.jsonl"
    rng = random.Random(17)  # noqa: S311  # moments, not secrets
    monitor_dies = set(range(KILLS // (MONITOR_KILLS + 1), KILLS - 1, KILLS // (MONITOR_KILLS + 1)))
    grown = torn = 0
    with started("followers", address, str(file)) as nursery, ExitStack() as stack:
        monitor = stack.enter_context(started("monitor", address, str(history)))
        assert told(monitor) == "busy"
        for kill in range(KILLS):
            size = file.stat().st_size if file.exists() else 0
            child = int(told(nursery, "start"))
            if kill in monitor_dies:
                monitor.kill()
                monitor.wait()
                monitor = stack.enter_context(started("monitor", address, str(history)))
                assert told(monitor) == "busy"  # this follower lives through it
            time.sleep(rng.uniform(0.0, 0.5))
            os.kill(child, signal.SIGKILL)
            assert int(told(nursery, "wait")) == signal.SIGKILL
            if file.exists():
                grown += file.stat().st_size > size
                torn += not file.read_bytes().endswith(b"\n")
        latest = int(told(monitor, "enough").removeprefix("idle after "))
        child = int(told(nursery, "start"))
        until(lambda: f'"sequence":{latest},'.encode() in file.read_bytes().splitlines()[-1], "the end of the log")
        os.kill(child, signal.SIGKILL)
        told(nursery, "wait")
    sys.stdout.write(f"{latest + 1} events; {grown} of {KILLS} kills while events came in, {torn} within a line\n")
    store = Store(f"sqlite:///{history}", Retention())
    store.open()
    try:
        log = store.machine("demo", "lab").events(limit=latest + 10)
    finally:
        store.close()
    assert [event.sequence for event in log] == list(range(latest + 1))
    assert file.read_text(encoding="utf-8").splitlines() == [event.text for event in log]
    # Otherwise the test has shown nothing: the kills must have hit followers at work.
    assert grown > KILLS // 3
    assert latest > KILLS
