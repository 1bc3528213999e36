"""The running service: output equal to that of the offline monitor, silence, errors, start and stop."""

import json
import platform
import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from models.alarm_names import STREAM_LOST
from models.commissioning.commissioned import install
from models.machine import load_machine
from models.signals.link import LinkSettings
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Health, Report
from service.api.server import HttpError
from service.monitor.conversion import alarm_cloud_event
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import MonitorReport
from service.runtime.runtime import Runtime, running
from service.settings.service import HttpSettings
from service.stream.checkpoints import stored_event, stored_report
from service.stream.transport import LinkError, TopicMessage, follow
from service.terminal.logs import Limiter
from simulator.scenario import parse_fault
from tests.service.rig.live import (
    IMPATIENT,
    ROOT,
    endpoint,
    fed_service,
    machine_file,
    scenario_blocks,
    send,
    service,
    settings,
    until,
)


class Topics:
    """Messages that a client received, by the last part of the key."""

    def __init__(self) -> None:
        self.messages: list[TopicMessage] = []

    def texts(self, suffix: str) -> list[str]:
        return [message.text for message in list(self.messages) if message.key.endswith(suffix)]


def test_live_output_equals_offline_output_and_silence_clears_no_alarm(tmp_path: Path) -> None:
    file = machine_file(tmp_path, IMPATIENT)
    machine = load_machine(file)
    stream = scenario_blocks(70.0, parse_fault("c_bz=0.5@0"))
    offline = MachineMonitor(install(machine, "lab"))
    reports = [offline.step(block) for block in stream]
    windows = tuple(window for report in reports for window in report.windows)
    events = tuple(event for report in reports for event in report.events)
    assert [event.alarm.name for event in events] == ["c_bz"]

    address, topics = endpoint(), Topics()
    with service(address, file, bundle="lab", when_full="wait") as (_, worker):
        client = LinkSettings(mode="client", connect=(address,))
        names = ("report", "alarm_event", "alarm_state", "health")
        with follow(client, "demo/lab", names, topics.messages.append):
            until(lambda: bool(topics.texts("/health")), "first health")
            send(address, stream, machine)
            until(lambda: worker.health().quality.accepted_blocks == len(stream), "all blocks")
            kept = [one for _, one in reversed(worker.history.reports(limit=1000))]
            assert kept == [stored_report(window) for window in windows]
            (told,) = (one for one in worker.history.events(limit=1000) if one.alarm != STREAM_LOST)
            assert told == replace(stored_event(worker.identity, events[0], 0), recorded_ns=told.recorded_ns)

            until(lambda: len(topics.texts("/report")) == len(windows), "reports on the topic")
            published = [Report.model_validate_json(text) for text in topics.texts("/report")]
            assert published == list(windows)
            until(lambda: "stream-lost" in "".join(topics.texts("/alarm/event")), "alarm on the silence")
            heard = [AlarmCloudEvent.model_validate_json(text) for text in topics.texts("/alarm/event")]
            assert heard[0] == alarm_cloud_event(worker.identity, events[0])
            (lost,) = (one.data for one in heard[1:])
            assert (lost.kind, lost.name, lost.sequence) == ("raised", "stream-lost", 1)
            assert lost.time_ns == stream[-1].end_ns + 500_000_000
            until(lambda: '"stream-lost"' in topics.texts("/alarm/state")[-1], "alarms with the silence among them")
            states = AlarmStates.model_validate_json(topics.texts("/alarm/state")[-1])
            assert [(alarm.name, alarm.state) for alarm in states.alarms] == [
                ("c_bz", "unacknowledged"),
                ("stream-lost", "unacknowledged"),
            ]
            assert states.sequence == 1

            def latest() -> Health:
                return Health.model_validate_json(topics.texts("/health")[-1])

            until(lambda: latest().stream.silent, "silence on the topic")
            silent = latest()
            assert silent.state == "danger"  # the raised alarm stays visible beside the silence
            assert silent.stream.silent_since_ns == stream[-1].end_ns
            assert silent.reason.startswith("no data since 2026-01-01T00:0")
            assert [alarm.name for alarm in silent.alarms if alarm.raised and alarm.name != STREAM_LOST] == ["c_bz"]
            assert silent.report == published[-1]
            said = [Health.model_validate_json(text).state.value for text in topics.texts("/health")]
            assert "danger" in said
            # Health is published on changes only, not because a block came in or a second went by.
            news = [without_progress(json.loads(text)) for text in topics.texts("/health")]
            assert all(before != after for before, after in pairwise(news))


def without_progress(health: dict[str, Any]) -> dict[str, Any]:
    """The health message without the fields that change with every block."""
    health["stream"]["data_age_s"] = None
    health["quality"]["accepted_blocks"] = None
    return health


def test_new_data_end_a_silence_and_refused_blocks_do_not(tmp_path: Path) -> None:
    with fed_service(machine_file(tmp_path, IMPATIENT)) as (_, worker, feed):
        until(lambda: worker.health().state == "no-data", "silence from the start")
        assert worker.health().reason == "no data since the monitor started"
        assert worker.health().stream.silent_since_ns is None
        assert worker.health().stream.data_age_s is None
        feed.put(feed.block(rate_hz=2048.0))
        told = "no data since the monitor started, blocks are refused: "
        until(lambda: worker.health().reason.startswith(told), "refusal")
        feed.put_good()
        until(lambda: worker.health().state == "warming", "end of the silence")
        until(lambda: worker.health().state == "no-data", "silence")
        assert re.fullmatch(r"no data since \S+Z", worker.health().reason)  # an earlier refusal is none of its causes
        # Refused blocks do not count as data.
        accepted = worker.health().quality.accepted_blocks
        for _ in range(3):
            feed.put(feed.block(samples=np.full((200, 9), np.nan, dtype=np.float32)))
        until(lambda: worker.health().quality.refused_blocks == {"rate": 1, "not-finite": 3}, "refusals")
        assert (worker.health().state, worker.health().quality.accepted_blocks) == ("no-data", accepted)
        assert re.match(r"no data since \S+Z, blocks are refused: demo/lab: block", worker.health().reason)


class _Poisoned(MachineMonitor):
    """A monitor with a defect that one payload triggers."""

    def step_payload(
        self, payload: bytes, attachment: bytes, encoding: str, dropped_before: int = 0
    ) -> tuple[MonitorReport, ...]:
        if encoding == "poison":
            raise ZeroDivisionError("defect in the monitor")
        return super().step_payload(payload, attachment, encoding, dropped_before)


def test_a_defect_in_the_monitor_costs_one_block_and_raises_an_alarm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.stream.worker.MachineMonitor", _Poisoned)
    with fed_service() as (runtime, worker, feed):
        feed.put_good()
        feed.put_raw(b"", b"", "poison")
        feed.put_good()
        until(lambda: worker.health().quality.accepted_blocks == 2, "block after the defect")
        health = worker.health()
        assert (health.worker_errors, health.last_worker_error) == (1, "ZeroDivisionError: defect in the monitor")
        until(lambda: "monitor-fault" in {one.name for one in worker.alarms().alarms if one.raised}, "the alarm on it")
        answer = httpx.get(f"{runtime.http_url}/readyz", trust_env=False, timeout=180.0)
        assert (answer.status_code, answer.json()["machines"][0]["worker_errors"]) == (200, 1)


def test_a_failed_start_leaves_nothing_running_and_frees_its_ports() -> None:
    address = endpoint()
    with service(address) as (runtime, _):
        port = int(runtime.http_url.rsplit(":", 1)[1])
        with pytest.raises(HttpError) as http:
            Runtime(settings(endpoint(), http=HttpSettings(port=port))).start()
        assert f"HTTP cannot listen on 127.0.0.1 port {port}: the port is in use" in str(http.value)
        failed = Runtime(settings(address))
        with pytest.raises(LinkError) as link:
            failed.start()
        assert f"listen {address}) could not be opened: address already in use" in str(link.value)
        assert not failed.readiness().ready
        assert not any(one.status().alive for one in failed.machines())
    # Both addresses are free again.
    with running(settings(address, http=HttpSettings(port=port))) as runtime:
        assert runtime.readiness().ready


def test_a_stopped_service_ends_its_worker_thread() -> None:
    with fed_service(when_full="wait", bound=1) as (_, worker, feed):
        feed.put_good(50)
        until(lambda: worker.health().quality.accepted_blocks > 0, "blocks")
    assert not worker.status().alive


def test_log_lines_of_one_kind_are_limited() -> None:
    now = [0.0]
    limiter = Limiter(lambda: now[0])
    assert [limiter.admit("gap") for _ in range(4)] == [0, None, None, None]
    assert limiter.admit("refused") == 0
    now[0] = 10.0
    assert limiter.admit("gap") == 3
    assert limiter.admit("gap") is None


def test_health_over_http_is_the_health_on_the_topic() -> None:
    topics = Topics()
    with fed_service() as (runtime, worker, feed):
        link = LinkSettings(mode="client", connect=runtime.settings.link.listen)
        with follow(link, "*/*", ("health",), topics.messages.append):
            feed.put_raw(b"", b"", "rubbish")
            until(lambda: bool(worker.health().quality.refused_blocks), "refusal")
            until(lambda: any("rubbish" in text for text in topics.texts("/health")), "refusal on the topic")
        place = f"{runtime.http_url}/api/v1/machines/demo/lab/health"
        over_http = httpx.get(place, trust_env=False, timeout=180.0).json()
        assert over_http == json.loads(topics.texts("/health")[-1])


_ARENAS = """
import sys, threading
from pathlib import Path
from service.commands.running import prepare_numerics
def size_mb():
    return int(Path("/proc/self/statm").read_text().split()[0]) * 4096 / 1e6
if sys.argv[1] == "shared":
    prepare_numerics()
threading.stack_size(2**20)
before_mb, barrier, done = size_mb(), threading.Barrier(9), threading.Event()
def work():
    held = [bytearray(50_000) for _ in range(10)]
    barrier.wait()
    done.wait()
threads = [threading.Thread(target=work) for _ in range(8)]
for thread in threads:
    thread.start()
barrier.wait()
print(size_mb() - before_mb)
done.set()
"""


# What is tested is a setting of glibc; elsewhere it changes nothing.
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no arenas")
def test_threads_get_no_malloc_arena_of_their_own() -> None:
    grown_mb = {}
    for how in ("own", "shared"):
        run = subprocess.run([sys.executable, "-c", _ARENAS, how], cwd=ROOT, capture_output=True, text=True, check=True)
        grown_mb[how] = float(run.stdout)
    assert grown_mb["shared"] < 100 < 200 < grown_mb["own"]  # an arena takes 64 MB of the address space


LIMITED = ["sh", "-c", 'ulimit -v "$1"; shift; exec "$@"', "sh"]
MONITOR = ["-m", "service", "run", "--http-port", "0", "--listen"]
PROGRAM = """
import threading
import typer
from service.commands.running import exit_codes

def main() -> None:
    with exit_codes():
        {}

typer.run(main)
"""
NO_MEMORY = "bytearray(2**34)"
NO_THREAD = "threading.stack_size(2**32); threading.Thread(target=print).start()"


def ended(limit_kb: int, *arguments: str) -> list[str]:
    """Error output of a program that must exit with 1."""
    command = [*LIMITED, str(limit_kb), sys.executable, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=180, check=False)
    assert (done.returncode, done.stdout) == (1, ""), done
    return done.stderr.splitlines()


@pytest.mark.parametrize("limit_kb", [200_000, 1_000_000])
def test_a_monitor_does_not_start_under_too_low_a_memory_limit(limit_kb: int) -> None:
    (said,) = ended(limit_kb, *MONITOR, endpoint())
    assert "ulimit -v" in said
    assert f"{limit_kb * 1024 // 1_000_000} MB" in said
    assert "2000 MB" in said


@pytest.mark.parametrize("code", [NO_MEMORY, NO_THREAD])
def test_running_out_of_memory_later_names_the_limit(code: str) -> None:
    (said,) = ended(2_500_000, "-c", PROGRAM.format(code))
    assert "ulimit -v" in said
    assert "2560 MB" in said
