"""Measures the speed-up of evaluating an archive of recordings on two Ray workers instead of one.

Run: ``python benchmarks/archive.py [--minutes 20] [--machines 4]`` (minutes). Rotor kits (9 channels, 2 kHz) are
recorded for the given time each, and the archive is evaluated as by ``rotorwatch replay --offline --ray``, on a cluster
of this computer with one core and with two, in turns, twice. The processor time of all workers is printed too: on a
computer with other load, durations are unreliable, but the extra processor time of two workers, which disturb each
other, limits the possible speed-up.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_worker_niceness", "0")

import argparse
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from machine_kind import MachineKind
from ray.cluster_utils import Cluster

from models.machine import load_machine
from service.runtime.archive import MachineTask, on_cluster
from simulator.scenario import load_scenario
from simulator.stream import blocks, record

EVER_NS = 2**63 - 1


def archive(folder: Path, machines: int, minutes: float) -> list[MachineTask]:
    """Record the machines, and return the tasks of evaluating them."""
    scenario, _ = load_scenario("healthy")
    tasks = []
    for number in range(machines):
        MachineKind().machine(folder, f"kit{number}")
        file = folder / f"kit{number}.toml"
        machine, recording = load_machine(file), folder / f"kit{number}.mcap"
        given = scenario.overridden(seed=number + 1, duration_s=60 * minutes)
        record(machine, blocks(given, machine), recording)
        tasks.append(MachineTask(f"{machine.site}/{machine.name}", (recording,), f"{file}@lab", "", 0, EVER_NS))
    return tasks


def descendants_s() -> dict[int, float]:
    """Processor time, s, of all descendants of this process, by process id."""
    found: dict[int, tuple[int, float]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text(encoding="utf-8").rsplit(")", 1)[1].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        found[int(stat.parent.name)] = int(fields[1]), sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")
    ours = {os.getpid()}
    while new := {pid for pid, (parent, _) in found.items() if parent in ours} - ours:
        ours |= new
    return {pid: found[pid][1] for pid in ours - {os.getpid()}}


@contextmanager
def watched() -> Iterator[dict[int, float]]:
    """Track the processor time of all descendants while the block runs, because workers end when they are idle."""
    seen, over = descendants_s(), threading.Event()

    def watch() -> None:
        while not over.wait(0.1):
            seen.update(descendants_s())

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield seen
    finally:
        over.set()
        thread.join()


def evaluated(tasks: Sequence[MachineTask], workers: int) -> tuple[float, float, float]:
    """Evaluate all tasks; return duration, processor time of the cluster, and length of the data, all in s."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": workers, "include_dashboard": False})
    try:
        with watched() as seen:
            begin_s, before_s = time.monotonic(), sum(seen.values())
            data_s = sum(summary.data_s for summary, _ in on_cluster(cluster.address, tasks))
            took_s = time.monotonic() - begin_s
        return took_s, sum(seen.values()) - before_s, data_s
    finally:
        cluster.shutdown()  # type: ignore[no-untyped-call]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="speed of evaluating an archive on two Ray workers and on one")
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--machines", type=int, default=4)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        tasks = archive(Path(name), asked.machines, asked.minutes)
        for _ in range(2):
            took: dict[int, tuple[float, float]] = {}
            for workers in (1, 2):
                took_s, used_s, data_s = evaluated(tasks, workers)
                took[workers] = took_s, used_s
                print(
                    f"{workers} worker{'s' if workers > 1 else ''}: {data_s:.0f} s of data in {took_s:.1f} s "
                    f"({data_s / took_s:.0f} x real time), {used_s:.1f} s of processor",
                    flush=True,
                )
            (one_s, one_used_s), (two_s, two_used_s) = took[1], took[2]
            print(
                f"two against one: {one_s / two_s:.2f} x; by processor time {2 * one_used_s / two_used_s:.2f} x at most"
            )


if __name__ == "__main__":
    main()
