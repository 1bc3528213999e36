"""What the campaigns' commands write and read back: files that cannot be used are said to be so, by name."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from models.errors import RecordingError
from models.mistakes import mistakes

__all__ = ["read_numbers", "read_to_redraw", "writing"]

_Numbers = TypeVar("_Numbers", bound=BaseModel)


@contextmanager
def writing(place: Path) -> Iterator[None]:
    """Turn an error of the file system inside the block into one that names the file or folder being written.

    Raises
    ------
    RecordingError
        If it cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{place}: cannot be written ({error.strerror})") from error


def read_numbers(kind: type[_Numbers], path: Path) -> _Numbers:
    """Read back what a command wrote as JSON.

    Raises
    ------
    RecordingError
        If it is damaged.
    OSError
        If it is not there.
    """
    try:
        return kind.model_validate_json(path.read_text(encoding="utf-8"))
    except ValidationError as error:
        raise RecordingError("\n".join(f"{path}: {text}" for _, text in mistakes(error, kind))) from error


def read_to_redraw(kind: type[_Numbers], path: Path) -> _Numbers:
    """Read the numbers of an earlier run, for ``--redraw``.

    Raises
    ------
    RecordingError
        If there are none, or they are damaged.
    """
    try:
        return read_numbers(kind, path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}); run without --redraw first") from error
