"""A monitor, a publisher and an operator at work, and measurements of them while faults are caused on purpose.

The monitor and the publisher are the programs as users start them. The operator keeps shelving and unshelving an
alarm, and records confirmed orders. A witness on the network records every alarm event that it receives.
"""

import os
import re
import signal
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
import zenoh

from models.alarm_names import STREAM_LOST
from models.signals.link import LinkSettings
from rotorwatch.client.client import Client
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.health import Health, HealthState
from rotorwatch.records.monitor import Readiness
from tests.loopback import session_of
from tests.service.delivery.hooked import Hook
from tests.service.rig.live import LAB, Program, endpoint, program, until
from tests.sure import sure

BLOCK_S = 0.2
_PLACE = "/api/v1/machines/demo/lab"
_SHELVED = "EI"  # an alarm that nothing here raises
_LONGEST_S = 180.0
_LOOK_S = 0.05
_DISK = "mkdir -p {0} && mount -t tmpfs -o size={1} tmpfs {0} && exec"

Event = tuple[str, str, str, int]
"""Identity, alarm, kind and time of an alarm event."""


@dataclass(frozen=True, slots=True)
class Seen:
    """The state that a monitor reported at one moment."""

    ready: bool
    readiness: Readiness
    health: Health

    def raised(self, name: str) -> bool:
        return any(one.name == name and one.present for one in self.health.alarms)

    @property
    def why_not(self) -> str:
        return "; ".join(self.readiness.reasons)

    @property
    def flowing(self) -> bool:
        age_s = self.health.stream.data_age_s
        return age_s is not None and age_s < 1.0 and not self.health.stream.silent

    @property
    def well(self) -> bool:
        """Whether data arrive and nothing is wrong with service or stream; a gap counts while the window holds it."""
        calm = {HealthState.WARMING, HealthState.HEALTHY}
        return self.ready and self.flowing and self.health.state in calm and not self.raised(STREAM_LOST)


@dataclass(slots=True)
class Plant:
    folder: Path
    rng: np.random.Generator
    undo: ExitStack
    address: str = field(default_factory=endpoint)
    pace: float = 1.0
    settings: str = ""
    connects: bool = False
    disk: str = ""
    receiver: Hook | None = None
    router: Program | None = None
    monitor: Program | None = None
    publishers: list[Program] = field(default_factory=list)
    answered: list[Event] = field(default_factory=list)
    heard: list[Event] = field(default_factory=list)
    missing_s: float = 0.0
    dropped: int = 0
    stated_s: list[float] = field(default_factory=list)
    recovered_s: list[float] = field(default_factory=list)
    away_s: float = 0.0
    orders_may_be_lost: bool = False
    _lives: int = 0
    _begin_s: float = 0.0
    _last: Health | None = None
    _over: threading.Event = field(default_factory=threading.Event)
    _threads: list[threading.Thread] = field(default_factory=list)

    @property
    def history(self) -> Path:
        """The database file, as this process reaches it."""
        if self.disk:
            return Path(f"/proc/{self.running.process.pid}/root").joinpath(
                *self.folder.parts[1:], "history", "h.sqlite"
            )
        return self.folder / "history" / "h.sqlite"

    @property
    def running(self) -> Program:
        return sure(self.monitor)

    # Programs

    def start(self) -> Program:
        self.monitor = None
        (self.folder / "history").mkdir(exist_ok=True)
        link = f'connect = ["{self.address}"]\nmode = "client"' if self.connects else f'listen = ["{self.address}"]'
        file = self.folder / "monitor.toml"
        file.write_text(
            f'[link]\n{link}\n[http]\nport = 0\n[[machines]]\nfile = "lab"\n{self.settings}', encoding="utf-8"
        )
        mount = _DISK.format(self.folder / "history", self.disk)
        started = self.undo.enter_context(
            program(
                self.folder, "service", "run", "--config", str(file),
                within=("unshare", "-rm", "sh", "-c", f'{mount} "$0" "$@"') if self.disk else (),
                ROTORWATCH_HISTORY__URL=f"sqlite:///{self.folder}/history/h.sqlite",
                ROTORWATCH_QUEUE__WHEN_FULL="drop",
            )
        )  # fmt: skip
        started.url()
        self.monitor = started
        self._lives += 1
        return started

    def publish(self, *more: str, run: int = 1) -> Program:
        role = ("--mode", "client") if self.connects else ()
        started = self.undo.enter_context(
            program(
                self.folder, "simulator.rotorsim", "publish", "healthy", "--connect", self.address, "--run", str(run),
                "--pace", str(self.pace), "--block-s", str(BLOCK_S), "--seed", str(self.rng.integers(10**9)),
                "--wait-for-subscriber", "60", "--duration", "3600", *role, *more,
            )
        )  # fmt: skip
        self.publishers.append(started)
        return started

    def start_router(self) -> None:
        self.router = self.undo.enter_context(program(self.folder, "service", "router", "--listen", self.address))
        self.router.wait_for("router listening")

    def end(self, number: signal.Signals = signal.SIGKILL) -> int:
        """End the monitor after noting its counts; return its exit code."""
        self.note()
        ended, self.monitor = self.running, None
        ended.process.send_signal(number)
        return ended.process.wait(_LONGEST_S)

    # Observations

    def look(self) -> Seen | None:
        if self.monitor is None or self.monitor.process.poll() is not None:
            return None
        try:
            with httpx.Client(base_url=self.monitor.url(), trust_env=False, timeout=_LONGEST_S) as http:
                answer = http.get("/readyz")
                fields = {name: value for name, value in answer.json().items() if name in Readiness.model_fields}
                self._last = Health.model_validate_json(http.get(f"{_PLACE}/health").content)
        except (httpx.HTTPError, ValueError):
            return None
        return Seen(answer.status_code == 200, Readiness.model_validate(fields), self._last)

    def wait(self, condition: Callable[[Seen], bool], what: str) -> None:
        deadline = time.monotonic() + _LONGEST_S
        seen = self.look()
        while seen is None or not condition(seen):
            if time.monotonic() > deadline:
                said = "no answer" if seen is None else f"{seen.health.state}, {seen.why_not or 'ready'}"
                raise AssertionError(f"no {what} within {_LONGEST_S:g} s ({said})")
            time.sleep(_LOOK_S)
            seen = self.look()

    def flowing(self, blocks: int = 20) -> None:
        self.wait(lambda s: s.flowing and s.health.quality.accepted_blocks >= blocks, "data")

    def at_work(self, *options: str) -> Program:
        """Publish, wait for data, and carry on for a moment."""
        publisher = self.publish(*options)
        self.flowing()
        self.rest(0.5, 2.0)
        return publisher

    def under_orders(self) -> None:
        """Publish, wait for data, and then for confirmed orders."""
        self.publish()
        self.flowing()
        self.wait_for_orders()

    def rest(self, from_s: float, to_s: float) -> None:
        """Let a time pass that depends on the seed."""
        time.sleep(self.rng.uniform(from_s, to_s))

    def note(self) -> None:
        """Add the counts of the running monitor."""
        self.look()
        if self._last is not None and self.monitor is not None:
            self.missing_s += self._last.quality.missing_s
            self.dropped += self._last.quality.queue_dropped_blocks
            self._last = None

    def broken(self) -> None:
        """Begin timing: the fault was caused just now."""
        self._begin_s = time.monotonic()

    mended = broken

    def stated(self, condition: Callable[[Seen], bool], what: str) -> None:
        self.wait(condition, f"statement: {what}")
        self.stated_now()

    def stated_now(self) -> None:
        """Record that the fault has been stated just now."""
        self.stated_s.append(time.monotonic() - self._begin_s)

    def recovered(self, condition: Callable[[Seen], bool] = lambda seen: seen.well) -> None:
        self.wait(condition, "recovery")
        self.recovered_s.append(time.monotonic() - self._begin_s)

    def over(self, condition: Callable[[Seen], bool] = lambda seen: seen.well) -> None:
        """The fault was repaired just now: wait for recovery."""
        self.mended()
        self.recovered(condition)

    # Results

    def log(self) -> list[Event]:
        """Every alarm event that is in the monitor's log."""
        with Client(self.running.url(), timeout_s=_LONGEST_S) as client:
            return [_event(one) for one in client.alarm_events("demo/lab", after=-1)]

    def _operate(self) -> None:
        """Shelve and unshelve an alarm repeatedly, and record what was confirmed."""
        action = "shelve"
        while not self._over.wait(0.3):
            at = self.monitor
            if at is None:
                continue
            order = {"reason": "a test", **({"duration_s": 3600.0} if action == "shelve" else {})}
            with suppress(httpx.HTTPError, AssertionError):
                answer = httpx.post(
                    f"{at.url()}{_PLACE}/alarms/{_SHELVED}/{action}",
                    json=order, headers={"if-match": "*"}, trust_env=False, timeout=_LONGEST_S,
                )  # fmt: skip
                if answer.status_code == 200:
                    for one in answer.json()["events"]:
                        self.answered.append(_event(AlarmCloudEvent.model_validate(one)))
                elif answer.status_code != 409:
                    continue
                action = "unshelve" if action == "shelve" else "shelve"

    def work(self) -> None:
        self._threads.append(threading.Thread(target=self._operate))
        self._threads[0].start()

    def rest_from_work(self) -> None:
        self._over.set()
        for one in self._threads:
            one.join()

    def unaccounted(self) -> int | None:
        """Blocks that were published and neither evaluated nor stated as missing; None if unknown."""
        if self._lives != 1 or len(self.publishers) != 1:
            return None
        assert self.publishers[0].stop() == 0
        told = re.search(r"published (\d+) blocks", self.publishers[0].output())
        assert told is not None, self.publishers[0].errors()
        published = int(told[1])

        def found() -> int:
            seen = self.look()
            if seen is None:
                return 0
            return seen.health.quality.accepted_blocks + round(seen.health.quality.missing_s / BLOCK_S)

        deadline = time.monotonic() + 20.0
        while found() < published and time.monotonic() < deadline:
            time.sleep(_LOOK_S)
        return published - found()

    def wait_for_orders(self, more: int = 2) -> None:
        wanted = len(self.answered) + more
        until(lambda: len(self.answered) >= wanted, "answers to operators")


def _event(event: AlarmCloudEvent) -> Event:
    return event.id, event.data.name, event.data.kind.value, event.data.time_ns


@contextmanager
def _witness(address: str, heard: list[Event]) -> Iterator[None]:
    def take(sample: zenoh.Sample) -> None:
        heard.append(_event(AlarmCloudEvent.model_validate_json(sample.payload.to_bytes())))

    with session_of(LinkSettings(mode="client", connect=(address,))) as session:
        subscriber = session.declare_subscriber(LAB.keys.alarm_event, take)
        yield
        subscriber.undeclare()  # type: ignore[no-untyped-call]


@contextmanager
def plant(folder: Path, seed: int, prepare: Callable[[Plant], None]) -> Iterator[Plant]:
    with ExitStack() as undo:
        made = Plant(folder, np.random.default_rng(seed), undo)
        prepare(made)
        made.start()
        undo.enter_context(_witness(made.address, made.heard))
        made.work()
        try:
            yield made
        finally:
            made.rest_from_work()


@contextmanager
def locked(history: Path) -> Iterator[None]:
    blocker = sqlite3.connect(history, isolation_level=None)
    blocker.execute("BEGIN IMMEDIATE")
    try:
        yield
    finally:
        blocker.close()


def pause(one: Program) -> None:
    os.kill(one.process.pid, signal.SIGSTOP)
