"""``rotorwatch history``: check, back up and restore the SQLite file of the history."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from models.errors import MachineFileError
from service.commands.running import HistoryOption

if TYPE_CHECKING:  # imports sqlalchemy, which would delay --help
    from service.history.file import HistoryFile

commands = typer.Typer(
    name="history", no_args_is_help=True, help="The SQLite file of the history: check it, back it up, restore it."
)


@commands.command()
def check(config: HistoryOption = None) -> None:
    """Check the whole file, even while a monitor runs; exit code 1 if it is damaged.

    [bold]Example[/bold]

    [cyan]rotorwatch history check --config plant.toml[/cyan]
    """
    from service.history.file import faults  # noqa: PLC0415  # keeps --help quick

    file = _chosen(config).path
    found = faults(file)
    for fault in found:
        typer.echo(f"{file}: {fault}", err=True)
    if found:
        raise typer.Exit(1)
    typer.echo(f"{file}: ok")


@commands.command()
def backup(
    copy: Annotated[Path, typer.Argument(metavar="FILE", help="New file.")], config: HistoryOption = None
) -> None:
    """Copy the history, even while a monitor runs, and check the copy.

    [bold]Example[/bold]

    [cyan]rotorwatch history backup /backup/history-monday.sqlite --config plant.toml[/cyan]
    """
    from service.history.file import back_up  # noqa: PLC0415  # keeps --help quick

    file = _chosen(config).path
    back_up(file, copy)
    typer.echo(f"{file} copied to {copy}, which holds hashes of the access tokens: keep it where others cannot read it")


@commands.command()
def restore(
    backup_file: Annotated[Path, typer.Argument(metavar="FILE", help="Backup made by rotorwatch history backup.")],
    config: HistoryOption = None,
) -> None:
    """Replace the history with a backup; the monitor must be stopped. The previous file is kept.

    [bold]Example[/bold]

    [cyan]rotorwatch history restore /backup/history-monday.sqlite --config plant.toml[/cyan]
    """
    from service.history.file import restore as put_back  # noqa: PLC0415  # keeps --help quick

    if not backup_file.is_file():
        why = "is a folder, expected a file" if backup_file.is_dir() else "no such file"
        raise MachineFileError(f"{backup_file}: {why}")
    file = _chosen(config)
    kept = put_back(file, backup_file)
    typer.echo(f"{file.path} restored from {backup_file}" + (f"; the previous file is kept as {kept}" if kept else ""))


def _chosen(config: Path | None) -> "HistoryFile":
    from service.history.database import Database  # noqa: PLC0415
    from service.settings.service import load_settings  # noqa: PLC0415  # keeps --help quick

    database = Database(load_settings(config).history.database, 5.0)
    if database.file is None:
        way = "expected a file" if database.is_sqlite else "use pg_dump and pg_restore"
        raise MachineFileError(f"{config or 'settings'}: history.url is {database.shown}: {way}")
    return database.file
