"""What the tests of the running service share: real sessions on loopback, real processes, waiting for conditions."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import httpx
import numpy as np
import numpy.typing as npt
import zenoh
import zenoh.ext

from models.machine import MachineFile, load_machine
from models.signals.block import SampleBlock
from models.signals.link import LinkSettings
from models.signals.wire import encode_block
from rotorwatch.records.health import Health
from service.runtime.runtime import Runtime, running
from service.settings.access import AccessSettings, LimitSettings
from service.settings.service import HistorySettings, HttpSettings, MachineEntry, QueueSettings, ServiceSettings
from service.stream.inbox import RawBlock
from service.stream.transport import Link, MachineCallbacks, MachineLink
from service.stream.worker import MachineWorker
from simulator.publisher import PublishSettings, publish
from simulator.scenario import Event
from tests import loopback
from tests.service.rig.preloaded import Preloaded
from tests.windows import healthy_blocks

endpoint = loopback.endpoint
ROOT = Path(__file__).parents[3]
LAB = load_machine("lab")
START_NS = 1_767_225_600_000_000_000
IN_MEMORY = HistorySettings(url="sqlite:///:memory:")
OPEN = AccessSettings(open_on_loopback=True, limits=LimitSettings(requests_per_minute=1_000_000))
PATIENT = ("[operation]", "[ingest]\nno_data_after_s = 3600.0\n\n[operation]")
"""For `machine_file`: missing data are never a silence."""
IN_ORDER = ("[operation]", "[ingest]\nno_data_after_s = 3600.0\nreorder_blocks = 0\n\n[operation]")
"""The same without reordering: a gap is one at once."""
IMPATIENT = ("[operation]", "[ingest]\nblock_to_s = 0.2\nno_data_after_s = 0.5\n\n[operation]")
"""The opposite: half a second without data is a silence."""
SHORT = (("length_s = 60.0", "length_s = 20.0"), ("off_delay_s = 60.0", "off_delay_s = 20.0"))
"""For `machine_file`: windows are full, and alarms cleared, after a third of the time."""
QUICK = (PATIENT, *SHORT)
"""Both, for streams that come as fast as they are evaluated."""
_ALONE = {
    "ROTORWATCH_HISTORY__URL": "sqlite:///:memory:",
    "ROTORWATCH_ACCESS__OPEN_ON_LOOPBACK": "true",
    "ROTORWATCH_ACCESS__LIMITS__REQUESTS_PER_MINUTE": "1000000",
    "ROTORWATCH_QUEUE__WHEN_FULL": "wait",
}
"""Unless a test says otherwise, programs leave nothing behind, are open to everybody on this computer, and lose nothing
when it is busy."""


def until(condition: Callable[[], bool], what: str, timeout_s: float = 180.0) -> None:
    """Wait for a condition, at most until a deadline."""
    deadline, pause_s = time.monotonic() + timeout_s, 0.005
    while not condition():
        assert time.monotonic() < deadline, f"no {what} within {timeout_s} s"
        time.sleep(pause_s)
        pause_s = min(1.2 * pause_s, 0.05)  # polling over HTTP keeps two programs busy


def until_subscribed(session: zenoh.Session, key: str) -> None:
    """Wait until a key has a subscriber, whose declaration takes time to arrive."""
    probe = session.declare_publisher(key)
    until(lambda: bool(probe.matching_status.matching), f"subscriber of {key}")  # type: ignore[attr-defined]  # the stub says bool
    probe.undeclare()  # type: ignore[no-untyped-call]


@contextmanager
def open_session(connect: str, mode: Literal["peer", "client"] = "peer") -> Iterator[zenoh.Session]:
    """A session with a service that has subscribed to the lab machine: nothing that it puts is missed."""
    with loopback.session_of(LinkSettings(mode=mode, connect=(connect,))) as session:
        until_subscribed(session, LAB.keys.stream)
        yield session


def advanced_publisher(
    session: zenoh.Session, key: str, kept: int = 0, *, heartbeat_s: float = 0.2, detected: bool = True, **more: Any
) -> zenoh.ext.AdvancedPublisher:
    """A publisher like the simulator's: losses are detected, and `kept` messages cached for late subscribers."""
    return zenoh.ext.declare_advanced_publisher(
        session, key, congestion_control=zenoh.CongestionControl.BLOCK,
        cache=zenoh.ext.CacheConfig(max_samples=kept) if kept else None,
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=heartbeat_s, sporadic_heartbeat=None),
        publisher_detection=detected, **more,
    )  # fmt: skip


def settings(
    listen: str,
    machine: str = "lab",
    bundle: str | None = None,
    when_full: str = "drop",
    bound: int = 600,
    **others: object,
) -> ServiceSettings:
    """Settings of a service on loopback with a free HTTP port; `others` are sections to replace."""
    made = ServiceSettings(
        link=LinkSettings(listen=(listen,)), http=HttpSettings(port=0), history=IN_MEMORY, access=OPEN,
        machines=(MachineEntry(file=machine, bundle=bundle),),
        queue=QueueSettings.model_validate({"blocks": bound, "when_full": when_full}),
    )  # fmt: skip
    return made.model_copy(update=others)


def kept_in(folder: Path) -> HistorySettings:
    return HistorySettings(url=f"sqlite:///{folder / 'history.sqlite'}")


def worker_of(runtime: Runtime) -> MachineWorker:
    """The first machine, which this process monitors itself."""
    worker = runtime.machines()[0]
    assert isinstance(worker, MachineWorker)
    return worker


@contextmanager
def service(
    listen: str, machine: str = "lab", bundle: str | None = None, when_full: str = "drop", bound: int = 600
) -> Iterator[tuple[Runtime, MachineWorker]]:
    with running(settings(listen, machine, bundle, when_full, bound)) as runtime:
        yield runtime, worker_of(runtime)


def machine_file(folder: Path, *replacements: tuple[str, str]) -> str:
    text = (ROOT / "models/machines/lab.toml").read_text(encoding="utf-8")
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    path = folder / "machine.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


_simulated: dict[tuple[tuple[Event, ...], int, int], list[SampleBlock]] = {}
"""The longest stream of each kind so far: shorter ones are its first blocks."""


def scenario_blocks(duration_s: float, *faults: Event, start_ns: int = START_NS, run: int = 1) -> list[SampleBlock]:
    """Blocks of 0.1 s of the shipped healthy scenario, shortened, with faults added; read-only."""
    count, what = round(10 * duration_s), (faults, start_ns, run)
    if len(_simulated.get(what, ())) < count:
        _simulated[what] = [*healthy_blocks(LAB, duration_s, 7_700_011, *faults, start_ns=start_ns, run=run)]
        for block in _simulated[what]:
            block.samples.setflags(write=False)
    return _simulated[what][:count]


def send(connect: str, stream: list[SampleBlock], machine: MachineFile = LAB) -> None:
    """Publish blocks as the simulator does, as fast as the service takes them."""
    plan = PublishSettings(
        link=LinkSettings(connect=(connect,)), pace=None, wait_for_subscriber_s=180.0, linger_s=0.0, drain_s=180.0
    )
    summary = publish(machine, ((block, ()) for block in stream), plan)
    assert summary.blocks == len(stream)


@dataclass(slots=True)
class Feed:
    """Good blocks of the shipped machine, one after the other, published without the simulator."""

    session: zenoh.Session
    machine: MachineFile = LAB
    run: int = 1
    sequence: int = 0
    start_ns: int = START_NS
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(5))

    def samples(self, n_samples: int = 200) -> npt.NDArray[np.float32]:
        return self.rng.standard_normal((n_samples, len(self.machine.sensors))).astype(np.float32)

    def block(self, **changes: object) -> SampleBlock:
        """The block that comes next, with some fields replaced."""
        fields: dict[str, object] = {
            "start_ns": self.start_ns, "sequence": self.sequence, "run": self.run, "rate_hz": self.machine.rate_hz,
            "samples": self.samples(),
        }  # fmt: skip
        return SampleBlock(**(fields | changes))  # type: ignore[arg-type]  # tests give fields of any kind

    def put(self, *blocks: SampleBlock, schema_hash: str | None = None) -> None:
        known = self.machine.descriptor.schema_hash if schema_hash is None else schema_hash
        for block in blocks:
            self.put_raw(*encode_block(block, known))

    def put_raw(self, payload: bytes, attachment: bytes, encoding: str) -> None:
        self.session.put(
            self.machine.keys.stream,
            payload,
            attachment=attachment or None,
            encoding=encoding,
            # The sender must not drop on a busy computer: blocks may be lost only where the test looks.
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def put_good(self, count: int = 1) -> None:
        """Publish the next good blocks and go on to the one after them."""
        for _ in range(count):
            block = self.block()
            self.put(block)
            self.sequence += 1
            self.start_ns = block.end_ns

    def skip(self, seconds: int = 3) -> None:
        """Leave out some seconds: a gap before the next block."""
        self.sequence += 10 * seconds
        self.start_ns += seconds * 10**9

    def gap(self) -> None:
        """Publish two good blocks with a gap between them."""
        self.put_good()
        self.skip()
        self.put_good()


@contextmanager
def feeding(plan: ServiceSettings) -> Iterator[tuple[Runtime, Feed]]:
    with running(plan) as runtime, open_session(plan.link.listen[0]) as session:
        yield runtime, Feed(session, runtime.machines()[0].machine)


@contextmanager
def fed_service(machine: str = "lab", **how: Any) -> Iterator[tuple[Runtime, MachineWorker, Feed]]:
    with feeding(settings(endpoint(), machine, **how)) as (runtime, feed):
        yield runtime, worker_of(runtime), feed


@dataclass(slots=True)
class Program:
    """A started program and the files its output goes to."""

    process: subprocess.Popen[bytes] | Preloaded
    out: Path
    err: Path

    def output(self) -> str:
        return self.out.read_text(encoding="utf-8")

    def errors(self) -> str:
        return self.err.read_text(encoding="utf-8")

    def latest(self) -> dict[str, Any]:
        """The newest line of a program that prints JSON lines."""
        lines = self.output().rpartition("\n")[0].splitlines()
        return dict(json.loads(lines[-1])) if lines else {}

    def wait_for(self, text: str) -> None:
        """Wait until standard output holds a text."""
        until(lambda: self.process.poll() is not None or text in self.output(), f"{text!r} in the output")
        assert text in self.output(), f"ended without {text!r}:\n{self.output()}\n{self.errors()}"

    def url(self) -> str:
        """URL of a monitor's HTTP API, from its output."""
        self.wait_for("HTTP API http")
        return self.output().split("HTTP API ", 1)[1].split()[0]

    def health(self, place: str = "demo/lab") -> Health:
        answer = httpx.get(f"{self.url()}/api/v1/machines/{place}/health", trust_env=False, timeout=180.0)
        return Health.model_validate_json(answer.raise_for_status().content)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.process.wait(180)


@contextmanager
def program(
    folder: Path,
    *arguments: str,
    cwd: Path = ROOT,
    alone: dict[str, str] | None = None,
    within: tuple[str, ...] = (),
    network: str = "",
    **environment: str,
) -> Iterator[Program]:
    """Run ``python -m ARGUMENTS`` from the checkout or elsewhere; `alone` is an environment of its own.

    The words `within` come before the command; `network` is that of a host. It is killed on exit.
    """
    number = len(list(folder.glob("*.out")))
    out, err = folder / f"{number}.out", folder / f"{number}.err"
    variables = {**({**os.environ, **_ALONE} if alone is None else alone), "COLUMNS": "200", **environment}
    process: subprocess.Popen[bytes] | Preloaded
    with out.open("wb") as out_file, err.open("wb") as err_file:
        if within:
            process = subprocess.Popen(
                [*within, sys.executable, "-m", *arguments], cwd=cwd, stdin=subprocess.DEVNULL, stdout=out_file,
                stderr=err_file, env=variables,
            )  # fmt: skip
        else:
            process = Preloaded(arguments, cwd, out, err, variables, network)
    try:
        yield Program(process, out, err)
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


def ignore(*_: object) -> None:
    """Accept any arguments."""


def no_events(after: int, limit: int) -> str:
    """The log of a machine on which nothing has happened."""
    return "[]"


@contextmanager
def machine_link(
    where: str | LinkSettings,
    on_block: Callable[[RawBlock], None],
    *,
    wait: bool = False,
    alarm_events: Callable[[int, int], str] = no_events,
) -> Iterator[tuple[Link, MachineLink]]:
    """A machine's link that listens on an address, or connects as its settings say."""
    callbacks = MachineCallbacks(on_block, ignore, ignore, ignore, lambda: '{"h": 1}', lambda: '{"a": 1}', alarm_events)
    link = Link(LinkSettings(listen=(where,)) if isinstance(where, str) else where)
    declared = MachineLink(link, LAB.keys, callbacks, wait_when_full=wait)
    try:
        yield link, declared
    finally:
        declared.close()
        link.close()
