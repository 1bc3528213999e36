"""The demo: a simulated machine breaks, the monitor says what broke.

Simulator and monitor run as separate programs on loopback with nothing else running; this program only starts them,
listens to the topics like any other client, asks the HTTP API, and stops them again::

    rotorsim publish ──stream──> rotorwatch run ──report, alarm/event──> this program
           └────────────truth──────────────────────────────────────────────┘
"""

import os
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import httpx
from pydantic import BaseModel, ConfigDict
from rich.console import Console

from models.errors import RotorwatchError
from models.machine import Machine, load_machine
from models.signals.link import LinkSettings
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.health import Report
from service.lines import alarm_event_line, report_line
from service.transport import TopicMessage, follow

__all__ = ["DemoError", "DemoOptions", "Outcome", "run_demo"]

_START_S = 60.0
_STOP_S = 10.0
_ENVIRONMENT = {
    "PYTHONUNBUFFERED": "1",
    # A demo leaves nothing behind, and who runs it is the only one to look at it.
    "ROTORWATCH_HISTORY__URL": "sqlite:///:memory:",
    "ROTORWATCH_ACCESS__OPEN_ON_LOOPBACK": "true",
}


class DemoError(RotorwatchError):
    """A program of the demo did not start or died; the message holds the end of its output."""


class Truth(BaseModel):
    """The part of the simulator's truth record that the demo looks at."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    data_s: float
    relative_changes: dict[str, float]


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """What to show.

    Attributes
    ----------
    scenario : str
        A shipped scenario of the simulator: a fault's name, or "healthy".
    seed : int
        Of the simulation; training used none of the small numbers.
    pace : float
        Data seconds per second.
    once : bool
        End after the scenario.
    http_port : int
        0 takes a free one.
    """

    scenario: str
    seed: int
    pace: float
    once: bool
    http_port: int


@dataclass(slots=True)
class Outcome:
    """What was injected and what was said about it.

    Attributes
    ----------
    injected : dict of str to float
        True relative changes, from the truth topic.
    raised : dict of str to float
        Relative changes of the raised alarms, from the alarm topic.
    over_http : set of str
        Parameters whose alarm the HTTP API showed too.
    windows : int
        Reports on evaluated windows.
    """

    injected: dict[str, float] = field(default_factory=dict)
    raised: dict[str, float] = field(default_factory=dict)
    over_http: set[str] = field(default_factory=set)
    windows: int = 0

    def verdict(self) -> str:
        """Why the demo failed; empty if exactly what was injected was raised, on the topic and over HTTP."""
        if not self.windows:
            return "no window was evaluated"
        wrong = sorted(set(self.raised) - set(self.injected))
        missed = sorted(set(self.injected) - set(self.raised))
        if wrong:
            return f"an alarm named {', '.join(wrong)}, which did not change"
        if missed:
            return f"no alarm named {', '.join(missed)}"
        for name, true in self.injected.items():
            if abs(self.raised[name] - true) > 0.25 * abs(true):
                return f"the alarm on {name} says {self.raised[name]:+.1%}, injected was {true:+.1%}"
        unseen = sorted(set(self.injected) - self.over_http)
        return f"the HTTP API did not show the alarm on {', '.join(unseen)}" if unseen else ""


def run_demo(options: DemoOptions) -> int:
    """Run the demo until its scenario ends (`once`) or until interrupted.

    Returns
    -------
    int
        Exit code: 0 if exactly the injected parameter was named, 1 otherwise. Interrupted: 130.

    Raises
    ------
    DemoError
        If a program does not start or dies.
    """
    machine, console = load_machine("lab"), Console(highlight=False, soft_wrap=True)
    with ExitStack() as stack:
        stack.enter_context(_interruptible())
        try:
            outcome = _play(options, machine, console, stack)
        except KeyboardInterrupt:
            console.print("\nstopped")
            return 130
    reason = outcome.verdict()
    if reason:
        console.print(f"[bold red]demo failed:[/] {reason}")
        return 1
    named = ", ".join(f"{name} {change:+.1%}" for name, change in outcome.raised.items()) or "nothing"
    injected = ", ".join(f"{name} {change:+.1%}" for name, change in outcome.injected.items()) or "nothing"
    console.print(f"[bold green]demo passed:[/] injected {injected}; named {named}; nothing else was raised")
    return 0


def _play(options: DemoOptions, machine: Machine, console: Console, stack: ExitStack) -> Outcome:
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    port = options.http_port or _free_port()
    url = f"http://127.0.0.1:{port}"
    base = f"{url}/api/v1/machines/{machine.site}/{machine.name}"
    monitor = stack.enter_context(
        _program("monitor", "service.rotorwatch", "run", "--listen", endpoint, "--http-port", str(port))
    )
    _wait_until_ready(url, monitor)
    link = LinkSettings(mode="client", connect=(endpoint,))
    inbox: queue.SimpleQueue[TopicMessage] = queue.SimpleQueue()
    topics = ("report", "alarm_event", "truth")
    stack.enter_context(follow(link, f"{machine.site}/{machine.name}", topics, inbox.put))
    simulator = stack.enter_context(
        _program(
            "simulator", "simulator.rotorsim", "publish", options.scenario,
            "--seed", str(options.seed), "--pace", f"{options.pace:g}", "--connect", endpoint,
            "--wait-for-subscriber", f"{_START_S:g}",
        )
    )  # fmt: skip
    window_s = machine.window.length_s
    console.print(
        f"[bold]rotorwatch demo[/]  machine {machine.site}/{machine.name}, {options.pace:g} times real time, "
        f"seed {options.seed}\n"
        f"open [bold]{url}[/] in a browser, or:  curl {base}/health\n"
        f"one line per window: relative change of each parameter with its 95 % interval; "
        f"the first window takes {window_s:g} s of data"
    )
    outcome, quiet_since = Outcome(), time.monotonic()
    while True:
        try:
            message = inbox.get(timeout=0.2)
        except queue.Empty:
            finished = simulator.process.poll() is not None
            if not finished:
                quiet_since = time.monotonic()
            simulator.must_not_have_failed()
            monitor.must_run()
            if finished and options.once and time.monotonic() - quiet_since > 2.0:
                return outcome
            continue
        quiet_since = time.monotonic()
        _show(message, outcome, console, base)


def _show(message: TopicMessage, outcome: Outcome, console: Console, base: str) -> None:
    topic = message.key.rsplit("/", 1)[-1]
    if topic == "report":
        report = Report.model_validate_json(message.text)
        outcome.windows += bool(report.parameters)
        style = {"alert": "yellow", "danger": "red", "healthy": "green"}.get(report.state, "dim")
        console.print(report_line(report), style=style)
    elif topic == "truth":
        truth = Truth.model_validate_json(message.text)
        changes = {name: change for name, change in truth.relative_changes.items() if change}
        if changes and changes != outcome.injected:
            text = ", ".join(f"{name} {change:+.0%}" for name, change in changes.items())
            console.print(f"          [bold]the simulator has just changed {text}[/] (the monitor is not told)")
        outcome.injected |= changes
    else:
        event = AlarmCloudEvent.model_validate_json(message.text)
        console.print(alarm_event_line(event), style="bold white on red")
        if event.data.kind == "raised" and event.data.relative_change is not None:
            outcome.raised[event.data.name] = event.data.relative_change
            answer = httpx.get(f"{base}/alarms", timeout=_STOP_S)
            states = AlarmStates.model_validate_json(answer.content)
            shown = {alarm.name for alarm in states.alarms if alarm.raised}
            outcome.over_http |= shown
            console.print(f"          over HTTP, {base}/alarms: {', '.join(sorted(shown)) or 'nothing'} raised")


@dataclass(slots=True)
class _Program:
    """One started program and where its output goes."""

    name: str
    process: subprocess.Popen[bytes]
    output: Path

    def must_run(self) -> None:
        """Raise if it ended."""
        if self.process.poll() is not None:
            raise DemoError(f"the {self.name} ended with exit code {self.process.returncode}:\n{self._tail()}")

    def must_not_have_failed(self) -> None:
        """Raise if it ended with an error."""
        if self.process.poll():
            self.must_run()

    def _tail(self) -> str:
        return "\n".join(self.output.read_text(encoding="utf-8", errors="replace").splitlines()[-15:])


@contextmanager
def _program(name: str, module: str, *arguments: str) -> Iterator[_Program]:
    """Run a program beside this one; it is gone when the block is left, however it is left."""
    with tempfile.TemporaryDirectory(prefix="rotorwatch-demo-") as directory:
        output = Path(directory) / f"{name}.log"
        with output.open("wb") as sink:
            # A session of its own: Ctrl-C reaches this program alone, which then stops the others in order.
            process = subprocess.Popen(  # noqa: S603  # our own modules, no shell
                [sys.executable, "-m", module, *arguments],
                stdout=sink,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env=os.environ | _ENVIRONMENT,
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


def _wait_until_ready(url: str, monitor: _Program) -> None:
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        monitor.must_run()
        try:
            if httpx.get(f"{url}/readyz", timeout=1.0).status_code == httpx.codes.OK:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise DemoError(f"the monitor was not ready after {_START_S:g} s")


@contextmanager
def _interruptible() -> Iterator[None]:
    """Treat a termination signal like Ctrl-C, so that no process is left behind."""

    def interrupt(signum: int, frame: FrameType | None) -> None:
        del signum, frame
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _free_port() -> int:
    """A free TCP port below the range from which the system takes ports for outgoing connections."""
    while True:
        port = 10_000 + int.from_bytes(os.urandom(2), "little") % 20_000
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        return port
