"""The option ``--version`` of both programs."""

from typing import Annotated

import typer

__all__ = ["VersionOption"]


def _say_version(context: typer.Context, wanted: bool) -> None:
    if wanted:
        from rotorwatch import __version__  # noqa: PLC0415  # brings pydantic, which nothing else here waits for

        typer.echo(f"{context.find_root().info_name} {__version__}")
        raise typer.Exit


VersionOption = Annotated[
    bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Say the version, and nothing else.")
]
