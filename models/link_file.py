"""A file that says how a program connects to Zenoh: one table ``[link]``, as in the settings of a monitor."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from models.errors import MachineFileError
from models.mistakes import checked, read_toml
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
    link = checked(_LinkFile, read_toml(path), path).link
    if not link.listen and not link.connect:
        raise MachineFileError(f"{path}: link: expected endpoints in listen or connect, found neither")
    return link.beside(path.parent)
