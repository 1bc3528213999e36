"""From nothing to the first trend: `rotorwatch init`, `doctor`, `run` and `plot trend` with a user's two sensors."""

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from models.machine import load_machine_file
from models.signals.block import SampleBlock
from models.signals.link import LinkSettings
from models.signals.recording import RecordedMessage
from models.signals.wire import encode_block
from service.access.scopes import Scope
from service.analysis.arrival import examined
from service.runtime.runtime import running
from service.settings.service import load_settings
from simulator.publisher import PublishSettings, publish
from tests.loopback import endpoint
from tests.service.rig.live import ROOT, until
from tests.service.rig.monitored import client, token
from tests.service.rig.preloaded import rotorwatch as run
from tests.sure import sure

RATE_HZ, START_NS = 2560.0, 1_767_225_600_000_000_000
FAN = (
    "init", "--site", "plant", "--name", "fan", "--rate-hz", "2560", "--zones", "ISO 20816-3 group 2 rigid",
    "--sensor", "DE-H acceleration g DE horizontal", "--sensor", "NDE-V velocity mm/s NDE vertical",
)  # fmt: skip

PROBE = ("--sensor", "DE-X displacement um DE X")


def blocks(seconds: float, rate_hz: float = RATE_HZ, every_s: float = 0.5) -> Iterator[tuple[SampleBlock, tuple[()]]]:
    rng, size = np.random.default_rng(95), round(0.5 * rate_hz)
    for number in range(round(seconds / every_s)):
        t = number * every_s + np.arange(size) / rate_hz
        drive = 0.04 * np.sin(2 * np.pi * 24.8 * t) + 0.05 * rng.standard_normal(size)
        samples = np.column_stack([drive, 1.1 * np.sin(2 * np.pi * 24.8 * t)]).astype(np.float32)
        start_ns = START_NS + round(number * every_s * 1e9)
        yield SampleBlock(run=3, sequence=number, start_ns=start_ns, rate_hz=rate_hz, samples=samples), ()


@contextmanager
def publishing(folder: Path, address: str, seconds: float, pace: float, rate_hz: float = RATE_HZ) -> Iterator[None]:
    """Publish a user's sensors: wait for a subscriber and send until the end."""
    stop = threading.Event()
    machine = load_machine_file(folder / "fan.toml").model_copy(update={"rate_hz": rate_hz})
    every_s = 0.5 if machine.schedule is None else machine.schedule.every_s
    settings = PublishSettings(
        link=LinkSettings(connect=(address,)), pace=pace, wait_for_subscriber_s=60.0, linger_s=5.0
    )
    sender = threading.Thread(target=lambda: publish(machine, blocks(seconds, rate_hz, every_s), settings, stop=stop))
    sender.start()
    try:
        yield
    finally:
        stop.set()
        sender.join()


def test_init_writes_files_that_other_commands_accept(tmp_path: Path) -> None:
    tmp_path /= "of a plant"
    done = run(*FAN, "--folder", str(tmp_path), "--speed-rpm", "1488")
    assert done.returncode == 0, done.stderr
    assert f"rotorwatch doctor --machine '{tmp_path}/fan.toml'" in done.stdout
    machine = load_machine_file(tmp_path / "fan.toml")
    assert [channel.name for channel in machine.sensors] == ["DE-H", "NDE-V"]
    assert sure(machine.operation).speed_rpm == 1488
    assert run("check-config", str(tmp_path / "rotorwatch.toml")).returncode == 0
    again = run(*FAN, "--folder", str(tmp_path))
    assert again.returncode == 2
    assert "--overwrite" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("init",), "--site is missing, and there is no terminal to ask for it"),
        (("init", "--site", "plant", "--name", "fan", "--sensor", "a b c d e"), "--rate-hz is missing"),
        ((*FAN, "--sensor", "DE-A acceleration"), "has 2 words, expected 5"),
        ((*FAN, "--sensor", "DE-A acceleration g rms DE axial"), "has 6 words, expected 5"),
        ((*FAN, "--sensor", "DE-A acceleration G DE axial"), "did you mean g"),
        ((*FAN, "--snapshots", "10"), "--snapshots '10' has 1 words, expected two, such as '0.1 10'"),
        ((*FAN, "--snapshots", "10 5"), "on_s 10 must be below every_s 5"),
        ((*FAN, "--zones", "ISO 20816-3 group 2 stiff"), "is not one of"),
        ((*FAN, "--zones", "ISO 20816-3 shaft"), "shaft applies to no channel, expected one of displacement"),
        ((*FAN, "--zones", "ISO 20816-3 shaft", *PROBE), "ISO 20816-3 shaft: the running speed is not known"),
        (("init", "--site", "a plant", *FAN[3:]), "a plant"),
    ],
)
def test_init_refuses_wrong_arguments_and_writes_nothing(tmp_path: Path, arguments: tuple[str, ...], says: str) -> None:
    done = run(*arguments, "--folder", str(tmp_path))
    assert done.returncode == 2
    assert says in done.stderr
    assert list(tmp_path.iterdir()) == []


def examined_by_doctor(folder: Path, *more: str, rate_hz: float = RATE_HZ) -> subprocess.CompletedProcess[str]:
    address = endpoint()
    with publishing(folder, address, 120, 2.0, rate_hz=rate_hz):
        return run("doctor", "--machine", str(folder / "fan.toml"), "--listen", address, *more)


def test_the_doctor_reports_rate_levels_and_zones(tmp_path: Path) -> None:
    run(*FAN, "--folder", str(tmp_path))
    done = examined_by_doctor(tmp_path, "--seconds", "2")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "sampling rate 2560 Hz, expected 2560" in done.stdout
    # Not exact: a busy computer delivers fewer blocks, and there is noise.
    said = float(done.stdout.split("DE-H ")[1].split()[0])
    assert said == pytest.approx(np.hypot(0.04 / np.sqrt(2), 0.05), rel=0.05)
    assert "zone" in done.stdout


def test_the_doctor_waits_for_snapshots(tmp_path: Path) -> None:
    run(*FAN, "--folder", str(tmp_path), "--snapshots", "0.5 2")
    done = examined_by_doctor(tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "listening for 12.5 s" in done.stdout  # ten seconds, and a period with its snapshot
    assert "0.5 s in the latest snapshot, in blocks of 1280 samples" in done.stdout
    assert "DE-H 0.05" in done.stdout


def test_the_doctor_reports_a_wrong_rate_and_missing_data(tmp_path: Path) -> None:
    run(*FAN, "--folder", str(tmp_path))
    done = examined_by_doctor(tmp_path, "--seconds", "2", rate_hz=2000.0)
    assert done.returncode == 1
    assert "rate_hz" in done.stdout
    assert done.stdout.count("blocks would be refused, for example: ") == 1
    silent = run("doctor", "--machine", str(tmp_path / "fan.toml"), "--listen", endpoint(), "--seconds", "1")
    assert silent.returncode == 1
    assert "nothing arrived under rotorwatch/plant/fan/stream" in silent.stdout
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        refused = run("doctor", "--machine", str(tmp_path / "fan.toml"), "--listen", taken)
    assert refused.returncode == 1
    assert f"If it is a monitor, listen beside it: --connect {taken}" in refused.stderr
    assert "no publisher answers a query for it (docs/wire.md)" in silent.stdout


def test_the_doctor_names_the_stream_of_a_machine_with_another_name(tmp_path: Path) -> None:
    run(*FAN, "--folder", str(tmp_path))
    other, address = tmp_path / "other.toml", endpoint()
    other.write_text((tmp_path / "fan.toml").read_text().replace('name = "fan"', 'name = "fan-1"'))
    with publishing(tmp_path, address, 120, 2.0):
        done = run("doctor", "--machine", str(other), "--listen", address, "--seconds", "1")
    assert "nothing arrived under rotorwatch/plant/fan-1/stream; heard were rotorwatch/plant/fan/stream" in done.stdout


def test_the_doctor_sums_up_gaps_and_disconnected_sensors(tmp_path: Path) -> None:
    run(*FAN, "--folder", str(tmp_path))
    machine = load_machine_file(tmp_path / "fan.toml")

    def troubles(sent: Iterator[tuple[SampleBlock, tuple[()]]]) -> list[str]:
        return examined(machine, [
            RecordedMessage(machine.keys.stream, *encode_block(block, ""), block.start_ns, block.start_ns)
            for block, _ in sent
        ])[1]  # fmt: skip

    told = troubles(blocks(12.0, every_s=0.6))
    assert "19 times a block does not follow the previous one; 1.9 s of data are missing, for example:" in told
    assert sum("0.1 s" in one for one in told) == 3
    fast = [(replace(one, start_ns=one.start_ns - 150_000 * one.sequence), ()) for one, _ in blocks(12.0)]
    by_time = "by their time stamps, 2560.77 samples come in a second, expected 2560: speed and frequencies are wrong"
    assert [one for one in troubles(iter(fast)) if by_time in one]
    both = [(each, ()) for block, _ in blocks(12.0) for each in (block, replace(block, run=4))]
    assert "two publishers contradict each other: runs 3 and 4 both send" in troubles(iter(both))
    whole = list(blocks(6.0))
    for block, _ in whole[4:7]:
        block.samples[:, 1] = np.nan
    (trouble,) = (one for one in troubles(iter(whole)) if "NDE-V" in one)
    assert trouble == "NDE-V: sent as NaN, the last time for 1.5 s, expected numbers: its sensor is not connected"


def test_the_doctor_compares_clocks_and_reports_a_keyphasor_sent_as_volts(tmp_path: Path) -> None:
    probe, keyphasor = "VE-1 displacement um shaft-end axial", "KPH shaft_angle rad shaft rotation"
    run(*FAN, "--sensor", probe, "--sensor", keyphasor, "--folder", str(tmp_path))
    machine = load_machine_file(tmp_path / "fan.toml")
    messages = []
    for block, _ in blocks(3.0):
        volts = np.where(np.arange(len(block.samples)) % 100 < 5, -14.0, -7.0).astype(np.float32)
        gap = np.full(len(block.samples), -1015.0, np.float32)
        sent = replace(block, samples=np.column_stack([block.samples, gap, volts]).astype(np.float32))
        messages.append(RecordedMessage(machine.keys.stream, *encode_block(sent, ""), sent.end_ns - 3600 * 10**9, 0))
    lines, troubles = examined(machine, messages)
    zone = ", 3600 s ahead of this computer's clock: perhaps local time (by 1 h), expected UTC"
    assert any(one.endswith(zone) for one in lines), lines
    assert any("VE-1 0 µm pp, gap -1015 µm" in one for one in lines), lines
    (trouble,) = (one for one in troubles if "shaft angle" in one)
    assert "it is between -14 and -7 rad" in trouble
    assert "instead of an angle from 0 to 2 pi" in trouble


def test_two_sensors_have_a_trend_after_init_run_and_plot(tmp_path: Path) -> None:
    run(*FAN, "--folder", str(tmp_path))
    address, settings = endpoint(), tmp_path / "rotorwatch.toml"
    text = settings.read_text(encoding="utf-8")
    settings.write_text(text.replace("tcp/127.0.0.1:7447", address) + "\n[http]\nport = 0\n", encoding="utf-8")
    with running(load_settings(settings)) as service, publishing(tmp_path, address, 100, 50.0):
        (worker,) = service.machines()
        until(lambda: worker.health().filled == 1, "a full window")
        health = worker.health()
        assert health.state == "watching"
        assert [one.channel for one in sure(health.report).levels] == ["DE-H", "NDE-V"]
        until(lambda: worker.history.downsampled(quantity="level", names=["NDE-V:overall"], points=10) != (), "a level")
        (bucket, *_) = worker.history.downsampled(quantity="level", names=["NDE-V:overall"], points=1)
        assert bucket.mean == pytest.approx(1.1 / np.sqrt(2), rel=0.01)
        with client(service, token(service, Scope.READ)) as http:
            exposed = http.get("/metrics").text
        levels = [one for one in exposed.splitlines() if one.startswith("rotorwatch_level{")]
        (line,) = [one for one in levels if 'channel="NDE-V"' in one and 'measure="overall"' in one]
        assert 'unit="mm/s"' in line
        assert float(line.split()[-1]) == pytest.approx(1.1 / np.sqrt(2), rel=0.01)
    recordings = [str(path) for path in (tmp_path / "recordings").rglob("*.mcap")]
    done = run("plot", "trend", *recordings, "--out", str(tmp_path / "trend.svg"))
    assert done.returncode == 0, done.stderr
    assert "DE-H" in (tmp_path / "trend.svg").read_text(encoding="utf-8")


def test_init_prompts_until_an_empty_channel_and_repeats_invalid_entries(tmp_path: Path) -> None:
    keyboard, terminal = os.openpty()
    wrong = "two thousand", "DE-H acceleration g DE", "DE-H acceleration furlong DE horizontal"
    typed = ("a plant", "plant", "fan/1", "fan", wrong[0], "2560", *wrong[1:], FAN[10], FAN[12], "")
    os.write(keyboard, "".join(f"{line}\n" for line in typed).encode())
    command = [sys.executable, "-m", "service", "init", "--folder", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, stdin=terminal, capture_output=True, text=True, timeout=60, check=False)
    for end in (keyboard, terminal):
        os.close(end)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("cannot be part of a key: use 1 to 64 letters") == 2
    assert "has 4 words, expected 5" in done.stdout
    assert "unit 'furlong' is not one of" in done.stdout
    assert [one.name for one in load_machine_file(tmp_path / "fan.toml").sensors] == ["DE-H", "NDE-V"]
