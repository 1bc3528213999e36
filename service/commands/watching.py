"""``rotorwatch watch`` and ``rotorwatch status``: show what monitors report."""

import json
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Column, Table

from models.errors import MachineFileError, RotorwatchError
from service.commands.replay import NamespaceOption, in_namespace
from service.commands.running import ENDPOINT, ConnectOption, LinkOption

if TYPE_CHECKING:  # these import numpy and scipy, which would delay --help
    from rotorwatch.records.health import Health
    from service.stream.transport import TopicMessage

commands = typer.Typer()
_ALARM, _NO_DATA, _NO_ANSWER = 1, 3, 4
_SUMMARY = {0: "well", _ALARM: "alarm", _NO_DATA: "no-data", _NO_ANSWER: "no-answer"}
_BAD_STATES = ("alert", "danger", "outside-model", "data-health", "no-data")
_WIDEST, _FOLDED = 1000, 16
_QUIET = {
    "shelved": "",
    "suppressed": "",
    "out-of-service": "",
    "returned": ", cleared, to be acknowledged",
    "latched-unacknowledged": ", cleared, to be acknowledged and reset",
    "latched-acknowledged": ", cleared, to be reset",
}
"""States of alarms that are not normal but do not count as raised, with the words that explain them."""
_STYLES = {
    "danger": "bold red",
    "alert": "bold yellow",
    "outside-model": "yellow",
    "data-health": "magenta",
    "unchanged": "green",
    "no-data": "magenta",
    "healthy": "green",
}


@commands.command()
def watch(
    machine: Annotated[str, typer.Option(metavar="SITE/MACHINE", help="Machine to show; * stands for any.")] = "*/*",
    connect: ConnectOption = None,
    link: LinkOption = None,
    windows: Annotated[bool, typer.Option("--windows", help="Also one line per evaluated window.")] = False,
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
    if machine.count("/") != 1:
        raise MachineFileError(f"--machine is {machine!r}, expected SITE/MACHINE such as demo/lab or */lab")
    from models.signals.link import LinkSettings, load_link  # noqa: PLC0415  # keeps --help quick
    from service.stream.transport import follow  # noqa: PLC0415
    from service.terminal.stopping import stop_request  # noqa: PLC0415

    topics = ("alarm_state", "alarm_event", "health", *(("report",) if windows else ()))
    base = LinkSettings(mode="client", connect=(ENDPOINT,)) if link is None else load_link(link)
    ends = {"connect": tuple(connect)} if connect else {}
    settings = in_namespace(base.model_copy(update=ends), namespace)
    lines = None if as_json else _Lines()

    def show(message: "TopicMessage") -> None:
        try:
            if lines is None:
                sys.stdout.write(f'{{"topic": {json.dumps(message.key)}, "message": {message.text}}}\n')
            else:
                lines.show(message)
            sys.stdout.flush()
        except (BrokenPipeError, SystemExit):  # the reader has closed the pipe; rich turns the error into SystemExit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            stop.ask()

    with stop_request() as stop, follow(settings, machine, topics, show) as connected:
        there = True
        while not stop.wait(0.5):
            if connected() != there:
                there = not there
                typer.echo("connected again" if there else "connection lost, trying again", err=True)


@commands.command()
def status(
    url: Annotated[str, typer.Option(help="Address of the monitor's HTTP API.")] = "http://127.0.0.1:8080",
    token: Annotated[
        str | None,
        typer.Option(
            envvar="ROTORWATCH_TOKEN",
            show_envvar=True,
            help="Token with the scope read, if the API requires one; preferably set in the environment.",
        ),
    ] = None,
    ca: Annotated[Path | None, typer.Option(metavar="FILE", help="Authority (PEM) of the API's certificate.")] = None,
    certificate: Annotated[
        tuple[Path, Path] | None, typer.Option(metavar="FILE KEY", help="Own certificate and key (PEM), if required.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document, for another program.")] = False,
) -> None:
    """Table of all machines of a running monitor.

    Exit code 0: no alarm is raised on any machine (healthy, warming, not
    evaluable). 1: an alarm is raised on a machine. 3: none is raised, but the
    data of a machine have stopped. 4: the monitor does not answer, or refuses
    the token. 2: an argument that cannot be used. Reasons, and alarms that are
    shelved, suppressed, out of service, or cleared and waiting for an operator,
    are listed below the table.

    [bold]Examples[/bold]

    [cyan]rotorwatch status || echo "look at the machines"[/cyan]

    [cyan]rotorwatch status --json | jq -r '.machines[] | .machine + " " + .state'[/cyan]
    """
    from service.terminal.lines import reason_of  # noqa: PLC0415  # keeps --help quick

    healths, code, why = [], _NO_ANSWER, ""
    try:
        healths = _fetch_healths(url, token, ca, certificate)
        code = max((_exit_code(health) for health in healths), key=(0, _NO_DATA, _ALARM).index, default=0)
    except MachineFileError:
        raise
    except RotorwatchError as error:
        why = str(error)
    if as_json:
        machines = [health.model_dump(mode="json") for health in healths]
        answer = {"url": url, "summary": _SUMMARY[code], "reason": why, "machines": machines}
        typer.echo(json.dumps(answer, ensure_ascii=False))
    if code == _NO_ANSWER:
        typer.echo(why, err=True)
    if as_json or code == _NO_ANSWER:
        raise typer.Exit(code)
    columns = ("state", "window", "raised alarms", "data age", "refused", "gaps")
    table = Table(Column("machine", overflow="fold"), *(Column(name, no_wrap=True) for name in columns))
    remarks: list[str] = []
    for health in healths:
        place = f"{health.site}/{health.machine}"
        age_s = health.stream.data_age_s
        table.add_row(
            place,
            f"[{_STYLES.get(health.state, 'default')}]{health.state}[/]",
            f"{health.filled:.0%}",
            "\n".join(f"{alarm.name} {alarm.severity}" for alarm in health.alarms if alarm.raised) or "-",
            "-" if age_s is None else f"{age_s:.1f} s",
            str(sum(health.quality.refused_blocks.values())),
            str(health.quality.gaps),
        )
        remarks += [f"{place}: {reason_of(health)}"] if health.reason else []
        differs = "; ".join(health.stream.descriptor_mismatch)
        remarks += [f"{place}: the publisher's channel descriptor differs from the file: {differs}"] if differs else []
        growth = None if health.report is None else health.report.level_growth
        remarks += [] if growth is None else [f"{place}: {growth.text}"]
        quiet = [alarm for alarm in health.alarms if alarm.state in _QUIET]
        remarks += [f"{place}: {alarm.name} is {alarm.state}{_QUIET[alarm.state]}" for alarm in quiet]
    # Only machine names are folded, to no less than `_FOLDED` characters, so lines may exceed the terminal's width.
    longest = max((len(f"{health.site}/{health.machine}") for health in healths), default=0)
    least = Console(width=_WIDEST).measure(table).maximum - max(0, longest - _FOLDED)
    Console(soft_wrap=True, width=max(Console().width, least)).print(table)
    for remark in remarks:
        typer.echo(remark)
    raise typer.Exit(code)


def _exit_code(health: "Health") -> int:
    """Exit code of `status` for one machine; an alarm takes precedence over missing data."""
    from models.alarm_names import STREAM_LOST  # noqa: PLC0415  # keeps --help quick

    raised = {alarm.name for alarm in health.alarms if alarm.raised}
    if raised - {STREAM_LOST} or (health.state in _BAD_STATES and health.state != "no-data"):
        return _ALARM
    return _NO_DATA if raised or health.stream.silent or health.state == "no-data" else 0


class _Lines:
    """Shows messages as text: alarms always, states when they change, windows if subscribed to."""

    def __init__(self) -> None:
        self._console = Console(highlight=False, markup=False, soft_wrap=True)
        self._states: dict[str, str] = {}
        self._alarms: set[str] = set()

    def show(self, message: "TopicMessage") -> None:
        """Show a message, if there is anything new in it."""
        from rotorwatch import AlarmCloudEvent, AlarmStates, Health, Report  # noqa: PLC0415  # keeps --help quick
        from service.terminal import lines  # noqa: PLC0415

        if message.key.endswith("/alarm/event"):
            event = AlarmCloudEvent.model_validate_json(message.text)
            style = _STYLES[event.data.severity] if event.data.kind in {"raised", "escalated"} else "green"
            self._console.print(lines.alarm_event_line(event), style=style)
        elif message.key.endswith("/alarm/state"):
            if message.key not in self._alarms:  # later changes arrive as events
                self._alarms.add(message.key)
                for line in lines.alarm_state_lines(AlarmStates.model_validate_json(message.text)):
                    self._console.print(line, style="bold")
        elif message.key.endswith("/health"):
            health = Health.model_validate_json(message.text)
            if self._states.get(message.key) != health.state:
                self._states[message.key] = health.state
                self._console.print(lines.health_line(health), style=_STYLES.get(health.state))
        else:
            report = Report.model_validate_json(message.text)
            bad = _STYLES.get(report.state) if report.state in _BAD_STATES else None
            self._console.print(lines.report_line(report), style=bad)


def _fetch_healths(
    url: str, token: str | None, ca: Path | None, certificate: tuple[Path, Path] | None
) -> "list[Health]":
    # Imports an HTTP client, which would delay --help.
    from rotorwatch import AccessRefused, Client, ClientError, NoAnswer, RequestRefused  # noqa: PLC0415

    try:
        client = Client(url, token, ca=ca, certificate=certificate, timeout_s=5.0)
    except ClientError as error:
        raise MachineFileError(f"--url, --token, --certificate, --ca: {error}") from error
    try:
        with client:
            return [client.health(f"{one.site}/{one.machine}") for one in client.machines()]
    except AccessRefused as error:
        raise RotorwatchError(
            f"{url}: {error}; set ROTORWATCH_TOKEN to a token with the scope read (rotorwatch token create)"
        ) from error
    except RequestRefused as error:
        raise RotorwatchError(f"{url}: the monitor's HTTP API answers {error.status}: {error}") from error
    except NoAnswer as error:
        why = str(error).partition(": ")[2]
        if "CERTIFICATE_VERIFY_FAILED" in why:
            raise RotorwatchError(
                f"{url}: its certificate is not trusted under this name: {why}; --ca takes the authority (PEM) of a "
                "certificate of your own, --url the name in it"
            ) from error
        why = re.sub(r"\[Errno -?\d+\] ", "", why)
        raise RotorwatchError(
            f"{url}: the monitor's HTTP API does not answer: {why}; --url says where it is"
        ) from error
    except ClientError as error:
        raise RotorwatchError(f"{url}: this is not the HTTP API of a monitor: {error}") from error
