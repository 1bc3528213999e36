"""A file that says how a program connects to Zenoh: one table ``[link]``, as in the settings of a monitor."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from models.errors import MachineFileError
from models.machine import read_toml, validation_text
from models.signals.link import LinkSettings

__all__ = ["load_link"]


class _LinkFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True)

    link: LinkSettings


def load_link(path: Path) -> LinkSettings:
    """Load a link file; files named in it are taken from its folder.

    Raises
    ------
    MachineFileError
        Naming the file, the field and what was expected. Passwords, certificates and keys are read and checked when a
        session is opened.
    """
    try:
        link = _LinkFile.model_validate(read_toml(path)).link
    except ValidationError as error:
        raise MachineFileError(validation_text(path, error)) from error
    if not link.listen and not link.connect:
        raise MachineFileError(f"{path}: link: expected endpoints in listen or connect, found neither")
    return link.beside(path.parent)
