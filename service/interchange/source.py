"""Interface of file formats to the importer. A new format is one class, and a row of `Format`.

A source yields columns as they are in the file, in pieces, and the time and units that the file states. It does not
check them: units, times and numbers are checked in one place for all formats.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from models.errors import MachineFileError
from models.mistakes import did_you_mean

CHUNK_ROWS = 65536  # rows read at a time

Array = npt.NDArray[Any]


class SourceError(MachineFileError):
    """A file from another program cannot be imported; the message names file, column and, where there is one, row."""


class Format(StrEnum):
    """Format of a file."""

    source: str  # class in this package, imported together with its library when needed
    suffixes: tuple[str, ...]  # endings of file names
    dated: bool  # whether files state when they were recorded

    def __new__(cls, name: str, source: str, suffixes: tuple[str, ...], dated: bool = False) -> Self:
        """Create a member from its name in a mapping, class, suffixes, and whether files are dated."""
        kind = str.__new__(cls, name)
        kind._value_, kind.source, kind.suffixes, kind.dated = name, source, suffixes, dated
        return kind

    CSV = "csv", "tables.CsvSource", (".csv", ".txt", ".tsv", ".csv.gz", ".txt.gz")
    PARQUET = "parquet", "tables.ParquetSource", (".parquet", ".pq")
    NPZ = "npz", "arrays.NumpySource", (".npz",)
    MAT = "mat", "arrays.MatlabSource", (".mat", ".h5", ".hdf5")
    WAV = "wav", "arrays.WavSource", (".wav",)
    UFF = "uff", "acquisition.UniversalSource", (".uff", ".unv")
    TDMS = "tdms", "acquisition.TdmsSource", (".tdms",), True
    MF4 = "mf4", "acquisition.MdfSource", (".mf4", ".mdf"), True

    @classmethod
    def of(cls, path: Path) -> Self | None:
        """Format by the ending of a file's name; None if unknown."""
        return next((kind for kind in cls if path.name.lower().endswith(kind.suffixes)), None)

    def open(self, path: Path, **options: Any) -> "Source":
        """Open a file with the `Source` class that reads this format."""
        module, _, name = self.source.partition(".")
        found: Source = getattr(import_module(f"service.interchange.{module}"), name)(path, **options)
        return found


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
    """Time base that a file states for its rows."""

    rate_hz: float | None = None  # samples per second
    start_ns: int | None = None  # time of the first row (or of time 0 in `time`), nanoseconds since 1970-01-01 UTC
    # Column with the time of each row, in seconds since `start_ns`, if the format defines one.
    time: Reference | None = None
    rounded_hz: float = 0.0  # by how much the format rounds `rate_hz`


class Source(AbstractContextManager["Source", None]):
    """An open file of named columns.

    A subclass finds the columns of its format and passes them as `columns`, objects of the format's library by name.
    The methods here serve columns that have a length and can be sliced, in a file without time and units; a subclass
    overrides those that differ. Opening a file that is not of the format raises `SourceError`.
    """

    kind: ClassVar[str]  # name of the format
    package: ClassVar[str] = ""  # package of the extra ``io`` that reads it
    entry: ClassVar[str] = "column"  # the format's word for a column
    cut: bool = False  # whether it ends before what its writer had begun is complete

    def __init__(self, path: Path, columns: Mapping[str, Any]) -> None:
        self.path = path
        self._columns = columns

    def names(self) -> tuple[str, ...]:
        """Names of all columns."""
        return tuple(self._columns)

    def named(self, column: str) -> str:
        """Check that a column exists, and return its name.

        Raises
        ------
        SourceError
            If it does not exist; the message lists the columns.
        """
        names = self.names()
        if column not in names:
            there = ", ".join(names[:40]) + (f" and {len(names) - 40} more" if len(names) > 40 else "")
            # The most common mistake is to leave out the unit that follows the name.
            near = [name for name in names if _bare(name) == _bare(column)]
            meant = f"; did you mean {near[0]!r}?" if len(near) == 1 else did_you_mean(column, names)
            raise SourceError(f"{self.path}: no {self.entry} {column!r}; there are {there or 'none'}{meant}")
        return column

    def timing(self, columns: Sequence[Reference]) -> Timing:  # noqa: ARG002  # for subclasses
        """Time base that the file states for these columns; raises `SourceError` if they contradict each other."""
        return Timing()

    def unit(self, column: Reference) -> str:  # noqa: ARG002  # for subclasses
        """Unit that the file states for a column, or an empty string."""
        return ""

    def chunks(self, columns: Sequence[Reference]) -> Iterator[tuple[Array, ...]]:
        """Iterate over all rows, `CHUNK_ROWS` at a time; may be called repeatedly.

        Yields
        ------
        tuple of ndarray, shape (n_rows,)
            One array per column, all of the same length, numbers or datetime64 as in the file.
        """
        lengths, reads = zip(*(self._rows(reference) for reference in columns), strict=True) if columns else ((), ())
        count = equally_long(self.path, columns, lengths)
        with readable(self.path, self.kind, self.package):
            for first in range(0, count, CHUNK_ROWS):
                rows = slice(first, min(first + CHUNK_ROWS, count))
                yield tuple(np.asarray(read(rows)) for read in reads)

    def values(self, column: str) -> Array:
        """Read an array that is not a column of samples, such as scales or pulse times, as it is in the file."""
        with readable(self.path, self.kind, self.package):
            return np.ravel(np.asarray(self._column(Reference(column))[...]))

    def close(self) -> None:
        """Close the file, if it is still open."""

    def __exit__(self, *_: object) -> None:
        self.close()

    def _column(self, reference: Reference) -> Any:
        """The library's object for a column without index."""
        found = self._columns[self.named(reference.column)]
        if reference.index is not None:
            raise SourceError(f"{self.path}: {self.entry} {reference}: index is for tables within .npz and .mat files")
        return found

    def _rows(self, reference: Reference) -> tuple[int, Callable[[slice], Any]]:
        """Length of a column, and a function that reads a slice of its rows."""
        column = self._column(reference)
        return len(column), column.__getitem__


ONE_RATE = "write the file with one rate, or leave one of them out of the mapping and of the machine file"
"""Advice in errors on a file whose columns differ in rate or length."""


def _bare(name: str) -> str:
    """Name of a column without unit and blanks, case-folded, for comparison."""
    return re.sub(r"\s+|[\[(].*", "", name).casefold()


def equally_long(path: Path, columns: Sequence[Reference], lengths: Sequence[int]) -> int:
    """Common length of columns.

    Raises
    ------
    SourceError
        If lengths differ, naming two columns.
    """
    for reference, length in zip(columns, lengths, strict=True):
        if length != lengths[0]:
            raise SourceError(
                f"{path}: column {reference} has {length} rows, column {columns[0]} has {lengths[0]}; "
                f"expected the same: {ONE_RATE}"
            )
    return lengths[0] if lengths else 0


@contextmanager
def readable(path: Path, kind: str, package: str = "") -> Iterator[None]:
    """Convert errors in reading to clear ones: damaged file, not of this kind, or the package that is missing.

    Raises
    ------
    SourceError
        For any exception of a format's library: most libraries have no error class for bad files.
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
