"""``rotorwatch record`` and ``rotorwatch recover``: write messages to files, and recover files after a crash."""

import json
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from models.errors import MachineFileError, RecordingError
from service.commands.replay import link_of
from service.commands.running import ConnectOption, LinkOption, ListenOption, exit_code, prepare_numerics

if TYPE_CHECKING:  # these import numpy, which would delay --help
    from models.machine import MachineFile
    from models.signals.link import LinkSettings
    from service.recordings.recorder import MachineRecorder
    from service.settings.service import HistorySettings, RecordingSettings

_STATUS_S = 0.5

commands = typer.Typer()


@commands.command()
def record(
    machine: Annotated[
        list[str] | None, typer.Option(metavar="FILE", help="Machine to record: shipped name or path. Repeatable.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the files, which are in DIR/<site>/<machine>/.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Settings (TOML) of the monitor: machines, \\[recording], \\[history]."),
    ] = None,
    connect: ConnectOption = None,
    listen: ListenOption = None,
    link: LinkOption = None,
    rotate_s: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Longest time in one file; 300 if left out.")
    ] = None,
    rotate_mb: Annotated[
        float | None, typer.Option(metavar="MB", help="Size at which a file is closed; 256 if left out.")
    ] = None,
    keep_gb: Annotated[
        float | None, typer.Option(metavar="GB", help="Most that is kept per machine; 20 if left out.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="The recorders' status as JSON lines: how many messages are safe on disk.")
    ] = False,
) -> None:
    """Record everything that is published under machines' keys until Ctrl-C.

    A monitor records by itself if its settings say so; this is for recording without one. Older files are deleted;
    those around an alarm in the history of a monitor on this computer are kept longer.

    [bold]Examples[/bold]

    Beside a monitor on this computer, with its settings:
    [cyan]rotorwatch record --config plant.toml --out /data/recordings[/cyan]

    Two machines, through a router:
    [cyan]rotorwatch record --machine pump-7.toml --machine fan-2.toml --out /data --connect tcp/10.0.0.9:7447[/cyan]
    """
    with ExitStack() as undo:
        prepare_numerics()
        directory = None if out is None else str(out)
        changes = {"directory": directory, "rotate_s": rotate_s, "rotate_mb": rotate_mb, "keep_gb": keep_gb}
        machines, settings, history, beside = _settings(config, machine, changes)
        from service.history.shared import committed_events  # noqa: PLC0415  # keeps --help quick
        from service.recordings.recorder import MachineRecorder  # noqa: PLC0415
        from service.settings.service import LogSettings  # noqa: PLC0415
        from service.stream.transport import Link, tap  # noqa: PLC0415
        from service.terminal.logs import configure_logging  # noqa: PLC0415
        from service.terminal.stopping import stop_request  # noqa: PLC0415

        configure_logging(LogSettings())
        recorders = [
            MachineRecorder(one, settings, partial(committed_events, history.database, one.site, one.name))
            for one in machines
        ]
        for recorder in recorders:
            recorder.prepare()  # raises at once if the folder cannot be written
        stop = undo.enter_context(stop_request())
        session = Link(link_of(connect, listen, link, beside))
        undo.callback(session.close)
        with ExitStack() as running:
            for recorder in recorders:
                running.callback(recorder.stop)
                recorder.start()
                running.callback(tap(session, recorder.machine.keys, recorder.put))
                if not as_json:
                    typer.echo(f"recording {recorder.machine.keys.root} into {recorder.folder}/; Ctrl-C ends")
            told: dict[Path, str] = {}
            sys.stdout.flush()
            while True:
                if as_json:
                    _tell_changes(recorders, told)
                if stop.wait(_STATUS_S):
                    break
        if as_json:
            _tell_changes(recorders, told)
        elif not _summed_up(recorders):
            raise typer.Exit(1)


@commands.command()
def recover(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Left by a crash, usually NAME.mcap.part.")],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Name of the recovered recording, for one FILE. If left out: NAME.mcap, or NAME.recovered.mcap if the "
            "damaged file has that name.",
        ),
    ] = None,
) -> None:
    """Recover damaged recordings and those whose writer was killed; report what was recovered and what was lost.

    The damaged file stays. A recorder that is started again recovers its own files by itself.

    [bold]Example[/bold]

    [cyan]rotorwatch recover /data/recordings/demo/lab/20261121T142530Z.mcap.part[/cyan]
    """
    if out is not None and len(files) > 1:
        raise MachineFileError(f"--out names one file, and there are {len(files)} to recover")
    code = 0
    for file in files:
        try:
            _recover(file, out)
        except RecordingError as error:
            code = max(code, exit_code(error))
            typer.echo(str(error), err=True)
    if code:
        raise typer.Exit(code)


def _tell_changes(recorders: "list[MachineRecorder]", told: dict[Path, str]) -> None:
    """Write a JSON line for every recorder whose status has changed since its last line."""
    for recorder in recorders:
        line = json.dumps(asdict(recorder.status()))
        if told.get(recorder.folder) != line:
            told[recorder.folder] = line
            typer.echo(line)
    sys.stdout.flush()


def _settings(
    config: Path | None, machines: list[str] | None, changes: Mapping[str, str | float | None]
) -> "tuple[list[MachineFile], RecordingSettings, HistorySettings, LinkSettings | None]":
    """Machines, recording and history settings, and a link to the streams of the monitor with that settings file.

    The command line overrides the settings file.
    """
    from models.machine import load_machine_file  # noqa: PLC0415  # keeps --help quick
    from models.mistakes import checked  # noqa: PLC0415
    from service.settings.service import RecordingSettings, load_settings  # noqa: PLC0415

    settings = load_settings(config)
    if not machines and config is None:
        raise MachineFileError("nothing to record: give --machine FILE, or --config FILE with machines in it")
    fields = settings.recording.model_dump() | {name: one for name, one in changes.items() if one is not None}
    recording = checked(RecordingSettings, fields, "command line")
    if recording.directory is None:
        raise MachineFileError("nowhere to record to: give --out DIR, or directory in [recording] of the settings")
    files = machines or [entry.file for entry in settings.machines]
    loaded = [load_machine_file(file) for file in files]
    roots = [one.keys.root for one in loaded]
    for root in roots:
        if roots.count(root) > 1:
            raise MachineFileError(f"two of the machine files describe {root}")
    # A client of what the monitor connects to, or of the monitor itself; names that it accepts are not the recorder's.
    ends = {"mode": "client", "listen": (), "connect": settings.link.connect or settings.link.listen}
    beside = None if config is None else settings.link.model_copy(update=ends | {"grants": (), "passwords_file": None})
    return loaded, recording, settings.history, beside


def _summed_up(recorders: "list[MachineRecorder]") -> bool:
    """Print what was recorded; return whether nothing was lost."""
    whole = True
    for recorder in recorders:
        status = recorder.status()
        whole = whole and not status.dropped and not status.lost and not status.problem
        typer.echo(
            f"{status.site}/{status.machine}: {status.synced} of {status.received} messages recorded, "
            f"{status.files} files closed; {status.dropped} dropped, {status.lost} lost"
            + (f"; {status.problem}" if status.problem else "")
        )
    return whole


def _recover(file: Path, out: Path | None) -> None:
    from models.signals.recording import inspect_recording, salvage_recording  # noqa: PLC0415  # keeps --help quick
    from service.recordings.catalogue import PART  # noqa: PLC0415
    from service.recordings.leftovers import is_locked, loss_text  # noqa: PLC0415

    partial = file.suffix == PART
    if partial and is_locked(file.parent):
        raise RecordingError(f"{file}: a recorder is running in {file.parent} and recovers what is left there")
    if not partial and inspect_recording(file).complete:
        typer.echo(f"{file}: complete, nothing to recover")
        return
    own_name = file.with_suffix("") if partial else file.with_name(f"{file.name.removesuffix('.mcap')}.recovered.mcap")
    target = out or own_name
    salvage = salvage_recording(file, target)
    typer.echo(f"{file}: {salvage.count} messages recovered into {target}")
    width = max(map(len, salvage.messages), default=0)
    for key, count in sorted(salvage.messages.items()):
        typer.echo(f"  {key:<{width}} {count:>9} messages")
    begin, end = (datetime.fromtimestamp(t * 1e-9, UTC) for t in (salvage.start_ns, salvage.end_ns))
    span_s = (salvage.end_ns - salvage.start_ns) * 1e-9
    typer.echo(f"  from {begin:%Y-%m-%d %H:%M:%S.%f} to {end:%Y-%m-%d %H:%M:%S.%f} UTC ({span_s:.3f} s)")
    typer.echo(f"  {loss_text(salvage)}")
