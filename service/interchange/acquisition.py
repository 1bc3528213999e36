"""Sources for files of measuring systems, each read with its own library.

TDMS files of LabVIEW and DIAdem; ASAM MDF version 4 (MF4), the format of vehicle and test bench recorders; and time
responses in data set 58 (functions at nodal degrees of freedom) of the Universal File Format.
"""

import logging
import os
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime, tzinfo
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from models.signals.block import nanoseconds
from service.interchange.source import (
    CHUNK_ROWS,
    ONE_RATE,
    Array,
    Reference,
    Source,
    SourceError,
    Timing,
    equally_long,
    readable,
)
from service.monitor.conversion import rfc3339

_SAME_TIME_S = 1e-9
_FIRST_SEGMENTS = 8  # of a TDMS file, in which the first samples are looked for
_BIG_ENDIAN = 0x40  # bit of a TDMS segment's table of contents
_UNFINISHED = 2**64 - 1  # in place of a TDMS segment's length while it is being written
_TIME_RESPONSE = 1
_MOST_RATE_DIFFERENCE = 1e-6


class TdmsSource(Source):
    """A TDMS file, read piece by piece. Channels are named ``group/channel``, or ``channel`` where that is unique."""

    kind, package, entry = "TDMS", "npTDMS", "channel"

    def __init__(self, path: Path) -> None:
        with readable(path, self.kind, self.package):
            from nptdms import TdmsFile, log  # noqa: PLC0415  # an extra

            log.log_manager.set_level(logging.ERROR)  # `cut` says what its warnings say
            self._file = path.open("rb")  # opened here, because the library does not close a file that it cannot read
            try:
                self._tdms = TdmsFile.open(self._file)
                channels = [channel for group in self._tdms.groups() for channel in group.channels()]
            except BaseException:
                self._file.close()
                raise
        short = [channel.name for channel in channels]
        full = {f"{channel.group_name}/{channel.name}": channel for channel in channels}
        unique = {channel.name: channel for channel in channels if short.count(channel.name) == 1}
        self.cut = self._tdms.file_status.incomplete_final_segment
        super().__init__(path, full | {name: channel for name, channel in unique.items() if name not in full})

    def timing(self, columns: Sequence[Reference]) -> Timing:
        """Rate and start of the waveforms (``wf_increment``, ``wf_start_time``, ``wf_start_offset``)."""
        found: Timing | None = None
        first = self._first_stated() if columns else {}
        for reference in columns:
            channel = self._column(reference)
            timing = _waveform(channel.properties)
            begun_ns = _waveform(first.get(channel.path, {})).start_ns or 0
            lasts_ns = len(channel) / timing.rate_hz * 1e9 if timing.rate_hz else float("inf")
            if begun_ns > 0 and (timing.start_ns or 0) - begun_ns > lasts_ns:  # before 1970: not set, as 1904 is
                raise SourceError(
                    f"{self.path}: channel {reference} begins at {rfc3339(begun_ns)} and anew at "
                    f"{rfc3339(timing.start_ns or 0)}, longer after that than its {len(channel)} samples last: several "
                    "measurements with a gap that is not kept; expected a file for each"
                )
            if found is not None and timing != found:
                raise SourceError(
                    f"{self.path}: channel {reference} has {_told(timing)}, channel {columns[0]} has {_told(found)}; "
                    f"expected the same (wf_increment, wf_start_time, wf_start_offset): {ONE_RATE}"
                )
            found = timing
        return found or Timing()

    def _first_stated(self) -> dict[str, Any]:
        """Properties of channels at their first samples; the library keeps those of the last segment."""
        from nptdms import TdmsFile  # noqa: PLC0415  # an extra

        index = b""
        with readable(self.path, self.kind), self.path.open("rb") as file:
            for _ in range(_FIRST_SEGMENTS):
                lead = file.read(28)
                if len(lead) < 28:
                    break
                following, data_from = struct.unpack_from((">" if lead[4] & _BIG_ENDIAN else "<") + "QQ", lead, 12)
                if following == _UNFINISHED:
                    break
                index += b"TDSh" + lead[4:] + file.read(data_from)  # as in the file of type .tdms_index
                groups = TdmsFile.read_metadata(BytesIO(index)).groups()
                if any(len(channel) for group in groups for channel in group.channels()):
                    return {channel.path: channel.properties for group in groups for channel in group.channels()}
                file.seek(following - data_from, os.SEEK_CUR)
        return {}

    def unit(self, column: Reference) -> str:
        """Property ``unit_string``, or ``NI_UnitDescription`` as written by NI-DAQ."""
        properties = self._column(column).properties
        return str(properties.get("unit_string") or properties.get("NI_UnitDescription") or "")

    def chunks(self, columns: Sequence[Reference]) -> Iterator[tuple[Array, ...]]:
        """Rows, `CHUNK_ROWS` at a time; an error says if the file is truncated, which leaves columns unequally long."""
        try:
            yield from super().chunks(columns)
        except SourceError as error:
            if not self.cut:
                raise
            raise SourceError(
                f"{error}; the file ends within a segment: it is truncated, or still being written"
            ) from error

    def close(self) -> None:
        """Close the file."""
        self._tdms.close()
        self._file.close()

    def _rows(self, reference: Reference) -> tuple[int, Callable[[slice], Any]]:
        channel = self._column(reference)
        return len(channel), lambda rows: channel.read_data(rows.start, rows.stop - rows.start)


def _told(timing: Timing) -> str:
    rate = "no rate" if timing.rate_hz is None else f"{timing.rate_hz:.12g} samples per second"
    return f"{rate} from {'no time' if timing.start_ns is None else rfc3339(timing.start_ns)} on"


def _waveform(properties: Any) -> Timing:
    """Rate and start of a waveform; unreadable values count as missing, and the mapping must then state them."""
    rate_hz = start_ns = None
    with suppress(TypeError, ValueError):
        increment_s = float(properties.get("wf_increment") or 0.0)
        rate_hz = 1 / increment_s if increment_s > 0 else None
    if (start := properties.get("wf_start_time")) is not None:
        with suppress(TypeError, ValueError):
            offset_ns = round(float(properties.get("wf_start_offset") or 0.0) * 1e9)
            start_ns = int(np.datetime64(start, "ns").astype(np.int64)) + offset_ns
    return Timing(rate_hz, start_ns)


class MdfSource(Source):
    """An MF4 file, read piece by piece.

    A channel is named ``number of its group/name``, and also by its own name if that is unique. ``time`` is the time
    column of the first channel that is requested together with it.
    """

    kind, package, entry = "MF4", "asammdf", "channel"

    def __init__(self, path: Path, *, zone: tzinfo = UTC) -> None:
        self._zone = zone
        places: dict[str, tuple[int, int]] = {}
        with readable(path, self.kind, self.package):
            from asammdf import MDF  # noqa: PLC0415  # an extra
            from asammdf.blocks.mdf_v4 import MDF4  # noqa: PLC0415

            # The library fails to close a half-read damaged file, and would print a second traceback from __del__.
            MDF4.__del__ = lambda _: None  # type: ignore[method-assign]
            logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # its errors are raised as exceptions as well
            self._file: Any = MDF(path)
            for name, found in self._file.channels_db.items():
                for group, index in found:
                    if index != self._file.masters_db.get(group):
                        places[f"{group}/{name}"] = (group, index)
                        if len(found) == 1:
                            places[name] = (group, index)
        super().__init__(path, {"time": None} | places)

    def timing(self, columns: Sequence[Reference]) -> Timing:  # noqa: ARG002
        """Start of the measurement, in `zone` if the file names none; every row has its own time."""
        header, start_ns = self._file.header, None
        with suppress(ValueError):
            if hasattr(header, "date") and not getattr(header, "abs_time", 0):
                # MDF before 3.2: local time, which the library would take for that of this computer.
                began = datetime.strptime(f"{header.date.decode()} {header.time.decode()}", "%d:%m:%Y %H:%M:%S")
            else:
                began = header.start_time
            start_ns = nanoseconds(began if began.tzinfo else began.replace(tzinfo=self._zone))
        return Timing(start_ns=start_ns, time=Reference("time"))

    def unit(self, column: Reference) -> str:
        """Unit of the channel."""
        if column.column == "time":
            return "s"
        group, index = self._column(column)
        return str(self._file.get_channel_unit(group=group, index=index) or "")

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
                yield tuple(present[0].timestamps if signal is None else _valid(signal) for signal in signals)

    def values(self, column: str) -> Array:
        """Read a channel whole."""
        group, index = self._column(Reference(column))
        with readable(self.path, self.kind, self.package):
            return np.asarray(self._file.get(group=group, index=index).samples)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, place: tuple[int, int], first: int) -> Any:
        return self._file.get(
            group=place[0],
            index=place[1],
            record_offset=first,
            record_count=CHUNK_ROWS,
            ignore_invalidation_bits=True,  # otherwise invalid samples are left out, and channels have other lengths
        )


def _valid(signal: Any) -> Array:
    """Samples of an MF4 channel, NaN where the file marks them as invalid."""
    samples, invalid = np.asarray(signal.samples), signal.invalidation_bits
    return samples if invalid is None or not np.any(invalid) else np.where(invalid, np.nan, samples)


class UniversalSource(Source):
    """A UFF file, read whole. A data set is named by number, ``set 1``, and by its first line if that is unique."""

    kind, package, entry = "UFF", "pyuff", "data set"

    def __init__(self, path: Path) -> None:
        with readable(path, self.kind, self.package):
            import pyuff  # noqa: PLC0415  # an extra

            file = pyuff.UFF(str(path))
            numbers = [number for number, kind in enumerate(file.get_set_types()) if kind == 58]
            read = file.read_sets(numbers) if numbers else []
            # Each data set is enclosed by two such lines, so an odd number means that the file is truncated.
            whole = len(re.findall(rb"(?m)^    -1 *\r?$", path.read_bytes())) % 2 == 0
            self._cut = "" if whole else "; the file is truncated, it ends within another one"
        sets: list[dict[str, Any]] = [read] if isinstance(read, dict) else list(read)
        sets = [found for found in sets if found["func_type"] == _TIME_RESPONSE]
        for found in sets:
            if len(found["data"]) != found["num_pts"]:
                raise SourceError(
                    f"{path}: is truncated: {len(found['data'])} samples of {str(found['id1']).strip()} are there, "
                    f"expected the {found['num_pts']} that its header says"
                )
        if not sets:
            raise SourceError(f"{path}: holds no time response (data set 58 with function type 1){self._cut}")
        titles = [str(found["id1"]).strip() for found in sets]
        self._sets = {f"set {number + 1}": found for number, found in enumerate(sets)}
        for title, found in zip(titles, sets, strict=True):
            if title not in ("", "NONE") and titles.count(title) == 1:
                self._sets.setdefault(title, found)
        super().__init__(path, {name: np.asarray(found["data"]) for name, found in self._sets.items()})

    def timing(self, columns: Sequence[Reference]) -> Timing:
        """Rate from the abscissa's increment, or from its values where the file gives no increment."""
        rates = [self._rate_hz(reference) for reference in columns]
        for reference, rate_hz in zip(columns, rates, strict=True):
            if abs(rate_hz / rates[0] - 1) > _MOST_RATE_DIFFERENCE:
                raise SourceError(
                    f"{self.path}: {reference} has {rate_hz:g} samples per second, {columns[0]} has {rates[0]:g}; "
                    "expected the same"
                )
        return Timing(rate_hz=rates[0] if rates else None)

    def unit(self, column: Reference) -> str:
        """Label of the ordinate's unit."""
        label = str(self._sets[column.column]["ordinate_axis_units_lab"]).strip()
        return "" if label == "NONE" else label

    def named(self, column: str) -> str:
        """Check that a data set exists, and return its name; the error says if the file is truncated."""
        try:
            return super().named(column)
        except SourceError as error:
            raise SourceError(f"{error}{self._cut}") from error

    def _rate_hz(self, reference: Reference) -> float:
        self._column(reference)  # raises if there is no such data set
        found = self._sets[reference.column]
        step_s = float(found["abscissa_inc"])
        if found["abscissa_spacing"] == 1 and step_s > 0:
            return 1 / step_s
        steps = np.diff(np.asarray(found["x"], dtype=np.float64))
        if steps.size == 0 or steps.min() <= 0 or np.ptp(steps) > _MOST_RATE_DIFFERENCE * steps.mean() + 1e-9:
            raise SourceError(f"{self.path}: {reference} is not sampled evenly, expected one time step throughout")
        return float(1 / steps.mean())
