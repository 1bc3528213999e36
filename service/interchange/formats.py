"""Formats of files that are imported: one row per format."""

from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Any, Self


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

    @property
    def reader(self) -> Any:
        """The `Source` class that reads this format."""
        module, _, name = self.source.partition(".")
        return getattr(import_module(f"service.interchange.{module}"), name)
