"""The readings of a window in one value, and what windows are reduced to: the same numbers of many, added up.

Both are arrays with a record for each series, compressed; in them the numbers of series are differences, which halves
what compressing leaves of them.
"""

from collections.abc import Sequence
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
"""A standard error that there is none of is NaN."""
BUCKET = np.dtype(
    [
        ("series_id", "<i4"), ("count", "<i4"), ("minimum", "<f8"), ("maximum", "<f8"), ("total", "<f8"),
        ("errors", "<i4"), ("errors_total", "<f8"),
    ]
)  # fmt: skip
_FEW = 4  # places to count in, for each number
_log = structlog.get_logger("rotorwatch", part="history")


def packed(records: Records) -> bytes:
    """Make one value of records."""
    stored = records.copy()
    stored["series_id"][1:] -= records["series_id"][:-1]
    return zstandard.compress(stored.tobytes())


def unpacked(values: Sequence[bytes], kind: np.dtype[np.void]) -> tuple[npt.NDArray[np.intp], Records]:
    """Records of many values, each with the place of the value that it was in; one that is damaged has none."""
    opened, decompressor = [], zstandard.ZstdDecompressor()
    for each in values:
        try:
            opened.append(decompressor.decompress(each))
        except zstandard.ZstdError as error:
            _log.error("the readings of a window are damaged; they are passed over", why=str(error))
            opened.append(b"")
    records = np.frombuffer(bytearray().join(opened), kind)
    sizes = np.array([len(each) for each in opened], np.intp) // kind.itemsize
    sums = np.concatenate([[0], np.cumsum(records["series_id"], dtype=np.int64)])
    records["series_id"] = sums[1:] - np.repeat(sums[np.cumsum(sizes) - sizes], sizes)
    return np.repeat(np.arange(len(opened)), sizes), records


def singles(readings: Records) -> Records:
    """Each reading as a bucket of its own."""
    made, known = np.empty(len(readings), BUCKET), ~np.isnan(readings["standard_error"])
    made["series_id"], made["count"], made["errors"] = readings["series_id"], 1, known
    made["minimum"] = made["maximum"] = made["total"] = readings["value"]
    made["errors_total"] = np.where(known, readings["standard_error"], 0.0)
    return made


def finite(parts: Records) -> npt.NDArray[np.bool_]:
    """Which have a mean."""
    found: npt.NDArray[np.bool_] = np.isfinite(parts["total"]) & np.isfinite(parts["errors_total"])
    return found


def _distinct(numbers: npt.NDArray[np.integer[Any]]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Which numbers there are, and the place of each among them: `np.unique`, without sorting where they are small."""
    if not len(numbers) or numbers.min() < 0 or numbers.max() > _FEW * len(numbers) + 1000:
        found, places = np.unique(numbers, return_inverse=True)
        return found.astype(np.int64), places
    there = np.bincount(numbers) > 0
    return np.flatnonzero(there), (np.cumsum(there) - 1)[numbers]


def add_up(parts: Records, places: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], Records]:
    """Buckets, those at the same place and of the same series in one, by place and series; and their places."""
    series_ids, column = _distinct(parts["series_id"])
    width = max(1, len(series_ids))
    keys, group = _distinct(places * width + column)
    made = np.empty(len(keys), BUCKET)
    made["series_id"] = series_ids[keys % width]
    for name in ("count", "total", "errors", "errors_total"):
        made[name] = np.bincount(group, parts[name], len(keys))
    # Numbers of two bytes are sorted without comparing them.
    order = np.argsort(group.astype(np.uint16) if len(keys) <= 2**16 else group, kind="stable")
    sizes = np.bincount(group, minlength=len(keys))
    first = np.cumsum(sizes) - sizes
    made["minimum"] = np.minimum.reduceat(parts["minimum"][order], first)
    made["maximum"] = np.maximum.reduceat(parts["maximum"][order], first)
    return keys // width, made


def fill_buckets(
    database: Database, connection: Connection, machine_id: int, after: int, last: int, bucket_ns: int
) -> None:
    """Add the windows from one number, exclusive, to another to the buckets; the machine's row must be locked."""
    window, stored = windows.c, buckets.c
    query = select(window.end_ns, window.recorded_ns, window.readings).order_by(window.number)
    query = query.where(window.machine_id == machine_id, window.number > after, window.number <= last)
    rows = connection.execute(query).all()
    starts = [row.end_ns // bucket_ns * bucket_ns for row in rows]
    for start_ns in sorted(set(starts)):
        inside = [row for row, start in zip(rows, starts, strict=True) if start == start_ns]
        parts = singles(unpacked([row.readings for row in inside], READING)[1])
        parts, recorded_ns = parts[finite(parts)], [row.recorded_ns for row in inside]
        key = {"machine_id": machine_id, "start_ns": start_ns, "length_ns": bucket_ns}
        there = select(stored.recorded_ns, stored.readings).where(*(stored[name] == key[name] for name in key))
        for row in connection.execute(there):
            parts = np.concatenate([unpacked([row.readings], BUCKET)[1], parts])
            recorded_ns.append(row.recorded_ns)
        if len(parts):
            _, made = add_up(parts, np.zeros(len(parts), np.int64))
            changes = {"recorded_ns": max(recorded_ns), "readings": packed(made)}
            new = database.insert(buckets).values(key | changes)
            connection.execute(new.on_conflict_do_update(index_elements=list(key), set_=changes))
