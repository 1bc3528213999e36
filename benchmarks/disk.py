"""Measures the bytes written to disk per hop and machine in steady state, including SQLite's log and checkpoints.

Run: ``python benchmarks/disk.py [--machines 20] [--hops 60] [--seed 1] [--days 30]``. Simulated rotor kits with
different seeds go through real workers into one SQLite history as fast as possible, i.e. faster than in real time; the
hops are counted. Machines complete their hops one after the other, like independent machines; with ``--together`` they
do so at the same time and share transactions. The measured quantity is ``write_bytes`` of this process in
``/proc/self/io``, i.e. bytes written to the device, from the first full windows until everything has been moved from
the write-ahead log to the file. The history is prefilled with buckets of ``--days`` days, because in an empty one all
rows of new buckets would lie on one page.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sqlite3
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np
from capacity import Process

from models.commissioning.commissioned import install
from models.signals.block import SampleBlock
from models.signals.wire import encode_block
from service.history.records import Retention
from service.history.store import Store
from service.history.windows import BUCKET, packed
from service.settings.service import LogSettings, QueueSettings
from service.stream.inbox import RawBlock
from service.stream.liveness import Clocks
from service.stream.worker import MachineWorker
from service.terminal.logs import configure_logging
from simulator.scenario import load_scenario
from simulator.stream import blocks

BLOCK_S = 0.5
BUCKET_NS = 600 * 10**9


def stream(seed: int, length_s: float, start_ns: int) -> Iterator[SampleBlock]:
    """Blocks of a simulated healthy rotor kit."""
    scenario, machine = load_scenario("healthy")
    for block, _ in blocks(scenario.overridden(seed=seed, duration_s=length_s), machine, BLOCK_S, start_ns):
        yield block


def age(file: Path, before_ns: int, days: float) -> int:
    """Fill the history with buckets of `days` days for every machine; return their number."""
    count = round(days * 86_400 * 10**9 / BUCKET_NS)
    end_ns = before_ns // BUCKET_NS * BUCKET_NS
    rng = np.random.default_rng(1)
    with closing(sqlite3.connect(file, timeout=60.0)) as database:
        series: dict[int, list[int]] = {}
        for series_id, machine_id in database.execute("SELECT series_id, machine_id FROM series"):
            series.setdefault(machine_id, []).append(series_id)
        records = {machine_id: np.zeros(len(own), BUCKET) for machine_id, own in series.items()}
        for back in range(count, 0, -1):
            for machine_id, own in series.items():
                one = records[machine_id]
                one["series_id"], one["count"], one["errors"] = own, 120, 120
                for name in ("minimum", "maximum", "total", "errors_total"):
                    one[name] = rng.standard_normal(len(own))
                start_ns = end_ns - back * BUCKET_NS
                row = machine_id, start_ns, BUCKET_NS, start_ns, packed(one)
                columns = "(machine_id, start_ns, length_ns, recorded_ns, readings)"
                database.execute(f"INSERT INTO buckets {columns} VALUES (?, ?, ?, ?, ?)", row)  # noqa: S608  # ours
        database.commit()
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return count * len(series)


def feed(workers: list[MachineWorker], streams: list[Iterator[SampleBlock]], hops: int, *, together: bool) -> None:
    """Feed every machine the data of `hops` hops, and wait until the results are committed."""
    per_hop = round(workers[0].machine.window.hop_s / BLOCK_S)
    for _ in range(hops):
        for worker, source in zip(workers, streams, strict=True):
            for block in islice(source, per_hop):
                worker.inbox.put(RawBlock(*encode_block(block, worker.machine.descriptor.schema_hash)))
            if not together:
                settled([worker])
        settled(workers)


def settled(workers: list[MachineWorker]) -> None:
    """Wait until every machine has nothing to do."""
    for worker in workers:
        idle = threading.Event()
        worker.inbox.call(idle.set)
        while not idle.wait(0.001) or len(worker.inbox):
            idle.clear()
            worker.inbox.call(idle.set)


def measure(machines: int, hops: int, seed: int, days: float, *, together: bool) -> None:
    """Run `machines` machines over `hops` hops, and print the bytes written."""
    _, machine = load_scenario("healthy")
    warm = machine.window.hops + 3
    start_ns = time.time_ns()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        file = Path(folder) / "history.sqlite"
        store = Store(f"sqlite:///{file}", Retention())
        store.open()
        workers = []
        for number in range(machines):
            one = machine.model_copy(update={"name": f"lab{number}"})
            queue = QueueSettings(when_full="wait")
            workers.append(MachineWorker(install(one, "lab"), queue, store.machine(one.site, one.name), Clocks()))
            workers[-1].start(lambda *_: None)
        length_s = (warm + hops + 2) * machine.window.hop_s
        streams = [stream(seed + number, length_s, start_ns) for number in range(machines)]
        feed(workers, streams, warm, together=together)
        buckets = age(file, start_ns, days)
        own = Process(os.getpid())
        before, begin_s, count = own.written_mb(), time.monotonic(), sum(worker.tally.windows for worker in workers)
        feed(workers, streams, hops, together=together)
        per_s = time.monotonic() - begin_s
        with closing(sqlite3.connect(file, timeout=60.0)) as database:
            page = database.execute("PRAGMA page_size").fetchone()[0]
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        total_mb = own.written_mb() - before
        count = sum(worker.tally.windows for worker in workers) - count
        print(
            f"{machines:3d} machines (seeds {seed} to {seed + machines - 1}), {count} hops in {per_s:.0f} s, "
            f"{'together' if together else 'one after the other'}, {buckets} buckets before, pages of {page} bytes: "
            f"{1e3 * total_mb / count:.1f} kB per hop and machine; the file has {file.stat().st_size / 1e6:.1f} MB",
            flush=True,
        )
        before = own.written_mb()
        for worker in workers:
            worker.stop()
        store.close()
        print(f"    an orderly stop: {(own.written_mb() - before) / machines:.2f} MB for each machine", flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="bytes written to the disk per hop and machine")
    parser.add_argument("--machines", type=int, default=1)
    parser.add_argument("--hops", type=int, default=600, help="hops of each machine")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--days", type=float, default=30.0, help="days of buckets already in the history")
    parser.add_argument("--together", action="store_true", help="machines complete their hops at the same time")
    asked = parser.parse_args()
    configure_logging(LogSettings(level="error"))
    measure(asked.machines, asked.hops, asked.seed, asked.days, together=asked.together)


if __name__ == "__main__":
    main()
