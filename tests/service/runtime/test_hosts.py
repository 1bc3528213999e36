"""Machine, monitor and operator on separate hosts with a router between them: a cut cable and a lost host."""

import sqlite3
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest

from rotorwatch.records.health import Health, HealthState
from tests.service.rig.hosts import MIDDLE, hosts, why_not
from tests.service.rig.live import ROOT, SHORT, Program, machine_file, program, until

_WHY_NOT = why_not()
# Hosts are network namespaces, which only root can create.
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(_WHY_NOT), reason=f"NO HOSTS: {_WHY_NOT}")]

PACE = 10.0
CUT_S = 13.0
"""Longer than Zenoh's lease (10 s) and, at this pace, than what the publisher's cache holds."""
LATER_S, LENGTH_S = 900.0, 45.0
"""When the machine's data resume after its host was lost, and for how long."""
START_NS = 1_767_225_600 * 10**9
BLOCK_S = 0.1
FOLLOW = """
import sys, zenoh
from models.signals.link import LinkSettings
from rotorwatch.client.alarm_log import follow_alarms

config = zenoh.Config()
for path, value in LinkSettings(mode="client", connect=(sys.argv[1],)).zenoh_items().items():
    config.insert_json5(path, value)
with zenoh.open(config) as session:
    follow_alarms(session, ["demo/lab"], {}, lambda event: print(event.id, flush=True))
"""


def log_of(history: Path) -> list[tuple[int, str, str, str]]:
    """Sequence, identifier, kind and alarm of every event."""
    with closing(sqlite3.connect(f"file:{history}?mode=ro", uri=True, timeout=60.0)) as database:
        return database.execute("SELECT sequence, id, kind, alarm FROM alarm_events ORDER BY sequence").fetchall()


def test_loss_by_a_cut_cable_or_lost_host_is_stated_and_alarm_events_arrive_once(tmp_path: Path) -> None:
    history, machine, told = tmp_path / "history.sqlite", machine_file(tmp_path, *SHORT), tmp_path / "told"
    with hosts("machine", "monitor", "operator") as net, ExitStack() as running:

        def router(host: str) -> str:
            return f"tcp/{net.middle_from(host)}:7447"

        def started(host: str, *arguments: str) -> Program:
            made = program(
                tmp_path, *arguments, network=net.network(host), ROTORWATCH_HISTORY__URL=f"sqlite:///{history}",
                ROTORWATCH_QUEUE__WHEN_FULL="drop",
            )  # fmt: skip
            return running.enter_context(made)

        def published(start_ns: int, fault_s: float, length_s: float) -> Program:
            start = np.datetime64(start_ns, "ns").astype(str)
            return started(
                "machine",
                *("simulator.rotorsim", "publish", "healthy", "--machine", machine, "--fault", f"k_by=-0.33@{fault_s}"),
                *("--mode", "client", "--connect", router("machine"), "--wait-for-subscriber", "120"),
                *("--pace", f"{PACE:g}", "--start", start, "--duration", f"{length_s:g}", "--linger", "60"),
            )

        def health() -> Health:
            return Health.model_validate_json(net.asked("monitor", f"{url}/api/v1/machines/demo/lab/health"))

        def evaluated_until() -> int:
            report = health().report
            return 0 if report is None or report.state is HealthState.WARMING else report.end_ns

        def accounted_s() -> float:
            """Seconds of data that were evaluated or are reported missing."""
            quality = health().quality
            return BLOCK_S * quality.accepted_blocks + quality.missing_s

        listening = ("--listen", "tcp/0.0.0.0:7447", "--without-grants")
        started(MIDDLE, "service", "router", *listening).wait_for("router listening")
        monitor = started(
            "monitor", *("service", "run", "--machine", machine, "--connect", router("monitor"), "--http-port", "0")
        )
        follow = [*net.within("operator"), sys.executable, "-c", FOLLOW, router("operator")]
        with told.open("wb") as out:
            follower = running.enter_context(subprocess.Popen(follow, stdout=out, cwd=ROOT))
        running.callback(follower.kill)
        url = monitor.url()
        publisher = published(START_NS, 15.0, LATER_S)
        until(lambda: any(one[2:] == ("raised", "k_by") for one in log_of(history)), "alarm")

        net.cut("monitor")
        time.sleep(CUT_S)
        # A monitor that other programs slow down still has blocks from before the cut to take.
        until(lambda: health().stream.silent, "silence")
        away, cut_ns = health(), evaluated_until()
        assert away.state is HealthState.ALERT, "missing data must not hide the alarm"
        net.mend("monitor")
        until(lambda: evaluated_until() > cut_ns + 1e9 * PACE * CUT_S, "window after the cut")

        net.lose("machine", publisher)
        net.put("machine")
        published(START_NS + round(1e9 * LATER_S), 0.0, LENGTH_S)
        until(lambda: evaluated_until() > START_NS + round(1e9 * LATER_S), "window after the host was lost")
        until(lambda: accounted_s() > LATER_S + LENGTH_S - 0.5 * BLOCK_S, "last block", 60.0)
        assert accounted_s() == pytest.approx(LATER_S + LENGTH_S, abs=0.01)
        assert health().quality.link_missed_blocks > 0

        log = log_of(history)
        assert [sequence for sequence, *_ in log] == list(range(len(log)))
        assert [one[2:] for one in log if one[3] == "k_by"] == [("raised", "k_by")]
        assert ("raised", "stream-lost") in {one[2:] for one in log}
        until(lambda: len(told.read_text(encoding="utf-8").splitlines()) >= len(log), "events at the operator's")
        assert told.read_text(encoding="utf-8").splitlines() == [identifier for _, identifier, *_ in log]
