"""Common parts of the commands: exit codes, one thread for linear algebra, shared options."""

import errno
import inspect
import math
import os
import re
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from models.errors import BundleError, MachineFileError, PictureError, RecordingError, RotorwatchError
from service.terminal.memory import prepare_memory

ENDPOINT = "tcp/127.0.0.1:7447"  # where a monitor listens by default

_RAGGED = re.compile(r"(?<!\n)(?<!\[/cyan\])\n(?!\n|\[cyan\])")
"""Line breaks within a paragraph of a help text, except around examples."""
_FILES = 65_536
_UNUSABLE = {errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.EROFS}
"""System errors for a file that the user has named and this program cannot use."""
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""System errors for a file without room; if the error has no file name, it may concern standard output."""
_NO_THREAD = "can't start new thread"
_MB = 1_000_000
_ADDRESS_SPACE_MB = 2_000
_OF_A_MACHINE_MB = 100  # mostly thread stacks and reservations of libraries, of which little is used

HistoryOption = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Settings (TOML) of the monitor; \\[history] is used.")
]
ConnectOption = Annotated[
    list[str] | None,
    typer.Option("--connect", metavar="ENDPOINT", help="Zenoh endpoint to connect to, as a client. Repeatable."),
]
ListenOption = Annotated[
    list[str] | None, typer.Option("--listen", metavar="ENDPOINT", help="Zenoh endpoint to listen on. Repeatable.")
]
LinkOption = Annotated[
    Path | None,
    typer.Option(
        "--link", metavar="FILE", help="How to connect: a file with the table \\[link], with passwords or certificates."
    ),
]

FromOption = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="TIME",
        help="Data from this time on: seconds after their start, or a data time such as 2026-01-01T00:02:30Z (UTC).",
    ),
]
ToOption = Annotated[str | None, typer.Option("--to", metavar="TIME", help="Data before this time; same format.")]


def _say_version(wanted: bool) -> None:
    if wanted:
        from rotorwatch import __version__  # noqa: PLC0415  # imports an HTTP client, only needed here

        typer.echo(f"rotorwatch {__version__}")
        raise typer.Exit


VersionOption = Annotated[
    bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Show the version and exit.")
]


def finite(value: float | None) -> float | None:
    """Refuse NaN and infinities; limits of an option let NaN through."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number.")
    return value


class Commands(TyperGroup):
    """The commands of a program, with exit codes; refused arguments are reported in the style of fields of a file."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command by its name, with a help text that wraps at the terminal's width."""
        found = super().get_command(ctx, cmd_name)
        for one in (found, *getattr(found, "commands", {}).values()):
            if one is not None and one.help:
                one.help = _RAGGED.sub(" ", inspect.cleandoc(one.help))
        return found

    def invoke(self, ctx: Any) -> Any:
        """Run the command of the command line."""
        try:
            with exit_codes():
                return super().invoke(ctx)
        except typer.BadParameter as error:
            from models.mistakes import argument_text  # noqa: PLC0415  # imports pydantic, which would delay --help

            error.message = argument_text(error) or error.message
            raise


def prepare_numerics() -> None:
    """Configure threads and memory of the process for numerics; must be called before numpy is imported.

    With one thread for linear algebra, results do not depend on the number of cores, and workers do not compete.
    """
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    prepare_memory()


def raise_file_limit() -> None:
    """Raise the limit of open files and connections to what the system allows, at most 65 536."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _FILES if hard == resource.RLIM_INFINITY else min(hard, _FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):  # if the system forbids it, the limit stays
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def check_address_space() -> None:
    """Refuse to start with too little address space: libraries that get no memory would crash or hang.

    Raises
    ------
    RotorwatchError
        Naming the limit and what is needed.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < _ADDRESS_SPACE_MB * _MB:
        raise RotorwatchError(f"the monitor cannot start: {_too_small(limit)}")


def _output_is_full() -> bool:
    """Whether not even the end of a line can be written to the output."""
    try:
        sys.stdout.write("\n")
        sys.stdout.flush()
    except OSError:
        return True
    return False


def _too_small(limit: int) -> str:
    return (
        f"the address space of the process is limited to {limit // _MB} MB (ulimit -v), expected at least "
        f"{_ADDRESS_SPACE_MB} MB for one machine and {_OF_A_MACHINE_MB} MB for each further one"
    )


def exit_code(error: RotorwatchError) -> int:
    """Exit code: 2 for an unusable file or argument, such as a missing recording; 1 for all other errors."""
    kinds = FileNotFoundError | IsADirectoryError | NotADirectoryError | PermissionError
    cause = error.__cause__
    missing = isinstance(cause, kinds) or (isinstance(cause, OSError) and cause.errno == errno.ENAMETOOLONG)
    unusable = isinstance(error, RecordingError | PictureError) and missing
    return 2 if unusable or isinstance(error, MachineFileError | BundleError) else 1


@contextmanager
def exit_codes() -> Iterator[None]:
    """Exit with code 2 for an unusable file or argument, 1 for later errors, after printing one message."""
    try:
        yield
    except RotorwatchError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(exit_code(error)) from error
    except OSError as error:
        if error.errno in _FULL and error.filename is None:
            what = "the output" if _output_is_full() else "a file"
            typer.echo(f"{what} cannot be written ({error.strerror})", err=True)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # discards output that is still buffered
            raise typer.Exit(1) from error
        if error.errno not in _UNUSABLE or error.filename is None:
            raise
        typer.echo(f"{error.filename}: {error.strerror}", err=True)
        raise typer.Exit(2) from error
    except (MemoryError, RuntimeError) as error:
        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit == resource.RLIM_INFINITY or (isinstance(error, RuntimeError) and _NO_THREAD not in str(error)):
            raise
        typer.echo(f"out of memory ({str(error) or type(error).__name__}): {_too_small(limit)}", err=True)
        raise typer.Exit(1) from error
