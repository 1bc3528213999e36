"""``rotorwatch token`` and ``rotorwatch audit``: who may use the HTTP API, and who did."""

import getpass
import os
import shlex
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

import typer

from models.errors import MachineFileError
from service.commands.running import HistoryOption

if TYPE_CHECKING:  # these import sqlalchemy, which would delay --help
    from rotorwatch.records.history import AuditRecord
    from service.history.store import Store
    from service.settings.service import HistorySettings

commands = typer.Typer()
tokens = typer.Typer(
    name="token", no_args_is_help=True, help="Tokens for the HTTP API; they work at once, without a restart."
)
_PAGE = 500


@tokens.command()
def create(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Who will use it, as shown in the audit log.")],
    scope: Annotated[
        list[str] | None,
        typer.Option("--scope", metavar="SCOPE", help="read, operate or configure; none includes another. Repeatable."),
    ] = None,
    days: Annotated[
        int | None, typer.Option("--days", metavar="DAYS", help="How long it is valid; until revoked if left out.")
    ] = None,
    config: HistoryOption = None,
) -> None:
    """Create a token and show it once; only a hash of it is kept.

    [bold]Examples[/bold]

    [cyan]rotorwatch token create dashboard --scope read[/cyan]

    [cyan]rotorwatch token create "control room" --scope read --scope operate --days 90 --config plant.toml[/cyan]
    """
    from service.access.scopes import Scope  # noqa: PLC0415  # keeps --help quick
    from service.access.tokens import check_name_is_free, new_token  # noqa: PLC0415

    unknown = set(scope or ()) - set(Scope)
    if unknown:
        raise MachineFileError(f"--scope is {', '.join(sorted(unknown))}, expected {', '.join(Scope)}")
    now_ns = time.time_ns()
    record, text = new_token(name, [Scope(one) for one in scope or ()], now_ns=now_ns, days=days)
    with _opened(config) as store:
        check_name_is_free(name, store.tokens.all(), now_ns)
        _write(store, "create-token", f"{record.token_id}, {name}, {' '.join(record.scopes)}")
        store.tokens.add(record)
    until = "until it is revoked" if record.expires_ns is None else f"until {_utc(record.expires_ns)}"
    typer.echo(f"token {record.token_id} of {name} ({', '.join(record.scopes)}), valid {until}", err=True)
    typer.echo("it is shown this once; send it as header Authorization: Bearer TOKEN", err=True)
    typer.echo(text)


def creation_hint(config: Path | None, history: "HistorySettings") -> str:
    """Instruction for creating a monitor's first token, valid in any folder and without the monitor's environment."""
    if history.in_memory:
        return (
            "no tokens can exist for it: the history is in memory, where other programs cannot create them; started "
            "with ROTORWATCH_ACCESS__OPEN_ON_LOOPBACK=true it answers everybody on this computer"
        )
    command = ["rotorwatch" if shutil.which("rotorwatch") else sys.argv[0], "token", "create", "operator"]
    command += ["--scope", "read", "--scope", "operate"]
    if config is not None:
        command += ["--config", str(config.absolute())]
    said, prefix = "no tokens exist for it yet", ""
    overridden = bool({"ROTORWATCH_HISTORY", "ROTORWATCH_HISTORY__URL"} & {name.upper() for name in os.environ})
    if overridden and urlsplit(history.database).password is not None:
        said += " (create one with ROTORWATCH_HISTORY__URL as it is here)"
    elif overridden or (history.url is None and os.environ.get("XDG_STATE_HOME")):
        prefix = f"ROTORWATCH_HISTORY__URL={shlex.quote(history.database)} "
    return f"{said}: {prefix}{shlex.join(command)}"


@tokens.command("list")
def list_(config: HistoryOption = None) -> None:
    """Show every token ever created, and which are valid.

    [bold]Example[/bold]

    [cyan]rotorwatch token list --config plant.toml[/cyan]
    """
    from rich.console import Console  # noqa: PLC0415  # keeps --help quick
    from rich.table import Column, Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    from service.access.tokens import token_state  # noqa: PLC0415

    with _opened(config) as store:
        records = store.tokens.all()
    now_ns = time.time_ns()
    table = Table(Column("token", no_wrap=True), "name", "scopes", "created", "expires", "state")
    for record in sorted(records, key=lambda one: one.created_ns):
        state = token_state(record, now_ns)
        since = "" if record.revoked_ns is None else f" {_utc(record.revoked_ns)}"
        table.add_row(
            record.token_id,
            Text(record.name),
            ", ".join(record.scopes),
            _utc(record.created_ns),
            "-" if record.expires_ns is None else _utc(record.expires_ns),
            Text(state + since, style="green" if state == "valid" else "red"),
        )
    Console(soft_wrap=True).print(table)


@tokens.command()
def revoke(
    token: Annotated[str, typer.Argument(metavar="ID", help="Public part of the token, from: rotorwatch token list.")],
    config: HistoryOption = None,
) -> None:
    """Revoke a token: it is refused from the next request on.

    [bold]Example[/bold]

    [cyan]rotorwatch token revoke 3fK09aZqT1xB[/cyan]
    """
    from service.access.tokens import masked  # noqa: PLC0415  # keeps --help quick

    with _opened(config) as store:
        record = store.tokens.find(token)
        if record is None:
            raise MachineFileError(
                f"there is no token {masked(token)!r}; expected the 12 characters after rw_, see: rotorwatch token list"
            )
        if record.revoked_ns is None:
            _write(store, "revoke-token", f"{record.token_id}, {record.name}")
            store.tokens.revoke(token, time.time_ns())
            typer.echo(f"token {record.token_id} of {record.name} is revoked")
        else:
            typer.echo(f"token {record.token_id} of {record.name} was revoked at {_utc(record.revoked_ns)}")


@commands.command()
def audit(
    machine: Annotated[
        str | None, typer.Option(metavar="SITE/MACHINE", help="Only what was done to this machine.")
    ] = None,
    actor: Annotated[str | None, typer.Option(metavar="NAME", help="Only what this user did.")] = None,
    limit: Annotated[int, typer.Option(min=1, max=100_000, help="At most this many, the newest.")] = 50,
    config: HistoryOption = None,
) -> None:
    """Show who did what over HTTP, and who was refused; newest first, times in UTC.

    One entry per line: time, status, caller, address, action and the reason given.
    If the outcome of an action is not known, the monitor ended after the start
    of the action, before it could write the outcome.

    [bold]Example[/bold]

    [cyan]rotorwatch audit --machine plant/pump-7 --limit 20[/cyan]
    """
    if machine is not None and machine.count("/") != 1:
        raise MachineFileError(f"--machine is {machine!r}, expected SITE/MACHINE such as demo/lab")
    with _opened(config) as store:
        entries = list(islice(_with_outcomes(store, machine, actor), limit))
    who = max((len(entry.actor) for entry in entries), default=0)
    origin = max((len(entry.address) for entry in entries), default=0)
    for entry in entries:
        typer.echo(_audit_line(entry, who, origin))
    if not entries:
        typer.echo("no entries", err=True)


def _with_outcomes(store: "Store", machine: str | None, actor: str | None) -> "Iterator[AuditRecord]":
    """Audit entries, newest first, without `STARTED` entries whose outcome has an entry too."""
    from service.access.audit import STARTED  # noqa: PLC0415  # keeps --help quick

    outcomes: set[tuple[int, str, str]] = set()
    before: int | None = None
    while page := store.audit.entries(before=before, limit=_PAGE, machine=machine, actor=actor):
        for entry in page:
            key = (entry.at_ns, entry.method, entry.path)
            if entry.status != 0 or entry.action != STARTED or key not in outcomes:
                outcomes.add(key)
                yield entry
        before = page[-1].number


def _audit_line(entry: "AuditRecord", who: int, origin: int) -> str:
    """Format an entry as a line of any length; `who` and `origin` are column widths."""
    from service.access.audit import STARTED  # noqa: PLC0415  # keeps --help quick

    status = str(entry.status) if entry.status else "not known"
    done = " ".join(part for part in (entry.action, entry.machine, entry.alarm) if part and part != STARTED)
    what = done or f"{entry.method} {entry.path}"  # the action tells as much as the path of the request
    why = f": {entry.reason}" if entry.reason else ""
    columns = (_utc(entry.at_ns), f"{status:<9}", f"{entry.actor or '-':<{who}}", f"{entry.address or '-':<{origin}}")
    return "  ".join((*columns, f"{what}{why}"))


@contextmanager
def _opened(config: Path | None) -> "Iterator[Store]":
    from service.history.store import Store  # noqa: PLC0415
    from service.settings.service import load_settings  # noqa: PLC0415  # keeps --help quick

    history = load_settings(config).history
    if history.in_memory:
        raise MachineFileError(
            f"{config}: history.url is {history.database!r}: tokens would be in memory, where other "
            "programs cannot read them; expected a file or a PostgreSQL server"
        )
    store = Store(history.database, history.retention)
    store.open()
    try:
        yield store
    finally:
        store.close()


def _write(store: "Store", action: str, reason: str) -> None:
    """Write an action to the audit log, before it is executed."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container whose user has no name
        user = f"user {os.getuid()}"
    said = {"action": action, "reason": reason, "method": "command", "path": "rotorwatch token"}
    store.audit.append(time.time_ns(), 200, actor=user, address="", machine="", alarm="", **said)


def _utc(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")
