"""The command line: recordings, exit codes, messages, signals, and a quick start."""

import json
import signal
import socket
import threading
from pathlib import Path

import numpy as np
import pytest
import zenoh
from typer.testing import CliRunner, Result

from models.signals.link import LinkSettings
from models.signals.recording import read_recording, summarize_recording
from models.signals.wire import decode_block
from simulator.rotorsim import app
from simulator.scenario import load_scenario
from simulator.stream import DEFAULT_START_NS, TruthRecord, blocks
from tests.loopback import endpoint, session_of
from tests.service.rig.live import program
from tests.sure import sure

ROOT = Path(__file__).parents[2]


def _run(*arguments: str | float | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_help_shows_examples_and_scenarios() -> None:
    assert "rotorsim record c_by c_by.mcap" in _run("record", "--help").output
    assert "k_bz" in _run("--help").output


def test_a_recording_holds_what_the_publisher_would_send(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    result = _run("record", "healthy", path, "--duration", 12, "--seed", 5, "--fault", "e=0.3@3", "--block-s", 0.25)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"recorded 48 blocks, 12.0 s of data, in {path}\n"
    scenario, machine = load_scenario("healthy")
    scenario = scenario.overridden(seed=5, duration_s=12.0)
    messages = list(read_recording(path))
    keys = machine.keys
    assert summarize_recording(path).messages == {keys.descriptor: 1, keys.truth: 2, keys.stream: 48}
    assert messages[0].key == keys.descriptor
    assert json.loads(messages[0].payload) == machine.descriptor.model_dump(mode="json")
    times = [message.log_time_ns for message in messages]
    assert times == sorted(times)
    assert times[0] == DEFAULT_START_NS
    stream = [m for m in messages if m.key == keys.stream]
    for message, (block, _) in zip(stream, blocks(scenario, machine, 0.25), strict=True):
        received = decode_block(message.payload, message.attachment, message.encoding)
        assert (received.start_ns, received.sequence, received.run) == (block.start_ns, block.sequence, 1)
        assert received.schema_hash == machine.descriptor.schema_hash
        assert message.log_time_ns == message.publish_time_ns == block.end_ns
        if block.end_ns <= DEFAULT_START_NS + 3_000_000_000:  # the same as without the fault, as it has not come yet
            np.testing.assert_array_equal(received.samples, block.samples)
    truth = [TruthRecord.model_validate_json(m.payload) for m in messages if m.key == keys.truth]
    assert [entry.relative_changes["e"] for entry in truth] == [0.0, 0.3]
    assert {entry.seed for entry in truth} == {5}


def test_the_same_command_makes_the_same_bytes(tmp_path: Path) -> None:
    paths = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    for path in paths:
        assert _run("record", "healthy", path, "--duration", 3).exit_code == 0
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_start_run_machine_and_arrow_are_options(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    result = _run(
        "record", "healthy", path, "--duration", 1, "--machine", "heavy", "--start", "2027-03-04T05:06:07.5+01:00",
        "--run", 9, "--encoding", "arrow",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    stream = [m for m in read_recording(path) if m.key == "rotorwatch/demo/heavy/stream"]
    block = decode_block(stream[0].payload, stream[0].attachment, stream[0].encoding)
    assert (block.start_ns, block.run) == (1_804_133_167_500_000_000, 9)


def test_a_run_time_failure_exits_1() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        result = _run("publish", "--duration", 1, "--listen", f"tcp/127.0.0.1:{taken.getsockname()[1]}")
    assert result.exit_code == 1
    assert "no Zenoh session" in result.stderr
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_publishing_cleanly(tmp_path: Path, number: signal.Signals) -> None:
    address = endpoint()
    three = threading.Event()
    gone = threading.Event()

    def keep(sample: zenoh.Sample) -> None:
        block = decode_block(sample.payload.to_bytes(), sure(sample.attachment).to_bytes(), str(sample.encoding))
        if block.sequence >= 3:
            three.set()

    def watch(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            gone.set()

    with session_of(LinkSettings(listen=(address,))) as session:
        session.declare_subscriber("rotorwatch/demo/lab/stream", keep)
        session.liveliness().declare_subscriber("rotorwatch/demo/lab/alive/publisher", watch)
        command = ("simulator.rotorsim", "publish", "--connect", address, "--block-s", "0.05")
        with program(tmp_path, *command) as publisher:
            assert three.wait(180)
            assert publisher.stop(number) == 0
        assert gone.wait(180)
    # Progress and nothing else.
    assert [line for line in publisher.errors().splitlines() if "s of data" not in line] == []
    (said,) = publisher.output().splitlines()
    assert said.startswith("published ")
    assert said.endswith("s of data, on rotorwatch/demo/lab/stream")


@pytest.mark.parametrize("listened", [True, False])
def test_publishing_shows_progress_and_whether_there_is_a_subscriber(listened: bool) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        where = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    with session_of(LinkSettings(listen=(where,))) as session:
        if listened:
            session.declare_subscriber("rotorwatch/demo/lab/stream", lambda _: None)
        result = _run("publish", "healthy", "--duration", 2.5, "--connect", where, "--linger", 0)
    assert result.exit_code == 0, result.output
    assert "of 2.5 s of data" in result.stderr
    assert ("rotorwatch/demo/lab/stream has no subscriber" in result.stderr) is not listened
