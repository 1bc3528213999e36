"""Which source reads which file."""

from pathlib import Path

from service.interchange.mapping import Mapping
from service.interchange.source import Source, SourceError

__all__ = ["open_source"]

_SUFFIXES = {
    ".csv": "csv",
    ".txt": "csv",
    ".tsv": "csv",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".npz": "npz",
    ".mat": "mat",
    ".wav": "wav",
    ".uff": "uff",
    ".unv": "uff",
    ".tdms": "tdms",
    ".mf4": "mf4",
    ".mdf": "mf4",
}


def open_source(path: Path, mapping: Mapping) -> Source:  # noqa: PLR0911  # one return per format
    """Open a file by the format that the mapping or the end of its name says.

    Raises
    ------
    SourceError
        If the format is not known, or the file is not of it.
    """
    if not path.is_file():
        raise SourceError(f"{path}: no such file")
    kind = mapping.format or _SUFFIXES.get(path.suffix.lower())
    match kind:  # each imports what only it needs
        case "csv":
            from service.interchange.tables import CsvSource  # noqa: PLC0415

            return CsvSource(path, mapping.csv, mapping.time.column, datetimes=mapping.time.is_datetime)
        case "parquet":
            from service.interchange.tables import ParquetSource  # noqa: PLC0415

            return ParquetSource(path)
        case "npz":
            from service.interchange.arrays import NumpySource  # noqa: PLC0415

            return NumpySource(path)
        case "mat":
            from service.interchange.arrays import MatlabSource  # noqa: PLC0415

            return MatlabSource(path)
        case "wav":
            from service.interchange.arrays import WavSource  # noqa: PLC0415

            return WavSource(path)
        case "uff":
            from service.interchange.universal import UniversalSource  # noqa: PLC0415

            return UniversalSource(path)
        case "tdms":
            from service.interchange.tdms import TdmsSource  # noqa: PLC0415

            return TdmsSource(path)
        case "mf4":
            from service.interchange.mdf import MdfSource  # noqa: PLC0415

            return MdfSource(path)
    raise SourceError(
        f"{path}: format {path.suffix or 'without a suffix'!r} is not known; say format = ... in the mapping, or name "
        f"the file {', '.join(_SUFFIXES)}"
    )
