"""Sources that hold named arrays: NumPy .npz, MATLAB .mat, WAV.

In all three an array is a set of columns, samples run along its longer side, and rows are sliced from memory (or from
the file, if it is memory-mapped).
"""

import os
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from service.interchange.source import Array, Reference, Source, SourceError, Timing, readable


class _Arrays(Source):
    """Columns of named arrays, sliced when their rows are read."""

    def _rows(self, reference: Reference) -> tuple[int, Callable[[slice], Any]]:
        array = self._column(Reference(reference.column))  # an ndarray, or a data set that slices like one
        name, asked, shape = f"{self.path}: {reference.column}", reference.index, tuple(int(n) for n in array.shape)
        if len(shape) == 1 and asked in (None, 0):
            return len(array), array.__getitem__
        if len(shape) != 2:
            raise SourceError(f"{name} has shape {shape}, expected one column or a table of columns")
        length, width = max(shape), min(shape)
        index = asked if asked is not None else 0 if width == 1 else -1
        if not 0 <= index < width:
            found = "" if asked is None else f" (found {asked})"
            raise SourceError(
                f"{name} has {width} columns of {length} samples, expected index = 0 to {width - 1}{found}"
            )
        along_first = shape[0] >= shape[1]
        return length, (lambda rows: array[rows, index]) if along_first else (lambda rows: array[index, rows])


class NumpySource(_Arrays):
    """A NumPy .npz file, read whole; its dates are in `zone`. Pickled objects are refused: they could run code."""

    kind = "NumPy .npz"

    def __init__(self, path: Path, *, zone: str = "UTC") -> None:
        with readable(path, self.kind):
            archive = np.load(path, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise SourceError(f"{path}: a single array, expected an archive of named arrays (.npz)")
            with archive:
                arrays = {}
                for name in archive.files:
                    try:
                        arrays[name] = _in_utc(archive[name], zone)
                    except ValueError as error:
                        if "allow_pickle" not in str(error):
                            raise
                        # Object arrays hold no samples; the other arrays can still be used.
            super().__init__(path, arrays)


def _in_utc(array: Array, zone: str) -> Array:
    """Convert dates, which have no time zone of their own in NumPy, from `zone`; other arrays stay as they are."""
    if zone == "UTC" or array.dtype.kind != "M":
        return array
    import pyarrow as pa  # noqa: PLC0415  # slow to import; only for these files

    from service.interchange.tables import as_array, of_zone  # noqa: PLC0415

    return as_array(of_zone(pa.array(array.ravel().astype("datetime64[ns]")), zone)).reshape(array.shape)


class MatlabSource(_Arrays):
    """A MATLAB .mat file: version 4 to 7 read whole, version 7.3 (HDF5) column by column.

    Fields are named ``struct.field``, in the third element of a struct array ``struct(3).field``; the contents of the
    third cell of a cell array ``cell{3}``.
    """

    kind, package = "MATLAB", "h5py"

    def __init__(self, path: Path) -> None:
        self._file: Any = None
        with readable(path, self.kind, self.package):
            with path.open("rb") as file:
                head = file.read(520)
            if b"\x89HDF\r\n\x1a\n" in (head[:8], head[512:520]):
                import h5py  # noqa: PLC0415  # an extra; only for these files

                self._file = h5py.File(path, "r")
                found: dict[str, Any] = {}
                self._file.visititems(lambda name, item: _collect_hdf5(found, name, item))
                super().__init__(path, found)
            else:
                from scipy.io import loadmat  # noqa: PLC0415  # slow to import; only for these files

                content = loadmat(path, squeeze_me=True)
                own = (_arrays_in(name, value) for name, value in content.items() if not name.startswith("__"))
                super().__init__(path, dict(chain.from_iterable(own)))

    def unit(self, column: Reference) -> str:
        """Attribute ``unit`` or ``units`` of an HDF5 data set; MATLAB writes none.

        Where `scale_factor` turns the numbers into that unit, it says so, so that they are not taken for values in it.
        """
        attributes = getattr(self._columns[column.column], "attrs", {})
        stated = np.ravel(attributes.get("unit", attributes.get("units", "")))
        one = stated[0] if stated.size == 1 else ""
        text = one.decode(errors="replace") if isinstance(one, bytes) else str(one) if isinstance(one, str) else ""
        return f"{text} after scale_factor".lstrip() if "scale_factor" in attributes else text

    def close(self) -> None:
        """Close the file, if it is still open."""
        if self._file is not None:
            self._file.close()


_UNKNOWN_SIZE = 0xFFFFFFFF  # size field of a data chunk whose length was not known when it was written


class WavSource(_Arrays):
    """A WAV file; its channels are named ``1``, ``2`` and so on. It is memory-mapped if its number format allows.

    Integers are converted to fractions of full scale, so `scale` in the mapping is the value at full scale.
    """

    kind = "WAV"

    def __init__(self, path: Path) -> None:
        from scipy.io import wavfile  # noqa: PLC0415  # slow to import; only for these files

        self._check_whole(path)
        with readable(path, self.kind), warnings.catch_warnings():
            warnings.simplefilter("ignore", wavfile.WavFileWarning)  # other programs' chunks, which the library skips
            try:
                rate, samples = wavfile.read(path, mmap=True)
            except ValueError:  # 24 bits cannot be mapped
                rate, samples = wavfile.read(path)
        table = samples[:, None] if samples.ndim == 1 else samples
        self._rate_hz = float(rate) or None  # 0 means unknown
        super().__init__(path, {str(number + 1): table[:, number] for number in range(table.shape[1])})

    def _check_whole(self, path: Path) -> None:
        """Refuse a truncated file, which would otherwise be read without any error."""
        with readable(path, self.kind), path.open("rb") as file:
            order, frame, long_size = (">" if file.read(12)[:4] == b"RIFX" else "<"), 1, 0
            while len(head := file.read(8)) == 8:
                name, size = struct.unpack(f"{order}4sI", head)
                if name == b"data":
                    size, there = long_size or size, path.stat().st_size - file.tell()
                    if size == 0 and there >= frame:
                        raise SourceError(
                            f"{path}: was not finished: its header says 0 samples, but {there // frame} of each "
                            "channel follow; repair it, such as with sox --ignore-length"
                        )
                    if size == _UNKNOWN_SIZE or size <= there:
                        return
                    raise SourceError(
                        f"{path}: is truncated: {there // frame} samples of each channel are there, "
                        f"expected the {size // frame} that its header says"
                    )
                content = file.read(min(size, 16))
                if name == b"fmt " and len(content) == 16:
                    (frame,) = struct.unpack_from(f"{order}H", content, 12)
                elif name == b"ds64":
                    (long_size,) = struct.unpack_from("<Q", content, 8)
                file.seek(size + size % 2 - len(content), os.SEEK_CUR)

    def timing(self, columns: Sequence[Reference]) -> Timing:  # noqa: ARG002
        """Rate from the header, in whole Hz; WAV has no start time."""
        return Timing(rate_hz=self._rate_hz, rounded_hz=0.5)

    def unit(self, column: Reference) -> str:
        """``of full scale`` for integers, so that they are not silently taken for values in the channel's unit."""
        return "of full scale" if self._columns[column.column].dtype.kind in "iu" else ""

    def chunks(self, columns: Sequence[Reference]) -> Iterator[tuple[Array, ...]]:
        """Rows, `CHUNK_ROWS` at a time, integers as fractions of full scale."""
        for chunk in super().chunks(columns):
            yield tuple(_over_full_scale(column) for column in chunk)


def _over_full_scale(column: Array) -> Array:
    if column.dtype.kind == "u":
        return np.asarray((column.astype(np.float64) - 128) / 128)
    if column.dtype.kind == "i":
        return np.asarray(column / float(2 ** (8 * column.dtype.itemsize - 1)))
    return column


def _arrays_in(name: str, value: Any) -> Iterator[tuple[str, Array]]:
    """Numeric arrays of a variable, including those in structs and cells, by their MATLAB names."""
    array = np.asarray(value)
    if array.dtype.names is not None:  # structs
        for number, struct in enumerate(array.ravel(order="F")):
            place = name if array.size == 1 else f"{name}({number + 1})"
            for field in array.dtype.names:
                yield from _arrays_in(f"{place}.{field}", struct[field])
    elif array.dtype == object and isinstance(value, np.ndarray):  # excludes sparse matrices
        for number, inner in enumerate(array.ravel(order="F")):
            yield from _arrays_in(f"{name}{{{number + 1}}}", inner)
    elif array.dtype.kind in "fiub":
        yield name, np.atleast_1d(array)


def _collect_hdf5(found: dict[str, Any], name: str, item: Any, within: tuple[str, ...] = (), place: str = "") -> None:
    """Collect numeric data sets in `found`. MATLAB stores (n, m) tables as (m, n); samples run along the longer side.

    Cells, and fields of struct arrays, are references to objects elsewhere in the file, which are followed.
    """
    name = place + name
    if name.startswith("#") or getattr(item, "shape", None) is None:  # a group, or a data set without any value
        return
    if item.dtype.kind == "O" and item.dtype.metadata and "ref" in item.dtype.metadata:
        parent, _, field = name.rpartition("/")
        is_cell = not parent or item.attrs.get("MATLAB_class", b"") == b"cell"
        for number, reference in enumerate(np.ravel(item[()])):
            place = f"{name}{{{number + 1}}}" if is_cell else f"{parent}({number + 1})/{field}"
            if not reference or (inner := item.file[reference]).name in within:  # null reference, or a cycle
                continue
            inside = (*within, inner.name)
            _collect_hdf5(found, place, inner, inside)
            if hasattr(inner, "visititems"):
                inner.visititems(partial(_collect_hdf5, found, within=inside, place=f"{place}/"))
        return
    is_array = item.ndim <= 2 and item.size > 0 and item.dtype.kind in "fiu"
    if is_array and item.attrs.get("MATLAB_class", b"") != b"char":
        found[name.replace("/", ".")] = item
