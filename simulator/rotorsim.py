"""The command ``rotorsim``: a simulated machine that publishes its vibration, or writes it into a recording."""

import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn

from models.errors import MachineFileError
from models.machine import Machine, load_machine
from models.signals.block import nanoseconds
from models.signals.link import LinkSettings, load_link
from simulator.commands import Commands, VersionOption, finite
from simulator.scenario import Scenario, load_scenario, parse_fault, shipped_scenarios

if TYPE_CHECKING:  # the stream imports scipy, which --help must not wait for
    from simulator.stream import BlockStream, RunSummary

_FIRST_LINE_S = 2.0
_LINE_S = 10.0

app = typer.Typer(
    name="rotorsim",
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="Simulated rotor with unbalance, random excitation and faults that begin when you choose, as a sensor stream.",
    epilog=f"Shipped scenarios: {', '.join(shipped_scenarios())}. Write your own: docs/scenario.md.",
)


_Mode = Literal["peer", "client"]
_ScenarioArgument = Annotated[
    str, typer.Argument(metavar="SCENARIO", help="Shipped scenario by name, or the path of a scenario file.")
]
_MachineOption = Annotated[
    str | None, typer.Option("--machine", help="Machine to use instead of the scenario's: shipped name, or path.")
]
_SeedOption = Annotated[int | None, typer.Option(min=0, help="Seed of all random forces and noise.")]
_DurationOption = Annotated[float | None, typer.Option("--duration", help="Data seconds; the scenario's if left out.")]
_FaultOption = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        metavar="NAME=CHANGE@SECONDS",
        help="Add a fault: k_by=-0.25@140 removes a quarter of the horizontal bearing stiffness after 140 s. "
        "Names: k_by, c_by, k_bz, c_bz (bearing stiffness and damping), e (unbalance), EI (shaft). Repeatable.",
    ),
]
_BlockOption = Annotated[float, typer.Option("--block-s", help="Length of a block, s; 0.02 to 0.5 is sensible.")]
_EncodingOption = Annotated[
    Literal["raw", "arrow"], typer.Option(help="Raw samples with a fixed header, or Arrow IPC streams.")
]


@app.callback()
def _program(_version: VersionOption = False) -> None:
    pass


@app.command()
def publish(
    scenario: _ScenarioArgument = "healthy",
    machine: _MachineOption = None,
    seed: _SeedOption = None,
    duration_s: _DurationOption = None,
    fault: _FaultOption = None,
    pace: Annotated[
        str,
        typer.Option(
            help="Data seconds per second: 1 is real time, 20 twenty times faster, max limited by back-pressure only."
        ),
    ] = "1",
    block_s: _BlockOption = 0.1,
    encoding: _EncodingOption = "raw",
    connect: Annotated[
        list[str] | None, typer.Option(help="Endpoint to connect to, default tcp/127.0.0.1:7447. Repeatable.")
    ] = None,
    listen: Annotated[list[str] | None, typer.Option(help="Endpoint to listen on, default none. Repeatable.")] = None,
    mode: Annotated[_Mode | None, typer.Option(help="Role in the Zenoh network, default peer.")] = None,
    link_file: Annotated[
        Path | None,
        typer.Option(
            "--link",
            metavar="FILE",
            help="How to connect (TOML with a table \\[link]): endpoints, password, certificates. --mode replaces its "
            "mode, --connect and --listen replace its endpoints.",
        ),
    ] = None,
    start: Annotated[
        str | None, typer.Option(help="Time of the first sample, ISO 8601 (UTC if no zone); now if left out.")
    ] = None,
    run: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Run number; changes with every start if left out.")
    ] = None,
    wait_for_subscriber_s: Annotated[
        float | None,
        typer.Option(
            "--wait-for-subscriber",
            min=0,
            callback=finite,
            help="Send nothing before someone listens, with --pace max also later; give up after SECONDS.",
        ),
    ] = None,
    linger_s: Annotated[
        float,
        typer.Option(
            "--linger", min=0, callback=finite, help="Stay this many seconds after the end, for slow subscribers."
        ),
    ] = 2.0,
) -> None:
    """Publish the stream of a simulated machine.

    [bold]Examples[/bold]

    A healthy machine in real time, to the monitor on this computer:
    [cyan]rotorsim publish[/cyan]

    A bearing that loses stiffness after 140 s, twenty times faster:
    [cyan]rotorsim publish k_by --pace 20[/cyan]

    To a router that wants a password or a certificate (docs/zenoh-security.md):
    [cyan]rotorsim publish --link publisher.toml[/cyan]

    Two faults of your own in ten minutes, as fast as the monitor can take them:
    [cyan]rotorsim publish --duration 600 --fault e=0.3@200 --fault c_by=-0.3@400 --pace max[/cyan]
    """
    loaded, rig = _load(scenario, machine, seed, duration_s, fault, block_s)
    factor = _pace(pace)
    start_ns = None if start is None else _time_ns(start)
    from simulator.publisher import PublishSettings  # noqa: PLC0415  # keeps --help quick
    from simulator.publisher import publish as publish_stream  # noqa: PLC0415

    link = _link(link_file, mode, listen, connect)
    settings = PublishSettings(link, factor, encoding, wait_for_subscriber_s, linger_s)
    number = int(time.time()) % 65535 + 1 if run is None else run
    with _stop_on_signal() as stop, _progress(loaded.duration_s, rig.keys.stream) as on_block:
        stream = _stream(loaded, rig, block_s, start_ns, number)
        summary = publish_stream(rig, stream, settings, stop=stop, on_block=on_block)
    typer.echo(f"published {summary.blocks} blocks, {summary.data_s:.1f} s of data, on {rig.keys.stream}")


@app.command()
def record(
    scenario: _ScenarioArgument,
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="Recording to write (.mcap).")],
    machine: _MachineOption = None,
    seed: _SeedOption = None,
    duration_s: _DurationOption = None,
    fault: _FaultOption = None,
    block_s: _BlockOption = 0.1,
    encoding: _EncodingOption = "raw",
    start: Annotated[str, typer.Option(help="Time of the first sample, ISO 8601 (UTC if no zone).")] = (
        "2026-01-01T00:00:00Z"
    ),
    run: Annotated[int, typer.Option(min=0, max=65535, help="Run number.")] = 1,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing recording.")] = False,
) -> None:
    """Write the stream of a simulated machine into a recording, at full speed.

    [bold]Examples[/bold]

    Five minutes with a damping fault, ready to be replayed or trained on:
    [cyan]rotorsim record c_by c_by.mcap[/cyan]

    Another realisation of the healthy machine, ten minutes long:
    [cyan]rotorsim record healthy healthy-7.mcap --seed 7 --duration 600[/cyan]
    """
    loaded, rig = _load(scenario, machine, seed, duration_s, fault, block_s)
    start_ns = _time_ns(start)
    if not output.parent.is_dir():
        raise MachineFileError(f"{output}: the folder {output.parent} does not exist")
    if output.is_dir():
        raise MachineFileError(f"{output}: is a folder, expected the name of a recording (.mcap)")
    for existing in (output, output.with_name(output.name + ".part")):
        if existing.exists() and not overwrite:
            raise MachineFileError(f"{existing}: already exists; --overwrite replaces it")
    from simulator.stream import record as record_stream  # noqa: PLC0415  # keeps --help quick

    with _stop_on_signal() as stop, _progress(loaded.duration_s, "") as on_block:
        stream = _stream(loaded, rig, block_s, start_ns, run)
        summary = record_stream(
            rig, stream, output, encoding=encoding, overwrite=overwrite, stop=stop, on_block=on_block
        )
    typer.echo(f"recorded {summary.blocks} blocks, {summary.data_s:.1f} s of data, in {output}")


def _load(
    name: str, machine: str | None, seed: int | None, duration_s: float | None, faults: list[str] | None, block_s: float
) -> tuple[Scenario, Machine]:
    scenario, rig = load_scenario(name)
    if machine is not None:
        rig = load_machine(machine)
        scenario.check_channels(rig)
    events = [parse_fault(text) for text in faults or ()]
    scenario = scenario.overridden(seed=seed, duration_s=duration_s, faults=events)
    low, high = rig.ingest.block_from_s, rig.ingest.block_to_s
    if not max(low, 1 / rig.rate_hz) <= block_s <= high:
        raise MachineFileError(f"--block-s is {block_s:g}, expected {low:g} to {high:g} for machine {rig.name}")
    return scenario, rig


def _stream(scenario: Scenario, machine: Machine, block_s: float, start_ns: int | None, run: int) -> "BlockStream":
    """Blocks of the scenario; without a start time, they start at the moment when the first one is asked for."""
    from simulator.stream import blocks  # noqa: PLC0415  # imports scipy

    yield from blocks(scenario, machine, block_s, time.time_ns() if start_ns is None else start_ns, run)


def _link(file: Path | None, mode: _Mode | None, listen: list[str] | None, connect: list[str] | None) -> LinkSettings:
    """Settings of the file, with those of the command line in their place; a local monitor if there are neither."""
    update: dict[str, object] = {} if mode is None else {"mode": mode}
    if listen or connect:
        update |= {"listen": tuple(listen or ()), "connect": tuple(connect or ())}
    link = LinkSettings(connect=("tcp/127.0.0.1:7447",)) if file is None else load_link(file)
    return link.model_copy(update=update)


def _pace(text: str) -> float | None:
    if text == "max":
        return None
    pace = 0.0
    with suppress(ValueError):
        pace = float(text)
    if not 0 < pace <= 1e4:
        raise MachineFileError(f"--pace is {text!r}, expected a number above 0 (1 is real time) or max")
    return pace


def _time_ns(text: str) -> int:
    try:
        start_ns = nanoseconds(datetime.fromisoformat(text))
    except ValueError as error:
        raise MachineFileError(f"--start is {text!r}, expected ISO 8601 such as 2026-01-01T00:00:00Z") from error
    if not 0 <= start_ns < nanoseconds(datetime(2262, 1, 1, tzinfo=UTC)):
        raise MachineFileError(f"--start is {text!r}, expected a time from 1970 to 2261")
    return start_ns


@contextmanager
def _stop_on_signal() -> Iterator[threading.Event]:
    """Give an event that SIGINT and SIGTERM set, so that a run ends between two blocks with everything closed."""
    stop = threading.Event()
    asked: queue.SimpleQueue[bool] = queue.SimpleQueue()

    def listen() -> None:
        if asked.get():
            stop.set()

    # The handler itself must not set the event: it may interrupt this thread while that holds the event's lock.
    listener = threading.Thread(target=listen, name="signals", daemon=True)
    listener.start()
    before = {number: signal.signal(number, lambda *_: asked.put(True)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        asked.put(False)
        listener.join()


@contextmanager
def _progress(duration_s: float, key: str) -> Iterator[Callable[["RunSummary"], None]]:
    """Data time, pace and current truth, as a bar on a terminal and as lines elsewhere; and whether anybody listens."""
    console = Console(stderr=True)
    columns = (
        BarColumn(bar_width=20),
        TextColumn("{task.completed:.1f} / {task.total:.1f} s"),
        TextColumn("{task.fields[pace]:.1f} x real time"),
        TextColumn("{task.fields[truth]}"),
    )
    heard, next_s = True, _FIRST_LINE_S
    with Progress(*columns, console=console, disable=not console.is_terminal, refresh_per_second=5) as progress:
        task = progress.add_task("", total=duration_s, pace=0.0, truth="")

        def say(text: str) -> None:
            if progress.disable:
                typer.echo(text, err=True)
            else:
                console.print(text, style="yellow", markup=False, highlight=False)

        def on_block(summary: "RunSummary") -> None:
            nonlocal heard, next_s
            truth = "" if summary.truth is None else summary.truth.text
            progress.update(task, completed=summary.data_s, pace=summary.pace, truth=escape(truth))
            if summary.heard is not None and summary.heard != heard:
                heard = summary.heard
                say(
                    f"{key} now has a subscriber"
                    if heard
                    else f"{key} has no subscriber: is a monitor running (rotorwatch run), and is it at the address "
                    "given by --connect?"
                )
            if progress.disable and summary.elapsed_s >= next_s:
                next_s = summary.elapsed_s + _LINE_S
                done = f"{summary.data_s:.1f} of {duration_s:.1f} s of data"
                say(f"{done}, {summary.pace:.1f} x real time, {truth}")

        yield on_block


if __name__ == "__main__":
    app()
