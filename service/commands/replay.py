"""``rotorwatch replay``: evaluates recordings offline, or publishes them on the network unchanged."""

import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from models.errors import MachineFileError, RecordingError, RotorwatchError
from service.commands.running import ENDPOINT, FromOption, ToOption, finite, prepare_numerics

if TYPE_CHECKING:  # these import pydantic, numpy and pyarrow, which would delay --help
    from models.signals.keys import MachineKeys
    from models.signals.link import LinkSettings
    from rotorwatch.records.replays import OfflineSummary
    from service.recordings.replay.player import Control
    from service.recordings.replay.source import RecordingSource
    from service.runtime.archive import MachineTask
    from service.stream.replay_link import NetworkPlan

commands = typer.Typer()
_SLOWEST, _FASTEST = 0.1, 1000.0

NamespaceOption = Annotated[
    str | None,
    typer.Option("--namespace", metavar="PREFIX", help="Receive and publish only below this prefix, that of a replay."),
]


def in_namespace(link: "LinkSettings", namespace: str | None) -> "LinkSettings":
    """Link settings with the namespace of the command line, if there is one.

    Raises
    ------
    MachineFileError
        If the namespace is not a valid prefix of a key.
    """
    if namespace is None:
        return link
    _check_prefix("--namespace", namespace)
    return link.model_copy(update={"namespace": namespace})


@commands.command()
def replay(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings (.mcap), in any order.")],
    offline: Annotated[
        bool, typer.Option("--offline", help="Evaluate at full speed, without a network; writes JSON lines.")
    ] = False,
    machine: Annotated[
        str | None,
        typer.Option(
            metavar="FILE[@BUNDLE]",
            help="Offline: evaluate with this machine file, and after @ its bundle (trained or commissioned). If left "
            "out, the shipped machine with the recorded site and name, with its networks.",
        ),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="FIELD=VALUE",
            help="Offline: a line that overrides the machine file, such as alarms.on_delay_s=60. Repeatable.",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Offline: settings (TOML) that name machine files and bundles.")
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Offline: every recorded machine, each a task on this Ray cluster (auto: that of this "
            "computer); --out is then a folder, with one file for each.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Offline: write the lines here, not to the terminal.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Offline: replace the file of --out.")] = False,
    key: Annotated[
        str | None, typer.Option(metavar="SITE/MACHINE", help="Only this machine, if the recordings contain several.")
    ] = None,
    from_: FromOption = None,
    to: ToOption = None,
    prefix: Annotated[
        str | None,
        typer.Option(
            "--prefix",
            metavar="PREFIX",
            help='Prefix of every key; replay/<name of the first file> if left out. "" is the original keys, '
            "which is refused while a publisher or monitor of the machine is alive.",
        ),
    ] = None,
    pace: Annotated[
        str, typer.Option(help="Seconds of data per second, 0.1 to 1000, or max: as fast as accepted.")
    ] = "1",
    loop: Annotated[
        str, typer.Option(metavar="N", help="Passes, or forever; each has its own prefix: PREFIX/1, ...")
    ] = "1",
    everything: Annotated[
        bool, typer.Option("--all", help="Every recorded key, not only stream, descriptor and truth.")
    ] = False,
    connect: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help=f"Zenoh endpoint; {ENDPOINT} if left out. Repeatable.")
    ] = None,
    listen: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help="Listen here instead. Repeatable.")
    ] = None,
    wait_s: Annotated[
        float,
        typer.Option(
            "--wait-for-subscriber",
            metavar="S",
            min=0,
            callback=finite,
            help="Wait at most this long before the first block.",
        ),
    ] = 0.0,
    progress: Annotated[
        Literal["auto", "json", "none"],
        typer.Option(help="A bar if there is a terminal; or JSON lines on standard output; or nothing."),
    ] = "auto",
    control: Annotated[bool, typer.Option("--control", hidden=True, help="Take commands from standard input.")] = False,
    nice: Annotated[int, typer.Option(min=0, max=19, hidden=True, help="Run at lower priority.")] = 0,
) -> None:
    """Replay recordings: offline through the monitor, or onto the network byte for byte.

    On the network a replay stays apart from live data: its keys begin with a prefix, and a monitor receives them only
    with that prefix as its namespace. In a terminal the space bar pauses and the arrow keys go 10 s back and forth. All
    times are those of the data, however fast they were recorded.

    [bold]Examples[/bold]

    Reports of the monitor on a recording:
    [cyan]rotorwatch replay 20260101T000000Z.mcap --offline --out reports.jsonl[/cyan]

    Reports on a whole day, with other limits:
    [cyan]rotorwatch replay day/*.mcap --offline --machine stricter.toml@lab --out stricter.jsonl[/cyan]
    [cyan]rotorwatch replay day/*.mcap --offline --set alarms.parameters.k_by.raise_above=0.2 --out calmer.jsonl[/cyan]

    A whole archive, on all computers of a Ray cluster:
    [cyan]rotorwatch replay archive/*/*/*.mcap --offline --config plant.toml --ray auto --out results[/cyan]

    Ten times faster onto the network, for a monitor beside the live one:
    [cyan]rotorwatch run --namespace replay/monday --listen tcp/127.0.0.1:7450 --http-port 8081[/cyan]
    [cyan]rotorwatch replay monday.mcap --pace 10 --connect tcp/127.0.0.1:7450[/cyan]
    """
    if nice:
        os.nice(nice)
    prepare_numerics()
    from service.recordings.replay.console import orders, show  # noqa: PLC0415  # keeps --help quick
    from service.recordings.replay.player import Control  # noqa: PLC0415
    from service.recordings.replay.source import RecordingSource  # noqa: PLC0415

    try:
        source = RecordingSource(files)
    except RecordingError as error:
        raise MachineFileError(str(error)) from error  # a file that cannot be used is exit code 2
    machines = source.machines if key is None else (source.machine(key),)
    from_ns, to_ns = source.between(from_, to, *machines)
    _check_options(offline, {"--machine": machine, "--config": config, "--set": set_, "--ray": ray, "--out": out,
                             "--overwrite": overwrite},
                   {"--prefix": prefix, "--connect": connect, "--listen": listen, "--all": everything,
                    "--pace": pace != "1", "--loop": loop != "1", "--wait-for-subscriber": wait_s})  # fmt: skip
    wishes = Control()
    with _stoppable(wishes), orders(wishes, lines=control, keyboard=not offline and progress == "auto"):
        if offline:
            from service.runtime.archive import MachineTask  # noqa: PLC0415

            wanted = _machines_of(config, machine)
            for change in set_ or ():
                if "=" not in change:
                    raise MachineFileError(f"--set {change!r}: expected FIELD=VALUE, as alarms.on_delay_s=60")
            changes = "\n".join(set_ or ())
            chosen = (source.machine(key),) if ray is None else machines
            tasks = []
            for one in chosen:
                recorded = source.paths_between(from_ns, to_ns, frozenset({one.stream}))
                tasks.append(MachineTask(f"{one.site}/{one.machine}", recorded, wanted(one), changes, from_ns, to_ns))
            if ray is None:
                _evaluate(source, tasks[0], out, overwrite, progress, wishes)
            else:
                _evaluate_all(source, tasks, out, overwrite, ray)
            return
        from service.stream.replay_link import NetworkPlan, replay_to_network  # noqa: PLC0415

        plan = NetworkPlan(
            link=link_of(connect, listen),
            machines=machines,
            everything=everything,
            prefix=_prefix(prefix, files[0]),
            pace=_pace(pace),
            passes=_passes(loop, prefix),
            from_ns=from_ns,
            to_ns=to_ns,
            wait_for_subscriber_s=wait_s,
        )
        _announce(plan)
        with show(progress) as bar:
            count = replay_to_network(source, plan, wishes, bar)
        typer.echo(f"{count} messages replayed", err=True)


def _evaluate(
    source: "RecordingSource",
    task: "MachineTask",
    out: Path | None,
    overwrite: bool,
    progress: Literal["auto", "json", "none"],
    control: "Control",
) -> None:
    from rotorwatch.records.replays import ReplayLine  # noqa: PLC0415
    from service.recordings.replay.console import show  # noqa: PLC0415
    from service.recordings.replay.offline import OfflineReplay, choose_machine  # noqa: PLC0415  # keeps --help quick

    as_json = progress == "json"
    if as_json and out is None:
        raise MachineFileError("--progress json writes to standard output: name a file for the results with --out")
    keys = source.machine(task.title)
    installed = choose_machine(keys, task.machine, task.changes)
    with _lines(out, overwrite) as write:
        run = OfflineReplay(source, keys, installed, write, from_ns=task.from_ns, to_ns=task.to_ns)
        for text in run.descriptor_differences:
            typer.echo(f"the recorded channel descriptor differs from the machine file: {text}", err=True)
        # No progress bar if the lines go to the same terminal.
        quiet = out is None and sys.stdout.isatty() and not as_json
        with show("none" if quiet else progress) as bar:
            summary = run.run(control, bar)
    if as_json:
        typer.echo(ReplayLine(kind="summary", summary=summary).model_dump_json())
    else:
        for line in summary_lines(summary):
            typer.echo(line, err=True)
    if summary.stopped:
        if out is not None:
            typer.echo(f"{out} holds the lines up to that point", err=True)
        raise typer.Exit(130)
    if summary.blocks == 0:
        raise RotorwatchError(f"no block was accepted: {summary.last_refusal or 'there was none'}")


def _evaluate_all(
    source: "RecordingSource", tasks: "Sequence[MachineTask]", folder: Path | None, overwrite: bool, ray: str
) -> None:
    """Evaluate every machine on a cluster, and print each result as soon as it is available."""
    from service.runtime.archive import on_cluster  # noqa: PLC0415  # keeps --help quick

    begin_s, data_s = time.monotonic(), 0.0
    if folder is None:
        raise MachineFileError("--ray evaluates every recorded machine: name a folder for the results with --out")
    for one in tasks:
        if (file := _file_of(folder, one.title)).exists() and not overwrite:
            raise MachineFileError(f"{file}: already exists; --overwrite replaces it")
    typer.echo(f"{len(tasks)} machines in {len(source.paths)} recordings ...", err=True)
    for done, (summary, text) in enumerate(on_cluster(ray, tasks), start=1):
        file, data_s = _file_of(folder, f"{summary.site}/{summary.machine}"), data_s + summary.data_s
        with _report_write_errors(file):
            folder.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8", newline="\n")
        raised = f", raised at the end: {', '.join(summary.raised)}" if summary.raised else ""
        typer.echo(
            f"{done:4d} of {len(tasks)}  {summary.site}/{summary.machine}: {summary.data_s:.0f} s of data, "
            f"{summary.windows} windows, {summary.alarms} alarm events{raised}",
            err=True,
        )
    took_s = time.monotonic() - begin_s
    typer.echo(f"{data_s:.0f} s of data in {took_s:.1f} s: {data_s / took_s:.0f} times real time", err=True)


def _file_of(folder: Path, title: str) -> Path:
    return folder / f"{title.replace('/', '.')}.jsonl"


def _machines_of(config: Path | None, machine: str | None) -> "Callable[[MachineKeys], str | None]":
    """Function from a machine's keys to the machine file and bundle to use, in the notation of `choose_machine`."""
    if config is None:
        return lambda _: machine
    if machine is not None:
        raise MachineFileError("--machine and --config both name machine files, expected one of them")
    from service.settings.service import load_settings  # noqa: PLC0415  # keeps --help quick

    entries = {one.load().title: one for one in load_settings(config).machines}

    def named(keys: "MachineKeys") -> str | None:
        if (one := entries.get(f"{keys.site}/{keys.machine}")) is None:
            raise MachineFileError(f"{config}: machines: none is {keys.site}/{keys.machine}, which was recorded")
        return one.file if one.bundle is None else f"{one.file}@{one.bundle}"

    return named


def summary_lines(summary: "OfflineSummary") -> Iterator[str]:
    """Describe the result of an offline replay in lines of text."""
    refused = ", ".join(f"{count} {reason}" for reason, count in summary.refused_blocks.items())
    raised = ", ".join(summary.raised) or "none"
    latest = f"; latest reason: {summary.last_refusal}" if refused else ""
    yield f"{summary.site}/{summary.machine}, machine file {summary.machine_hash}, bundle {summary.bundle or 'none'}"
    yield f"{summary.windows} windows, {summary.alarms} alarm events, raised at the end: {raised}"
    yield f"{summary.data_s:.1f} s of data in {summary.elapsed_s:.1f} s: {summary.times_real_time:.0f} times real time"
    yield f"{summary.blocks} blocks accepted, refused: {refused or 'none'}{latest}"
    if summary.skipped_windows:
        yield f"{summary.skipped_windows} windows not evaluated, as in the monitor, which could not keep up"
    if summary.gaps:
        yield f"gaps: {summary.gaps}, {summary.missing_s:.1f} s missing"
    if summary.first_windows:
        yield summary.first_windows
    if summary.stopped:
        yield "stopped before the end"
    yield f"SHA-256 of the lines {summary.sha256}"


@contextmanager
def _lines(out: Path | None, overwrite: bool) -> "Iterator[Callable[[str], object]]":
    if out is None:
        try:
            yield lambda line: sys.stdout.write(line + "\n")
            sys.stdout.flush()
        except BrokenPipeError:  # the reader has closed the pipe
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        return
    if out.exists() and not overwrite:
        raise MachineFileError(f"{out}: already exists; --overwrite replaces it")
    with _report_write_errors(out):
        file = out.open("w", encoding="utf-8", newline="\n")

    def write(line: str) -> None:
        with _report_write_errors(out, half=True):
            file.write(line + "\n")

    try:
        yield write
    finally:
        with _report_write_errors(out, half=True):
            file.close()


@contextmanager
def _report_write_errors(out: Path, *, half: bool = False) -> Iterator[None]:
    """Report a system error as one of writing `out`; if it came halfway (`half`), remove the incomplete file."""
    try:
        yield
    except OSError as error:
        if half and out.is_file():
            out.unlink()
        raise MachineFileError(f"{out}: cannot be written ({error.strerror or error})") from error


@contextmanager
def _stoppable(control: "Control") -> Iterator[None]:
    """Stop the replay cleanly on SIGINT and SIGTERM."""
    from service.terminal.stopping import stop_request  # noqa: PLC0415  # keeps --help quick

    def watch() -> None:
        stop.wait()
        control.stop()

    with stop_request() as stop:
        thread = threading.Thread(target=watch, name="signals", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.ask()  # ends the thread; the replay is over
            thread.join()


def _check_options(offline: bool, only_offline: dict[str, object], only_network: dict[str, object]) -> None:
    wrong, instead = (only_network, "without") if offline else (only_offline, "with")
    for name, value in wrong.items():
        if value:
            raise MachineFileError(f"{name} makes sense only {instead} --offline")


def _pace(text: str) -> float | None:
    if text == "max":
        return None
    try:
        pace = float(text)
    except ValueError:
        pace = 0.0
    if not _SLOWEST <= pace <= _FASTEST:
        raise MachineFileError(f"--pace is {text!r}, expected {_SLOWEST:g} to {_FASTEST:g}, or max")
    return pace


def _passes(text: str, prefix: str | None) -> int | None:
    passes = None if text == "forever" else int(text) if text.isascii() and text.isdigit() else 0
    if passes == 0:
        raise MachineFileError(f"--loop is {text!r}, expected a number from 1, or forever")
    if passes != 1 and prefix == "":
        raise MachineFileError("--loop needs a prefix: on the original keys only one pass is possible")
    return passes


def _prefix(prefix: str | None, first: Path) -> str:
    named = f"replay/{re.sub('[^A-Za-z0-9_-]', '-', first.name.partition('.')[0])}" if prefix is None else prefix
    _check_prefix("--prefix", named)
    return named


def _check_prefix(option: str, prefix: str) -> None:
    from models.signals.link import NAMESPACE_PATTERN  # noqa: PLC0415  # keeps --help quick

    if not re.fullmatch(NAMESPACE_PATTERN, prefix):
        raise MachineFileError(
            f"{option} is {prefix!r}, expected letters, digits, '_', '-' and '.', in parts separated by '/'"
        )


def link_of(
    connect: list[str] | None,
    listen: list[str] | None,
    link: Path | None = None,
    settings: "LinkSettings | None" = None,
) -> "LinkSettings":
    """Link settings of a file, or else `settings`; endpoints on the command line replace all of them and the role."""
    from models.mistakes import checked  # noqa: PLC0415  # keeps --help quick
    from models.signals.link import LinkSettings, load_link  # noqa: PLC0415

    # A router forwards between clients, but not between peers, which it assumes to be connected to each other.
    ends = {"mode": "peer" if listen else "client", "listen": tuple(listen or ()), "connect": tuple(connect or ())}
    base = settings if link is None else load_link(link)
    if base is not None:
        return base.model_copy(update=ends if listen or connect else {})
    return checked(LinkSettings, ends if listen or connect else ends | {"connect": (ENDPOINT,)}, "command line")


def _announce(plan: "NetworkPlan") -> None:
    names = ", ".join(f"{keys.site}/{keys.machine}" for keys in plan.machines)
    if plan.passes != 1:
        where = f"each pass under a prefix of its own: {plan.prefix_of(1)}, {plan.prefix_of(2)}, ..."
    else:
        where = f"under {plan.prefix}" if plan.prefix else "on the original keys"
    typer.echo(f"replaying {names} {where}", err=True)
    if plan.prefix:
        typer.echo(f"a monitor receives it with: rotorwatch run --namespace {plan.prefix_of(1)}", err=True)
