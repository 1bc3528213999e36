"""Source: ASAM MDF version 4 (MF4), the format of vehicle and test bench recorders."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service.interchange.source import CHUNK_ROWS, Array, Reference, Source, SourceError, Timing, equally_long, readable

_SAME_TIME_S = 1e-9


class MdfSource(Source):
    """An MF4 file, read piece by piece.

    A channel is named by its own name where that is unique, and always ``number of its group/name``. ``time`` is the
    time column of the first channel that is asked for together with it.
    """

    kind, package, entry = "MF4", "asammdf", "channel"

    def __init__(self, path: Path) -> None:
        places: dict[str, tuple[int, int]] = {}
        with readable(path, self.kind, self.package):
            from asammdf import MDF  # noqa: PLC0415  # an extra
            from asammdf.blocks.mdf_v4 import MDF4  # noqa: PLC0415

            # What it has half read of a damaged file it cannot close, and says so with a traceback beside ours.
            MDF4.__del__ = lambda _: None  # type: ignore[method-assign]
            logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # its errors come as exceptions as well
            if not path.is_file():
                raise SourceError(f"{path}: no such file")
            self._file: Any = MDF(path)
            for name, found in self._file.channels_db.items():
                for group, index in found:
                    if index != self._file.masters_db.get(group):
                        places[f"{group}/{name}"] = (group, index)
                        if len(found) == 1:
                            places[name] = (group, index)
        super().__init__(path, {"time": None} | places)

    def timing(self, columns: Sequence[Reference]) -> Timing:  # noqa: ARG002
        """Start of the measurement; every row has its own time."""
        return Timing(start_ns=self._start_ns(), time=Reference("time"))

    def unit(self, column: Reference) -> str:
        """Unit of the channel."""
        if column.column == "time":
            return "s"
        group, index = self._column(column)
        return str(self._file.groups[group].channels[index].unit or "")

    def chunks(self, columns: Sequence[Reference]) -> Iterator[tuple[Array, ...]]:
        """Rows, `CHUNK_ROWS` at a time; channels of several groups must have the same times."""
        places = [self._column(reference) for reference in columns]
        asked = [reference for reference, place in zip(columns, places, strict=True) if place is not None]
        groups = [place[0] for place in places if place is not None]
        if not groups:
            raise SourceError(f"{self.path}: time alone is no measurement, expected a channel as well")
        counts = [int(self._file.groups[group].channel_group.cycles_nr) for group in groups]
        count = equally_long(self.path, asked, counts)
        with readable(self.path, self.kind, self.package):
            for first in range(0, count, CHUNK_ROWS):
                signals = [None if place is None else self._read(place, first) for place in places]
                present = [signal for signal in signals if signal is not None]
                for reference, signal in zip(asked, present, strict=True):
                    if np.abs(signal.timestamps - present[0].timestamps).max(initial=0.0) > _SAME_TIME_S:
                        raise SourceError(f"{self.path}: channels {asked[0]} and {reference} have different times")
                yield tuple(
                    present[0].timestamps if signal is None else np.asarray(signal.samples) for signal in signals
                )

    def values(self, column: str) -> Array:
        """Read a channel whole."""
        group, index = self._column(Reference(column))
        with readable(self.path, self.kind, self.package):
            return np.asarray(self._file.get(group=group, index=index).samples)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, place: tuple[int, int], first: int) -> Any:
        return self._file.get(group=place[0], index=place[1], record_offset=first, record_count=CHUNK_ROWS)

    def _start_ns(self) -> int:
        start = np.datetime64(self._file.header.start_time.replace(tzinfo=None), "ns")
        offset = self._file.header.start_time.utcoffset()
        return int(start.astype(np.int64)) - (0 if offset is None else round(offset.total_seconds() * 1e9))
