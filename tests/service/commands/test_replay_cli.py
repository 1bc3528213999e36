"""`rotorwatch replay` as a process: what it writes, where, and its exit codes; a namespace on the command line."""

import hashlib
import json
import signal
from functools import partial
from pathlib import Path

import pytest

from models.signals.recording import read_recording
from service.commands.replay import link_of
from simulator.scenario import parse_fault
from tests.service.rig.live import LAB, endpoint, machine_file, program, scenario_blocks, until
from tests.service.rig.preloaded import ran, rotorwatch
from tests.service.rig.replaying import recording, write


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    return recording(folder / "faulty.mcap", scenario_blocks(80.0, parse_fault("c_bz=0.5@0")))


run = partial(rotorwatch, "replay")


def test_output_is_the_same_in_a_file_and_on_the_terminal(faulty: Path, tmp_path: Path) -> None:
    out = tmp_path / "reports.jsonl"
    to_file = run(faulty, "--offline", "--out", out)
    to_terminal = run(faulty, "--offline")
    assert to_file.returncode == to_terminal.returncode == 0, to_file.stderr
    assert to_file.stdout == ""
    text = out.read_text(encoding="utf-8")
    assert to_terminal.stdout == text
    topics = [json.loads(line)["topic"] for line in text.splitlines()]
    assert set(topics) == {LAB.keys.report, LAB.keys.alarm_event}
    assert f"SHA-256 of the lines {hashlib.sha256(text.encode()).hexdigest()}" in to_file.stderr
    assert "800 blocks accepted, refused: none" in to_file.stderr
    assert "1 alarm events, raised at the end: c_bz" in to_file.stderr
    again = run(faulty, "--offline", "--out", out)
    assert (again.returncode, "already exists" in again.stderr) == (2, True)
    assert out.read_text(encoding="utf-8") == text


def test_a_full_disk_leaves_no_partial_results_file(faulty: Path, tmp_path: Path) -> None:
    out = tmp_path / "reports.jsonl"
    found = ran("service", "replay", faulty, "--offline", "--out", out, largest_file=8192)
    assert (found.returncode, found.stderr.splitlines()[-1:]) == (2, [f"{out}: cannot be written (File too large)"])
    assert not out.exists()


def test_a_full_output_for_progress_is_not_blamed_on_the_results_file(faulty: Path, tmp_path: Path) -> None:
    out = tmp_path / "reports.jsonl"
    command = ("service", "replay", faulty, "--offline", "--progress", "json", "--out", out)
    found = ran(*command, out=Path("/dev/full"))
    assert (found.returncode, found.stderr) == (1, "the output cannot be written (No space left on device)\n")


def test_an_interrupted_offline_replay_exits_130_and_names_its_partial_output(faulty: Path, tmp_path: Path) -> None:
    out = tmp_path / "reports.jsonl"
    command = ("service", "replay", str(faulty), "--offline", "--progress", "json", "--out", str(out))
    with program(tmp_path, *command) as started:
        started.wait_for('"progress"')
        assert started.stop(signal.SIGINT) == 130
        assert '"stopped":true' in started.output()
        assert f"{out} holds the lines up to that point" in started.errors()


def test_offline_replay_with_another_machine_file_and_limit(faulty: Path, tmp_path: Path) -> None:
    """Another machine name is reported and evaluated; with a higher limit the alarm is not raised."""
    file = machine_file(tmp_path, ('name = "lab"', 'name = "lab2"'))
    calm = "alarms.parameters.c_bz = {raise_above = 0.8, danger_above = 0.9}"
    first = 'levels.reference = "first windows"'
    changes = ("--set", calm, "--set", first)
    found = run(faulty, "--offline", "--machine", file, *changes, "--out", tmp_path / "out.jsonl")
    assert found.returncode == 0, found.stderr
    assert "machine is 'lab', expected 'lab2'" in found.stderr
    assert "demo/lab2" in found.stderr
    assert "0 alarm events, raised at the end: none" in found.stderr
    assert "800 blocks accepted, refused: none" in found.stderr
    assert "1 of 5 first windows, so no limit is relative to this machine yet" in found.stderr


def test_mismatching_channels_are_named(faulty: Path, tmp_path: Path) -> None:
    file = machine_file(tmp_path, ('unit = "mm/s"', 'unit = "m/s"'))
    found = run(faulty, "--offline", "--machine", file, "--to", "2")
    assert found.returncode == 1
    assert "channels.2.unit (y1_dot) is 'mm/s', expected 'm/s'" in found.stderr
    assert "no block was accepted: demo/lab: the stream's channel descriptor has hash" in found.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--offline", "--from", "soon"), "--from is 'soon'"),
        (("--offline", "--from", "500"), "nothing was recorded in between"),
        (("--offline", "--key", "demo/fan"), "machines with sample blocks: demo/lab"),
        (("--offline", "--prefix", "x"), "--prefix makes sense only without --offline"),
        (("--offline", "--pace", "10"), "--pace makes sense only without --offline"),
        (("--offline", "--progress", "json"), "--out"), (("--offline", "--set", "alarms.on_delay_s="), "changes: "),
        (("--offline", "--set", "alarms.on_delay_s=-1"), "alarms.on_delay_s"),
        (("--offline", "--set", "alarms.delay_s=1"), "alarms.delay_s"),
        (("--offline", "--set", "alarms.on_delay_s"), "--set 'alarms.on_delay_s': expected FIELD=VALUE"),
        (("--machine", "lab"), "--machine makes sense only with --offline"),
        (("--pace", "0"), "--pace is '0', expected 0.1 to 1000, or max"), (("--pace", "nan"), "--pace is 'nan'"),
        (("--loop", "0"), "--loop is '0'"), (("--prefix", "a/*"), "--prefix is 'a/*'"),
        (("--prefix", "", "--loop", "2"), "--loop needs a prefix"),
    ],
)  # fmt: skip
def test_invalid_options_are_refused(faulty: Path, arguments: tuple[str, ...], message: str) -> None:
    from typer.testing import CliRunner  # noqa: PLC0415  # in this process: a dozen starts would take a minute

    from service.commands.rotorwatch import app  # noqa: PLC0415

    found = CliRunner().invoke(app, ["replay", str(faulty), *arguments])
    assert found.exit_code == 2, found.output
    assert message in found.stderr


def test_unusable_files_and_addresses_are_named(tmp_path: Path, faulty: Path) -> None:
    (tmp_path / "text.mcap").write_text("no recording", encoding="utf-8")
    found = run(tmp_path / "text.mcap", "--offline")
    assert found.returncode == 2
    assert "text.mcap: not a recording (MCAP)" in found.stderr
    other = [message for message in read_recording(faulty) if message.key != LAB.keys.stream]
    found = run(write(tmp_path / "empty.mcap", other), "--offline")
    assert found.returncode == 2
    assert "empty.mcap: contains no sample blocks" in found.stderr
    found = run(faulty, "--connect", endpoint())
    assert (found.returncode, "nothing answers there" in found.stderr) == (1, True)


def test_a_monitor_in_a_replays_namespace_raises_its_alarms(faulty: Path, tmp_path: Path) -> None:
    """By the commands of the documentation: monitor, replay, alarm; a replay is not recorded."""
    address = endpoint()
    text = '[recording]\ndirectory = "recordings"\n\n[queue]\nwhen_full = "wait"\n'
    (tmp_path / "plant.toml").write_text(text, encoding="utf-8")
    arguments = ("--config", str(tmp_path / "plant.toml"), "--listen", address, "--http-port", "0")
    with program(tmp_path, "service", "run", *arguments, "--namespace", "replay/x") as monitor:
        monitor.wait_for("HTTP API")
        assert "Zenoh namespace replay/x" in monitor.output()
        options = ("--prefix", "replay/x", "--pace", "max", "--connect", address, "--wait-for-subscriber", "20")
        found = run(faulty, *options)
        assert found.returncode == 0, found.stderr
        assert "801 messages replayed" in found.stderr
        until(lambda: monitor.health().quality.accepted_blocks == 800, "all blocks")
        until(lambda: monitor.health().state == "danger", "alarm")
        assert [alarm.name for alarm in monitor.health().alarms if alarm.raised] == ["c_bz"]
        assert monitor.stop() == 0
    assert not (tmp_path / "recordings").exists()


def test_endpoints_on_the_command_line_replace_those_of_a_link_file(tmp_path: Path) -> None:
    """All of them: connecting elsewhere with a router's file does not listen at the router's endpoint."""
    file, here, there = tmp_path / "link.toml", "tcp/127.0.0.1:7001", "tcp/127.0.0.1:7002"
    file.write_text(f'[link]\nmode = "router"\nlisten = ["{here}"]\nmax_message_mb = 3\n', encoding="utf-8")
    ends = [(one.mode, one.listen, one.connect) for one in (
        link_of(None, None, file), link_of([there], None, file), link_of(None, [there], file)
    )]  # fmt: skip
    assert ends == [("router", (here,), ()), ("client", (), (there,)), ("peer", (there,), ())]
    assert link_of([there], None, file).max_message_mb == 3
