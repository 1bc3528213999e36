"""Whoever follows an alarm log has every event once and in order, however often it, or the monitor, is killed."""

import os
import random
import signal
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.service.live import Program, endpoint, program, until
from tests.service.postgres import opened

KILLS = int(os.environ.get("ROTORWATCH_KILLS", "8"))
MONITOR_KILLS = 1


@pytest.mark.slow
def test_follower_killed_again_and_again_has_the_exact_log(tmp_path: Path) -> None:
    """A kill at random moments, also in the middle of a line; the monitor is killed in between. Many more::

    ROTORWATCH_KILLS=1000 python -m pytest tests/service/test_late_joiner.py -s
    """
    address, enough, file = endpoint(), tmp_path / "enough", tmp_path / "followed.jsonl"
    history = f"sqlite:///{tmp_path}/history.sqlite"
    rng = random.Random(17)  # noqa: S311  # moments, not secrets
    monitor_dies = set(range(KILLS // (MONITOR_KILLS + 1), KILLS - 1, KILLS // (MONITOR_KILLS + 1)))
    grown = torn = 0

    def started(what: str, place: Path) -> Program:
        words = ("tests.service.late_joiner", what, address, str(place))
        return stack.enter_context(program(tmp_path, *words, ROTORWATCH_HISTORY__URL=history))

    with ExitStack() as stack:
        monitor = started("monitor", enough)
        monitor.wait_for("busy")
        for kill in range(KILLS):
            size = file.stat().st_size if file.exists() else 0
            follower = started("follow", file)
            if kill in monitor_dies:
                monitor.kill()
                monitor = started("monitor", enough)
                monitor.wait_for("busy")  # this follower lives through it
            time.sleep(rng.uniform(0.0, 0.5))
            follower.kill()
            assert follower.process.returncode == -signal.SIGKILL, follower.errors()
            if file.exists():
                grown += file.stat().st_size > size
                torn += not file.read_bytes().endswith(b"\n")
        enough.touch()
        monitor.wait_for(".")
        latest = int(monitor.output().split()[-1].rstrip("."))
        started("follow", file)

        def ended() -> bool:
            return f'"sequence":{latest},'.encode() in file.read_bytes().splitlines()[-1]

        while not ended():  # thousands of lines, each on the disk before the next: as long as it takes
            size = file.stat().st_size
            until(lambda size=size: ended() or file.stat().st_size > size, "more of the log")  # type: ignore[misc]
    sys.stdout.write(f"{latest + 1} events; {grown} of {KILLS} kills while events came in, {torn} within a line\n")
    with opened(history) as store:
        log = store.machine("demo", "lab").events(limit=latest + 10)
    assert [event.sequence for event in log] == list(range(latest + 1))
    assert file.read_text(encoding="utf-8").splitlines() == [event.text for event in log]
    # Otherwise the test has shown nothing: the kills must have hit followers at work.
    assert grown > KILLS // 3
    assert latest > KILLS
