"""The readings of a window as one value of the database, and buckets: the readings of many windows, added up.

Both are compressed arrays with a record for each series. The numbers of series are stored as differences, which halves
the size after compression.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import structlog
import zstandard
from sqlalchemy import Connection, select

from service.history.database import Database
from service.history.tables import buckets, windows

Records: TypeAlias = npt.NDArray[np.void]
READING = np.dtype([("series_id", "<i4"), ("value", "<f8"), ("standard_error", "<f8")])
"""A missing standard error is NaN."""
BUCKET = np.dtype(
    [
        ("series_id", "<i4"), ("count", "<i4"), ("minimum", "<f8"), ("maximum", "<f8"), ("total", "<f8"),
        ("errors", "<i4"), ("errors_total", "<f8"),
    ]
)  # fmt: skip
_FIELDS: tuple[str, ...] = BUCKET.names or ()
_ALL = slice(None)
_FEW = 4  # counters for each number, up to which `_distinct` counts and does not sort
_log = structlog.get_logger("rotorwatch", part="history")


def packed(records: Records) -> bytes:
    """Compress records into one value."""
    stored = records.copy()
    stored["series_id"][1:] -= records["series_id"][:-1]
    return zstandard.compress(stored.tobytes())


def unpacked(values: Sequence[bytes], kind: np.dtype[np.void]) -> tuple[npt.NDArray[np.intp], Records]:
    """Records of many values, each with the place of the value it was in; a damaged value has no records."""
    opened, decompressor = [], zstandard.ZstdDecompressor()
    for each in values:
        try:
            opened.append(decompressor.decompress(each))
        except zstandard.ZstdError as error:
            _log.error("the readings of a window are damaged; they are skipped", why=str(error))
            opened.append(b"")
    records = np.frombuffer(bytearray().join(opened), kind)
    sizes = np.array([len(each) for each in opened], np.intp) // kind.itemsize
    sums = np.concatenate([[0], np.cumsum(records["series_id"], dtype=np.int64)])
    records["series_id"] = sums[1:] - np.repeat(sums[np.cumsum(sizes) - sizes], sizes)
    return np.repeat(np.arange(len(opened)), sizes), records


@dataclass(frozen=True, slots=True)
class Parts:
    """Buckets as one array for each field: a million readings are added up much faster than as records."""

    series_id: npt.NDArray[np.int32]
    count: npt.NDArray[np.int32]
    minimum: npt.NDArray[np.float64]
    maximum: npt.NDArray[np.float64]
    total: npt.NDArray[np.float64]
    errors: npt.NDArray[np.int32]
    errors_total: npt.NDArray[np.float64]

    def of(self, chosen: npt.NDArray[np.bool_]) -> "Parts":
        """Only the chosen buckets."""
        return self if chosen.all() else Parts(*(getattr(self, name)[chosen] for name in _FIELDS))

    @classmethod
    def together(cls, parts: Sequence["Parts"]) -> "Parts":
        """All buckets of several, in this order."""
        return cls(*(np.concatenate([getattr(each, name) for each in parts]) for name in _FIELDS))


def singles(readings: Records, chosen: npt.NDArray[np.intp] | slice = _ALL) -> Parts:
    """Each reading as a bucket of its own."""
    series_id, values, errors = (readings[name][chosen] for name in ("series_id", "value", "standard_error"))
    known = ~np.isnan(errors)
    once = np.ones(len(values), np.int32)
    return Parts(series_id, once, values, values, values, known.astype(np.int32), np.where(known, errors, 0.0))


def stored_parts(stored: Records, chosen: npt.NDArray[np.intp] | slice = _ALL) -> Parts:
    """Stored buckets, field by field."""
    return Parts(*(stored[name][chosen] for name in _FIELDS))


def finite(parts: Parts) -> npt.NDArray[np.bool_]:
    """Which buckets have a finite mean."""
    return np.isfinite(parts.total) & np.isfinite(parts.errors_total)


def _distinct(numbers: npt.NDArray[np.integer[Any]]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Distinct numbers in order, and the place of each number among them; `np.unique` without sorting small numbers."""
    if not len(numbers) or numbers.min() < 0 or numbers.max() > _FEW * len(numbers) + 1000:
        found, places = np.unique(numbers, return_inverse=True)
        return found.astype(np.int64), places
    there = np.bincount(numbers) > 0
    return np.flatnonzero(there), (np.cumsum(there) - 1)[numbers]


def add_up(parts: Parts, places: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], Records]:
    """Merge buckets of the same place and series; return the places and the buckets, ordered by place and series."""
    series_ids, column = _distinct(parts.series_id)
    width = max(1, len(series_ids))
    keys, group = _distinct(places * width + column)
    made = np.empty(len(keys), BUCKET)
    made["series_id"] = series_ids[keys % width]
    for name in ("count", "total", "errors", "errors_total"):
        made[name] = np.bincount(group, getattr(parts, name), len(keys))
    minimum, maximum = np.full(len(keys), np.inf), np.full(len(keys), -np.inf)
    np.minimum.at(minimum, group, parts.minimum)
    np.maximum.at(maximum, group, parts.maximum)
    made["minimum"], made["maximum"] = minimum, maximum
    return keys // width, made


def fill_buckets(
    database: Database, connection: Connection, machine_id: int, after: int, last: int, bucket_ns: int
) -> None:
    """Add the windows with after < number ≤ last to the buckets; the machine's row must be locked."""
    window, stored = windows.c, buckets.c
    query = select(window.end_ns, window.recorded_ns, window.readings).order_by(window.number)
    query = query.where(window.machine_id == machine_id, window.number > after, window.number <= last)
    rows = connection.execute(query).all()
    starts = [row.end_ns // bucket_ns * bucket_ns for row in rows]
    for start_ns in sorted(set(starts)):
        inside = [row for row, start in zip(rows, starts, strict=True) if start == start_ns]
        parts = singles(unpacked([row.readings for row in inside], READING)[1])
        parts, recorded_ns = parts.of(finite(parts)), [row.recorded_ns for row in inside]
        key = {"machine_id": machine_id, "start_ns": start_ns, "length_ns": bucket_ns}
        there = select(stored.recorded_ns, stored.readings).where(*(stored[name] == key[name] for name in key))
        for row in connection.execute(there):
            parts = Parts.together([stored_parts(unpacked([row.readings], BUCKET)[1]), parts])
            recorded_ns.append(row.recorded_ns)
        if len(parts.total):
            _, made = add_up(parts, np.zeros(len(parts.total), np.int64))
            changes = {"recorded_ns": max(recorded_ns), "readings": packed(made)}
            new = database.insert(buckets).values(key | changes)
            connection.execute(new.on_conflict_do_update(index_elements=list(key), set_=changes))
