"""Source: TDMS files of LabVIEW and DIAdem."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service.interchange.source import Reference, Source, SourceError, Timing, readable


class TdmsSource(Source):
    """A TDMS file, read piece by piece. Channels are named ``group/channel``, or ``channel`` where that is unique."""

    kind, package, entry = "TDMS", "npTDMS", "channel"

    def __init__(self, path: Path) -> None:
        with readable(path, self.kind, self.package):
            from nptdms import TdmsFile  # noqa: PLC0415  # an extra

            self._file = path.open("rb")  # ours, because the library leaves a file open that it cannot read
            try:
                self._tdms = TdmsFile.open(self._file)
                channels = [channel for group in self._tdms.groups() for channel in group.channels()]
            except BaseException:
                self._file.close()
                raise
        short = [channel.name for channel in channels]
        full = {f"{channel.group_name}/{channel.name}": channel for channel in channels}
        unique = {channel.name: channel for channel in channels if short.count(channel.name) == 1}
        super().__init__(path, full | {name: channel for name, channel in unique.items() if name not in full})

    def timing(self, columns: Sequence[Reference]) -> Timing:
        """Rate and start of the waveforms (``wf_increment``, ``wf_start_time``, ``wf_start_offset``)."""
        found: Timing | None = None
        for reference in columns:
            properties = self._column(reference).properties
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
        properties = self._column(column).properties
        return str(properties.get("unit_string") or properties.get("NI_UnitDescription") or "")

    def close(self) -> None:
        """Close the file."""
        self._tdms.close()
        self._file.close()

    def _rows(self, reference: Reference) -> tuple[int, Callable[[slice], Any]]:
        channel = self._column(reference)
        return len(channel), lambda rows: channel.read_data(rows.start, rows.stop - rows.start)


def _start_ns(properties: Any) -> int | None:
    start = properties.get("wf_start_time")
    if start is None:
        return None
    offset_ns = round(float(properties.get("wf_start_offset") or 0.0) * 1e9)
    return int(np.datetime64(start, "ns").astype(np.int64)) + offset_ns
