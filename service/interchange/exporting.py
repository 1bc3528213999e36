"""Export of a table from recordings to a file for other programs, with units."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from models.errors import MachineFileError, RecordingError
from models.signals.recording import writing
from service.interchange.exported import Selection, Table, alarm_table, report_table, stream_table
from service.interchange.source import Array
from service.recordings.replay.source import clock

ExportFormat = Literal["parquet", "csv", "mat"]
ExportSubject = Literal["stream", "reports", "alarms"]

_OTHER_PROGRAMS = {".parquet", ".csv", ".mat", ".xlsx", ".xls"}
_LARGEST_MATLAB = 2**31 - 1
_TABLES = {"stream": stream_table, "reports": report_table, "alarms": alarm_table}


def export(
    selection: Selection, what: ExportSubject, kind: ExportFormat, out: Path, *, overwrite: bool = False
) -> Table:
    """Write a table and return it, with its number of rows and the messages that were skipped.

    Parquet has ``unit`` and ``description`` in the metadata of its fields; CSV has ``name [unit]`` in its header; .mat
    has a struct per column with its samples, unit and description. Parquet and CSV are written while the recordings are
    read; a .mat file is assembled in memory. An incomplete file is removed.

    Raises
    ------
    MachineFileError
        If the file already exists or has the ending of another format, or the time that is wanted ends before it
        begins.
    RecordingError
        If the recordings cannot be read or hold none of the requested data, or the file cannot be written.
    """
    if out.suffix in _OTHER_PROGRAMS - {f".{kind}"}:  # Excel, for one, refuses a CSV file that is named .xlsx
        raise MachineFileError(f"{out}: expected a name that ends in .{kind}, as the format is {kind}")
    if out.exists() and not overwrite:
        raise MachineFileError(f"{out}: already exists; --overwrite replaces it")
    if selection.from_ns is not None and selection.to_ns is not None and selection.from_ns >= selection.to_ns:
        raise MachineFileError(
            f"--from is {clock(selection.from_ns)}, not before --to-time {clock(selection.to_ns)} UTC"
        )
    if any(path.exists() and out.exists() and path.samefile(out) for path in selection.source.paths):
        raise RecordingError(f"{out}: is one of the recordings")
    table = _TABLES[what](selection)
    with _completed(out) as part:
        match kind:
            case "parquet":
                with pa.parquet.ParquetWriter(part, table.schema, compression="zstd") as writer:
                    for batch in table.batches:
                        writer.write_batch(batch)
            case "csv":
                _write_csv(table, part)
            case "mat":
                _write_matlab(table, part)
        if table.rows == 0:
            names = ", ".join(map(str, selection.source.paths))
            why = f" ({table.skipped[0]})" if table.skipped else ""
            if selection.from_ns is not None or selection.to_ns is not None:
                span = selection.source.span(selection.keys)
                data = f"the data are of {clock(span.start_ns)} to {clock(span.end_ns)} UTC"
                why = f" in the time that is wanted; {data}{why}"
            if what != "stream" and selection.keys.report not in selection.source.keys:
                why += ": only a monitor records them; rotorwatch replay --offline computes them from the samples"
            raise RecordingError(f"{names}: no {what}{why}")
    return table


@contextmanager
def _completed(out: Path) -> Iterator[Path]:
    """Write to a temporary name, and rename the file when it is complete."""
    if out.is_dir():
        raise RecordingError(f"{out}: is a folder, expected the name of a file")
    if out.exists() and not out.is_file():
        raise RecordingError(f"{out}: is a device or pipe, expected the name of a file")
    part = out.with_name(out.name + ".part")
    try:
        with writing(out):
            part.touch()  # fails early with a clear error, unlike the libraries, if the folder does not exist
            yield part
            part.replace(out)
    finally:
        part.unlink(missing_ok=True)


def _write_csv(table: Table, part: Path) -> None:
    fields = []
    for field in table.schema:
        unit = field.metadata[b"unit"].decode()
        label = f"{field.name} [{unit}]" if unit and not field.name.endswith("_ns") else field.name
        fields.append(pa.field(label, field.type))
    plain = pa.schema(fields)
    with pa.csv.CSVWriter(part, plain, write_options=pa.csv.WriteOptions(quoting_style="needed")) as writer:
        for batch in table.batches:
            writer.write_batch(pa.record_batch(batch.columns, schema=plain))


def _write_matlab(table: Table, part: Path) -> None:
    from scipy.io import savemat  # noqa: PLC0415  # slow to import; only for these files

    whole = pa.Table.from_batches(list(table.batches), schema=table.schema)
    if whole.nbytes > _LARGEST_MATLAB:
        raise RecordingError(
            f"{part.with_suffix('')}: {whole.nbytes / 1e9:.2g} GB, but a .mat file of version 5 holds 2 GB at most; "
            "export a part with --from and --to-time, or Parquet, which MATLAB reads"
        )
    columns, taken = {}, set[str]()
    for field in table.schema:
        name = _matlab_name(field.name, taken)
        columns[name] = {
            "samples": _matlab_column(whole.column(field.name)),
            "name": field.name,
            "unit": field.metadata[b"unit"].decode(),
            "description": field.metadata[b"description"].decode(),
        }
    info = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
    savemat(part, {"data": columns, "info": info}, appendmat=False, oned_as="column", long_field_names=True)


def _matlab_column(column: pa.ChunkedArray) -> Array:
    if pa.types.is_string(column.type):
        return np.array([text or "" for text in column.to_pylist()], dtype=object)
    if column.null_count:
        return np.array([np.nan if value is None else value for value in column.to_pylist()], dtype=np.float64)
    return np.asarray(column.to_numpy())


def _matlab_name(name: str, taken: set[str]) -> str:
    """A field name that MATLAB accepts: letters, digits and _, beginning with a letter, at most 63."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    plain = (plain if plain[:1].isalpha() else f"x{plain}")[:60]
    unique = next(one for one in chain([plain], (f"{plain}_{number}" for number in count(2))) if one not in taken)
    taken.add(unique)
    return unique
