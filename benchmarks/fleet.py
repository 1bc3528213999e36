"""Kills computers of a fleet, and measures how long it takes until every machine is evaluated again; compares alarms.

Run: ``python benchmarks/fleet.py --database postgresql://USER@HOST/NAME`` (some 20 minutes; the database is emptied).
Three nodes of a Ray cluster, all on this computer, monitor rotor kits (9 channels, 2 kHz, windows of 60 s) that this
process sends at pace 1, as in ``capacity.py``. In every fourth machine a bearing loses a third of its stiffness. Once
all windows are full, one node after the other is killed (``SIGKILL``) and replaced. The measured time is that from each
kill until every machine has a report on data later than the kill. Then the same streams are run without kills, and the
alarm logs of both runs are compared: sequence, kind, alarm, and data time.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_worker_niceness", "0")

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psycopg
from capacity import BLOCK_S, KINDS, Plant, sending
from machine_kind import MachineKind
from ray.cluster_utils import Cluster
from running_monitor import on_loopback, serving, started

from models.machine import MachineFile, load_machine
from service.runtime.fleet import HEALTH_CHECKS
from simulator.scenario import load_scenario, parse_fault
from simulator.stream import blocks

COMPUTERS, CORES = 3, 2
EVERY = 4
BETWEEN_S = 30.0
PATIENCE_S = 120.0
WARM_S = 80.0


def emptied(database: str) -> None:
    """Drop all tables."""
    with psycopg.connect(database, autocommit=True) as connection:
        connection.execute("DROP SCHEMA public CASCADE")
        connection.execute("CREATE SCHEMA public")


def fleet_files(folder: Path, machines: Sequence[MachineFile], database: str, link: str, inner: str) -> Path:
    """Write the settings of a fleet for machines whose files are in the folder, and return their path."""
    lines = [f'[link]\nmode = "client"\nconnect = ["{link}"]', f'[fleet]\nlisten = "{inner}"']
    lines += [f'[history]\nurl = "{database}"']
    lines += [f'[[machines]]\nfile = "{machine.name}.toml"\nbundle = "lab"' for machine in machines]
    (folder / "fleet.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / "fleet.toml"


@contextmanager
def routing(folder: Path, link: str) -> Iterator[None]:
    """Run a Zenoh router in its own process: in one process, publishers and router would wait for the same threads."""
    command, environment = ["service", "router", "--listen", link], dict(os.environ)
    router = started(command, folder / "router", folder / "router_log", environment)
    try:
        while link not in (folder / "router").read_text(encoding="utf-8"):
            if router.poll() is not None:
                raise SystemExit(f"the router did not start:\n{(folder / 'router_log').read_text(encoding='utf-8')}")
            time.sleep(0.1)
        yield
    finally:
        router.terminate()
        router.wait(60)


@contextmanager
def cluster_of() -> Iterator[Any]:
    """A Ray cluster of `COMPUTERS` nodes and a head node without cores."""
    head = {"num_cpus": 0, "include_dashboard": False, "_system_config": json.loads(HEALTH_CHECKS)}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        for _ in range(COMPUTERS):
            cluster.add_node(num_cpus=CORES)
        yield cluster
    finally:
        cluster.shutdown()  # type: ignore[no-untyped-call]


def logs_of(url: str, plant: Plant, until_ms: int) -> dict[str, list[tuple[int, str, str, int]]]:
    """Alarm log of every machine up to the end of the data; times are data times, ms since the start."""
    found = {}
    with httpx.Client(base_url=url, trust_env=False, timeout=60.0) as http:
        for machine in plant.machines:
            path = f"/api/v1/machines/{machine.site}/{machine.name}/alarms/events?limit=1000"
            events = [one["data"] for one in http.get(path).raise_for_status().json()["events"]]
            timed = [
                (one["sequence"], one["kind"], one["name"], round((one["time_ns"] - plant.start_ns) / 1e6))
                for one in events
            ]
            found[machine.name] = sorted(one for one in timed if one[-1] < until_ms)
    return found


def again_s(plant: Plant, killed_s: float) -> float | None:
    """Seconds from a kill until every machine has a report on later data; None while one has none."""
    later_ns = time.time_ns() - round((time.monotonic() - killed_s) * 1e9) - plant.start_ns
    firsts = [
        min((at for at, end_ns in plant.windows[one.name] if end_ns > later_ns and at > killed_s), default=None)
        for one in plant.machines
    ]
    known = [at for at in firsts if at is not None]
    return max(known) - killed_s if len(known) == len(firsts) else None


def killed(plant: Plant, cluster: Any, number: int) -> None:
    """Kill a node, add a new one, and print when all machines are evaluated again."""
    killed_s = time.monotonic()
    cluster.remove_node(sorted(cluster.worker_nodes, key=lambda node: node.node_id)[0], allow_graceful=False)
    cluster.add_node(num_cpus=CORES)
    while (took_s := again_s(plant, killed_s)) is None and time.monotonic() < killed_s + PATIENCE_S:
        time.sleep(0.1)
    found = "not all are" if took_s is None else f"all evaluated again after {took_s:.1f} s"
    print(f"  kill {number + 1}: {found}", flush=True)
    time.sleep(max(0.0, killed_s + BETWEEN_S - time.monotonic()))


def run(
    count: int, kills: int, length_s: float, seed: int, database: str
) -> dict[str, list[tuple[int, str, str, int]]]:
    """Monitor `count` machines while killing `kills` nodes, and return the alarm logs."""
    emptied(database)
    base = load_machine("lab")
    scenario, _ = load_scenario("healthy")
    fault = parse_fault(f"k_by=-0.33@{WARM_S:g}")
    streams = []
    for kind in range(KINDS):
        given = scenario.overridden(seed=seed + kind, duration_s=length_s, faults=(fault,) if kind % EVERY == 0 else ())
        streams.append([block for block, _ in blocks(given, base, BLOCK_S, start_ns=0)])
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name, cluster_of() as cluster:
        folder = Path(name)
        machines = [MachineKind().machine(folder, f"kit{number}") for number in range(count)]
        environment, link = on_loopback(folder)
        _, inner = on_loopback(folder)
        for gone in ("ROTORWATCH_LINK", "ROTORWATCH_HISTORY__URL"):
            environment.pop(gone)
        settings = fleet_files(folder, machines, database, link, inner)
        command = ("fleet", "--address", cluster.address, "--config", str(settings))
        with (
            routing(folder, link),
            serving(folder, environment, *command) as (_, url),
            sending(link, machines, streams) as (plant, sender),
        ):
            time.sleep(WARM_S + BETWEEN_S)
            for number in range(kills):
                killed(plant, cluster, number)
                if not sender.is_alive():
                    raise SystemExit("the streams have ended: the last kill says nothing")
            sender.join()
            time.sleep(3 * base.window.hop_s)
            late = np.array([one for _, one in plant.heard])
            print(f"  reports late by {np.median(late):.2f} s (median), {np.quantile(late, 0.99):.2f} (99 %)")
            logs = logs_of(url, plant, round(1e3 * length_s))
    return logs


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="a fleet whose computers are killed")
    parser.add_argument("--machines", type=int, default=60)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--database", required=True, help="PostgreSQL database; its contents are dropped")
    asked = parser.parse_args()
    logs = {}
    length_s = WARM_S + (2 * asked.kills + 2) * BETWEEN_S  # twice, for a busy computer
    for kills in (asked.kills, 0):
        print(f"{asked.machines} machines, {kills} kills, seed {asked.seed}", flush=True)
        logs[kills] = run(asked.machines, kills, length_s, asked.seed, asked.database)
    same = 0
    for name, log in logs[asked.kills].items():
        numbers = [one[0] for one in log]
        if numbers != list(range(len(numbers))):
            print(f"{name}: sequence {numbers}")
        if log == logs[0][name]:
            same += 1
        else:
            print(f"{name}: with kills {json.dumps(log)}\n      without {json.dumps(logs[0][name])}")
    print(f"{same} of {asked.machines} alarm logs are the same; {sum(map(len, logs[0].values()))} events without kills")


if __name__ == "__main__":
    main()
