"""How many machines one monitor carries: end to end, from the last sample of a hop to its report on the topic.

Run: ``python benchmarks/capacity.py --machines 10 20 40`` (some minutes for each). A monitor with its history in a file
and networks on watches so many rotor kits (9 channels, 2 kHz, windows of 60 s, hops of 5 s); this process, which shares
the computer with it, sends streams simulated beforehand at pace 1, the machines' hops spread evenly over time. Cores
and memory are the monitor's own; *yardstick* is the processor time of the Fourier transforms that a hop's cross-spectra
need at the very least, measured here before. ``--stall 10`` stops the monitor for as long in the middle of it and tells
when reports are in time again.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import signal
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import httpx
import numpy as np
import zenoh
import zenoh.ext
from running_monitor import on_loopback, started, url_of

from models.diagnosis.moments import plan_for
from models.machine import MachineFile, load_machine
from models.signals.block import SampleBlock
from models.signals.link import LinkSettings
from models.signals.wire import encode_block
from simulator.scenario import load_scenario
from simulator.stream import blocks

BLOCK_S = 0.1
KINDS = 4
"""Streams with a seed of their own; machines share them, each with its own times."""
IN_TIME_S = 1.0
CACHED = 1200


def yardstick_s(machine: MachineFile) -> float:
    """Processor time of the Fourier transforms of a hop, the least of many."""
    plan = plan_for(machine)
    piece = np.random.default_rng(1).standard_normal((plan.hop + plan.segment, len(machine.sensors)))
    times = []
    for _ in range(200):
        begin_s = time.process_time()
        for at in range(0, plan.hop, plan.segment // 2):
            np.fft.rfft(piece[at : at + plan.segment], axis=0)
        times.append(time.process_time() - begin_s)
    return min(times)


@dataclass(slots=True)
class Process:
    """What the system says of a process and those that it has started: processor, memory, what went to the disk."""

    pid: int

    def all(self) -> list[Path]:
        """Where the system tells of each."""
        stats = ((one.parent, one.read_text(encoding="utf-8")) for one in Path("/proc").glob("[0-9]*/stat"))
        started = [place for place, text in stats if int(text.rsplit(")", 1)[1].split()[1]) == self.pid]
        return [Path(f"/proc/{self.pid}"), *started]

    def cpu_s(self) -> float:
        """Processor time so far, s."""
        stats = [(one / "stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split() for one in self.all()]
        return sum(int(one[11]) + int(one[12]) for one in stats) / os.sysconf("SC_CLK_TCK")

    def memory_mb(self) -> float:
        """Resident memory, what processes share counted in each, MB."""
        return sum(int((one / "statm").read_text(encoding="ascii").split()[1]) for one in self.all()) * 4096 / 1e6

    def written_mb(self) -> float:
        """What has gone to the disk, MB."""
        texts = [(one / "io").read_text(encoding="ascii").splitlines() for one in self.all()]
        return sum(int(dict(line.split(": ") for line in lines)["write_bytes"]) for lines in texts) / 1e6

    def signal(self, number: int) -> None:
        """Send a signal to all of them."""
        for one in self.all():
            os.kill(int(one.name), number)


@dataclass(slots=True)
class Plant:
    """Machines that send, each its own hops later than the one before, and when their reports came."""

    machines: Sequence[MachineFile]
    session: zenoh.Session
    streams: list[list[SampleBlock]]
    start_ns: int = field(default_factory=time.time_ns)
    sent_s: dict[tuple[str, int], float] = field(default_factory=dict)  # of every block, by its number
    heard: list[tuple[float, float]] = field(default_factory=list)  # when, and how late
    windows: dict[str, list[tuple[float, int]]] = field(default_factory=lambda: defaultdict(list))  # when, and end
    behind_s: float = 0.0

    def hear(self, sample: zenoh.Sample) -> None:
        """Take a report."""
        now_s, report = time.monotonic(), json.loads(sample.payload.to_bytes())
        last = -(-(report["end_ns"] - self.start_ns) // round(BLOCK_S * 1e9)) - 1
        self.heard.append((now_s, now_s - self.sent_s[report["machine"], last]))
        self.windows[report["machine"]].append((now_s, report["end_ns"] - self.start_ns))

    def send(self, ended: threading.Event) -> None:
        """Send everything, at the pace of the data, until the end."""
        count, per_hop = len(self.machines), round(self.machines[0].window.hop_s / BLOCK_S)
        hashes = [machine.descriptor.schema_hash for machine in self.machines]
        # As a real publisher: a monitor that begins again gets what it missed.
        outlets = [
            zenoh.ext.declare_advanced_publisher(
                self.session,
                machine.keys.stream,
                congestion_control=zenoh.CongestionControl.BLOCK,
                cache=zenoh.ext.CacheConfig(max_samples=CACHED),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=1.0, sporadic_heartbeat=None),
            )
            for machine in self.machines
        ]
        begin_s = time.monotonic()
        for tick in range(len(self.streams[0]) + per_hop):
            for number, machine in enumerate(self.machines):
                at = tick - number * per_hop // count
                if not 0 <= at < len(self.streams[0]):
                    continue
                due_s = begin_s + (tick + number / count) * BLOCK_S
                if ended.wait(max(0.0, due_s - time.monotonic())):
                    return
                block = self.streams[number % KINDS][at]
                block = replace(block, start_ns=block.start_ns + self.start_ns)
                payload, attachment, encoding = encode_block(block, hashes[number])
                self.sent_s[machine.name, at] = time.monotonic()
                outlets[number].put(payload, attachment=attachment, encoding=encoding)
                self.behind_s = time.monotonic() - due_s


@contextmanager
def monitored(folder: Path, machines: Sequence[MachineFile]) -> Iterator[tuple[Process, str, str]]:
    """A monitor of these machines: its process, its endpoint and its address."""
    environment, endpoint = on_loopback(folder)
    text = Path("models/machines/lab.toml").read_text(encoding="utf-8")
    entries = []
    for machine in machines:
        file = folder / f"{machine.name}.toml"
        file.write_text(text.replace('name = "lab"', f'name = "{machine.name}"'), encoding="utf-8")
        entries.append({"file": str(file), "bundle": "lab"})
    environment["ROTORWATCH_MACHINES"] = json.dumps(entries)
    process = started(["service.rotorwatch", "run"], folder / "out", folder / "log", environment)
    try:
        yield Process(process.pid), endpoint, url_of(process, folder / "out", folder / "log")
    finally:
        Process(process.pid).signal(signal.SIGCONT)
        process.terminate()
        process.wait(120)


@contextmanager
def sending(
    endpoint: str, machines: Sequence[MachineFile], streams: list[list[SampleBlock]]
) -> Iterator[tuple[Plant, threading.Thread]]:
    """A plant that sends and hears reports, and the thread that does until the streams end or the block is left."""
    config = zenoh.Config()
    for path, value in LinkSettings(mode="client", connect=(endpoint,)).zenoh_items().items():
        config.insert_json5(path, value)
    with zenoh.open(config) as session:
        plant, ended = Plant(machines, session, streams), threading.Event()
        subscriber = session.declare_subscriber("rotorwatch/*/*/report", plant.hear)
        sender = threading.Thread(target=plant.send, args=(ended,))
        sender.start()
        try:
            yield plant, sender
        finally:
            ended.set()
            sender.join()
            subscriber.undeclare()  # type: ignore[no-untyped-call]


def lost(url: str) -> int:
    """Blocks that were refused, dropped or are missing, of all machines."""
    count = 0
    with httpx.Client(base_url=url, trust_env=False, timeout=60.0, verify=False) as http:  # noqa: S501  # no HTTPS
        for machine in http.get("/api/v1/machines").json()["machines"]:
            health = http.get(f"/api/v1/machines/{machine['site']}/{machine['machine']}/health").json()
            quality = health["quality"]
            count += sum(quality["refused_blocks"].values()) + quality["queue_dropped_blocks"] + quality["gaps"]
    return count


def measure(count: int, seed: int, length_s: float, stall_s: float) -> None:
    """Watch so many machines for a while after their windows have filled, and print what it took."""
    base = load_machine("lab")
    machines = [base.model_copy(update={"name": f"kit{number}"}) for number in range(count)]
    scenario, _ = load_scenario("healthy")
    warm_s = base.window.length_s + 4 * base.window.hop_s
    streams = [
        [
            block
            for block, _ in blocks(
                scenario.overridden(seed=seed + kind, duration_s=warm_s + length_s), base, BLOCK_S, start_ns=0
            )
        ]
        for kind in range(min(KINDS, count))
    ]
    yardstick = yardstick_s(base)
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name,
        monitored(Path(name), machines) as (process, endpoint, url),
    ):
        idle_mb = process.memory_mb()
        with sending(endpoint, machines, streams) as (plant, _):
            time.sleep(warm_s)
            before, begin_s = (process.cpu_s(), process.written_mb(), time.process_time()), time.monotonic()
            first = len(plant.heard)
            again_s = _stalled(process, plant, stall_s, length_s) if stall_s else None
            time.sleep(max(0.0, begin_s + length_s - time.monotonic()))
            took_s = time.monotonic() - begin_s
            cpu_s, written_mb = process.cpu_s() - before[0], process.written_mb() - before[1]
            late = np.array([one for _, one in plant.heard[first:]])
            memory_mb, missing = process.memory_mb(), lost(url)
    expected = count * took_s / base.window.hop_s
    print(
        f"{count:4d} machines: {cpu_s / took_s:5.2f} cores ({1e3 * cpu_s / expected:.0f} ms a hop, "
        f"{cpu_s / expected / yardstick:.0f} x the yardstick of {1e3 * yardstick:.2f} ms), "
        f"{memory_mb:.0f} MB ({idle_mb:.0f} before data), {1e3 * written_mb / expected:.0f} kB written a hop; "
        f"{late.size} reports of {expected:.0f}, late by {np.median(late):.2f} s (median), "
        f"{np.quantile(late, 0.99):.2f} (99 %), {late.max():.2f} (most); {missing} blocks lost; "
        f"this process {(time.process_time() - before[2]) / took_s:.2f} cores, {plant.behind_s:.2f} s behind",
        flush=True,
    )
    if again_s is not None:
        print(f"     after {stall_s:g} s without a processor, reports were in time again after {again_s:.1f} s")


def _stalled(process: Process, plant: Plant, stall_s: float, most_s: float) -> float:
    """Stop the monitor for a while; seconds from then on until the last report that came late."""
    process.signal(signal.SIGSTOP)
    time.sleep(stall_s)
    process.signal(signal.SIGCONT)
    again_s = time.monotonic()
    time.sleep(max(0.0, most_s - stall_s))
    return max((at_s - again_s for at_s, late_s in plant.heard if at_s > again_s and late_s > IN_TIME_S), default=0.0)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="how many machines one monitor carries")
    parser.add_argument("--machines", type=int, nargs="+", default=[10, 20, 40])
    parser.add_argument("--seconds", type=float, default=120.0, help="that are measured, after the windows are full")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--stall", type=float, default=0.0, help="seconds for which the monitor is stopped")
    asked = parser.parse_args()
    for count in asked.machines:
        measure(count, asked.seed, asked.seconds, asked.stall)


if __name__ == "__main__":
    main()
