"""A fleet on separate hosts: after a cut cable and a lost host all is evaluated again and alarm logs are complete."""

import os
import pwd
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psycopg
import pytest

from models.commissioning.commissioned import Installed
from models.machine import load_machine
from rotorwatch.records.health import Health, HealthState
from service.monitor.monitor import MachineMonitor
from service.runtime.fleet import HEALTH_CHECKS
from simulator.scenario import parse_fault
from tests.service.rig.hosts import MIDDLE, Hosts, hosts, why_not
from tests.service.rig.live import PATIENT, ROOT, SHORT, machine_file, program, until
from tests.service.rig.postgres import USER, postgres_server
from tests.service.rig.watching import feed
from tests.windows import healthy_blocks

_WHY_NOT = why_not()
# Hosts are network namespaces, which only root can create.
pytestmark = [pytest.mark.long, pytest.mark.skipif(bool(_WHY_NOT), reason=f"NO HOSTS: {_WHY_NOT}")]

KITS = ("one", "two")
CUT_S = 30.0
AGAIN_S = 60.0
"""PostgreSQL drops a silent host after 15 s, Ray after about 5 s; then a process has to start and a hop to arrive."""
FAULT = "k_by=-0.33@30"
START_NS = 1_767_225_600 * 10**9
_VARIABLES = {
    "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT),
}  # fmt: skip


@dataclass(slots=True)
class Group:
    """A program and its child processes."""

    process: subprocess.Popen[bytes]

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def ray_node(net: Hosts, host: str, log: Path, *options: str) -> Group:
    command = [
        *net.within(host), str(Path(sys.executable).with_name("ray")), "start", "--disable-usage-stats", "--block",
    ]  # fmt: skip
    command += ["--node-ip-address", net.address(host), *options]
    variables = os.environ | _VARIABLES
    with log.open("wb") as out:
        made = Group(subprocess.Popen(command, stdout=out, stderr=out, cwd=ROOT, env=variables, start_new_session=True))
    until(lambda: "Ray runtime started" in log.read_text(encoding="utf-8", errors="replace"), f"Ray on {host}", 120.0)
    return made


@contextmanager
def database_on(net: Hosts, host: str) -> Iterator[tuple[str, str]]:
    """Run PostgreSQL on a host: its address for the other hosts, and for this test, which runs on none."""
    with postgres_server() as server:
        server.new_database("fleet")
        server.stop()
        with (server.folder / "data" / "pg_hba.conf").open("a", encoding="utf-8") as rules:
            rules.write("host all all 10.77.0.0/16 trust\n")
        owner = pwd.getpwnam(server.account or "nobody")
        user = ["setpriv", f"--reuid={owner.pw_uid}", f"--regid={owner.pw_gid}", "--clear-groups"]
        run = [str(server.programs / "postgres"), "-D", str(server.folder / "data"), "-k", str(server.folder)]
        process = subprocess.Popen(
            [*net.within(host), *user, *run, "-c", "listen_addresses=*", "-c", "fsync=off"],
            cwd=server.folder,
            stderr=subprocess.DEVNULL,
            env={"PATH": os.environ["PATH"], "LC_ALL": "C"},
        )
        try:
            until(lambda: _answers(server.url("fleet")), "PostgreSQL")
            yield f"postgresql://{USER}@{net.address(host)}/fleet", server.url("fleet")
        finally:
            process.send_signal(signal.SIGQUIT)  # at once
            process.wait()
            server.start()  # its owner stops it


def _answers(url: str) -> bool:
    try:
        psycopg.connect(url).close()
    except psycopg.OperationalError:
        return False
    return True


def settings_of(folder: Path, net: Hosts, database: str) -> Path:
    """Two machines, a shard each."""
    lines = [f'[link]\nmode = "client"\nconnect = ["tcp/{net.middle_from("first")}:7447"]']
    lines += [f'[fleet]\nlisten = "tcp/{net.address("first")}:7448"', f'[history]\nurl = "{database}"']
    lines += ["[http]\nport = 0", "[access]\nopen_on_loopback = true", "[shards]\ncount = 2"]
    for name in KITS:
        (folder / name).mkdir()
        file = machine_file(folder / name, *SHORT, PATIENT, ('name = "lab"', f'name = "{name}"'))
        lines.append(f'[[machines]]\nfile = "{file}"')
    (folder / "fleet.toml").write_text("\n\n".join(lines) + "\n", encoding="utf-8")
    return folder / "fleet.toml"


def undisturbed(file: Path, seed: int, length_s: float) -> list[tuple[int, str, str, int]]:
    """Alarm log of a machine that is watched by one monitor from beginning to end."""
    machine = load_machine(file)
    _, events = feed(MachineMonitor(Installed(machine)), healthy_blocks(machine, length_s, seed, parse_fault(FAULT)))
    return [(one.sequence, one.kind.value, one.alarm.name, one.time_ns) for one in events]


def logs_of(database: str) -> dict[str, list[tuple[int, str, str, int]]]:
    found: dict[str, list[tuple[int, str, str, int]]] = {name: [] for name in KITS}
    query = "SELECT name, sequence, kind, alarm, time_ns FROM alarm_events JOIN machines USING (machine_id)"
    with psycopg.connect(database) as connection:
        for name, *event in connection.execute(f"{query} ORDER BY sequence").fetchall():
            found[name].append(tuple(event))
    return found


def test_a_cut_cable_and_a_lost_host_do_not_change_the_alarm_logs_of_a_fleet(tmp_path: Path) -> None:
    with hosts("first", "left", "right", "machine", joined=True) as net, ExitStack() as running:
        database, local = running.enter_context(database_on(net, "first"))
        settings = settings_of(tmp_path, net, database)
        # The path of a socket is limited to about a hundred characters.
        rays = Path(running.enter_context(tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True)))
        listening = ("--listen", "tcp/0.0.0.0:7447", "--without-grants")
        router = program(tmp_path, "service", "router", *listening, network=net.network(MIDDLE))
        running.enter_context(router).wait_for("router listening")

        def node(host: str, *options: str) -> Group:
            made = ray_node(net, host, tmp_path / f"ray-{host}-{time.monotonic_ns()}", *options)
            running.callback(made.kill)
            return made

        def worker(host: str) -> Group:
            return node(host, "--address", f"{net.address('first')}:6379", "--num-cpus", "2")

        head = ("--head", "--port", "6379", "--num-cpus", "0", "--include-dashboard", "false", "--temp-dir", str(rays))
        node("first", *head, "--system-config", HEALTH_CHECKS)
        worker("left")
        right = worker("right")
        where = ("--address", f"{net.address('first')}:6379", "--config", str(settings))
        command = ("service", "fleet", *where)
        alone = {key: value for key, value in os.environ.items() if not key.startswith("ROTORWATCH_")} | _VARIABLES
        served = running.enter_context(program(tmp_path, *command, network=net.network("first"), alone=alone))
        url = served.url()

        def health(name: str) -> Health:
            return Health.model_validate_json(net.asked("first", f"{url}/api/v1/machines/demo/{name}/health"))

        def evaluated_until(name: str) -> int:
            report = health(name).report
            return 0 if report is None or report.state is HealthState.WARMING else report.end_ns

        def all_again(why: str) -> float:
            """Wait until every machine's window has reached current data; return the seconds it took."""
            begin_s, now_ns = time.monotonic(), START_NS + round(1e9 * (time.monotonic() - sent_s))
            until(lambda: min(evaluated_until(name) for name in KITS) > now_ns, why)
            return time.monotonic() - begin_s

        start = str(np.datetime64(START_NS, "ns"))
        for number, name in enumerate(KITS):
            where = ("--mode", "client", "--connect", f"tcp/{net.middle_from('machine')}:7447")
            what = ("--machine", str(tmp_path / name / "machine.toml"), "--seed", str(number + 1), "--fault", FAULT)
            running.enter_context(
                program(
                    tmp_path,
                    *("simulator.rotorsim", "publish", "healthy", "--duration", "900", "--start", start, *where, *what),
                    network=net.network("machine"),
                )
            )
        sent_s = time.monotonic()
        all_again("first window")
        until(lambda: all("k_by" in {one[2] for one in log} for log in logs_of(local).values()), "alarms")

        net.cut("left")
        cut_s = all_again("window while a cable is cut")
        time.sleep(max(0.0, CUT_S - cut_s))
        net.mend("left")
        worker("left")  # Ray has given up the former one, which has exited
        net.lose("right", right)
        lost_s = all_again("window after a host was lost")
        length_s = time.monotonic() - sent_s
        assert max(cut_s, lost_s) < AGAIN_S
        logs = logs_of(local)
        for number, name in enumerate(KITS):
            quality = health(name).quality
            assert quality.missing_s == 0.0
            assert [one[0] for one in logs[name]] == list(range(len(logs[name])))
            expected = undisturbed(tmp_path / name / "machine.toml", number + 1, length_s + 60.0)
            assert logs[name] == expected[: len(logs[name])]
            assert ("raised", "k_by") in {one[1:3] for one in logs[name]}
