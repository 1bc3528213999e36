"""A replay's progress on a terminal or for another program, and the orders that come from there."""

import os
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from rotorwatch.records.replays import ReplayLine, ReplayProgress
from service.recordings.replay.player import Control
from service.recordings.replay.source import clock

Show = Callable[[ReplayProgress], None]

_EVERY_S = 0.25
_POLL_S = 0.25
_STEP_S = 10.0
_ARROWS = {b"\x1b[C": _STEP_S, b"\x1b[D": -_STEP_S, b"\x1bOC": _STEP_S, b"\x1bOD": -_STEP_S}


@contextmanager
def show(kind: Literal["auto", "json", "none"]) -> Iterator[Show]:
    """Yield a function that shows progress, at most every `_EVERY_S` seconds and at the end; call it at any rate."""
    if kind == "json":
        with _seldom(_print_line) as take:
            yield take
    elif kind == "auto" and sys.stderr.isatty():
        columns = (BarColumn(), TextColumn("{task.percentage:3.0f} %"), TextColumn("{task.description}"))
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("", total=1.0)

            def draw(progress: ReplayProgress) -> None:
                bar.update(task, completed=progress.fraction, description=_describe(progress))

            with _seldom(draw) as take:
                yield take
    else:
        yield lambda _: None


@contextmanager
def orders(control: Control, *, lines: bool, keyboard: bool) -> Iterator[None]:
    """Obey orders on standard input, until the block is left.

    With `lines` each line is an order, see `obey`; when the input ends, because the program that gave the orders is
    gone, the replay stops. With `keyboard`, if standard input is a terminal, space pauses and goes on, arrows seek, q
    stops.
    """
    if lines:
        threading.Thread(target=_read_lines, args=(control,), name="orders", daemon=True).start()
        yield
    elif keyboard and sys.stdin.isatty():
        with _single_keys():
            done = threading.Event()
            thread = threading.Thread(target=_read_keys, args=(control, done), name="keys", daemon=True)
            thread.start()
            try:
                yield
            finally:
                done.set()
                thread.join()
    else:
        yield


def obey(control: Control, order: str) -> bool:
    """Carry out one order, and say whether it was understood.

    ``pause``, ``resume``, ``stop``, ``seek TIME_NS``, ``seek +SECONDS`` or ``seek -SECONDS``.
    """
    word, _, argument = order.strip().partition(" ")
    simple = {"pause": control.pause, "resume": control.resume, "stop": control.stop}
    if word in simple and not argument:
        simple[word]()
        return True
    if word != "seek":
        return False
    try:
        if argument[:1] in ("+", "-"):
            control.seek_by(float(argument))
        else:
            control.seek(int(argument))
    except (ValueError, OverflowError):
        return False
    return True


@contextmanager
def _seldom(take: Show) -> Iterator[Show]:
    """Pass on progress at most every `_EVERY_S` seconds, and always the last."""
    latest: list[ReplayProgress] = []
    due_s = 0.0

    def maybe(progress: ReplayProgress) -> None:
        nonlocal due_s
        latest[:] = [progress]
        now_s = time.monotonic()
        if now_s >= due_s or progress.paused:  # nothing may follow a pause for long
            due_s = now_s + _EVERY_S
            take(progress)
            latest.clear()

    yield maybe
    for progress in latest:
        take(progress)


def _print_line(progress: ReplayProgress) -> None:
    sys.stdout.write(ReplayLine(kind="progress", progress=progress).model_dump_json() + "\n")
    sys.stdout.flush()


def _describe(progress: ReplayProgress) -> str:
    found = f"  {progress.windows} windows, {progress.alarms} alarms" if progress.windows else ""
    number = f"  pass {progress.pass_number}" if progress.pass_number > 1 else ""
    return f"{clock(progress.position_ns)}{found}{number}{'  paused' if progress.paused else ''}"


def _read_lines(control: Control) -> None:
    for line in sys.stdin:
        if not obey(control, line):
            sys.stderr.write(f"order not understood: {line.strip()[:80]}\n")
    control.stop()


def _read_keys(control: Control, done: threading.Event) -> None:
    while not done.is_set():
        ready, _, _ = select.select([sys.stdin], [], [], _POLL_S)
        if not ready:
            continue
        pressed = os.read(sys.stdin.fileno(), 8)
        if not pressed:
            return
        if pressed == b" ":
            (control.resume if control.paused else control.pause)()
        elif pressed == b"q":
            control.stop()
        elif pressed in _ARROWS:
            control.seek_by(_ARROWS[pressed])


@contextmanager
def _single_keys() -> Iterator[None]:
    """Make keys arrive one by one, without being shown."""
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    tty.setcbreak(number)
    try:
        yield
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)
