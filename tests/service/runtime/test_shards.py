"""Processes that share the machines of a monitor: the same answers, a killed one, and settings that allow one only."""

import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import httpx_sse
import pytest

from models.errors import BundleError, MachineFileError
from models.machine import load_machine
from models.signals.link import LinkSettings
from models.stream_settings import IngestSettings
from rotorwatch.records.alarms import AlarmStates
from rotorwatch.records.health import Health, HealthState
from rotorwatch.records.monitor import Readiness
from rotorwatch.records.operations import OperationDone
from service.history.file import lock_file
from service.runtime.runtime import Runtime, running
from service.runtime.shards import Shards, shard_count
from service.settings.service import HistorySettings, MachineEntry, ServiceSettings, ShardSettings
from service.stream.transport import relay_items
from simulator.scenario import parse_fault
from tests.service.commands.test_demo import children_of
from tests.service.rig.live import (
    QUICK,
    Feed,
    endpoint,
    kept_in,
    machine_file,
    open_session,
    program,
    scenario_blocks,
    send,
    settings,
    until,
)
from tests.service.rig.monitored import answered, client, problem
from tests.service.rig.preloaded import CONTEXT

SECONDS = 35.0
NAMES = ("lab", "pump")
PATHS = (
    "", "/configuration", "/detectable", "/detectable?change=-0.2", "/alarms?all=true", "/alarms/events", "/spectra",
    "/orbits?revolutions=4", "/correlations", "/waveforms", "/full-spectra", "/waterfalls",
    "/readings?quantity=parameter&name=k_by",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fork processes off one that has imported everything, which is faster; a monitor run as a program spawns them."""
    monkeypatch.setattr("service.runtime.processes.multiprocessing.get_context", lambda _: CONTEXT)


def plan_for(folder: Path, count: int | None, address: str | None = None) -> ServiceSettings:
    """Two machines with short windows, and a history in a file."""
    address = address or endpoint()
    entries = []
    for name in NAMES:
        (folder / name).mkdir(exist_ok=True)
        changes = (*QUICK, ('name = "lab"', f'name = "{name}"'), ("on_delay_s = 5.0", "on_delay_s = 10.0"))
        entries.append(MachineEntry(file=machine_file(folder / name, *changes)))
    shards = ShardSettings(count=count)
    return settings(address, when_full="wait", machines=tuple(entries), shards=shards, history=kept_in(folder))


@contextmanager
def fed(folder: Path, count: int) -> Iterator[tuple[Runtime, httpx.Client]]:
    """The machine lab loses a third of its bearing stiffness, pump is healthy; both have sent all data."""
    plan = plan_for(folder, count)
    with running(plan) as runtime, client(runtime) as http:
        for entry, faults in zip(plan.machines, ((parse_fault("k_by=-0.33@0"),), ()), strict=True):
            send(plan.link.listen[0], scenario_blocks(SECONDS, *faults), load_machine(entry.file))
        for one in runtime.machines():
            until(lambda: one.health().quality.accepted_blocks == 10 * SECONDS, f"all blocks of {one.machine.name}")  # noqa: B023
        yield runtime, http


def comparable(http: httpx.Client, path: str) -> str:
    """An answer without wall-clock times."""
    answer = http.get(path)
    assert answer.status_code == 200, answer.text
    found = answer.json()
    if isinstance(found, dict):
        for event in found.get("events", ()):
            event.pop("recorded_ns", None)
    return repr(found)


def operators_and_listeners_reach_a_machine_of_another_process(http: httpx.Client) -> None:
    place = "/api/v1/machines/demo/lab/alarms"
    with httpx_sse.connect_sse(http, "GET", "/api/v1/events") as source:
        events = source.iter_sse()
        assert next(events).event == "start"
        seen = http.get(f"{place}/k_by")
        done = http.post(f"{place}/k_by/acknowledge", json={}, headers={"If-Match": seen.headers["etag"]})
        assert answered(done, OperationDone).alarm.state == "acknowledged"
        told = next(event for event in events if event.event == "alarm")
        assert '"acknowledged"' in told.data
        assert '"acknowledged"' in http.get("/api/v1/machines/demo/lab/health").text  # as soon as the event is out
        health = next(event for event in events if event.event == "health" and '"acknowledged"' in event.data)
        assert Health.model_validate_json(health.data).machine == "lab"
    again = http.post(f"{place}/k_by/acknowledge", json={}, headers={"If-Match": seen.headers["etag"]})
    problem(again, 409)
    nothing = http.post(f"{place}/nothing/acknowledge", json={}, headers={"If-Match": "*"})
    assert "no alarm nothing" in problem(nothing, 404).detail
    states = answered(http.get(place), AlarmStates)
    assert [one.state for one in states.alarms if one.name == "k_by"] == ["acknowledged"]


def test_answers_do_not_depend_on_the_number_of_processes_and_operations_reach_all(tmp_path: Path) -> None:
    answers, reports = [], []
    for count in (1, 2):
        folder = tmp_path / str(count)
        folder.mkdir()
        with fed(folder, count) as (runtime, http):
            places = [f"/api/v1/machines/demo/{name}" for name in NAMES]
            answers.append([comparable(http, place + path) for place in places for path in PATHS])
            reports.append([http.get(f"{place}/reports").json()["reports"] for place in places])
            healths = [answered(http.get(f"{place}/health"), Health) for place in places]
            assert [one.state for one in healths] == [HealthState.ALERT, HealthState.HEALTHY]
            assert any(one.name == "k_by" and one.raised for one in healths[0].alarms)
            readiness = answered(http.get("/readyz"), Readiness)
            assert [one.machine for one in readiness.machines] == list(NAMES)
            assert [one["machine"] for one in http.get("/api/v1/machines").json()["machines"]] == list(NAMES)
            metrics = http.get("/metrics").text
            for name, kept in zip(NAMES, reports[-1], strict=True):
                assert f'rotorwatch_blocks_accepted_total{{machine="{name}",site="demo"}} {10 * SECONDS}' in metrics
                assert f'rotorwatch_windows_total{{machine="{name}",site="demo"}} {float(len(kept))}' in metrics
            own = {one.machine.name for one in runtime.machines() if hasattr(one, "inbox")}
            assert own == (set(NAMES) if count == 1 else set())
            if count == 2:
                operators_and_listeners_reach_a_machine_of_another_process(http)
    assert answers[0] == answers[1]
    assert reports[0] == reports[1]


def test_a_hung_process_is_reported_and_a_killed_one_is_restarted_and_resumes(tmp_path: Path) -> None:
    plan = plan_for(tmp_path, 2)
    blocks = scenario_blocks(45.0, parse_fault("k_by=-0.33@0"))
    with running(plan) as runtime, client(runtime) as http, open_session(plan.link.listen[0]) as session:
        lab, pump = runtime.machines()
        feed = Feed(session, lab.machine)
        feed.put(*blocks[:440])
        until(lambda: lab.health().quality.accepted_blocks == 440, "the first blocks")
        until(lambda: lab.health().state is HealthState.ALERT, "the alarm")
        before = lab.history.events(after=-1)
        assert isinstance(runtime._machines, Shards)
        first, second = (shard.process.pid for shard in runtime._machines._shards)  # type: ignore[attr-defined]  # processes of this computer  # of lab and of pump
        os.kill(second, signal.SIGSTOP)
        until(lambda: not http.get("/readyz").is_success, "that it is told")
        assert "demo/pump: the process that monitors it has not responded" in problem(http.get("/readyz"), 503).detail
        assert pump.health().state is HealthState.NOT_EVALUABLE
        # Requests for a hung process are refused at once.
        assert "has not responded" in problem(http.get("/api/v1/machines/demo/pump/orbits"), 503).detail
        assert http.get("/api/v1/machines/demo/lab/orbits").status_code == 200
        os.kill(second, signal.SIGCONT)
        until(lambda: bool(http.get("/readyz").is_success), "that it is heard again")
        assert pump.health().state is not HealthState.NOT_EVALUABLE
        os.kill(first, signal.SIGKILL)
        # Hold the lock of the machine's history during the checks: the next process waits for it.
        lock = tmp_path / "history.sqlite.demo.lab.lock"
        held: list[int] = []

        def taken() -> bool:
            if (found := lock_file(lock)) is not None:
                held.append(found)
            return bool(held)

        until(taken, "the lock")
        until(lambda: not http.get("/readyz").is_success, "that it is told")
        assert "demo/lab: the process that monitored it ended (exit -9)" in problem(http.get("/readyz"), 503).detail
        assert lab.health().state is HealthState.ALERT  # a raised alarm stays visible
        assert "is being started again" in lab.health().reason
        for path in ("/orbits", "/alarms", "/detectable"):
            assert "is being started again" in problem(http.get(f"/api/v1/machines/demo/lab{path}"), 503).detail
            assert http.get(f"/api/v1/machines/demo/pump{path}").status_code == 200
        assert lab.status().tally.blocks == 440  # counters do not go back
        os.close(held[0])
        until(lambda: bool(http.get("/readyz").is_success), "a new process")
        started = [one.pid for one in multiprocessing.active_children()]
        assert second in started
        assert len(started) == 2
        until(lambda: lab.health().restart.startswith("resumed"), "that it goes on from where it stood")
        assert pump.health().restart == ""
        feed.put(*blocks[440:])
        until(lambda: lab.status().tally.blocks == 10, "the other blocks")
        log = lab.history.events(after=-1)
        assert log[: len(before)] == before
        assert [event.sequence for event in log] == list(range(len(log)))
        raised = [event.alarm for event in log if event.kind == "raised"]
        assert raised.count("k_by") == 1


def test_processes_end_with_the_monitor_that_started_them(tmp_path: Path) -> None:
    plan = plan_for(tmp_path, 2)
    machines = "[" + ",".join(one.model_dump_json() for one in plan.machines) + "]"
    with program(
        tmp_path,
        *("service", "run"),
        ROTORWATCH_MACHINES=machines,
        ROTORWATCH_SHARDS__COUNT="2",
        ROTORWATCH_HTTP__PORT="0",
        ROTORWATCH_LINK__LISTEN=f'["{endpoint()}"]',
        ROTORWATCH_HISTORY__URL=plan.history.database,
    ) as monitor:
        monitor.wait_for("HTTP API")
        own = {one: Path(f"/proc/{one}/cmdline").read_bytes() for one in children_of(monitor.process.pid)}
        started = [one for one, command in own.items() if b"spawn_main" in command]  # to share its machines
        assert len(started) == 2
        # A closing terminal signals all of its processes; the monitor alone decides when these end.
        states = [Path(f"/proc/{one}/status").read_text().partition("SigIgn:")[2].split()[0] for one in started]
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            assert all(int(ignored, 16) >> (number - 1) & 1 for ignored in states)
        monitor.kill()
    until(lambda: not any(Path(f"/proc/{one}").exists() for one in started), "end of all processes")
    with running(plan) as runtime:  # their machines are free at once
        assert runtime.readiness().ready


def test_the_number_of_processes_follows_machines_cores_and_settings(tmp_path: Path) -> None:
    plan = plan_for(tmp_path, None)
    assert shard_count(plan) == 1  # few machines
    cores = len(os.sched_getaffinity(0))
    assert shard_count(plan.model_copy(update={"machines": 30 * plan.machines})) == min(cores, 4)
    assert shard_count(plan_for(tmp_path, 5)) == 2  # no more than machines
    in_memory = plan_for(tmp_path, 2).model_copy(update={"history": HistorySettings(url="sqlite:///:memory:")})
    with pytest.raises(MachineFileError, match=r"shards.count is 2, expected 1: a history in memory"):
        shard_count(in_memory)
    users = tmp_path / "users"
    users.write_text("pump:secret\n", encoding="utf-8")
    users.chmod(0o600)
    listen = ("tcp/127.0.0.1:0",)
    for named in (
        LinkSettings(listen=listen, passwords_file=users),
        LinkSettings(listen=listen, connect=listen, user="pump", password_file=users),
    ):
        with pytest.raises(MachineFileError, match=r"expected 1: where link.listen asks for names"):
            shard_count(plan_for(tmp_path, 2).model_copy(update={"link": named}))


def test_a_broken_bundle_fails_the_start_by_name_and_leaves_no_process(tmp_path: Path) -> None:
    plan = plan_for(tmp_path, 2)
    broken = MachineEntry(file=plan.machines[1].file, bundle=str(tmp_path / "nothing"))
    failed = Runtime(plan.model_copy(update={"machines": (plan.machines[0], broken)}))
    with pytest.raises(BundleError, match="nothing: not a bundle"):
        failed.start()
    assert multiprocessing.active_children() == []


def test_the_timeout_of_a_stalled_shards_link_is_shorter_than_a_silence() -> None:
    place = "transport/link/tx/queue/congestion_control/block/wait_before_close"
    cut_off_s = int(relay_items(waits=False)[place]) / 1e6
    assert cut_off_s < IngestSettings().no_data_after_s / 2
    assert place not in relay_items(waits=True)  # there the source is to wait
