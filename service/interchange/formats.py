"""Which source reads which file."""

from importlib import import_module
from pathlib import Path

from service.interchange.mapping import Format, Mapping
from service.interchange.source import Source, SourceError

_SOURCES: dict[Format, tuple[str, tuple[str, ...]]] = {
    "csv": ("tables.CsvSource", (".csv", ".txt", ".tsv", ".csv.gz", ".txt.gz")),
    "parquet": ("tables.ParquetSource", (".parquet", ".pq")),
    "npz": ("arrays.NumpySource", (".npz",)),
    "mat": ("arrays.MatlabSource", (".mat", ".h5", ".hdf5")),
    "wav": ("arrays.WavSource", (".wav",)),
    "uff": ("acquisition.UniversalSource", (".uff", ".unv")),
    "tdms": ("acquisition.TdmsSource", (".tdms",)),
    "mf4": ("acquisition.MdfSource", (".mf4", ".mdf")),
}
"""Class in this package, imported when it is needed with the library that only it needs, and how files are named."""

DATED: tuple[Format, ...] = ("tdms", "mf4")  # formats whose files say when they were recorded


def format_of(path: Path, mapping: Mapping) -> Format | None:
    """Format that the mapping or the end of a file's name says; None if neither does."""
    named = (kind for kind, (_, suffixes) in _SOURCES.items() if path.name.lower().endswith(suffixes))
    return mapping.format or next(named, None)


def open_source(path: Path, mapping: Mapping) -> Source:
    """Open a file by the format that the mapping or the end of its name says.

    Raises
    ------
    SourceError
        If the format is not known, or the file is not of it.
    """
    if not path.is_file():
        raise SourceError(f"{path}: no such file")
    kind = format_of(path, mapping)
    if kind is None:
        suffixes = [suffix for _, those in _SOURCES.values() for suffix in those]
        raise SourceError(
            f"{path}: format {path.suffix or 'without a suffix'!r} is not known; say format = ... in the mapping, or "
            f"name the file {', '.join(suffixes)}"
        )
    module, _, name = _SOURCES[kind][0].partition(".")
    source = getattr(import_module(f"service.interchange.{module}"), name)
    found: Source
    if kind == "csv":
        base = mapping.time
        found = source(path, mapping.csv, base.column, datetimes=base.is_datetime, zone=base.zone or "UTC")
    elif kind == "parquet":
        found = source(path, zone=mapping.time.zone or "UTC")
    else:
        found = source(path)
    return found
