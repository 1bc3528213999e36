"""What an importer asks of a file. A new format is one class, and a row of `service.interchange.formats`.

A source hands out columns as the file has them, in pieces, and what the file itself says of time and units. It checks
nothing: units, times and numbers are judged in one place for all formats.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from models.errors import MachineFileError
from models.mistakes import did_you_mean

CHUNK_ROWS = 65536  # rows that are read at a time

Array = npt.NDArray[Any]


class SourceError(MachineFileError):
    """A file from another program cannot be imported; the message names file, column and, where there is one, row."""


@dataclass(frozen=True, slots=True)
class Reference:
    """A column of a file."""

    column: str  # name of the column, array, channel or data set
    # Which column of an array with two dimensions, counted from 0; samples run along its longer side.
    index: int | None = None

    def __str__(self) -> str:
        return self.column if self.index is None else f"{self.column}[{self.index}]"


@dataclass(frozen=True, slots=True)
class Timing:
    """What a file says about the time of its rows."""

    rate_hz: float | None = None  # samples per second
    start_ns: int | None = None  # time of the first row (or of time 0 in `time`), nanoseconds since 1970-01-01 UTC
    # The column with the time of each row, in seconds from `start_ns`, where the format has one by itself.
    time: Reference | None = None


class Source:
    """An open file of named columns; a context manager.

    A format says how its columns are found, and of these methods what is otherwise than here: columns that have a
    length and can be sliced, in a file that knows neither time nor units. `columns` are what the format's library has
    for each, by name. Opening a file that is not of the format raises `SourceError`.
    """

    kind: ClassVar[str]  # what the format is called
    package: ClassVar[str] = ""  # package of the extra ``io`` that reads it
    entry: ClassVar[str] = "column"  # what the format calls a column

    def __init__(self, path: Path, columns: Mapping[str, Any]) -> None:
        self.path = path
        self._columns = columns

    def names(self) -> tuple[str, ...]:
        """Columns that there are."""
        return tuple(self._columns)

    def named(self, column: str) -> str:
        """Return the name of a column that there is.

        Raises
        ------
        SourceError
            For another one, naming those that there are.
        """
        names = self.names()
        if column not in names:
            there = ", ".join(names[:40]) + (f" and {len(names) - 40} more" if len(names) > 40 else "")
            # What is left out most often is a unit behind the name.
            near = [name for name in names if _bare(name) == _bare(column)]
            meant = f"; did you mean {near[0]!r}?" if len(near) == 1 else did_you_mean(column, names)
            raise SourceError(f"{self.path}: no {self.entry} {column!r}; there are {there or 'none'}{meant}")
        return column

    def timing(self, columns: Sequence[Reference]) -> Timing:  # noqa: ARG002  # others need them
        """What the file says of the time of these columns; raises `SourceError` if they contradict each other."""
        return Timing()

    def unit(self, column: Reference) -> str:  # noqa: ARG002  # others need it
        """Unit that the file states for a column, or an empty string."""
        return ""

    def chunks(self, columns: Sequence[Reference]) -> Iterator[tuple[Array, ...]]:
        """Go through the rows from the first one on, `CHUNK_ROWS` at a time; may be asked again.

        Yields
        ------
        tuple of ndarray, shape (n_rows,)
            One per column and of the same length, numbers or datetime64 as the file has them.
        """
        lengths, reads = zip(*(self._rows(reference) for reference in columns), strict=True) if columns else ((), ())
        count = equally_long(self.path, columns, lengths)
        with readable(self.path, self.kind, self.package):
            for first in range(0, count, CHUNK_ROWS):
                rows = slice(first, min(first + CHUNK_ROWS, count))
                yield tuple(np.asarray(read(rows)) for read in reads)

    def values(self, column: str) -> Array:
        """Read an array that is no column of samples, such as scales or times of pulses, as the file has it."""
        with readable(self.path, self.kind, self.package):
            return np.ravel(np.asarray(self._column(Reference(column))[...]))

    def close(self) -> None:
        """Close the file, if it is still open."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _column(self, reference: Reference) -> Any:
        """What the library has for a column that has no index."""
        found = self._columns[self.named(reference.column)]
        if reference.index is not None:
            raise SourceError(f"{self.path}: {self.entry} {reference}: index is for tables within .npz and .mat files")
        return found

    def _rows(self, reference: Reference) -> tuple[int, Callable[[slice], Any]]:
        """Length of a column, and what reads some of its rows."""
        column = self._column(reference)
        return len(column), column.__getitem__


def _bare(name: str) -> str:
    """Name of a column without unit, blanks, and differences between capital and small letters."""
    return re.sub(r"\s+|[\[(].*", "", name).casefold()


def equally_long(path: Path, columns: Sequence[Reference], lengths: Sequence[int]) -> int:
    """Length of columns that belong together.

    Raises
    ------
    SourceError
        Naming two whose lengths differ.
    """
    for reference, length in zip(columns, lengths, strict=True):
        if length != lengths[0]:
            raise SourceError(
                f"{path}: column {reference} has {length} rows, column {columns[0]} has {lengths[0]}; expected the same"
            )
    return lengths[0] if lengths else 0


@contextmanager
def readable(path: Path, kind: str, package: str = "") -> Iterator[None]:
    """Say clearly that a file is damaged or not of this kind, or which package reads it.

    Raises
    ------
    SourceError
        For whatever a format's library raises on a bad file: most of them know no errors of their own.
    """
    try:
        yield
    except MachineFileError:
        raise
    except ModuleNotFoundError as error:
        raise SourceError(
            f"{path}: reading {kind} files needs the package {package}: pip install 'rotorwatch[io]'"
        ) from error
    except FileNotFoundError as error:
        raise SourceError(f"{path}: no such file") from error
    except OSError as error:
        raise SourceError(f"{path}: cannot be read as a {kind} file ({error.strerror or error})") from error
    except Exception as error:
        raise SourceError(f"{path}: damaged, or no {kind} file: {str(error) or type(error).__name__}") from error


def as_numbers(path: Path, reference: Reference, column: Array, first_row: int) -> npt.NDArray[np.float64]:
    """Samples of a column as float64.

    Raises
    ------
    SourceError
        If they are no numbers.
    """
    if column.dtype.kind not in "fiub":
        raise SourceError(
            f"{path}: column {reference} from row {first_row + 1} on holds {column.dtype}, expected real numbers"
        )
    return np.asarray(column, dtype=np.float64)
