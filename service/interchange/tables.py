"""Sources that hold tables: CSV and Parquet, read piece by piece through Arrow."""

import codecs
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet

from service.interchange.mapping import CsvFormat
from service.interchange.source import CHUNK_ROWS, Array, Reference, Source, SourceError, readable

_BYTES = 4 << 20
_HEAD = 100  # rows after which a line with too few cells is no sign of a wrong [csv] table in the mapping
_NO_ROW = "; delete this line if it is no whole row"
_NUMBER = r"[-+]?[\d.,]+([eE][-+]?\d+)?"
_GROUPED = r"[-+]?\d{1,3}([.,' ]\d{3})+([.,]\d+)?"  # a number such as 1,899.62, with separators of thousands
_DOTTED_DATE = r"^(\d\d)\.(\d\d)\.(\d{4})\b", r"\3-\2-\1"  # dots mean that the day comes first
_DECIMAL_COMMA = r"(:\d\d),(\d)", r"\1.\2"  # also a sign of ISO 8601, which Arrow does not read
_ZONED = r"(Z|[T ].*[+-]\d\d(:?\d\d)?)$"


class _Table(Source):
    """Base class of both tables; the time column is named in the mapping."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        super().__init__(path, dict.fromkeys(names))
        self._twice = {name for name in names if names.count(name) > 1}

    def values(self, column: str) -> Array:
        """Read a column that may be shorter than others; empty cells are left out."""
        pieces = [piece for (piece,) in self.chunks([Reference(column)])]
        joined = np.concatenate(pieces) if pieces else np.empty(0)
        return np.asarray(joined[~np.isnan(joined)])

    def _checked(self, columns: Sequence[Reference]) -> list[str]:
        for reference in columns:
            self._column(reference)
            if reference.column in self._twice:
                raise SourceError(
                    f"{self.path}: there are several columns named {reference.column!r}, expected a name of its own "
                    "for each: change them in the file"
                )
        return [reference.column for reference in columns]


class CsvSource(_Table):
    """A text table. Columns without a header are named ``1``, ``2`` and so on.

    With `datetimes`, the time column has ISO 8601 times or dates such as 31.01.2026, in `zone` unless they state one.
    If its first cells are integers it is read as such, because nanoseconds since 1970 have more digits than a float.
    """

    kind = "CSV"

    def __init__(
        self, path: Path, form: CsvFormat, time_column: str | None, *, datetimes: bool, zone: str = "UTC"
    ) -> None:
        self._form, self._time_column, self._zone = form, time_column, zone
        self._time_type = pa.string() if datetimes else pa.float64()
        try:
            with readable(path, self.kind), self._reader(path, ()) as reader:
                schema = reader.schema
                labels = list(schema.names)
        except SourceError as error:
            if not isinstance(error.__cause__, pa.ArrowInvalid | UnicodeError) or not path.stat().st_size:
                raise
            told = self._error_text(error)
            with path.open("rb") as file:
                if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
                    told = f'{path}: is in UTF-16; write encoding = "utf-16" in [csv] in the mapping'
                    raise SourceError(told) from error
            if told.endswith(_NO_ROW):
                raise SourceError(told) from error
            raise SourceError(
                f"{told}; taken as {form.encoding} with {form.delimiter!r} between cells and "
                f"{form.skip_lines} lines before the table: [csv] in the mapping says otherwise, with encoding, "
                "delimiter, decimal, header and skip_lines"
            ) from error
        names = [label.strip() if form.header else str(number + 1) for number, label in enumerate(labels)]
        if not datetimes and time_column in names and schema.field(names.index(time_column)).type == pa.int64():
            self._time_type = pa.int64()
        # Arrow's own names: with surrounding blanks, or generated if there is no header.
        self._labels: dict[str, str] = dict(zip(names, labels, strict=True))
        super().__init__(path, names)

    def unit(self, column: Reference) -> str:
        """Unit in brackets at the end of a column's name, as in ``y1 [um]`` or ``y1 (um)``."""
        name = column.column
        for opening, closing in ("[]", "()"):
            if name.endswith(closing) and opening in name:
                return name[name.rindex(opening) + 1 : -1].strip()
        return ""

    def named(self, column: str) -> str:
        """Check that a column exists, and return its name; the error says if the header consists of numbers."""
        try:
            return super().named(column)
        except SourceError as error:
            if not self._form.header or not all(re.fullmatch(_NUMBER, name) for name in self.names()):
                raise
            raise SourceError(
                f"{error}; the first line has numbers: without names, write header = false in [csv], and columns are "
                "1, 2, ..."
            ) from error

    def chunks(self, columns: Sequence[Reference]) -> Iterator[tuple[Array, ...]]:
        """Rows, some megabytes of text at a time."""
        wanted = self._checked(columns)
        count = 0
        with readable(self.path, self.kind):
            try:
                with self._reader(self.path, wanted) as reader:
                    for batch in reader:
                        count += batch.num_rows
                        yield tuple(self._array(name, batch.column(self._labels[name])) for name in wanted)
            except pa.ArrowInvalid as error:
                raise SourceError(
                    self._fault(wanted) or f"{self.path}: after row {count}: {self._error_text(error)}"
                ) from error

    def _reader(self, path: Path, wanted: Sequence[str], *, as_text: bool = False) -> Any:
        form = self._form
        types: dict[str, Any] = {}
        for name in wanted:
            kind = self._time_type if name == self._time_column else pa.float64()
            types[self._labels[name]] = pa.string() if as_text else kind
        return pa.csv.open_csv(
            path,
            pa.csv.ReadOptions(
                use_threads=False,
                block_size=_BYTES,
                skip_rows=form.skip_lines,
                skip_rows_after_names=form.skip_lines_after_header,
                autogenerate_column_names=not form.header,
                encoding=form.encoding,
            ),
            pa.csv.ParseOptions(delimiter=form.delimiter),
            pa.csv.ConvertOptions(
                column_types=types,
                include_columns=list(types) or None,
                decimal_point=form.decimal,
                null_values=["", "NaN", "nan", "NA", "N/A", "null", *form.missing],
                strings_can_be_null=True,
            ),
        )

    def _array(self, name: str, column: Any) -> Array:
        return as_array(_utc(column, self._zone) if self._is_datetime(name) else column)

    def _error_text(self, error: Exception) -> str:
        """Arrow's message, rows counted from 1 without header lines; for one after many good rows, with a remedy."""
        before = self._form.skip_lines + self._form.header + self._form.skip_lines_after_header
        printed = "".join(one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in str(error))
        text = re.sub(r"Row #(\d+)", lambda found: f"row {int(found[1]) - before}", printed)
        short = re.search(r"row (\d+): Expected \d+ columns", text)
        return text + _NO_ROW if short and int(short[1]) > _HEAD else text

    def _fault(self, wanted: list[str]) -> str:
        """Message on the first cell that is not a number or time; empty if none is found."""
        row = 0
        with self._reader(self.path, wanted, as_text=True) as reader:
            try:
                for batch in reader:
                    for name in wanted:
                        for offset, cell in enumerate(batch.column(self._labels[name]).to_pylist()):
                            if cell is not None and not self._is_value(name, cell):
                                what = "a number"
                                if self._is_datetime(name):
                                    what = "an ISO 8601 time, or no time column but time.start and time.rate_hz"
                                if name == self._time_column and not self._is_datetime(name):
                                    what += ', or ISO 8601 times with time.unit = "datetime" in the mapping'
                                if self._form.decimal == "." and re.fullmatch(r"[-+]?\d+,\d+", cell.strip()):
                                    what += ", or decimal commas with csv.decimal in the mapping"
                                elif re.fullmatch(_GROUPED, cell.strip()):
                                    what += " without separators of thousands"
                                elif name != self._time_column:
                                    what += ", or csv.missing in the mapping has what stands where there is none"
                                if row + offset == 0 and re.search(r"[^\W\d_]", cell):
                                    what += (
                                        ", or csv.skip_lines_after_header in the mapping leaves lines of text out"
                                        if self._form.header
                                        else ", or names with csv.header = true in the mapping"
                                    )
                                return (
                                    f"{self.path}: row {row + offset + 1}, column {name!r}: found {cell!r}, "
                                    f"expected {what}"
                                )
                    row += batch.num_rows
            except pa.ArrowInvalid as error:
                return f"{self.path}: after row {row}: {self._error_text(error)}"
        return ""

    def _is_datetime(self, name: str) -> bool:
        return name == self._time_column and bool(pa.types.is_string(self._time_type))

    def _is_value(self, name: str, cell: str) -> bool:
        try:
            if self._is_datetime(name):
                _utc(pa.array([cell]), self._zone)
            else:
                whole, *parts = cell.strip().split(self._form.decimal)
                float(".".join([whole.replace(".", "x"), *parts]))  # a point in another place is no decimal sign
        except (ValueError, pa.ArrowInvalid):
            return False
        return True


class ParquetSource(_Table):
    """A Parquet file, read row group by row group; timestamps without a time zone are in `zone`."""

    kind = "Parquet"

    def __init__(self, path: Path, *, zone: str = "UTC") -> None:
        self._zone = zone
        with readable(path, self.kind), pa.parquet.ParquetFile(path) as file:
            self._schema = file.schema_arrow
        super().__init__(path, self._schema.names)

    def unit(self, column: Reference) -> str:
        """Field metadata ``unit``, or ``units``."""
        metadata = self._schema.field(column.column).metadata or {}
        return (metadata.get(b"unit") or metadata.get(b"units") or b"").decode(errors="replace")

    def chunks(self, columns: Sequence[Reference]) -> Iterator[tuple[Array, ...]]:
        """Rows, `CHUNK_ROWS` at a time."""
        wanted = self._checked(columns)
        for name in wanted:
            kind = self._schema.field(name).type
            numbers = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind)
            if not (numbers or pa.types.is_timestamp(kind)):
                raise SourceError(f"{self.path}: column {name!r} holds {kind}, expected numbers")
        # With pre_buffer, Arrow would keep everything that it has read in memory.
        with readable(self.path, self.kind), pa.parquet.ParquetFile(self.path, pre_buffer=False) as file:
            for batch in file.iter_batches(batch_size=CHUNK_ROWS, columns=wanted, use_threads=False):
                yield tuple(as_array(of_zone(batch.column(name), self._zone)) for name in wanted)


def _utc(cells: Any, zone: str) -> Any:
    """Convert ISO 8601 texts, or dates such as 31.01.2026, to Arrow timestamps in UTC; without a zone, in `zone`."""
    for written, iso in _DOTTED_DATE, _DECIMAL_COMMA:
        cells = pa.compute.replace_substring_regex(cells, written, iso)
    zoned = pa.compute.match_substring_regex(cells, _ZONED)
    in_utc = pa.compute.binary_join_element_wise(cells, "Z", "")
    times = pa.compute.if_else(zoned, cells, in_utc).cast(pa.timestamp("ns", tz="UTC"))
    return times if zone == "UTC" else pa.compute.if_else(zoned, times, of_zone(times.cast(pa.timestamp("ns")), zone))


def of_zone(times: Any, zone: str) -> Any:
    """Convert timestamps without a time zone from `zone` to UTC; for an hour that occurs twice, the first is taken."""
    if zone == "UTC" or not pa.types.is_timestamp(times.type) or times.type.tz is not None:
        return times
    since = pa.compute.assume_timezone(times, zone, ambiguous="earliest", nonexistent="latest")
    return since.cast(pa.timestamp("ns", tz="UTC"))


def as_array(column: Any) -> Array:
    """Convert an Arrow column to NumPy, with NaN for missing numbers and NaT for missing times."""
    if pa.types.is_timestamp(column.type):
        return np.asarray(column.cast(pa.timestamp("ns")).to_numpy(zero_copy_only=False))
    numbers = column.cast(pa.float64()) if pa.types.is_null(column.type) else column  # a column without any numbers
    return np.asarray(numbers.to_numpy(zero_copy_only=False))
