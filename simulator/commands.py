"""What ``rotorsim`` and ``rotortrain`` share: how an argument that is refused is told."""

from typing import Any

import typer
from typer.core import TyperGroup

__all__ = ["Commands"]


class Commands(TyperGroup):
    """The commands of a program; an argument that is refused is told like a field of a file."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command of the command line."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            from models.mistakes import argument_text  # noqa: PLC0415  # pydantic, which --help must not wait for

            error.message = argument_text(error) or error.message
            raise
