"""``rotorwatch init`` and ``rotorwatch doctor``: set up a machine, and check what arrives from it."""

import json
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from models.errors import MachineFileError
from service.commands.replay import link_of
from service.commands.running import ENDPOINT, ConnectOption, LinkOption, ListenOption, finite, prepare_numerics

if TYPE_CHECKING:  # these import numpy, which would delay --help
    from models.machine import MachineFile

commands = typer.Typer()
_SENSOR = ("name", "quantity", "unit", "location", "direction")
_ANGLE = "angle_deg"
_SCHEDULE = ("on_s", "every_s")
_EXAMPLE = "DE-H acceleration g DE horizontal"


@commands.command()
def init(
    folder: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for the two files; created if it does not exist.")
    ] = Path(),
    site: Annotated[str | None, typer.Option(help="Site of the machine: a group of machines.")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the machine.")] = None,
    rate_hz: Annotated[float | None, typer.Option(metavar="HZ", help="Samples per second and channel.")] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="'NAME QUANTITY UNIT LOCATION DIRECTION [ANGLE]'",
            help=f"A channel of the stream, in stream order, such as '{_EXAMPLE}'; for a probe at an angle "
            "add it, in degrees from +y towards +z: 'VE-1X displacement um bearing X 45'. Repeatable.",
        ),
    ] = None,
    speed_rpm: Annotated[
        float | None, typer.Option(metavar="RPM", help="Nominal speed, if it is known: for 1x and 2x.")
    ] = None,
    snapshots: Annotated[
        str | None,
        typer.Option(
            metavar="'SECONDS EVERY'",
            help="If samples come in snapshots, their length and period in seconds, such as '0.1 10'.",
        ),
    ] = None,
    zones: Annotated[
        list[str] | None, typer.Option(help="Zones of a standard, such as 'ISO 20816-3 group 2 rigid'. Repeatable.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Write a machine file with only sensors, and monitor settings for it; asks for names, rate and sensors.

    The monitor watches vibration levels at once, and records. Diagnosis is added by [cyan]rotortrain commission[/cyan].

    [bold]Example[/bold]

    [cyan]rotorwatch init --site plant --name fan --rate-hz 25600 --sensor 'DE-H acceleration g DE horizontal'[/cyan]
    [cyan]rotorwatch doctor --machine fan.toml[/cyan]
    [cyan]rotorwatch run --config rotorwatch.toml[/cyan]
    """
    site = site or _asked("--site", "Site (a group of machines)", _name)
    name = name or _asked("--name", "Name of the machine", _name)
    rate = float(_asked("--rate-hz", "Samples per second and channel", float)) if rate_hz is None else rate_hz
    lines = sensor or _asked_sensors()
    from models.machine import MachineFile  # noqa: PLC0415  # keeps --help quick
    from models.mistakes import checked  # noqa: PLC0415

    fields: dict[str, Any] = {
        "site": site,
        "name": name,
        "rate_hz": rate,
        "operation": None if speed_rpm is None else {"speed_rpm": speed_rpm},
        "schedule": None if snapshots is None else _schedule(snapshots),
        "levels": {"zones": zones or []},
        "sensors": [_sensor(line) for line in lines],
    }
    machine_path, settings_path = folder / f"{name}.toml", folder / "rotorwatch.toml"
    if machine_path == settings_path:
        raise MachineFileError(f"--name is {name!r}: {settings_path} is the name of the settings, expected another one")
    machine = checked(MachineFile, {key: value for key, value in fields.items() if value is not None}, machine_path)
    for path in (machine_path, settings_path):
        if path.exists() and not overwrite:
            raise MachineFileError(f"{path}: already exists; --overwrite replaces it")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        machine_path.write_text(_machine_text(machine, speed_rpm), encoding="utf-8")
        settings_path.write_text(
            f'[link]\nlisten = ["{ENDPOINT}"]\n\n[recording]\ndirectory = "recordings"\n\n'
            f'[history]\nurl = "sqlite:///history.sqlite"\n\n[[machines]]\nfile = "{machine_path.name}"\n',
            encoding="utf-8",
        )
    except OSError as error:
        raise MachineFileError(f"--folder {folder}: cannot be written ({error.strerror or error})") from error
    channels = f"{len(machine.sensors)} channels at {machine.rate_hz:g} Hz"
    typer.echo(f"{machine_path}: {machine.title}, {channels}")
    typer.echo(f"{settings_path}: listens on {ENDPOINT}, records into {folder / 'recordings'}")
    typer.echo(f"samples are expected under {machine.keys.stream}; the wire format is in docs/wire.md")
    typer.echo(f"see what arrives: rotorwatch doctor --machine {quote(str(machine_path))}")
    typer.echo(f"monitor it:       rotorwatch run --config {quote(str(settings_path))}")


def _name(text: str) -> str:
    """Check a name at once, before anything else is asked for."""
    from models.signals.keys import NAME_PATTERN  # noqa: PLC0415  # keeps --help quick

    if not re.fullmatch(NAME_PATTERN, text):
        raise typer.BadParameter(f"{text!r} cannot be part of a key: use 1 to 64 letters, digits, '_' or '-'")
    return text


def _asked(option: str, text: str, kind: Callable[[str], object] = str, *, empty: bool = False) -> str:
    if not sys.stdin.isatty():
        raise MachineFileError(f"{option} is missing, and there is no terminal to ask for it")
    return str(typer.prompt(text, type=kind, default="" if empty else None, show_default=False))


def _asked_sensors() -> list[str]:
    """Ask for channels, one per line, until an empty line; after an error, ask again."""
    from models.mistakes import checked  # noqa: PLC0415  # keeps --help quick
    from models.signals.channels import Channel  # noqa: PLC0415

    typer.echo(f"Channels of the stream, in stream order: {' '.join(_SENSOR)} [{_ANGLE}]; such as: {_EXAMPLE}")
    found: list[str] = []
    while True:
        more = " (leave empty to finish)" if found else ""
        line = _asked("--sensor", f"Channel {len(found) + 1}{more}", empty=bool(found))
        if not line.strip():
            return found
        try:
            checked(Channel, _sensor(line), "--sensor")
            found.append(line)
        except MachineFileError as error:
            typer.echo(str(error))


def _sensor(line: str) -> dict[str, str]:
    words = line.split()
    angle = words[len(_SENSOR) :]
    if len(words) < len(_SENSOR) or len(angle) > 1 or (angle and not re.fullmatch(r"[-+.\d]+", angle[0])):
        raise MachineFileError(
            f"--sensor {line!r} has {len(words)} words, expected {len(_SENSOR)}: {' '.join(_SENSOR)}, "
            f"such as '{_EXAMPLE}', and besides at most a number, the {_ANGLE}"
        )
    return dict(zip((*_SENSOR, _ANGLE), words, strict=False))


def _schedule(given: str) -> dict[str, str]:
    words = given.split()
    if len(words) != len(_SCHEDULE):
        raise MachineFileError(f"--snapshots {given!r} has {len(words)} words, expected two, such as '0.1 10'")
    return dict(zip(_SCHEDULE, words, strict=True))


def _machine_text(machine: "MachineFile", speed_rpm: float | None) -> str:
    """Text of a machine file with the known fields, and a hint at the limits of levels."""
    lines = [f"site = {json.dumps(machine.site)}", f"name = {json.dumps(machine.name)}"]
    lines += [f"rate_hz = {machine.rate_hz}", f'dtype = "{machine.dtype}"']
    if speed_rpm is not None:
        lines += ["", "[operation]", f"speed_rpm = {float(speed_rpm)}"]
    if machine.schedule is not None:
        lines += ["", "[schedule]", *(f"{key} = {getattr(machine.schedule, key)}" for key in _SCHEDULE)]
    zones = json.dumps(machine.levels.zones)
    lines += ["", "# Limits of vibration levels: docs/levels.md", "[levels]", f"zones = {zones}"]
    for channel in machine.sensors:
        told = channel.model_dump(mode="json")
        lines += ["", "[[sensors]]", *(f"{key} = {json.dumps(told[key])}" for key in (*_SENSOR, _ANGLE) if key in told)]
    return "\n".join(lines) + "\n"


@commands.command()
def doctor(
    machine: Annotated[str, typer.Option(metavar="FILE", help="Machine file: shipped name or path.")],
    connect: ConnectOption = None,
    listen: ListenOption = None,
    link: LinkOption = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=1,
            max=86400,
            callback=finite,
            help="How long to listen; 10 s if left out, or long enough for a snapshot.",
        ),
    ] = None,
) -> None:
    """Listen to a machine's stream for a while, and report rate, units, levels and keyphasor, and what is missing.

    It listens as a monitor would, on tcp/127.0.0.1:7447. If a monitor is already running, connect to it.

    [bold]Examples[/bold]

    Before the monitor is started; the sensors connect to this computer:
    [cyan]rotorwatch doctor --machine fan.toml[/cyan]

    Beside a monitor:
    [cyan]rotorwatch doctor --machine fan.toml --connect tcp/127.0.0.1:7447[/cyan]
    """
    prepare_numerics()
    from models.machine import load_machine_file  # noqa: PLC0415  # keeps --help quick
    from models.signals.recording import RecordedMessage  # noqa: PLC0415
    from service.analysis.arrival import examined  # noqa: PLC0415
    from service.stream.transport import Link, LinkError, streams_heard, tap  # noqa: PLC0415

    known = load_machine_file(machine)
    listening = listen or ([] if connect or link else [ENDPOINT])
    try:
        session = Link(link_of(connect, listening, link))
    except LinkError as error:
        beside = f" If it is a monitor, listen beside it: --connect {listening[0]}" if listening else ""
        raise LinkError(f"{error}{beside}") from error
    heard: list[RecordedMessage] = []
    try:
        close = tap(session, known.keys, heard.append)
        schedule = known.schedule
        seconds = seconds or (10.0 if schedule is None else 10.0 + schedule.every_s + schedule.on_s)
        typer.echo(f"listening for {seconds:g} s to {known.keys.root} ...")
        sys.stdout.flush()
        time.sleep(seconds)
        close()
        # The commonest cause of silence is another site or name. All streams may be many: they are heard for 2 s.
        silent = all(one.key != known.keys.stream for one in heard)
        others = streams_heard(session, 2.0) if silent else ()
    finally:
        session.close()
    lines, troubles = examined(known, heard, others)
    for line in lines:
        typer.echo(line)
    for trouble in troubles:
        typer.echo(f"  - {trouble}")
    if troubles:
        raise typer.Exit(1)
