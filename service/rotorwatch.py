"""The command ``rotorwatch``: monitor machines, check settings, look at what monitors say."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.table import Table

from models.errors import BundleError, MachineFileError, RotorwatchError
from service.commands import interchange as interchange_commands
from service.commands import plot as plot_commands
from service.commands import record as record_commands
from service.commands import replay as replay_commands
from service.commands.replay import NamespaceOption, in_namespace
from service.commands.running import ENDPOINT, ConnectOption, ListenOption, exit_codes, one_blas_thread

if TYPE_CHECKING:  # these import numpy and scipy, which --help must not wait for
    from service.config import ServiceSettings
    from service.schemas import Health
    from service.transport import TopicMessage

__all__ = ["app"]

_BAD_STATES = ("alert", "danger", "outside-model", "data-health", "no-data")
_STYLES = {
    "danger": "bold red",
    "alert": "bold yellow",
    "outside-model": "yellow",
    "data-health": "magenta",
    "unchanged": "green",
    "no-data": "magenta",
    "healthy": "green",
}

app = typer.Typer(
    name="rotorwatch",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="Condition monitoring of rotating machines: which parameter changed, by how much, how sure.",
    epilog="Exit codes: 0 fine, 1 trouble at run time, 2 a file or argument that cannot be used.",
)

record_commands.register(app)
replay_commands.register(app)
interchange_commands.register(app)
plot_commands.register(app)


@app.command()
def run(
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Settings (TOML); the shipped machine if left out.")
    ] = None,
    machine: Annotated[
        list[str] | None,
        typer.Option(
            "--machine",
            metavar="FILE[@BUNDLE]",
            help="Monitor this machine instead of those in the settings: shipped name or path, and after @ its trained "
            "networks, if any. Repeatable.",
        ),
    ] = None,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    http_port: Annotated[
        int | None, typer.Option("--http-port", min=0, max=65535, help="Port of the HTTP API; 0 takes a free one.")
    ] = None,
    when_full: Annotated[
        Literal["drop", "wait"] | None,
        typer.Option(
            "--when-full",
            help="When blocks come faster than they can be evaluated: drop and count them (live machines), or make the "
            "sender wait (batch runs).",
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
    with exit_codes():
        one_blas_thread()
        from service.config import load_settings  # noqa: PLC0415  # keeps --help quick
        from service.logs import configure_logging  # noqa: PLC0415
        from service.runtime import running, stop_request  # noqa: PLC0415  # must see the variables set above

        settings = _overridden(load_settings(config), machine, listen, connect, http_port, when_full, namespace)
        configure_logging(settings.log)
        with stop_request() as stop, running(settings) as service:
            for worker in service.machines():
                networks = worker.identity.bundle or "none: the equations are not evaluated"
                typer.echo(f"machine {worker.identity.site}/{worker.identity.machine}, bundle {networks}")
            if settings.link.namespace:
                typer.echo(f"Zenoh namespace {settings.link.namespace}: nothing from outside it is heard")
            for what, ends in (("listening on", settings.link.listen), ("connecting to", settings.link.connect)):
                if ends:
                    typer.echo(f"Zenoh {what} {', '.join(ends)}")
            typer.echo(f"HTTP API {service.http_url}")
            sys.stdout.flush()
            stop.wait()


@app.command("check-config")
def check_config(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Settings or machine files (TOML).")],
) -> None:
    """Check settings and machine files; says what is wrong with which field.

    Machine files and trained networks that a settings file names are checked with it.

    [bold]Example[/bold]

    [cyan]rotorwatch check-config plant.toml pump-7.toml[/cyan]
    """
    faulty = False
    for file in files:
        try:
            typer.echo(f"{file}: ok, {_checked(file)}")
        except (MachineFileError, BundleError) as error:
            faulty = True
            text = str(error)
            typer.echo(text if text.startswith(str(file)) else f"{file}: {text}", err=True)
    if faulty:
        raise typer.Exit(2)


@app.command()
def watch(
    machine: Annotated[
        str, typer.Option("--machine", metavar="SITE/MACHINE", help="Which machine; * stands for any.")
    ] = "*/*",
    connect: ConnectOption = None,
    windows: Annotated[bool, typer.Option("--windows", help="One line per evaluated window as well.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object per line: topic and message.")] = False,
    namespace: NamespaceOption = None,
) -> None:
    """Show alarms and changes of state as they happen, until Ctrl-C.

    Times are UTC and those of the data. Figures are relative changes with their 95 % half widths.

    [bold]Examples[/bold]

    Alarms of every machine of the monitor on this computer:
    [cyan]rotorwatch watch[/cyan]

    Every window of one machine:
    [cyan]rotorwatch watch --machine demo/lab --windows[/cyan]

    For another program:
    [cyan]rotorwatch watch --json | jq .message.data.text[/cyan]
    """
    with exit_codes():
        if machine.count("/") != 1:
            raise MachineFileError(f"--machine is {machine!r}, expected SITE/MACHINE such as demo/lab or */lab")
        from models.signals.link import LinkSettings  # noqa: PLC0415  # keeps --help quick
        from service.runtime import stop_request  # noqa: PLC0415
        from service.transport import follow  # noqa: PLC0415

        topics = ("alarm_state", "alarm_event", "health", *(("report",) if windows else ()))
        link = LinkSettings(mode="client", connect=tuple(connect) if connect else (ENDPOINT,))
        link = in_namespace(link, namespace)
        show = _JsonLines() if as_json else _Lines()
        with stop_request() as stop, follow(link, machine, topics, show) as connected:
            there = True
            while not stop.wait(0.5):
                if connected() != there:
                    there = not there
                    typer.echo("connected again" if there else "connection lost, trying again", err=True)


@app.command()
def status(
    url: Annotated[str, typer.Option("--url", help="Where the monitor's HTTP API is.")] = "http://127.0.0.1:8080",
) -> None:
    """Table of all machines of a running monitor.

    Exit code 0 if every machine is healthy, warming or not evaluable; 1 if any is in alert, danger, outside the model
    or without data, or if the monitor does not answer.

    [bold]Example[/bold]

    [cyan]rotorwatch status || echo "look at the machines"[/cyan]
    """
    with exit_codes():
        healths = _fetch_healths(url.rstrip("/"))
        table = Table("machine", "state", "window", "raised alarms", "data age", "refused", "gaps", "why")
        for health in healths:
            alarms = [f"{a.name} {a.severity}" for a in health.alarms if a.raised]
            age_s = health.stream.data_age_s
            table.add_row(
                f"{health.site}/{health.machine}",
                f"[{_STYLES.get(health.state, 'default')}]{health.state}[/]",
                f"{health.filled:.0%}",
                ", ".join(alarms) or "-",
                "-" if age_s is None else f"{age_s:.1f} s",
                str(sum(health.quality.refused_blocks.values())),
                str(health.quality.gaps),
                health.reason or "-",
            )
        Console(soft_wrap=True).print(table)
        if any(health.state in _BAD_STATES for health in healths):
            raise typer.Exit(1)


@app.command()
def router(listen: ListenOption = None, connect: ConnectOption = None) -> None:
    """Run a Zenoh router until Ctrl-C, for networks in which monitors and sensors cannot reach each other directly.

    Everybody who connects to it must do so as a client: rotorwatch run --connect, rotorsim publish --mode client.

    [bold]Example[/bold]

    [cyan]rotorwatch router --listen tcp/0.0.0.0:7447[/cyan]
    """
    with exit_codes():
        from service.runtime import stop_request  # noqa: PLC0415  # keeps --help quick
        from service.transport import route  # noqa: PLC0415

        endpoints = tuple(listen) if listen else (ENDPOINT,)
        with stop_request() as stop, route(endpoints, tuple(connect or ())):
            typer.echo(f"router listening on {', '.join(endpoints)}")
            sys.stdout.flush()
            stop.wait()


@app.command()
def demo(
    fault: Annotated[
        str, typer.Option("--fault", metavar="NAME", help="What breaks: k_by, c_by, k_bz, c_bz, e; or healthy.")
    ] = "k_by",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Another realisation of all random forces and noise.")] = 1,
    pace: Annotated[float, typer.Option("--pace", min=0.1, max=100, help="Data seconds per second.")] = 10.0,
    once: Annotated[
        bool, typer.Option("--once", help="End by itself; exit 0 only if exactly the injected parameter was named.")
    ] = False,
    http_port: Annotated[
        int, typer.Option("--http-port", min=0, max=65535, help="Port of the HTTP API; 0 takes a free one.")
    ] = 0,
) -> None:
    """Show how a fault is found: start a simulated machine and a monitor, break the machine, and watch.

    [bold]Example[/bold]

    [cyan]rotorwatch demo --fault c_by --once[/cyan]
    """
    with exit_codes():
        one_blas_thread()
        from service.demo import DemoOptions, run_demo  # noqa: PLC0415  # keeps --help quick

        code = run_demo(DemoOptions(scenario=fault, seed=seed, pace=pace, once=once, http_port=http_port))
    raise typer.Exit(code)


class _Lines:
    """Shows messages as text: alarms always, states when they change, windows if subscribed to."""

    def __init__(self) -> None:
        self._console = Console(highlight=False, markup=False, soft_wrap=True)
        self._states: dict[str, str] = {}
        self._alarms: set[str] = set()

    def __call__(self, message: "TopicMessage") -> None:
        from service import lines, schemas  # noqa: PLC0415  # keeps --help quick

        if message.key.endswith("/alarm/event"):
            event = schemas.AlarmCloudEvent.model_validate_json(message.text)
            style = "green" if event.data.kind == "cleared" else _STYLES[event.data.severity]
            self._say(lines.alarm_event_line(event), style)
        elif message.key.endswith("/alarm/state"):
            if message.key not in self._alarms:  # later changes arrive as events
                self._alarms.add(message.key)
                for line in lines.alarm_state_lines(schemas.AlarmStates.model_validate_json(message.text)):
                    self._say(line, "bold")
        elif message.key.endswith("/health"):
            health = schemas.Health.model_validate_json(message.text)
            if self._states.get(message.key) != health.state:
                self._states[message.key] = health.state
                self._say(lines.health_line(health), _STYLES.get(health.state))
        else:
            report = schemas.Report.model_validate_json(message.text)
            self._say(lines.report_line(report), _STYLES.get(report.state) if report.state in _BAD_STATES else None)

    def _say(self, line: str, style: str | None) -> None:
        self._console.print(line, style=style)
        sys.stdout.flush()


class _JsonLines:
    """Writes messages as JSON lines."""

    def __call__(self, message: "TopicMessage") -> None:
        import json  # noqa: PLC0415  # only here

        sys.stdout.write(f'{{"topic": {json.dumps(message.key)}, "message": {message.text}}}\n')
        sys.stdout.flush()


def _overridden(
    settings: "ServiceSettings",
    machines: list[str] | None,
    listen: list[str] | None,
    connect: list[str] | None,
    http_port: int | None,
    when_full: Literal["drop", "wait"] | None,
    namespace: str | None,
) -> "ServiceSettings":
    """Put the command line over the settings; endpoints and role replace those of the settings altogether."""
    from service.config import MachineEntry, check_distinct  # noqa: PLC0415  # keeps --help quick

    update: dict[str, Any] = {}
    if machines:
        pairs = [text.partition("@") for text in machines]
        update["machines"] = tuple(MachineEntry(file=file, bundle=bundle or None) for file, _, bundle in pairs)
    if listen or connect:
        # A router joins clients; between peers, which it takes to know each other, it passes nothing on.
        mode = "peer" if listen else "client"
        ends = {"mode": mode, "listen": tuple(listen or ()), "connect": tuple(connect or ())}
        update["link"] = settings.link.model_copy(update=ends)
    if namespace is not None:
        update["link"] = in_namespace(update.get("link", settings.link), namespace)
        # What is replayed must not end up among the recordings and in the history of the live machine.
        update["recording"] = settings.recording.model_copy(update={"directory": None})
        update["history"] = settings.history.model_copy(update={"url": "sqlite:///:memory:"})
    if http_port is not None:
        update["http"] = settings.http.model_copy(update={"port": http_port})
    if when_full is not None:
        update["queue"] = settings.queue.model_copy(update={"when_full": when_full})
    overridden = settings.model_copy(update=update)
    check_distinct(Path("command line"), overridden)
    return overridden


def _checked(file: Path) -> str:
    """Check one file and say what it describes."""
    from models.commissioning.installed import install  # noqa: PLC0415  # keeps --help quick
    from models.machine import load_machine_file, read_toml  # noqa: PLC0415
    from service.config import load_settings  # noqa: PLC0415

    if {"site", "rotor", "sensors"} & set(read_toml(file)):
        machine = load_machine_file(file)
        return f"machine {machine.site}/{machine.name}, {len(machine.sensors)} channels at {machine.rate_hz:g} Hz"
    settings = load_settings(file)
    names = []
    for entry in settings.machines:
        machine = entry.load()
        install(machine, entry.bundle)
        names.append(f"{machine.site}/{machine.name}")
    return f"settings for {', '.join(names)}"


def _fetch_healths(url: str) -> "list[Health]":
    import httpx  # noqa: PLC0415  # only here
    from pydantic import ValidationError  # noqa: PLC0415

    from service.schemas import Health  # noqa: PLC0415  # keeps --help quick

    try:
        with httpx.Client(base_url=url, timeout=5.0, trust_env=False) as client:
            listed = client.get("/api/v1/machines").raise_for_status().json()["machines"]
            places = [f"/api/v1/machines/{entry['site']}/{entry['machine']}/health" for entry in listed]
            return [Health.model_validate_json(client.get(place).raise_for_status().content) for place in places]
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        raise RotorwatchError(f"{url}: the monitor's HTTP API does not answer: {error}") from error
    except (ValidationError, ValueError, KeyError, TypeError) as error:
        raise RotorwatchError(f"{url}: this is not the HTTP API of a monitor") from error


if __name__ == "__main__":
    app()
