"""The command ``rotorwatch``: monitoring, router, webhooks, demo and check of settings; see also `service.commands`."""

import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from models.errors import MachineFileError, RotorwatchError
from service.commands import access, history, installation, interchange, plot, record, replay, size, watching
from service.commands.replay import NamespaceOption, in_namespace, link_of
from service.commands.running import (
    ENDPOINT,
    Commands,
    ConnectOption,
    LinkOption,
    ListenOption,
    VersionOption,
    check_address_space,
    finite,
    prepare_numerics,
    raise_file_limit,
)
from service.terminal.memory import keep_loaded

if TYPE_CHECKING:  # these import numpy and scipy, which would delay --help
    from service.settings.service import ServiceSettings

app = typer.Typer(
    name="rotorwatch",
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="Condition monitoring of rotating machines: which parameter changed, by how much, and how sure it is.",
    epilog="Exit codes: 0 success, 1 error at run time, 2 unusable file or argument; of status also 3 no "
    "data, 4 no answer.",
)
webhooks = typer.Typer(name="webhook", no_args_is_help=True, help="Programs that receive alarm events.")


@app.callback()
def _program(_version: VersionOption = False) -> None:
    pass


@app.command()
def run(
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings (TOML); the shipped machine if left out.")
    ] = None,
    machine: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE[@BUNDLE]",
            help="Monitor this machine instead of those in the settings: shipped name or path, and after @ its bundle "
            "(trained or commissioned), if any. Repeatable.",
        ),
    ] = None,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    link: LinkOption = None,
    http_port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port of the HTTP API; 0 takes a free one.")
    ] = None,
    when_full: Annotated[
        Literal["drop", "wait"] | None,
        typer.Option(
            help="When blocks come faster than they can be evaluated: drop and count them (live machines), or make the "
            "sender wait (batch runs)."
        ),
    ] = None,
    namespace: NamespaceOption = None,
) -> None:
    """Monitor machines until Ctrl-C.

    [bold]Examples[/bold]

    The shipped rotor kit; sensors connect to tcp/127.0.0.1:7447, the API is at http://127.0.0.1:8080:
    [cyan]rotorwatch run[/cyan]

    Your own machines:
    [cyan]rotorwatch run --config plant.toml[/cyan]

    A simulation as fast as this computer can, started with [cyan]rotorsim publish k_by --pace max[/cyan] elsewhere:
    [cyan]rotorwatch run --when-full wait[/cyan]
    """
    _prepare()
    from models.mistakes import checked  # noqa: PLC0415  # keeps --help quick
    from service.settings.service import MachineEntry, check_distinct, load_settings  # noqa: PLC0415

    settings = load_settings(config)
    update: dict[str, Any] = {}
    if machine:
        pairs = [text.partition("@") for text in machine]
        named = [{"file": file, "bundle": bundle or None} for file, _, bundle in pairs]
        update["machines"] = tuple(checked(MachineEntry, one, "--machine") for one in named)
    if namespace is not None:
        # Replayed data must not enter the recordings and the history of the live machine.
        update["recording"] = settings.recording.model_copy(update={"directory": None})
        update["history"] = settings.history.model_copy(update={"url": "sqlite:///:memory:"})
    if http_port is not None:
        update["http"] = settings.http.model_copy(update={"port": http_port})
    if when_full is not None:
        update["queue"] = settings.queue.model_copy(update={"when_full": when_full})
    update["link"] = in_namespace(link_of(connect, listen, link, settings.link), namespace)
    settings = settings.model_copy(update=update)
    check_distinct(Path("command line"), settings)
    settings.link.check_reach("command line")
    _serve(settings, config)


@app.command()
def fleet(
    config: Annotated[Path, typer.Option(metavar="FILE", help="Settings (TOML), the same files on every computer.")],
    address: Annotated[
        str,
        typer.Option("--address", metavar="ADDRESS", help="Ray cluster: auto is that of this computer, or HOST:PORT."),
    ] = "auto",
) -> None:
    """Monitor the machines of a fleet on the computers of a Ray cluster, until Ctrl-C.

    Ray places each group of machines on a computer with room, and on another when that is lost; this process serves
    HTTP, the page, metrics and webhooks for all of them. It needs a history in PostgreSQL, Zenoh routers that sensors
    and computers connect to, and an endpoint of its own: see "Fleets" in docs/service.md, also for the health checks
    with which Ray notices sooner that a computer is lost.

    [bold]Example[/bold]

    On the first computer, and with its address on each of the others:
    [cyan]RAY_worker_niceness=0 ray start --head --disable-usage-stats[/cyan]
    [cyan]RAY_worker_niceness=0 ray start --address 10.0.0.5:6379 --disable-usage-stats[/cyan]
    Then on the first one:
    [cyan]rotorwatch fleet --address auto --config fleet.toml[/cyan]
    """
    _prepare()
    from service.settings.service import load_settings  # noqa: PLC0415  # keeps --help quick

    _serve(load_settings(config), config, address)


def _prepare() -> None:
    check_address_space()
    prepare_numerics()
    raise_file_limit()


def _serve(settings: "ServiceSettings", config: Path | None, ray_address: str | None = None) -> None:
    from models.commissioning.commissioned import KnowledgeLevel, knowledge_of  # noqa: PLC0415  # keeps --help quick
    from service.runtime.runtime import running  # noqa: PLC0415  # after the variables for numerics are set
    from service.terminal.logs import configure_logging  # noqa: PLC0415  # keeps --help quick
    from service.terminal.stopping import stop_request  # noqa: PLC0415

    configure_logging(settings.log)
    with stop_request() as stop, running(settings, ray_address) as service:
        keep_loaded()
        for worker in service.machines():
            full = knowledge_of(worker.machine).level is KnowledgeLevel.FULL
            without = "the equations are not evaluated" if full else "vibration levels alone are watched"
            typer.echo(f"machine {worker.machine.title}, bundle {worker.identity['bundle'] or f'none: {without}'}")
        if settings.link.namespace:
            typer.echo(f"Zenoh namespace {settings.link.namespace}: nothing outside it is received")
        for what, ends in (("listening on", settings.link.listen), ("connecting to", settings.link.connect)):
            if ends:
                typer.echo(f"Zenoh {what} {', '.join(ends)}")
        typer.echo(f"HTTP API {service.http_url}")
        if not settings.access.open_on_loopback and not service.store.tokens.all():
            typer.echo(access.creation_hint(config, settings.history))
        sys.stdout.flush()
        stop.wait()


@app.command("check-config")
def check_config(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Settings or machine files (TOML).")],
) -> None:
    """Check settings and machine files; reports what is wrong with which field.

    Machine files, trained networks, certificates, secrets and passwords that a settings file names are checked with it.

    [bold]Example[/bold]

    [cyan]rotorwatch check-config plant.toml pump-7.toml[/cyan]
    """
    faulty = False
    for file in files:
        try:
            typer.echo(f"{file}: ok, {_checked(file)}")
        except RotorwatchError as error:
            faulty = True
            text = str(error)
            typer.echo(text if text.startswith(str(file)) else f"{file}: {text}", err=True)
    if faulty:
        raise typer.Exit(2)


@app.command()
def router(
    listen: ListenOption = None,
    connect: ConnectOption = None,
    link: LinkOption = None,
    without_grants: Annotated[
        bool,
        typer.Option(
            "--without-grants",
            help="Allow everything to anyone who reaches it. Without this it listens off loopback only with grants.",
        ),
    ] = False,
) -> None:
    """Run a Zenoh router until Ctrl-C, for networks in which monitors and sensors cannot reach each other directly.

    Everybody who connects to it must do so as a client: rotorwatch run --connect, rotorsim publish --mode client.

    [bold]Example[/bold]

    [cyan]rotorwatch router --link router.toml[/cyan]

    On a network where everybody may do everything:
    [cyan]rotorwatch router --listen tcp/0.0.0.0:7447 --without-grants[/cyan]
    """
    from models.signals.link import LinkSettings, load_link  # noqa: PLC0415  # keeps --help quick
    from service.stream.transport import route  # noqa: PLC0415
    from service.terminal.stopping import stop_request  # noqa: PLC0415

    settings = LinkSettings(listen=(ENDPOINT,)) if link is None else load_link(link)
    changes: dict[str, Any] = {n: tuple(given) for n, given in (("listen", listen), ("connect", connect)) if given}
    settings = settings.model_copy(update=changes | ({"without_grants": True} if without_grants else {}))
    settings.check_reach("command line" if link is None else str(link))
    with stop_request() as stop, route(settings):
        typer.echo(f"router listening on {', '.join(settings.listen)}")
        sys.stdout.flush()
        stop.wait()


@webhooks.command()
def secret() -> None:
    """Create a secret for signing events; the receiver needs the same one.

    [bold]Example[/bold]

    [cyan](umask 077; rotorwatch webhook secret > pager.secret)[/cyan]
    """
    from service.delivery.webhooks.signature import new_secret  # noqa: PLC0415  # keeps --help quick

    typer.echo(new_secret())


@webhooks.command("test")
def test_webhook(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the webhook in the settings.")],
    config: Annotated[Path, typer.Option(metavar="FILE", help="Settings (TOML) of the monitor.")],
) -> None:
    """Send a test event, which is not an alarm, and report whether the receiver accepts it; exit code 1 if not.

    [bold]Example[/bold]

    [cyan]rotorwatch webhook test pager --config plant.toml[/cyan]
    """
    from service.delivery.webhooks.dispatcher import send_test  # noqa: PLC0415
    from service.settings.service import load_settings  # noqa: PLC0415  # keeps --help quick

    known = load_settings(config).webhooks
    settings = next((webhook for webhook in known if webhook.name == name), None)
    if settings is None:
        there = ", ".join(webhook.name for webhook in known) or "none"
        raise MachineFileError(f"{config}: no webhook {name}; there are: {there}")
    took_s = send_test(settings)
    typer.echo(f"{name}: {settings.target} accepted the test event, in {took_s:.2f} s")


@app.command()
def demo(
    fault: Annotated[
        Literal["k_by", "c_by", "k_bz", "c_bz", "e", "none"],
        typer.Option(help="What breaks first; with none, the machine stays healthy."),
    ] = "k_by",
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random forces and noise.")] = 1,
    pace: Annotated[float, typer.Option(min=0.1, max=100, callback=finite, help="Data seconds per second.")] = 10.0,
    once: Annotated[
        bool,
        typer.Option("--once", help="End after the first fault; exit 0 only if exactly the injected fault was named."),
    ] = False,
    http_port: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help="Port of the HTTP API. If left out 8080, and 7447 for Zenoh, where they are free; 0 takes free ones.",
        ),
    ] = None,
) -> None:
    """Show how a fault is found: start a simulated machine and a monitor, break the machine, and watch.

    Then the machine is repaired and something else breaks, until Ctrl-C.

    [bold]Example[/bold]

    [cyan]rotorwatch demo --fault c_by --once[/cyan]
    """
    check_address_space()
    prepare_numerics()
    typer.echo("starting a simulated machine and a monitor (some seconds) ...")
    sys.stdout.flush()
    from service.commands.demo import run_demo  # noqa: PLC0415  # keeps --help quick

    raise typer.Exit(run_demo(fault, seed, pace, once, http_port))


def _checked(file: Path) -> str:
    """Check a file, and return a description of its contents, with a line for each doubt."""
    from models.commissioning.commissioned import Installed, install, knowledge_of  # noqa: PLC0415  # keeps --help quick
    from models.doubts import doubts  # noqa: PLC0415
    from models.machine import load_machine_file  # noqa: PLC0415
    from models.mistakes import read_toml  # noqa: PLC0415
    from service.access.tls import lapses, tls_context  # noqa: PLC0415
    from service.delivery.webhooks.dispatcher import Webhooks  # noqa: PLC0415
    from service.settings.service import load_settings  # noqa: PLC0415

    fields = read_toml(file)
    if {"site", "rotor", "sensors"} & set(fields):
        machine = load_machine_file(file)
        known = knowledge_of(machine)  # a missing field of [rotor] is no error, but prevents diagnosis
        channels = f"{len(machine.sensors)} channels at {machine.rate_hz:g} Hz"
        window, (low_hz, high_hz) = machine.window, machine.window.band_hz
        lengths = f"windows of {window.length_s:g} s every {window.hop_s:g} s, segments of {window.segment_s:g} s"
        spectra = f"{lengths}, {low_hz:g} to {high_hz:g} Hz"
        found = f"machine {machine.title}, {channels}; {spectra}; knowledge level {known.level}: {known.text}"
        levels = machine.levels
        if levels.reference == "first windows" or (levels.reference is None and Installed(machine).watching):
            first = f"the first {levels.reference_windows} windows, {levels.reference_windows * window.length_s:g} s"
            found += f"; levels are compared with {first}{'' if levels.reference else ', until it is commissioned'}"
        return "\n  doubtful: ".join((found, *doubts(machine)))
    settings = load_settings(file)
    names, doubtful = [], []
    for entry in settings.machines:
        machine = entry.load()
        install(machine, entry.bundle)
        names.append(machine.title)
        doubtful += [f"{machine.title}: {one}" for one in doubts(machine)]
    # Check the files and environment variables that the monitor reads at its start.
    settings.link.zenoh_items()
    Webhooks(settings.webhooks)
    if settings.access.tls is not None:
        tls_context(settings.access.tls)
    told = (f"settings for {', '.join(names)}", *lapses(settings), _not_listening(settings.http.host))
    return "\n  doubtful: ".join(("; ".join(filter(None, told)), *doubtful))


def _not_listening(host: str) -> str:
    """Message if this computer cannot listen on a host, which settings of another computer may name; else empty."""
    try:
        socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        why = (error.strerror or str(error)).partition(" (while")[0]
        return f"this computer cannot listen on http.host {host} ({why})"
    return ""


# Added last, so that the commands of this module come first in the list.
for module in (installation, size, watching, access, record, replay, interchange):
    app.add_typer(module.commands)
for group in (access.tokens, webhooks, history.commands, plot.commands):
    app.add_typer(group)
