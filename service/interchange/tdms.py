"""Source: TDMS files of LabVIEW and DIAdem."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from service.interchange.arrays import equally_long
from service.interchange.source import CHUNK_ROWS, Array, Reference, SourceError, Timing, named, readable

__all__ = ["TdmsSource"]


class TdmsSource:
    """A TDMS file, read piece by piece. Channels are named ``group/channel``, or ``channel`` where that is unique.

    Parameters
    ----------
    path : Path

    Raises
    ------
    SourceError
        If it is not one.
    """

    path: Path

    def __init__(self, path: Path) -> None:
        self.path = path
        self._channels: dict[str, Any] = {}
        with readable(path, "TDMS", "npTDMS"):
            from nptdms import TdmsFile  # noqa: PLC0415  # an extra

            self._file = path.open("rb")  # ours, because the library leaves a file open that it cannot read
            try:
                self._tdms = TdmsFile.open(self._file)
                channels = [channel for group in self._tdms.groups() for channel in group.channels()]
            except BaseException:
                self._file.close()
                raise
        short = [channel.name for channel in channels]
        for channel in channels:
            self._channels[f"{channel.group_name}/{channel.name}"] = channel
        for channel in channels:
            if short.count(channel.name) == 1:
                self._channels.setdefault(channel.name, channel)

    def names(self) -> tuple[str, ...]:
        """Channels, by full and by short name."""
        return tuple(self._channels)

    def timing(self, columns: Sequence[Reference]) -> Timing:
        """Rate and start of the waveforms (``wf_increment``, ``wf_start_time``, ``wf_start_offset``)."""
        found: Timing | None = None
        for reference in columns:
            properties = self._channel(reference).properties
            increment_s = float(properties.get("wf_increment") or 0.0)
            timing = Timing(1 / increment_s if increment_s > 0 else None, _start_ns(properties))
            if found is not None and timing != found:
                raise SourceError(
                    f"{self.path}: channel {reference} starts or is sampled otherwise than {columns[0]}: {timing} "
                    f"and {found}"
                )
            found = timing
        return found or Timing()

    def unit(self, column: Reference) -> str:
        """Property ``unit_string``, or what NI-DAQ calls it."""
        properties = self._channel(column).properties
        return str(properties.get("unit_string") or properties.get("NI_UnitDescription") or "")

    def chunks(self, columns: Sequence[Reference]) -> Iterator[tuple[Array, ...]]:
        """Rows, `CHUNK_ROWS` at a time."""
        channels = [self._channel(reference) for reference in columns]
        count = equally_long(self.path, columns, [len(channel) for channel in channels])
        with readable(self.path, "TDMS", "npTDMS"):
            for first in range(0, count, CHUNK_ROWS):
                length = min(CHUNK_ROWS, count - first)
                yield tuple(np.asarray(channel.read_data(first, length)) for channel in channels)

    def values(self, column: str) -> Array:
        """Read a channel whole."""
        with readable(self.path, "TDMS", "npTDMS"):
            return np.asarray(self._channel(Reference(column)).read_data())

    def close(self) -> None:
        """Close the file."""
        self._tdms.close()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _channel(self, reference: Reference) -> Any:
        if reference.index is not None:
            raise SourceError(f"{self.path}: channel {reference}: index is for tables within .npz and .mat files")
        return self._channels[named(self.path, reference.column, self.names(), "channel")]


def _start_ns(properties: Any) -> int | None:
    start = properties.get("wf_start_time")
    if start is None:
        return None
    offset_ns = round(float(properties.get("wf_start_offset") or 0.0) * 1e9)
    return int(np.datetime64(start, "ns").astype(np.int64)) + offset_ns
