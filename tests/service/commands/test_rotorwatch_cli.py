"""The command `rotorwatch` as a process: what it prints, where, and its exit codes."""

import ctypes
import errno
import json
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
import typer

from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.example import example
from rotorwatch.records.health import Health, Report
from rotorwatch.records.levels import LevelGrowth
from rotorwatch.records.windows import NaturalFrequency, Shape
from service.commands.running import exit_codes
from service.terminal.lines import alarm_event_line, alarm_state_lines, health_line, report_line
from simulator.scenario import parse_fault
from tests.service.rig.live import (
    IMPATIENT,
    QUICK,
    ROOT,
    endpoint,
    fed_service,
    machine_file,
    program,
    scenario_blocks,
    send,
    service,
    until,
)
from tests.service.rig.preloaded import Piped, ran
from tests.service.rig.preloaded import rotorwatch as run


def test_numpy_computes_in_one_thread() -> None:
    code = (
        "import os, sys\nfrom service.commands import rotorwatch\n"
        "assert not {'numpy', 'pydantic', 'sqlalchemy', 'zenoh'} & set(sys.modules)  # --help does not wait for them\n"
        "rotorwatch.prepare_numerics()\nimport numpy as np\n"
        "a = np.ones((800, 800))\na @ a\nprint(len(os.listdir('/proc/self/task')))"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env={"PATH": "/usr/bin"}, check=True
    )
    assert found.stdout.strip() == "1"


@pytest.mark.parametrize("command", ["run", "check-config", "watch", "status", "router"])
def test_every_command_has_an_example(command: str) -> None:
    found = run(command, "--help")
    assert found.returncode == 0
    assert "Example" in found.stdout
    assert f"rotorwatch {command}" in found.stdout
    assert ("[link]" in found.stdout) == (command in ("run", "watch", "router"))  # table names are not taken for markup


def test_help_wraps_paragraphs_and_keeps_examples_on_their_own_lines() -> None:
    def lines(*command: str) -> list[str]:
        found = run(*command, "--help", COLUMNS="80")
        return [" ".join(line.split()) for line in found.stdout.splitlines()]

    told = lines("fleet")
    assert "that is lost; this process serves HTTP, the page, metrics and webhooks for all" in told
    assert "RAY_worker_niceness=0 ray start --head --disable-usage-stats" in told
    assert "Gaps stay gaps. The files of a folder, such as snapshots, are joined in the" in lines("import")
    assert "rotorwatch run --config plant.toml" in lines("run")
    assert "3 no data, 4 no answer" in " ".join(run("--help").stdout.split())


def test_an_inaccessible_file_is_reported_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as ended, exit_codes():
        raise PermissionError(errno.EACCES, "Permission denied", "/var/lib/rotorwatch/history.sqlite")
    assert ended.value.exit_code == 2
    assert capsys.readouterr().err == "/var/lib/rotorwatch/history.sqlite: Permission denied\n"
    with pytest.raises(PermissionError), exit_codes():  # without a file it is a defect
        raise PermissionError(errno.EPERM, "Operation not permitted")


def test_a_full_disk_is_reported_in_one_line() -> None:
    found = ran("service", "size", "--machines", "3", out=Path("/dev/full"))
    assert (found.returncode, found.stderr) == (1, "the output cannot be written (No space left on device)\n")


def test_another_file_that_has_no_room_is_not_told_as_the_output(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as ended, exit_codes():
        raise OSError(errno.ENOSPC, "No space left on device")
    assert ended.value.exit_code == 1
    assert capsys.readouterr().err == "a file cannot be written (No space left on device)\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_run_prints_its_addresses_needs_no_torch_and_stops_cleanly(tmp_path: Path, number: signal.Signals) -> None:
    address = endpoint()
    with program(
        tmp_path, "service", "run", "--listen", address, "--http-port", "0", ROTORWATCH_LOG__FORMAT="json"
    ) as started:
        url = started.url()
        assert f"Zenoh listening on {address}" in started.output()
        assert "machine demo/lab, bundle " in started.output()
        assert httpx.get(f"{url}/readyz", trust_env=False, timeout=180.0).json()["ready"]
        libraries = Path(f"/proc/{started.process.pid}/maps").read_text(encoding="utf-8")
        assert ("/numpy/" in libraries, "/torch/" in libraries) == (True, False)
        assert started.stop(number) == 0
        lines = [json.loads(line) for line in started.errors().splitlines()]
        assert lines[-1]["event"] == "stopped"
        assert {line["level"] for line in lines} == {"info"}


@pytest.mark.parametrize("command", ["run", "router"])
def test_a_signal_received_by_another_thread_stops_the_program_too(tmp_path: Path, command: str) -> None:
    more = ("--machine", "lab", "--http-port", "0") if command == "run" else ()
    with program(tmp_path, "service", command, "--listen", endpoint(), *more) as started:
        started.wait_for("HTTP API" if command == "run" else "router listening")
        number = started.process.pid
        other = next(int(task.name) for task in Path(f"/proc/{number}/task").iterdir() if int(task.name) != number)
        assert ctypes.CDLL(None).tgkill(number, other, signal.SIGTERM) == 0
        assert started.process.wait(180) == 0


def test_status_without_a_monitor_reports_no_answer_in_json() -> None:
    url = endpoint().replace("tcp/", "http://")
    found = run("status", "--url", url, "--json")
    said = json.loads(found.stdout)
    assert (found.returncode, said["summary"], said["machines"]) == (4, "no-answer", [])
    assert f"{url}: the monitor's HTTP API does not answer" in said["reason"]
    assert said["reason"].endswith("--url says where it is")


def test_status_distinguishes_stopped_data_from_an_alarm(tmp_path: Path) -> None:
    with fed_service(machine_file(tmp_path, IMPATIENT)) as (runtime, worker, feed):
        feed.put_good()
        until(lambda: worker.health().quality.accepted_blocks == 1, "a block")
        until(lambda: "stream-lost" in {one.name for one in worker.alarms().alarms if one.raised}, "the silence")
        worker.descriptor(worker.machine.descriptor.model_dump_json().replace('"um"', '"mm"', 1).encode())
        found, table = (run("status", "--url", runtime.http_url, *more) for more in (["--json"], []))
        feed.put_good()
        until(lambda: "returned" in {one.state for one in worker.alarms().alarms}, "the end of the silence")
        cleared = run("status", "--url", runtime.http_url)
    assert "demo/lab: stream-lost is returned, cleared, to be acknowledged" in cleared.stdout
    assert "differs from the file: channels.0.unit (y1) is 'mm', expected 'um'" in table.stdout
    assert found.returncode == table.returncode == 3
    said = json.loads(found.stdout)
    assert said["summary"] == "no-data"
    assert said["machines"][0]["reason"].startswith("no data since 20")


def test_watch_and_status_show_an_alarm(tmp_path: Path) -> None:
    address = endpoint()
    file = machine_file(tmp_path, *QUICK)
    watching = ("service", "watch", "--connect", address, "--windows")
    with (
        service(address, file, when_full="wait") as (runtime, worker),
        program(tmp_path, *watching, "--machine", "demo/*") as text,
        program(tmp_path, *watching, "--json") as lines,
    ):
        calm = run("status", "--url", runtime.http_url)
        assert calm.returncode == 0
        assert "warming" in calm.stdout
        until(lambda: "state is warming" in text.output() and "/health" in lines.output(), "watchers at work")
        send(address, scenario_blocks(37.0, parse_fault("k_bz=-0.3@0")), worker.machine)
        text.wait_for("ALERT: bearing stiffness, vertical (k_bz) changed by −")
        until(lambda: "org.rotorwatch.alarm.raised" in lines.output(), "alarm event as JSON")
        until(lambda: "00:00:32  demo/lab  alert" in text.output(), "line of the last window")
        assert "00:00:22  demo/lab  " in text.output()
        assert not [line for line in text.output().splitlines() if "healthy" in line and "changed: " in line]

        late = program(tmp_path, "service", "watch", "--connect", address)
        with late as joined:
            joined.wait_for("ALERT (unacknowledged): bearing stiffness, vertical")
            assert joined.stop() == 0
        found = run("status", "--url", runtime.http_url)
        assert found.returncode == 1
        assert "k_bz alert" in found.stdout
        machine = json.loads(run("status", "--url", runtime.http_url, "--json").stdout)["machines"][0]
        Health.model_validate(machine)
        assert [(one["name"], one["raised"]) for one in machine["alarms"]] == [("k_bz", True)]
        assert text.stop(signal.SIGINT) == 0
        assert lines.stop() == 0
        records = [json.loads(line) for line in lines.output().splitlines()]
    topics = {record["topic"].removeprefix("rotorwatch/demo/lab/") for record in records}
    assert topics == {"report", "health", "alarm/state", "alarm/event"}
    for record in records:
        if record["topic"].endswith("/report"):
            Report.model_validate(record["message"])


def test_watch_reports_the_loss_and_return_of_a_monitor(tmp_path: Path) -> None:
    address = endpoint()
    with ExitStack() as started:
        with service(address):
            watcher = started.enter_context(program(tmp_path, "service", "watch", "--connect", address))
            watcher.wait_for("state is ")
        until(lambda: "connection lost, trying again" in watcher.errors(), "loss noticed")
        with service(address):
            until(lambda: "connected again" in watcher.errors(), "return noticed")
        assert watcher.stop() == 0


@pytest.mark.parametrize("form", [(), ("--json",)])
def test_watch_ends_when_its_output_is_closed(form: tuple[str, ...], tmp_path: Path) -> None:
    address = endpoint()
    command = [sys.executable, "-m", "service", "watch", "--connect", address, *form]
    with service(address), (tmp_path / "err").open("w+b") as err:
        watcher = Piped(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=err, start_new_session=True)
        watcher.stdin.close()
        watcher.stdout.close()
        try:
            assert watcher.wait(60) == 0
        finally:
            watcher.kill()
        assert err.read() == b""


def test_reports_alarms_and_health_as_terminal_lines() -> None:
    report = Report.model_validate(example(Report))
    shape = Shape.model_validate(example(Shape))
    start, tail = "00:03:25  demo/lab  alert          ", "  |  changed: k_by  |  relation agrees"
    assert report_line(report) == f"{start}k_by −24.7±1.4 %{tail}"
    assert report.verdict is not None
    settled = report.model_copy(update={"verdict": report.verdict.model_copy(update={"settled": True})})
    small = report.parameters[0].model_copy(update={"relative_change": 0.005})
    assert report_line(settled.model_copy(update={"parameters": (small,)})) == f"{start}k_by  +0.5±1.4 %{tail}"
    sharp = small.model_copy(update={"standard_error": 0.0002})
    assert report_line(settled.model_copy(update={"parameters": (sharp,)})) == f"{start}k_by +0.500±0.039 %{tail}"
    blind = report.parameters[0].model_copy(update={"relative_change": None})
    assert report_line(settled.model_copy(update={"parameters": (blind,)})) == f"{start}k_by n/a{tail}"
    moved = NaturalFrequency.model_validate(example(NaturalFrequency)).model_copy(update={"verdict": "changed"})
    frequencies = {"natural_frequencies": (moved, moved.model_copy(update={"verdict": "not changed"}))}
    assert report_line(report.model_copy(update=frequencies)).endswith(f"agrees  |  {moved.text}")
    unread = {"level_growth": None, "reason": "y1: changed", "levels": ()}
    assert report_line(report.model_copy(update={**unread, "shapes": (shape,)})) == f"{start}y1: changed"
    seen = LevelGrowth.model_validate(example(LevelGrowth))
    assert report_line(report.model_copy(update={**unread, "shapes": (shape,), "level_growth": seen})).endswith(
        seen.text
    )
    just = report.model_copy(update={"verdict": report.verdict.model_copy(update={"current": (), "changed": ()})})
    assert "too little data since the change  |  changed: ?" in report_line(just)
    calm = report.verdict.model_copy(update={"changed": (), "detected": False, "outside_model": True})
    (opinion,) = report.opinions
    apart = opinion.model_copy(update={"agreement": (opinion.agreement[0].model_copy(update={"verdict": "disagree"}),)})
    shown = report_line(report.model_copy(update={"verdict": calm, "opinions": (apart,)}))
    assert shown.endswith("no change, outside the model  |  relation disagrees on k_by")
    early = report.model_copy(update={"parameters": (), "filled": 0.25, "state": "warming"})
    watching = report_line(early.model_copy(update={"state": "watching"}))
    assert watching.endswith("watching       DE-H 1.93 m/s2 rms, velocity 2.1 mm/s rms, 1x 1.1, zone B")
    assert report_line(early) == "00:03:25  demo/lab  warming        window 25% full"
    assert report_line(early.model_copy(update={"reason": "too fast"})).endswith("too fast")
    event = AlarmCloudEvent.model_validate(example(AlarmCloudEvent))
    assert alarm_event_line(event).startswith("00:03:25  demo/lab  ALERT: bearing stiffness, horizontal (k_by)")
    back = event.data.model_copy(update={"name": "stream-lost", "text": "cleared: data are arriving again"})
    assert alarm_event_line(event.model_copy(update={"data": back})) == (
        "00:03:25  demo/lab  cleared: data are arriving again (stream-lost)"
    )
    states = AlarmStates.model_validate(example(AlarmStates))
    assert alarm_state_lines(states) == (
        "00:03:25  demo/lab  ALERT (unacknowledged): bearing stiffness, horizontal  k_by −24.7±1.4 %",
    )
    lost = {"name": "stream-lost", "text": "stream lost", "relative_change": None, "note": "no usable data for 5 s"}
    assert alarm_state_lines(states.model_copy(update={"alarms": (states.alarms[0].model_copy(update=lost),)})) == (
        "00:03:25  demo/lab  ALERT (unacknowledged): stream lost: no usable data for 5 s",
    )
    health = Health.model_validate(example(Health))
    assert health_line(health) == "00:03:25  demo/lab  state is alert"
    unseen = health.model_copy(update={"report": None, "state": "no-data", "reason": "silence"})
    assert health_line(unseen) == "--:--:--  demo/lab  state is no-data: silence"
