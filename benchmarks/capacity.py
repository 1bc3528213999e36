"""Measures how many machines one monitor can watch, end to end: from the last sample of a hop to the published report.

Run: ``python benchmarks/capacity.py --machines 10 20 40`` (some minutes for each). A monitor with a history file and
trained networks watches the given numbers of rotor kits (9 channels, 2 kHz, windows of 60 s, hops of 5 s), or machines
of another kind: ``--channels 13 --rate 4000 --hop 10 --no-networks``, or ``--levels`` with any number of channels. This
process, on the same computer, sends previously simulated streams at pace 1, with the machines' hops spread evenly over
time. Cores and memory are those of the monitor alone; *yardstick* is the processor time of the Fourier transforms that
a hop's cross-spectra need at least, measured beforehand. ``--stall 10`` stops the monitor (with ``--of-shard`` one of
its processes) for 10 s, and prints when reports are in time again, what is lost, and which hops were not evaluated.
``costs.py`` uses this module to measure kinds of machines for ``rotorwatch size``.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import signal
import sqlite3
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import httpx
import numpy as np
import zenoh
import zenoh.ext
from machine_kind import MachineKind
from running_monitor import on_loopback, serving

from models.diagnosis.window.moments import plan_for
from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.link import LinkSettings
from models.signals.wire import encode_block

BLOCK_S = 0.1
KINDS = 4  # different streams, by seed; machines share them, each with its own times
IN_TIME_S = 1.0
CACHED = 1200


def yardstick_s(machine: MachineFile) -> float:
    """Processor time of the Fourier transforms of a hop, minimum of 200 runs."""
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
    """Resources used by a process and its children, from ``/proc``: processor, memory, bytes written."""

    pid: int

    def all(self) -> list[Path]:
        """Folders in ``/proc`` of the process and its children."""
        stats = ((one.parent, one.read_text(encoding="utf-8")) for one in Path("/proc").glob("[0-9]*/stat"))
        started = [place for place, text in stats if int(text.rsplit(")", 1)[1].split()[1]) == self.pid]
        return [Path(f"/proc/{self.pid}"), *started]

    def cpu_s(self) -> float:
        """Processor time so far, s."""
        stats = [(one / "stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split() for one in self.all()]
        return sum(int(one[11]) + int(one[12]) for one in stats) / os.sysconf("SC_CLK_TCK")

    def memory_mb(self) -> float:
        """Resident memory, MB; memory shared between processes counts in each."""
        return sum(int((one / "statm").read_text(encoding="ascii").split()[1]) for one in self.all()) * 4096 / 1e6

    def written_mb(self) -> float:
        """Data written to the disk, MB."""
        texts = [(one / "io").read_text(encoding="ascii").splitlines() for one in self.all()]
        return sum(int(dict(line.split(": ") for line in lines)["write_bytes"]) for lines in texts) / 1e6

    def signal(self, number: int) -> None:
        """Send a signal to the process and its children."""
        for one in self.all():
            os.kill(int(one.name), number)


@dataclass(slots=True)
class Plant:
    """Machines that send, with hops staggered in time, and the arrival times of their reports."""

    machines: Sequence[MachineFile]
    session: zenoh.Session
    streams: list[list[SampleBlock]]
    start_ns: int = field(default_factory=time.time_ns)
    sent_s: dict[tuple[str, int], float] = field(default_factory=dict)  # by machine and number of the block
    heard: list[tuple[float, float]] = field(default_factory=list)  # arrival and delay of each report, s
    windows: dict[str, list[tuple[float, int]]] = field(default_factory=lambda: defaultdict(list))  # arrival, end
    skipped: list[bool] = field(default_factory=list)  # whether each report is on a window that was not evaluated
    told_bytes: int = 0
    behind_s: float = 0.0

    def hear(self, sample: zenoh.Sample) -> None:
        """Record the arrival of a report."""
        now_s, payload = time.monotonic(), sample.payload.to_bytes()
        report = json.loads(payload)
        self.told_bytes += len(payload)
        last = -(-(report["end_ns"] - self.start_ns) // round(BLOCK_S * 1e9)) - 1
        self.skipped.append(report.get("skipped", False))
        self.heard.append((now_s, now_s - self.sent_s[report["machine"], last]))
        self.windows[report["machine"]].append((now_s, report["end_ns"] - self.start_ns))

    def send(self, ended: threading.Event) -> None:
        """Send all streams in real time, to their end or until `ended` is set."""
        count, per_hop = len(self.machines), round(self.machines[0].window.hop_s / BLOCK_S)
        hashes = [machine.descriptor.schema_hash for machine in self.machines]
        # Like a real publisher, with a cache from which a restarted monitor gets what it missed.
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
def monitored(
    folder: Path, machines: Sequence[MachineFile], bundle: dict[str, str]
) -> Iterator[tuple[Process, str, str]]:
    """Run a monitor of machines whose files are in the folder; yields its process, Zenoh endpoint and URL."""
    environment, endpoint = on_loopback(folder)
    entries = [{"file": str(folder / f"{machine.name}.toml"), **bundle} for machine in machines]
    environment["ROTORWATCH_MACHINES"] = json.dumps(entries)
    with serving(folder, environment) as (process, url):
        try:
            yield Process(process.pid), endpoint, url
        finally:
            Process(process.pid).signal(signal.SIGCONT)


def session_with(endpoint: str) -> zenoh.Session:
    """Open a Zenoh session as a client."""
    config = zenoh.Config()
    for path, value in LinkSettings(mode="client", connect=(endpoint,)).zenoh_items().items():
        config.insert_json5(path, value)
    return zenoh.open(config)


@contextmanager
def sending(
    endpoint: str, machines: Sequence[MachineFile], streams: list[list[SampleBlock]]
) -> Iterator[tuple[Plant, threading.Thread]]:
    """A plant that sends and receives reports, and its sending thread, which ends with the streams or the block."""
    with session_with(endpoint) as session:
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


def lost(url: str, machines: Sequence[MachineFile]) -> tuple[int, float, dict[str, list[str]]]:
    """Number of blocks refused, dropped or missing; missing data, s; and machines by the alarms that they raised."""
    count, missing_s, raised = 0, 0.0, defaultdict[str, list[str]](list)
    with httpx.Client(base_url=url, trust_env=False, timeout=60.0, verify=False) as http:  # noqa: S501  # no HTTPS
        for machine in machines:
            path = f"/api/v1/machines/{machine.site}/{machine.name}"
            quality = http.get(f"{path}/health").raise_for_status().json()["quality"]
            count += sum(quality["refused_blocks"].values()) + quality["queue_dropped_blocks"] + quality["gaps"]
            missing_s += quality["missing_s"]
            events = http.get(f"{path}/alarms/events?limit=1000").raise_for_status().json()["events"]
            for one in (event["data"] for event in events if event["data"]["kind"] == "raised"):
                raised[one["name"]].append(machine.name)
    return count, missing_s, raised


def held_bytes(file: Path) -> tuple[int, int, int]:
    """Number of reports in a history, and bytes of its file used by reports and by readings, indexes included."""
    with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True, timeout=60.0)) as database:
        pages = "SELECT cast(total(pgsize) AS INTEGER) FROM dbstat WHERE name GLOB ?"
        of_reports, of_windows = (
            database.execute(pages, [f"*{name}*"]).fetchone()[0] for name in ("reports", "windows")
        )
        return database.execute("SELECT count(*) FROM reports").fetchone()[0], of_reports, of_windows


@dataclass(frozen=True, slots=True)
class Figures:
    """Resources used by a plant of one kind; per hop and machine unless stated otherwise."""

    cores: float  # whole plant
    processor_ms: float
    yardstick_ms: float
    idle_mb: float  # memory of the whole plant before data arrive
    memory_mb: float  # whole plant
    written_kb: float
    reports_kb: float  # in the history's file, with indexes
    readings_kb: float
    told_kb: float  # published report


def measure(kind: MachineKind, count: int, seed: int, length_s: float, stall_s: float, *, of_shard: bool) -> Figures:
    """Watch `count` machines for `length_s` after their windows have filled; print and return the resources used."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        machines = [kind.machine(folder, f"kit{number}") for number in range(count)]
        window, yardstick = machines[0].window, yardstick_s(machines[0])
        warm_s = window.length_s + 4 * window.hop_s
        streams = [
            kind.stream(folder, seed + number, warm_s + length_s, BLOCK_S) for number in range(min(KINDS, count))
        ]
        with monitored(folder, machines, kind.bundle) as (process, endpoint, url):
            idle_mb = process.memory_mb()
            with sending(endpoint, machines, streams) as (plant, _):
                time.sleep(warm_s)
                before, begin_s = (process.cpu_s(), process.written_mb(), time.process_time()), time.monotonic()
                first, told_bytes, held = len(plant.heard), plant.told_bytes, held_bytes(folder / "history.sqlite")
                again_s = _stalled(process, plant, stall_s, length_s, of_shard=of_shard) if stall_s else None
                time.sleep(max(0.0, begin_s + length_s - time.monotonic()))
                took_s = time.monotonic() - begin_s
                cpu_s, written_mb = process.cpu_s() - before[0], process.written_mb() - before[1]
                late = np.array([one for _, one in plant.heard[first:]])
                told_bytes, memory_mb = plant.told_bytes - told_bytes, process.memory_mb()
                now = held_bytes(folder / "history.sqlite")
                (missing, missing_s, raised), untold = lost(url, machines), _untold(plant)
    expected = count * took_s / window.hop_s
    reports, report_bytes, readings_bytes = (last - first for last, first in zip(now, held, strict=True))
    figures = Figures(
        cores=cpu_s / took_s,
        processor_ms=1e3 * cpu_s / expected,
        yardstick_ms=1e3 * yardstick,
        idle_mb=idle_mb,
        memory_mb=memory_mb,
        written_kb=1e3 * written_mb / expected,
        reports_kb=report_bytes / max(1, reports) / 1e3,
        readings_kb=readings_bytes / max(1, reports) / 1e3,
        told_kb=told_bytes / max(1, late.size) / 1e3,
    )
    print(
        f"{count:4d} machines: {figures.cores:5.2f} cores ({figures.processor_ms:.0f} ms a hop, "
        f"{cpu_s / expected / yardstick:.0f} x the yardstick of {figures.yardstick_ms:.2f} ms), "
        f"{memory_mb:.0f} MB ({idle_mb:.0f} before data), "
        f"{figures.written_kb:.0f} kB written a hop, "
        f"{figures.reports_kb + figures.readings_kb:.1f} kept; "
        f"{late.size} reports of {expected:.0f}, {sum(plant.skipped[first:])} of them skipped, "
        f"late by {np.median(late):.2f} s (median), "
        f"{np.quantile(late, 0.99):.2f} (99 %), {late.max():.2f} (most); {missing} blocks lost; "
        f"this process {(time.process_time() - before[2]) / took_s:.2f} cores, {plant.behind_s:.2f} s behind",
        flush=True,
    )
    for alarm, where in sorted(raised.items()):
        print(f"     {alarm} raised {len(where)} times, of {len(set(where))} machines", flush=True)
    if again_s is not None:
        print(
            f"     after {stall_s:g} s without a processor, reports were in time again after {again_s:.1f} s; "
            f"{missing_s:.1f} s of data missing, {untold} hops without a report",
            flush=True,
        )
    return figures


def _stalled(process: Process, plant: Plant, stall_s: float, most_s: float, *, of_shard: bool) -> float:
    """Stop the monitor for `stall_s`, and return the seconds from its continuation to the last late report."""
    # The largest child process: one that monitors no machines, but manages shared resources, is small.
    largest = sorted(process.all()[1:], key=lambda one: int((one / "statm").read_text(encoding="ascii").split()[1]))[
        -1:
    ]
    stopped = largest if of_shard else process.all()
    if not stopped:
        raise SystemExit("--of-shard: one process monitors all machines; thirty are shared")
    for number, wait_s in ((signal.SIGSTOP, stall_s), (signal.SIGCONT, 0.0)):
        for one in stopped:
            os.kill(int(one.name), number)
        time.sleep(wait_s)
    again_s = time.monotonic()
    time.sleep(max(0.0, most_s - stall_s))
    return max((at_s - again_s for at_s, late_s in plant.heard if at_s > again_s and late_s > IN_TIME_S), default=0.0)


def _untold(plant: Plant) -> int:
    """Number of hops without a report between the first and the latest report of each machine."""
    hop_ns = round(plant.machines[0].window.hop_s * 1e9)
    ends = ({end_ns for _, end_ns in found} for found in plant.windows.values())
    return sum((max(found) - min(found)) // hop_ns + 1 - len(found) for found in ends)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="how many machines one monitor can watch")
    parser.add_argument("--machines", type=int, nargs="+", default=[10, 20, 40])
    parser.add_argument("--seconds", type=float, default=120.0, help="seconds measured after the windows are full")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--channels", type=int, default=9)
    parser.add_argument("--rate", type=float, default=2000.0, help="samples per second and channel")
    parser.add_argument("--hop", type=float, default=5.0, help="seconds between reports")
    parser.add_argument("--levels", action="store_true", help="machines of which only the channels are known")
    parser.add_argument("--no-networks", action="store_true", help="rotor kits without trained networks")
    parser.add_argument("--stall", type=float, default=0.0, help="seconds for which the monitor is stopped")
    parser.add_argument("--of-shard", action="store_true", help="stop one of the processes that share the machines")
    asked = parser.parse_args()
    kind = MachineKind(asked.channels, asked.rate, asked.hop, not asked.levels, not (asked.levels or asked.no_networks))
    for count in asked.machines:
        measure(kind, count, asked.seed, asked.seconds, asked.stall, of_shard=asked.of_shard)


if __name__ == "__main__":
    main()
