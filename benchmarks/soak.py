"""Runs a day of a machine, with all that can go wrong, through the real service, and compares it with an offline run.

Run: ``python benchmarks/soak.py --hours 24 --seed 1`` (hours of data). A simulated rotor kit changes its parameters at
times; probes get stuck; blocks are lost, repeated and swapped; the monitor is killed (SIGKILL) at work and restarted;
followers of the alarm log join, are killed and return. The same blocks go, in order and undisturbed, through the data
path in a separate process. At the end the log in the database, the log written by the followers and the offline log
must agree event by event; if they do not, the exit code is 1.

In the last third the monitor is not killed, to see whether its memory stays constant.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import zenoh
from capacity import Process, session_with
from machine_kind import rotor_kit
from running_monitor import on_loopback, started, url_of

from models.alarm_names import STREAM_LOST
from models.commissioning.commissioned import install
from models.machine import Machine, load_machine
from models.signals.block import SampleBlock
from models.signals.link import LinkSettings
from rotorwatch.client.alarm_log import follow_alarms
from rotorwatch.records.alarms import AlarmCloudEvent
from service.history.machine import MachineStore
from service.history.records import Retention
from service.history.store import Store
from service.monitor.monitor import MachineMonitor
from service.stream.transport import Link, LinkError
from simulator.publisher import PublishSettings, publish
from simulator.scenario import Scenario, load_scenario
from simulator.stream import blocks

_PLACE = "demo/lab"
_BLOCK_S = 0.5
_START_NS = 1_767_225_600_000_000_000
_AHEAD = 80  # most blocks in flight; a publisher caches 1200
_PATIENCE_S = 30.0
_FAULTS = {"k_by": (-0.35, -0.2, 0.4), "k_bz": (-0.35, 0.4), "c_by": (-0.5, 0.8), "c_bz": (-0.5, 0.8), "e": (0.5, 1.0)}
_PAGE = 1000


def machine_file(folder: Path) -> Path:
    """The shipped rotor kit, with a minute until the stream counts as lost, because the day is played much faster."""
    path = folder / "lab.toml"
    path.write_text(f"{rotor_kit()}\n[ingest]\nno_data_after_s = 60.0\n", encoding="utf-8")
    return path


def story(seed: int, hours: float) -> Scenario:
    """Scenario of temporary faults: one parameter at a time, for 5 to 20 minutes, every half an hour or so."""
    rng = np.random.default_rng([seed, 1])
    events, at_s = [], 400.0
    while at_s < hours * 3600 - 300:
        name = str(rng.choice(sorted(_FAULTS)))
        events.append({"at_s": at_s, "parameter": name, "relative_change": float(rng.choice(_FAULTS[name]))})
        at_s += float(rng.uniform(300, 1200))
        events.append({"at_s": at_s, "parameter": name, "relative_change": 0.0})
        at_s += float(rng.uniform(300, 1800))
    events = [event for event in events if float(str(event["at_s"])) < hours * 3600]
    loaded, _ = load_scenario("healthy")
    return Scenario.model_validate(loaded.model_dump() | {"duration_s": hours * 3600, "seed": seed, "events": events})


def lived(machine: Machine, seed: int, hours: float) -> Iterator[SampleBlock]:
    """Blocks that leave the machine, in order: some are lost for good, and at times a probe is stuck."""
    rng = np.random.default_rng([seed, 2])
    lost = stuck = 0
    for block, _ in blocks(story(seed, hours), machine, _BLOCK_S, _START_NS):
        draw = rng.random(3)
        if lost == 0 and draw[0] < 1 / 2400:  # every twenty minutes
            lost = int(rng.choice([1, 4, 20, 60, 260]))
        if stuck == 0 and draw[1] < 1 / 7200:  # every hour
            stuck = int(rng.integers(60, 300))
        if stuck:
            stuck -= 1
            block.samples[:, 0] = 12.5
        if lost:
            lost -= 1
        else:
            yield block


def offline(file: Path, seed: int, hours: float) -> None:
    """Print the offline alarm log, one event per line, and the ends of all windows."""
    machine = load_machine(file)
    monitor = MachineMonitor(install(machine, None))
    for block in lived(machine, seed, hours):
        report = monitor.step(block)
        for window in report.windows:
            print(window.end_ns, flush=True)
        for event in report.events:
            alarm = event.alarm
            shown = (event.kind, alarm.name, event.time_ns, alarm.occurrence, alarm.severity, alarm.state, alarm.change)
            print(json.dumps(shown), flush=True)


def follow(endpoint: str, path: Path) -> None:
    """Append the alarm log to a file, continuing after its last complete line, until killed."""
    kept = path.read_bytes() if path.exists() else b""
    whole = kept[: kept.rfind(b"\n") + 1]
    last = AlarmCloudEvent.model_validate_json(whole.splitlines()[-1]).data.sequence if whole else -1
    with path.open("r+b" if path.exists() else "w+b") as file:
        file.truncate(len(whole))
        file.seek(len(whole))

        def keep(event: AlarmCloudEvent) -> None:
            file.write(f"{event.model_dump_json()}\n".encode())
            file.flush()
            os.fsync(file.fileno())

        while True:
            try:
                link = Link(LinkSettings(mode="client", connect=(endpoint,)))
            except LinkError:  # the monitor is down at present
                continue
            follow_alarms(link.session, [_PLACE], {_PLACE: last}, keep)


@dataclass
class Plant:
    """The monitor, its follower, and what is observed of them."""

    folder: Path
    environment: dict[str, str]
    endpoint: str
    rng: np.random.Generator
    kills_wanted: float
    process: subprocess.Popen[bytes] | None = None
    url: str = ""
    reports: int = 0
    kills: int = 0
    follower: subprocess.Popen[bytes] | None = None
    follower_kills: int = 0
    memory_mb: list[tuple[float, float]] = field(default_factory=list)

    def start(self) -> None:
        """Start the monitor, with output in files of this start, and wait until it listens."""
        out, log = (self.folder / f"{name}-{self.kills}" for name in ("out", "log"))
        self.process = started(["service", "run"], out, log, self.environment)
        self.url = url_of(self.process, out, log)

    def kill(self) -> None:
        """Kill the monitor (SIGKILL) and restart it; wait until the publisher's cache arrives."""
        assert self.process is not None  # noqa: S101  # for the type checker
        self.process.kill()
        self.process.wait()
        self.kills += 1
        self.start()
        while True:
            health = _health(self.url)
            if health["quality"]["accepted_blocks"] or health["quality"]["refused_blocks"] or health["filled"]:
                break
            time.sleep(0.05)
        self.reports += 1  # blocks in flight have been lost or have arrived

    def toggle_follower(self) -> None:
        """Kill the follower if there is one, otherwise start one."""
        if self.follower is None:
            self.follower = subprocess.Popen(
                [sys.executable, __file__, "--follow", self.endpoint, "--into", str(self.folder / "followed.jsonl")]
            )
        else:
            self.follower.kill()
            self.follower.wait()
            self.follower = None
            self.follower_kills += 1

    def weigh(self, data_h: float) -> None:
        """Record the monitor's memory."""
        assert self.process is not None  # noqa: S101  # for the type checker
        self.memory_mb.append((data_h, Process(self.process.pid).memory_mb()))


def disturbed(plant: Plant, machine: Machine, seed: int, hours: float) -> Iterator[tuple[SampleBlock, tuple[()]]]:
    """The same blocks with repetitions and swaps; the monitor is killed in between."""
    rng, newest, sent, since = plant.rng, 0.0, 0, 0
    stream = lived(machine, seed, hours)
    recent: list[SampleBlock] = []
    kills_per_block = plant.kills_wanted / (hours * 2 / 3 * 3600 / _BLOCK_S)
    for first in stream:
        pair = [first]
        if rng.random() < 0.01:
            pair = [*islice(stream, int(rng.integers(1, 6))), first]  # overtaken by 1 to 5 blocks
        for block in pair:
            # After a session lost on a busy computer, only the next block reveals the loss: do not wait for ever.
            patience_s = time.monotonic() + _PATIENCE_S
            while plant.reports == since and sent >= _AHEAD and time.monotonic() < patience_s:
                time.sleep(0.002)
            if plant.reports != since:
                since, sent = plant.reports, 0
            yield block, ()
            sent += 1
            newest = max(newest, (block.end_ns - _START_NS) / 3.6e12)
            recent = [*recent[-100:], block]
            if rng.random() < 0.02:
                yield recent[int(rng.integers(0, len(recent)))], ()
        if newest < hours * 2 / 3 and rng.random() < kills_per_block:
            plant.kill()
            print(f"  {newest:6.2f} h  monitor killed", flush=True)
        if rng.random() < 2 * kills_per_block:
            plant.toggle_follower()
        if not plant.memory_mb or newest - plant.memory_mb[-1][0] >= hours / 96:
            plant.weigh(newest)


def counting(plant: Plant, session: zenoh.Session, machine: Machine) -> "zenoh.Subscriber[None]":
    """Count the reports that the monitor publishes."""

    def take(sample: zenoh.Sample) -> None:
        del sample
        plant.reports += 1

    return session.declare_subscriber(machine.keys.report, take)


def live(plant: Plant, machine: Machine, seed: int, hours: float) -> None:
    """Run the service over the day of data."""
    plant.start()
    with session_with(plant.endpoint) as session:
        subscriber = counting(plant, session, machine)
        settings = PublishSettings(
            link=LinkSettings(connect=(plant.endpoint,)), pace=None, wait_for_subscriber_s=60.0, linger_s=0, drain_s=60
        )
        publish(machine, disturbed(plant, machine, seed, hours), settings)
        subscriber.undeclare()  # type: ignore[no-untyped-call]


def differences(expected: list[list[object]], events: list[AlarmCloudEvent]) -> list[str]:
    """Differences between the live and the offline log, at most 20."""
    found = [f"sequence {at} is {one.data.sequence}" for at, one in enumerate(events) if one.data.sequence != at]
    last_ns = max((int(str(one[2])) for one in expected), default=0)
    logged: list[list[object]] = [
        [d.kind, d.name, d.time_ns, d.occurrence, d.severity, d.state, d.relative_change]
        for d in (one.data for one in events)
        if d.name != STREAM_LOST or d.time_ns <= last_ns  # the silence after the end is not in the offline log
    ]
    for number in range(max(len(expected), len(logged))):
        one = expected[number] if number < len(expected) else None
        other = logged[number] if number < len(logged) else None
        if one != other:
            found.append(f"event {number}: offline {one}, live {other}")
    return found[:20]


def main() -> None:
    """Run the soak test, or one of its helper processes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--kills", type=float, default=40.0, help="approximate number of kills of the monitor, in the first two thirds"
    )
    parser.add_argument("--keep", type=Path, help="empty folder in which all output is kept; deleted without it")
    parser.add_argument("--offline", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--follow", help=argparse.SUPPRESS)
    parser.add_argument("--into", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    if given.offline is not None:
        offline(given.offline, given.seed, given.hours)
        return
    if given.follow is not None:
        follow(given.follow, given.into)
        return
    if given.keep is not None:
        given.keep.mkdir(parents=True, exist_ok=True)
        sys.exit(soak(given.keep.absolute(), given.seed, given.hours, given.kills))
    with tempfile.TemporaryDirectory(prefix="rotorwatch-soak-") as place:
        sys.exit(soak(Path(place), given.seed, given.hours, given.kills))


def soak(folder: Path, seed: int, hours: float, kills_wanted: float) -> int:
    """Run live and offline, compare the logs, and print the result; return the exit code."""
    file, begin_s = machine_file(folder), time.monotonic()
    machine = load_machine(file)
    arguments = ["--offline", str(file), "--hours", str(hours), "--seed", str(seed)]
    with (folder / "offline.jsonl").open("wb") as sink:
        undisturbed = subprocess.Popen([sys.executable, __file__, *arguments], stdout=sink)
    environment, endpoint = on_loopback(folder)
    environment |= {
        "ROTORWATCH_MACHINES": json.dumps([{"file": str(file)}]),
        "ROTORWATCH_QUEUE": json.dumps({"blocks": 40, "when_full": "wait"}),
    }
    plant = Plant(folder, environment, endpoint, np.random.default_rng([seed, 3]), kills_wanted)
    try:
        live(plant, machine, seed, hours)
        undisturbed.wait()
        lines = [json.loads(line) for line in (folder / "offline.jsonl").read_text(encoding="utf-8").splitlines()]
        expected = [line for line in lines if isinstance(line, list)]
        windows = [line for line in lines if isinstance(line, int)]
        _last_window(plant, windows[-1])
        followed = _followed_to_the_end(plant, len(expected))
    finally:
        for process in (plant.follower, plant.process, undisturbed):
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGTERM)
                process.wait()
    store = Store(f"sqlite:///{folder / 'history.sqlite'}", Retention())
    store.open()
    try:
        history = store.machine(*_PLACE.split("/"))
        texts: list[str] = []
        while page := history.events(after=len(texts) - 1, limit=_PAGE):
            texts += [one.text for one in page]
        evaluated = _windows(history)
    finally:
        store.close()
    events = [AlarmCloudEvent.model_validate_json(text) for text in texts]
    faults = differences(expected, events)
    other = next((at for at, pair in enumerate(zip_longest(windows, evaluated)) if pair[0] != pair[1]), None)
    if other is not None:
        faults.append(f"window {other} of {len(windows)} ({len(evaluated)} live): another one than offline")
    if followed != texts[: len(followed)] or len(followed) < len(expected):
        faults.append(f"followers wrote {len(followed)} events down, the log has {len(texts)}; they must be the same")
    data_s = hours * 3600
    elapsed_s = time.monotonic() - begin_s
    print(f"{hours:g} h of data in {elapsed_s / 60:.1f} min ({data_s / elapsed_s:.0f} times real time), seed {seed}")
    print(f"monitor killed {plant.kills} times, followers {plant.follower_kills} times")
    kinds = {kind: sum(one.data.kind == kind for one in events) for kind in ("raised", "escalated", "cleared")}
    print(f"windows: {len(windows)} offline, {len(evaluated)} live")
    print(f"events: {len(expected)} offline, {len(events)} in the history ({kinds}), {len(followed)} followed")
    _tell_memory(plant, hours)
    print("\n".join(faults) if faults else "all logs are the same")
    return 1 if faults else 0


def _tell_memory(plant: Plant, hours: float) -> None:
    """Print the monitor's memory in the time without kills, and its slope."""
    calm = [(at, mb) for at, mb in plant.memory_mb if at > hours * 0.7]
    print(
        "memory of the monitor, MB, over the last third: " + "  ".join(f"{at:.1f} h {mb:.0f}" for at, mb in calm[::4])
    )
    if len(calm) > 1:
        slope = float(np.polyfit([at for at, _ in calm], [mb for _, mb in calm], 1)[0])
        print(f"slope {slope:+.2f} MB/h of data")


def _health(url: str) -> dict[str, Any]:
    answer = httpx.get(f"{url}/api/v1/machines/{_PLACE}/health", trust_env=False)
    health: dict[str, Any] = answer.raise_for_status().json()
    return health


def _windows(history: MachineStore) -> list[int]:
    """Ends of all windows that were evaluated live, in order."""
    ends: list[int] = []
    before: int | None = None
    while page := history.reports(before=before, limit=_PAGE):
        ends += [report.end_ns for _, report in page]
        before = page[-1][0]
    return ends[::-1]


def _last_window(plant: Plant, end_ns: int) -> None:
    """Wait up to 60 s until the monitor has evaluated the last window; the comparison shows if it has not."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        health = _health(plant.url)
        if (health["report"] or {"end_ns": 0})["end_ns"] >= end_ns:
            return
        time.sleep(0.1)


def _followed_to_the_end(plant: Plant, expected: int) -> list[str]:
    """Wait up to 60 s until the follower has all expected events, and return the lines that it wrote."""
    path = plant.folder / "followed.jsonl"
    if plant.follower is None:
        plant.toggle_follower()
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        if len(lines) >= expected:
            return lines
        time.sleep(0.1)
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


if __name__ == "__main__":
    main()
