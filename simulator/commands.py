"""What ``rotorsim`` and ``rotortrain`` share: refused arguments, ``--version``, and progress bars on stderr."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from typer.core import TyperGroup

from models.errors import MachineFileError, RotorwatchError


class Commands(TyperGroup):
    """The commands of a program; a refused argument is reported like a field of a file.

    The exit code is 2 for a file or argument that cannot be used, and 1 for a later error, each with one message.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the command of the command line."""
        try:
            return super().invoke(ctx)
        except RotorwatchError as error:
            typer.echo(str(error), err=True)
            raise typer.Exit(2 if isinstance(error, MachineFileError) else 1) from error
        except typer.BadParameter as error:
            from models.mistakes import argument_text  # noqa: PLC0415  # pydantic, which --help must not wait for

            error.message = argument_text(error) or error.message
            raise


def _say_version(context: typer.Context, wanted: bool) -> None:
    if wanted:
        from rotorwatch import __version__  # noqa: PLC0415  # brings pydantic, which nothing else here waits for

        typer.echo(f"{context.find_root().info_name} {__version__}")
        raise typer.Exit


VersionOption = Annotated[
    bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Show the version and exit.")
]


def finite(value: float | None) -> float | None:
    """Refuse NaN and infinity: the limits of an option let NaN pass."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number.")
    return value


def bars(*, remaining: bool = False) -> Progress:
    """Bars that are not started yet, with the time taken and, if wanted, the time that remains."""
    times = (TimeElapsedColumn(), TimeRemainingColumn()) if remaining else (TimeElapsedColumn(),)
    shown = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*shown, *times, console=Console(stderr=True))


@contextmanager
def labelled_bars(*, remaining: bool = False) -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar for each label: the function yielded takes label, amount done and total amount."""
    with bars(remaining=remaining) as shown:
        tasks: dict[str, TaskID] = {}

        def progress(label: str, done: int, total: int) -> None:
            if label not in tasks:
                tasks[label] = shown.add_task(label, total=total)
            shown.update(tasks[label], completed=done)

        yield progress
