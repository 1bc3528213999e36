"""Measures start-up and response times of a monitor with a history of a million reports.

Run: ``python benchmarks/history.py [--reports 1000000] [--machines 20] [--file FILE]``. If the file does not exist, the
store's own writer fills it (some minutes, 2 GB): reports every 5 s up to now, repeating a hundred reports of one
simulated rotor kit with new times and some noise on the readings, and a thousand alarm events for each machine. Then a
monitor is started with it and, for comparison, with an empty history, and each request of the page and of programs is
made several times for a machine in the middle. Times are those of the client; *processor* is that of the monitor.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
from capacity import Process
from machine_kind import MachineKind
from running_monitor import on_loopback, serving

from models.commissioning.commissioned import install
from models.machine import MachineFile
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.example import example
from rotorwatch.records.health import Report
from service.history.claim import PackedReport, pack
from service.history.database import Database
from service.history.records import Step, StoredEvent
from service.history.writer import Writer
from service.monitor.monitor import MachineMonitor
from service.stream.checkpoints import stored_readings, stored_report

HOP_NS = 5 * 10**9
AT_ONCE = 500
EVENTS = 1000
DIFFERENT = 100
BUCKET_NS = 600 * 10**9
TIMES = 7
GOAL_START_S, GOAL_ANSWER_S = 5.0, 0.3


def windows_of(folder: Path) -> list[Report]:
    """`DIFFERENT` reports of a simulated rotor kit."""
    kind = MachineKind()
    monitor = MachineMonitor(install(kind.machine(folder, "lab"), "lab"))
    length_s = 60.0 + 5.0 * DIFFERENT
    return [one for block in kind.stream(folder, 1, length_s, 0.5) for one in monitor.step(block).windows][-DIFFERENT:]


def event(sequence: int, time_ns: int) -> StoredEvent:
    """An alarm event."""
    told = dict(example(AlarmCloudEvent)) | {"id": f"event-{sequence}"}
    kind = "cleared" if sequence % 2 else "raised"
    return StoredEvent(
        sequence=sequence,
        id=f"event-{sequence}",
        time_ns=time_ns,
        recorded_ns=time_ns,
        kind=kind,
        alarm="k_by",
        severity="alert",
        state="normal" if sequence % 2 else "unacknowledged",
        occurrence=sequence // 2 + 1,
        actor="",
        text=json.dumps(told),
    )


def fill(file: Path, machines: Sequence[MachineFile], reports: int, folder: Path) -> None:
    """Fill the history with reports, readings and alarm events."""
    windows, rng = windows_of(folder), np.random.default_rng(1)
    texts = [pack("demo/lab", Step((stored_report(one),)), 0)[0].text for one in windows]
    columns = [stored_report(one) for one in windows]
    readings = [stored_readings([one]) for one in windows]
    each = reports // len(machines)
    now_ns = time.time_ns() // HOP_NS * HOP_NS
    database = Database(f"sqlite:///{file}", 60.0)
    database.start()
    writer = Writer(database, 1.0, AT_ONCE, BUCKET_NS)
    writer.start()
    for machine in machines:
        claim = writer.claim(machine.site, machine.name)
        for first in range(0, each, AT_ONCE):
            many = range(first, min(first + AT_ONCE, each))
            noise = 1.0 + 0.01 * rng.standard_normal(len(many))
            ends_ns = [now_ns - (each - number) * HOP_NS for number in many]
            step = Step(
                readings=tuple(
                    replace(one, end_ns=end_ns, value=one.value * factor)
                    for number, end_ns, factor in zip(many, ends_ns, noise.tolist(), strict=True)
                    for one in readings[number % len(readings)]
                ),
                events=tuple(
                    event(number * EVENTS // each, end_ns)
                    for number, end_ns in zip(many, ends_ns, strict=True)
                    if number * EVENTS // each != (number - 1) * EVENTS // each
                ),
            )
            packed = [
                PackedReport(
                    end_ns,
                    replace(columns[number % len(columns)], start_ns=end_ns - 12 * HOP_NS, end_ns=end_ns, text=""),
                    texts[number % len(texts)],
                )
                for number, end_ns in zip(many, ends_ns, strict=True)
            ]
            # The texts of the reports are in `packed`, compressed.
            writer.submit(claim, step, packed, ends_ns[-1])
        print(f"  {machine.name}: {each} reports", flush=True)
    writer.stop()
    database.stop()


@contextmanager
def monitored(folder: Path, file: Path, machines: Sequence[MachineFile]) -> Iterator[tuple[Process, str, float, float]]:
    """Run a monitor with this history; yields its process, URL, and seconds and processor time until it answered."""
    environment, _ = on_loopback(folder)
    entries = [{"file": str(folder / f"{machine.name}.toml"), "bundle": "lab"} for machine in machines]
    environment |= {"ROTORWATCH_MACHINES": json.dumps(entries), "ROTORWATCH_HISTORY__URL": f"sqlite:///{file}"}
    begin_s = time.monotonic()
    with serving(folder, environment) as (process, url):
        httpx.get(f"{url}/readyz", trust_env=False, timeout=60.0)
        yield Process(process.pid), url, time.monotonic() - begin_s, Process(process.pid).cpu_s()


def questions(machine: MachineFile, machines: Sequence[MachineFile]) -> dict[str, str]:
    """Paths of all requests, by description."""
    place = f"/api/v1/machines/{machine.site}/{machine.name}"
    of = "&".join(f"of={one.site}/{one.name}/parameter/k_by" for one in machines)
    end_ns = time.time_ns()
    day, most = (f"since_ns={end_ns - hours * 3600 * 10**9}" for hours in (24, 19))
    return {
        "machine list": "/api/v1/machines",
        "health of a machine": f"{place}/health",
        "alarms as they are": f"{place}/alarms",
        "newest 100 alarm events": f"{place}/alarms/events",
        "1000 alarm events after the first": f"{place}/alarms/events?after=0&limit=1000",
        "alarm events of one kind, of a day": f"{place}/alarms/events?kind=raised&{day}",
        "newest 100 reports": f"{place}/reports",
        "100 reports of yesterday": f"{place}/reports?{day}&until_ns={end_ns - 43_200 * 10**9}",
        "trend of all parameters, an hour": f"{place}/readings?points=240&since_ns={end_ns - 3600 * 10**9}",
        "trend of all parameters, a day": f"{place}/readings?points=240&{day}",
        "trend of all parameters, all there is": f"{place}/readings?points=240",
        "trend of one parameter, all there is": f"{place}/readings?points=240&name=k_by",
        "trend of all levels, 19 hours": f"{place}/readings?quantity=level&points=240&{most}",
        "trend of all levels, all there is": f"{place}/readings?quantity=level&points=240",
        "trends of all machines, a day": f"/api/v1/trends?{of}",
        "how large the history is": "/api/v1/history",
        "metrics": "/metrics",
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="a monitor with a long history")
    parser.add_argument("--reports", type=int, default=1_000_000)
    parser.add_argument("--machines", type=int, default=20)
    parser.add_argument("--file", type=Path, help="history to use, made if it does not exist")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        machines = [MachineKind().machine(folder, f"kit{number}") for number in range(asked.machines)]
        file = folder / "long.sqlite" if asked.file is None else asked.file.absolute()
        if not file.exists():
            begin_s = time.monotonic()
            fill(file, machines, asked.reports, folder)
            print(f"made in {time.monotonic() - begin_s:.0f} s")
        print(f"{file.stat().st_size / 1e6:.0f} MB, {asked.machines} machines, {asked.reports} reports")
        for what, history in (("no history", folder / "none.sqlite"), ("the history", file)):
            for _ in range(2):
                with monitored(folder, history, machines) as (process, url, took_s, used_s):
                    print(f"start with {what}: {took_s:.1f} s, {used_s:.1f} s of processor", flush=True)
                    if history is file and _ == 1:
                        ask(process, url, machines)


def ask(process: Process, url: str, machines: Sequence[MachineFile]) -> None:
    """Make all requests, and print their response times."""
    with httpx.Client(base_url=url, trust_env=False, timeout=60.0) as http:
        for what, path in questions(machines[len(machines) // 2], machines).items():
            times, before_s = [], process.cpu_s()
            for _ in range(TIMES):
                begin_s = time.monotonic()
                size = len(http.get(path).raise_for_status().content)
                times.append(time.monotonic() - begin_s)
            used_s = (process.cpu_s() - before_s) / TIMES
            beyond = f"  MORE THAN {GOAL_ANSWER_S:g} s" if statistics.median(times) > GOAL_ANSWER_S else ""
            print(
                f"  {what:<40} {1e3 * statistics.median(times):6.0f} ms (most {1e3 * max(times):.0f}), "
                f"{1e3 * used_s:.0f} ms of processor, {size / 1e3:.0f} kB{beyond}",
                flush=True,
            )


if __name__ == "__main__":
    main()
