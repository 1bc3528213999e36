"""Shards on the computers of a Ray cluster: Ray places each of them, and revives it when its computer is lost.

::

    sensors --> Zenoh routers --> shard 1, an actor on one computer ---> PostgreSQL <-- this process
                             '--> shard 2, an actor on another one --->     '
    this process <-- a Zenoh session with a password of its own --> shards: standings, questions

An actor is a process of Ray's that runs `service.runtime.shard.run_shard`, as a process of one computer does.
"""

import math
import os
import secrets
import socket
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

from models.errors import MachineFileError, RotorwatchError
from models.signals.link import LinkSettings
from service.runtime.processes import ShardProcess
from service.runtime.shard import run_shard
from service.runtime.shards import OF_A_SHARD
from service.settings.service import ServiceSettings
from service.stream.shard_link import KnownSettings
from service.stream.transport import Link
from service.terminal.logs import logger

_CORES_OF_A_MACHINE = 0.025
_MB_OF_A_PROCESS, _MB_OF_A_MACHINE = 150, 45
"""Measured for a machine of 13 channels with networks, rounded up, see ``docs/performance.md``."""
_USER = "shard"
_ANSWER_S = 5.0
_BALANCE_S = 5.0
_SETTLED_S = 60.0
"""Time from its latest start until a shard may be moved: if moved while it catches up, it is out of service twice."""
HEALTH_CHECKS = '{"health_check_period_ms": 1000, "health_check_timeout_ms": 2000, "health_check_failure_threshold": 5}'
"""Settings of Ray with which it notices after some 5 s that a computer is lost; without them it takes 13 to 15 s."""
_VARIABLES = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""As in a monitor of one process: results do not depend on the number of cores."""

_log = logger(part="fleet")


def fleet_count(settings: ServiceSettings) -> int:
    """How many shards a fleet has.

    Raises
    ------
    MachineFileError
        If the settings are not those of a fleet, in which nothing may be tied to one of its computers.
    """
    if settings.fleet is None:
        raise MachineFileError('expected [fleet] with listen = "tcp/HOST:7448", where the shards reach this process')
    if not settings.history.database.startswith("postgresql"):
        raise MachineFileError("history.url: expected postgresql://..., which the shards of all computers reach")
    if settings.link.listen or not settings.link.connect:
        raise MachineFileError(
            "link: expected connect, the Zenoh routers that sensors and all shards connect to, and no listen: shards "
            "move from one computer to another"
        )
    machines = len(settings.machines)
    return min(machines, settings.shards.count or math.ceil(machines / OF_A_SHARD))


class Fleet:
    """Gives shards processes in a Ray cluster; a `service.runtime.processes.Placement`.

    Parameters
    ----------
    address : str
        Address of the cluster: ``auto`` for that of this computer, or ``HOST:6379``.

    Raises
    ------
    RotorwatchError
        If Ray is not installed.
    """

    session_open = True  # streams do not come through this process

    def __init__(self, settings: ServiceSettings, address: str) -> None:
        self._settings = settings
        self._address = address
        self._ray = imported_ray()
        self._processes: list[_Actor] = []
        self._over = threading.Event()

    def connect(self, undo: ExitStack) -> Link:
        """As `Placement.connect`; joins the cluster.

        Raises
        ------
        RotorwatchError
            If there is no cluster.
        LinkError
            If `FleetSettings.listen` cannot be listened on.
        """
        join_cluster(self._address, undo)
        fleet = self._settings.fleet
        if fleet is None:
            raise MachineFileError("expected [fleet]")
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="rotorwatch-")))  # of mode 700
        secret = secrets.token_urlsafe(32)
        users = folder / "users"
        with open(os.open(users, os.O_WRONLY | os.O_CREAT, 0o600), "w", encoding="utf-8") as file:
            file.write(f"{_USER}:{secret}\n")
        link = Link(LinkSettings(mode="router", listen=(fleet.listen,), passwords_file=users, tls=fleet.tls))
        undo.callback(link.close)
        tls = fleet.tls and fleet.tls.model_copy(update={"certificate": None, "key": None, "mutual": False})
        self._inner = KnownSettings(mode="client", connect=(fleet.listen,), tls=tls, name=_USER, secret=secret)
        balance = threading.Thread(target=self._balance, name="balance", daemon=True)
        undo.callback(balance.join)
        undo.callback(self._over.set)
        balance.start()
        return link

    def process(self, number: int, settings: ServiceSettings) -> ShardProcess:
        """As `Placement.process`."""
        # What only this process needs stays here.
        alone = settings.model_copy(update={"fleet": None, "webhooks": ()})
        made = _Actor(self._ray, f"shard {number}", alone, self._inner)
        self._processes.append(made)
        return made

    def _balance(self) -> None:
        """Move shards to computers that have joined the cluster."""
        while not self._over.wait(_BALANCE_S):
            try:
                cores = {
                    one["NodeID"]: one["Resources"]["CPU"]
                    for one in self._ray.nodes()
                    if one["Alive"] and one["Resources"].get("CPU")
                }
            except Exception as error:  # whatever it is, shards go on where they are
                _log.warning("the cluster does not report its computers", why=str(error))
                continue
            placed = [one for one in self._processes if one.computer]
            if len(placed) < len(self._processes):
                continue  # a shard is being placed, and will soon take its cores
            shards = [(one.computer, one.cores) for one in placed]
            move = better_place(shards, cores)
            settled_s = time.monotonic() - _SETTLED_S
            for number, shard in enumerate(placed):
                if move is not None and shards[number] == shards[move[0]] and shard.placed_s < settled_s:
                    _log.info("a shard moves to a less busy computer", shard=number + 1)
                    shard.move_to(move[1])
                    break


def better_place(shards: Sequence[tuple[str, float]], cores: Mapping[str, float]) -> tuple[int, str] | None:
    """Which shard is to move to which computer.

    Parameters
    ----------
    shards : sequence of (str, float)
        Computer and cores of each.
    cores : mapping
        What each computer has.

    Returns
    -------
    tuple of (int, str) or None
        None if no move would leave more room on the fullest of the computers that it touches.

    Examples
    --------
    >>> better_place([("a", 0.4), ("a", 0.4)], {"a": 2.0, "b": 2.0}), better_place([("a", 0.4)], {"a": 2.0, "b": 2.0})
    ((0, 'b'), None)
    """
    taken = dict.fromkeys(cores, 0.0)
    for computer, wanted in shards:
        if computer in taken:
            taken[computer] += wanted
    share = {computer: taken[computer] / cores[computer] for computer in cores}
    for computer, wanted in sorted(((c, w) for c, w in set(shards) if c in share), key=lambda one: -share[one[0]]):
        least = min(share, key=lambda other: (taken[other] + wanted) / cores[other])
        if (taken[least] + wanted) / cores[least] < share[computer] - 1e-9 and least != computer:
            return shards.index((computer, wanted)), least
    return None


def imported_ray() -> Any:
    """The module `ray`; raises `RotorwatchError` where it is not installed."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray  # noqa: PLC0415  # only here: takes a second
    except ImportError as error:
        raise RotorwatchError("a fleet needs Ray: pip install 'rotorwatch[fleet]'") from error
    return ray


def join_cluster(address: str, undo: ExitStack) -> None:
    """Join a Ray cluster until the stack is unwound; raises `RotorwatchError` if there is none."""
    ray = imported_ray()
    try:
        host, separator, port = address.rpartition(":")
        if separator and port.isdecimal() and "/" not in host:  # Ray itself would try for minutes
            socket.create_connection((host.strip("[]"), int(port)), _ANSWER_S).close()
        ray.init(address=address, namespace="rotorwatch", logging_level="warning", runtime_env={"env_vars": _VARIABLES})
    except (OSError, RuntimeError, ValueError) as error:
        raise RotorwatchError(
            f"no Ray cluster at {address}: {error}; start one with: RAY_worker_niceness=0 ray start --head "
            f"--system-config '{HEALTH_CHECKS}'"
        ) from error
    undo.callback(ray.shutdown)


class ShardActor:
    """What Ray runs for a shard: monitors from the start of its process, on whichever computer that is."""

    def __init__(self, settings: ServiceSettings, inner: LinkSettings) -> None:
        self._arguments = (settings, inner)
        self._said: list[str] = []
        self._thread: threading.Thread | None = None
        self._listening = threading.Lock()
        self.begin()

    def begin(self) -> None:
        """Start to monitor its machines, unless it does so already."""
        if self._thread is not None and self._thread.is_alive():
            return
        if (niceness := os.nice(0)) > 0:
            why = "Ray was started without RAY_worker_niceness=0"
            _log.warning("other programs on this computer take precedence over this shard", niceness=niceness, why=why)
        self._said.clear()
        self._connection, theirs = Pipe()
        self._thread = threading.Thread(target=run_shard, args=(*self._arguments, theirs), daemon=True)
        self._thread.start()

    def said(self, number: int, wait_s: float) -> tuple[str, str] | None:
        """Its message of this number, and the computer it runs on; None if there is no such message yet.

        Raises
        ------
        EOFError
            If it has ended without.
        """
        with self._listening:  # a caller that gave up waiting may ask again before this call has ended
            try:
                if len(self._said) <= number and self._connection.poll(wait_s):
                    self._said.append(self._connection.recv_bytes().decode())
            except OSError as error:  # it was asked to stop when it had ended already
                raise EOFError from error
        computer = imported_ray().get_runtime_context().get_node_id()
        return (self._said[number], computer) if len(self._said) > number else None

    def wait(self) -> None:
        """Return once it has stopped monitoring."""
        if self._thread is not None:
            self._thread.join()

    def ask_to_stop(self) -> None:
        """Ask it to end in order."""
        with suppress(OSError):  # it has ended by itself
            self._connection.send_bytes(b"")


class _Actor:
    """A `ShardProcess` in the cluster."""

    def __init__(self, ray: Any, name: str, settings: ServiceSettings, inner: LinkSettings) -> None:
        machines = len(settings.machines)
        self.cores = machines * _CORES_OF_A_MACHINE
        self.computer = ""  # where it runs; empty while it does not
        self.placed_s = 0.0  # since when, monotonic
        self._ray = ray
        self._arguments = (settings, inner)
        self._options = {
            "name": name,
            "num_cpus": self.cores,
            "memory": (_MB_OF_A_PROCESS + machines * _MB_OF_A_MACHINE) * 10**6,
            "max_restarts": -1,
            "max_concurrency": 4,
            "scheduling_strategy": "SPREAD",
        }
        self._moves_to = ""
        self._life: Any = None  # Ray's reference to `ShardActor.wait`, once it has begun
        self._next = 0  # number of its next message
        self._begin()

    def begin_again(self) -> None:
        if self._moves_to:
            self._end_actor()
            strategies = self._ray.util.scheduling_strategies
            soft = strategies.NodeAffinitySchedulingStrategy(self._moves_to, soft=True)
            self._options["scheduling_strategy"] = soft
            self._moves_to = ""
            self._begin()
        else:
            # Ray has revived it or is doing so; this is for an actor whose process no longer monitors anything.
            self._actor.begin.remote()
        self._life, self._next = None, 0

    def _begin(self) -> None:
        self._actor = self._ray.remote(ShardActor).options(**self._options).remote(*self._arguments)

    def said(self, wait_s: float) -> str | None:
        answer = self._actor.said.remote(self._next, wait_s)
        try:
            found: tuple[str, str] | None = self._ray.get(answer, timeout=wait_s + _ANSWER_S)
        except self._ray.exceptions.ActorDiedError as error:
            raise EOFError from error
        except (self._ray.exceptions.RayActorError, self._ray.exceptions.GetTimeoutError):
            return None  # it is being revived, or Ray looks for room
        if found is None:
            return None
        said, computer = found
        if self._next == 0 and "\n" not in said:
            self.placed_s = time.monotonic()
            self.computer, self._life = computer, self._actor.wait.remote()
        self._next += 1
        return said

    def ended(self, wait_s: float) -> str:
        if self._life is None or not self._ray.wait([self._life], timeout=wait_s)[0]:
            return ""
        how = "moves to another computer" if self._moves_to else "stopped"
        try:
            self._ray.get(self._life)
        except self._ray.exceptions.RayError:
            how = "ended, or its computer was lost"
        self.computer = ""
        return how

    def move_to(self, computer: str) -> None:
        """Ask it to end in order, to be started on another computer."""
        self._moves_to = computer
        self.ask_to_stop()

    def ask_to_stop(self) -> None:
        self._actor.ask_to_stop.remote()

    def end(self, patience_s: float) -> None:
        self.ended(patience_s)
        self._end_actor()

    def _end_actor(self) -> None:
        with suppress(self._ray.exceptions.RayError):
            self._ray.kill(self._actor, no_restart=True)
