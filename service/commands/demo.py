"""The demo: a simulated machine breaks, the monitor names the fault; the machine is repaired, and breaks again.

Simulator and monitor run as separate programs on loopback; this program only starts them, subscribes to the topics and
queries the HTTP API like any other client, and stops them again::

    rotorsim publish ──stream──> rotorwatch run ──report, alarm/event──> this program
           └────────────truth──────────────────────────────────────────────┘

It is all one stream, so that for the monitor the machine never stops; the simulator gets the schedule of all faults at
its start::

    0 s        140 s          300 s          500 s          660 s
    healthy    first fault    repaired       next fault     repaired    ...
"""

import json
import os
import queue
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import cycle, islice
from pathlib import Path
from typing import IO

import httpx
from pydantic import BaseModel
from rich.console import Console

from models.alarm_names import CLOCK, GAP, OVERLOADED, STREAM_LOST
from models.errors import RotorwatchError
from models.machine import Machine, load_machine
from models.signals.link import LinkSettings
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Report
from service.stream.transport import TopicMessage, follow
from service.terminal.lines import alarm_event_line, report_heading, report_row, with_minus_signs
from service.terminal.stopping import handled

FAULTS = {"k_by": -0.25, "c_by": -0.30, "k_bz": -0.25, "c_bz": -0.30, "e": 0.30}
"""Faults as relative changes of parameters; the simulator's scenarios of these names apply the same changes."""

_HEALTHY_S = 140.0
_BROKEN_S = 160.0
_REPAIRED_S = 200.0
_ROUNDS = 200
_START_S = 120.0
_STOP_S = 10.0
_WIDTH = 100
_OF_A_BUSY_COMPUTER = (GAP, CLOCK, OVERLOADED, STREAM_LOST)
_PORTS = (7447, 8080)
_ENVIRONMENT = {
    "PYTHONUNBUFFERED": "1",
    # The demo must leave no files, and only the local user has access.
    "ROTORWATCH_HISTORY__URL": "sqlite:///:memory:",
    "ROTORWATCH_ACCESS__OPEN_ON_LOOPBACK": "true",
}
_RECORDING = {
    "rotate_s": 10.0,  # short, so that recordings are soon available for replay
    "rotate_mb": 50.0,
    "keep_gb": 0.15,
    "alarm_keep_gb": 0.15,
    "alarm_before_s": 60.0,
    "alarm_after_s": 60.0,
}
# Wrapper that ends a program when its standard input is closed, so that it ends even if the demo is killed.
_TIED = """
import atexit, os, runpy, shutil, signal, sys, threading, time
def tied():
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(20)
    os._exit(1)
threading.Thread(target=tied, daemon=True).start()
if sys.argv[1]:
    atexit.register(shutil.rmtree, sys.argv[1], True)
sys.argv = sys.argv[2:]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


class Truth(BaseModel, extra="ignore", frozen=True):
    """The part of the simulator's truth record that the demo uses."""

    time_ns: int
    data_s: float
    relative_changes: dict[str, float]


@dataclass(slots=True)
class Outcome:
    """Faults injected in one round, and alarms raised."""

    injected: dict[str, float] = field(default_factory=dict)  # true relative changes, from the truth topic
    # Relative changes of the raised alarms, from the alarm topic.
    raised: dict[str, float] = field(default_factory=dict)
    over_http: set[str] = field(default_factory=set)  # parameters whose alarm the HTTP API showed too
    windows: int = 0  # reports on evaluated windows
    others: set[str] = field(default_factory=set)  # other raised alarms
    # Raised alarms about the stream, which a busy computer can cause.
    of_the_data: set[str] = field(default_factory=set)

    def verdict(self) -> str:
        """Why the demo failed; empty if exactly the injected faults were raised, on the topic and over HTTP."""
        if not self.windows:
            return "no window was evaluated"
        wrong = sorted(set(self.raised) - set(self.injected))
        missed = sorted(set(self.injected) - set(self.raised))
        if wrong:
            return f"an alarm named {', '.join(wrong)}, which did not change"
        if missed:
            return f"no alarm named {', '.join(missed)}"
        if self.others:
            return f"{', '.join(sorted(self.others))} was raised, and no such fault was injected"
        for name, true in self.injected.items():
            if abs(self.raised[name] - true) > 0.25 * abs(true):
                return f"the alarm on {name} says {self.raised[name]:+.1%}, injected was {true:+.1%}"
        unseen = sorted(set(self.injected) - self.over_http)
        return f"the HTTP API did not show the alarm on {', '.join(unseen)}" if unseen else ""

    def line(self) -> str:
        """Summary of injected and named changes."""
        sides = (
            ", ".join(f"{name} {change:+.1%}" for name, change in changes.items()) or "nothing"
            for changes in (self.injected, self.raised)
        )
        busy = f"{', '.join(sorted(self.of_the_data))} (is this computer too busy for the pace?)"
        rest = f"of the data: {busy}" if self.of_the_data else "nothing else was raised"
        return with_minus_signs("injected {}; named {}; {}".format(*sides, rest))


def run_demo(fault: str, seed: int, pace: float, once: bool, http_port: int | None) -> int:
    """Run the demo for one fault (`once`) or until interrupted; `fault` is one of `FAULTS`, or "none".

    `seed` is that of the simulation (training used no small seeds), `pace` is data seconds per second. `once` also ends
    a demo without a fault, after the same time. Port 0 takes free ports, for Zenoh too; None takes the usual ports if
    they are free. The exit code is 0 if exactly the injected parameter was named, 1 if not, and 130 if interrupted.

    Raises
    ------
    RotorwatchError
        If a program does not start or dies.
    """
    console = Console(highlight=False)
    console.width = min(console.width, _WIDTH) if console.is_terminal else _WIDTH
    with ExitStack() as stack:
        # A termination signal is treated like Ctrl-C, so that the programs are stopped in order.
        stack.enter_context(handled((signal.SIGTERM, signal.SIGHUP), signal.default_int_handler))
        try:
            passed = _Show(fault, seed, pace, once, http_port, console).run(stack)
        except KeyboardInterrupt:
            console.print("\nstopping simulator and monitor ...")
            stack.close()
            console.print("stopped")
            return 130
    return 0 if passed else 1


class _Show:
    """Runs the two programs, and prints their messages."""

    def __init__(self, fault: str, seed: int, pace: float, once: bool, http_port: int | None, console: Console) -> None:
        self._seed, self._pace, self._once, self._console = seed, pace, once, console
        self._machine: Machine = load_machine("lab")
        zenoh_port, free_port = (_port(None if http_port == 0 else usual) for usual in _PORTS)
        self._endpoint = f"tcp/127.0.0.1:{zenoh_port}"
        self._url = f"http://127.0.0.1:{http_port or free_port}"
        self._base = f"{self._url}/api/v1/machines/{self._machine.title}"
        names = list(FAULTS)
        first = names.index(fault) if fault in FAULTS else 0
        self._rounds = [
            (name if fault in FAULTS else None, _HEALTHY_S + number * (_BROKEN_S + _REPAIRED_S))
            for number, name in enumerate(islice(cycle(names[first:] + names[:first]), _ROUNDS))
        ]
        self._round = 0
        self._start_ns: int | None = None
        self._due: deque[Truth] = deque()
        self._outcome = Outcome()

    def run(self, stack: ExitStack) -> bool:
        """Start both programs and show their messages to the end; return whether exactly the injected was named."""
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="rotorwatch-demo-", ignore_cleanup_errors=True))
        monitor = stack.enter_context(
            _program("monitor", "service", "run", "--listen", self._endpoint,
                     "--http-port", self._url.rpartition(":")[2], recordings=folder)
        )  # fmt: skip
        _wait_until_ready(self._url, monitor)
        link = LinkSettings(mode="client", connect=(self._endpoint,))
        inbox: queue.SimpleQueue[TopicMessage] = queue.SimpleQueue()
        stack.enter_context(follow(link, self._machine.title, ("report", "alarm_event", "truth"), inbox.put))
        self._introduce()
        simulator = stack.enter_context(
            _program(
                "simulator", "simulator.rotorsim", "publish", "healthy", "--connect", self._endpoint,
                "--seed", str(self._seed), "--pace", f"{self._pace:g}",
                "--duration", f"{self._rounds[-1][1] + _BROKEN_S + _REPAIRED_S:g}", *self._injections(),
                "--wait-for-subscriber", f"{_START_S:g}", "--linger", "0",
            )
        )  # fmt: skip
        while self._round < len(self._rounds):
            try:
                message = inbox.get(timeout=0.2)
            except queue.Empty:
                simulator.must_run()
                monitor.must_run()
                continue
            try:
                ended = self._tell(message)
            except httpx.TransportError as error:  # the monitor may have died after sending this message
                with suppress(subprocess.TimeoutExpired):
                    monitor.process.wait(_STOP_S)
                monitor.must_run()
                raise RotorwatchError(f"the monitor does not answer at {self._base}: {error}") from error
            if ended and (reason := self._end_of_round()) is not None:
                return not reason
        self._console.print(f"{_ROUNDS} faults were shown: stopping")
        return True

    def _injections(self) -> list[str]:
        return [
            text
            for name, at_s in self._rounds
            if name is not None
            for text in ("--fault", f"{name}={FAULTS[name]:g}@{at_s:g}", "--fault", f"{name}=0@{at_s + _BROKEN_S:g}")
        ]

    def _introduce(self) -> None:
        pace, window_s = self._pace, self._machine.window.length_s
        what = (
            f"After {_HEALTHY_S:g} s of data the simulator damages the rotor; the monitor does not "
            "know, and has to find out what changed and by how much."
            if self._rounds[0][0]
            else "Nothing breaks in this run, and no alarm may be raised."
        )
        program = _command()
        self._console.print(
            f"[bold]rotorwatch demo[/]: a simulated rotor publishes its vibration {pace:g} times faster than real "
            f"time (seed {self._seed}); a monitor listens. {what}\n\n"
            f"  page   [bold]{self._url}[/]\n"
            f"  API    {self._base}/health\n"
            f"  Zenoh  {self._endpoint}\n\n"
            f"In another terminal:\n"
            f"  {program} watch --connect {self._endpoint}\n"
            f"  {program} status --url {self._url}\n\n"
            "Each line is one window: the change of each parameter in %, ± its 95 % interval. k_by, k_bz: stiffness "
            "of the bearing, horizontal and vertical; c_by, c_bz: its damping; e: unbalance; EI: stiffness of the "
            "shaft. Times are those of the data, UTC. "
            f"Ctrl-C ends everything.\n\nThe first window fills: {window_s:g} s of data, {window_s / pace:g} s.\n"
            f"[bold]{report_heading()}[/]"
        )

    def _tell(self, message: TopicMessage) -> bool:
        """Show a message; return whether the fault has been present for `_BROKEN_S`, i.e. the round is over."""
        topic, console, outcome = message.key.rsplit("/", 1)[-1], self._console, self._outcome
        if topic == "report":
            report = Report.model_validate_json(message.text)
            outcome.windows += bool(report.parameters)
            while self._due and self._due[0].time_ns < report.end_ns:
                self._tell_truth(self._due.popleft())
            if report.parameters or report.reason:
                style = {"alert": "yellow", "danger": "red", "healthy": "green"}.get(report.state, "dim")
                console.print(report_row(report), style=style)
            end_s = self._rounds[self._round][1] + _BROKEN_S
            return self._start_ns is not None and report.end_ns >= self._start_ns + round(end_s * 1e9)
        if topic == "truth":
            truth = Truth.model_validate_json(message.text)
            self._start_ns = truth.time_ns - round(truth.data_s * 1e9) if self._start_ns is None else self._start_ns
            self._due.append(truth)
            return False
        event = AlarmCloudEvent.model_validate_json(message.text)
        raised = event.data.kind == "raised"
        console.print(alarm_event_line(event), style="bold white on red" if raised else "green", markup=False)
        if raised and event.data.relative_change is None:
            (outcome.of_the_data if event.data.name in _OF_A_BUSY_COMPUTER else outcome.others).add(event.data.name)
        elif raised and event.data.relative_change is not None:
            outcome.raised[event.data.name] = event.data.relative_change
            answer = httpx.get(f"{self._base}/alarms", timeout=_STOP_S)
            states = AlarmStates.model_validate_json(answer.content)
            shown = {alarm.name for alarm in states.alarms if alarm.raised}
            outcome.over_http |= shown
            console.print(f"          over HTTP, {self._base}/alarms: {', '.join(sorted(shown)) or 'nothing'} raised")
        return False

    def _tell_truth(self, truth: Truth) -> None:
        """Print the injected change, before the first window that contains it."""
        changes = {name: value for name, value in truth.relative_changes.items() if value}
        self._outcome.injected |= changes
        if changes:
            text = with_minus_signs(", ".join(f"{name} by {value:+.0%}" for name, value in changes.items()))
            self._console.print(f"          [bold]the simulator has just changed {text}[/] (the monitor does not know)")

    def _end_of_round(self) -> str | None:
        """Print the result of a round; with `once`, return why it failed (empty if passed), else None."""
        reason = self._outcome.verdict()
        if reason:
            self._console.print(f"[bold red]demo failed:[/] {with_minus_signs(reason)}")
        else:
            self._console.print(f"[bold green]demo passed:[/] {self._outcome.line()}")
        if self._once:
            return reason
        self._outcome = Outcome()
        self._round += 1
        if self._round < len(self._rounds) and (name := self._rounds[self._round][0]) is not None:
            self._console.print(
                f"          [bold]the machine has been repaired[/]; in {_REPAIRED_S:g} s of data {name} changes"
            )
        return None


@dataclass(slots=True)
class _Program:
    """A started program and the file with its output."""

    name: str
    process: subprocess.Popen[bytes]
    output: IO[bytes]

    def must_run(self) -> None:
        if (code := self.process.poll()) is not None:
            how = f"was killed ({signal.Signals(-code).name})" if code < 0 else f"ended with exit code {code}"
            self.output.seek(0)
            tail = self.output.read().decode(errors="replace").splitlines()[-15:]
            raise RotorwatchError("\n".join([f"the {self.name} {how}", *tail]))


@contextmanager
def _program(name: str, module: str, *arguments: str, recordings: str = "") -> Iterator[_Program]:
    """Run a program in the background; it is stopped, and `recordings` removed, however the block is left."""
    recording = {"ROTORWATCH_RECORDING": json.dumps({**_RECORDING, "directory": recordings})} if recordings else {}
    with tempfile.TemporaryFile() as output:  # nameless, so that it cannot be left behind
        process = subprocess.Popen(  # noqa: S603  # our own modules, no shell
            [sys.executable, "-c", _TIED, recordings, module, *arguments],
            stdout=output,
            stderr=subprocess.STDOUT,
            stdin=subprocess.PIPE,
            # In a new session, so that Ctrl-C only reaches this program, which then stops the others in order.
            start_new_session=True,
            env=os.environ | _ENVIRONMENT | recording,
        )
        try:
            yield _Program(name, process, output)
        finally:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                process.stdin.close()


def _wait_until_ready(url: str, monitor: _Program) -> None:
    deadline = time.monotonic() + _START_S
    with httpx.Client(timeout=1.0) as client:  # created once, because every client loads all certificates
        while time.monotonic() < deadline:
            monitor.must_run()
            try:
                if client.get(f"{url}/readyz").status_code == httpx.codes.OK:
                    return
            except httpx.TransportError:
                pass
            time.sleep(0.1)
    raise RotorwatchError(f"the monitor was not ready after {_START_S:g} s")


def _command() -> str:
    """Command with which this program can be called from the current folder."""
    if shutil.which("rotorwatch"):
        return "rotorwatch"
    script = Path(sys.executable).parent / "rotorwatch"
    return os.path.relpath(script) if script.is_file() else f"{sys.executable} -m service"


def _port(usual: int | None) -> int:
    """The usual port, or a free one below the range from which the system takes ports for outgoing connections."""
    port = usual
    while True:
        if port is not None:
            with socket.socket() as probe:
                # As servers do; otherwise a port with a recently closed connection would look taken.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind(("127.0.0.1", port))
                except OSError:
                    pass
                else:
                    return port
        port = 10_000 + int.from_bytes(os.urandom(2), "little") % 20_000
