"""The readings of a window as one value of the database, and buckets: the readings of many windows, added up.

Both are compressed arrays with a record for each series. The numbers of series are stored as differences, which halves
the size after compression. `trend` reduces readings over a long time to as many numbers as a plot can show.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import structlog
import zstandard
from sqlalchemy import Connection, func, select
from sqlalchemy.sql.elements import ColumnElement

from service.history.database import Database
from service.history.records import StoredBucket
from service.history.tables import buckets, machines, series, windows

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
_SINGLE = 20_000
"""Most windows whose single readings are reduced for a trend; for more, stored buckets are taken."""
_SINGLE_FOR_COARSE = 2_000
"""The same where stored buckets are at most twice as long as those asked for; they cost a tenth."""
_END = 2**63 - 1
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


_Timed = tuple[npt.NDArray[np.int64], Parts]
"""Buckets, and when each begins."""


def trend(  # noqa: PLR0913  # each narrows it
    connection: Connection,
    machine_id: int,
    bucket_ns: int,
    quantity: str,
    names: Sequence[str] | None,
    since_ns: int | None,
    until_ns: int | None,
    points: int,
) -> tuple[StoredBucket, ...]:
    """Reduce readings, single or in stored buckets, to at most `points` buckets; see `MachineStore.downsampled`.

    Every reading is in a stored bucket, or will be in the one that is being filled. If all windows that are asked for
    are still there, and not too many, their single readings are taken; otherwise stored buckets are, and single
    readings only where since or until lie within a bucket.
    """
    known = series.c
    query = select(known.series_id, known.name, known.dropped_ns).where(
        known.machine_id == machine_id, known.quantity == quantity
    )
    chosen = [row for row in connection.execute(query) if names is None or row.name in names]
    titles = {row.series_id: row.name for row in chosen}
    if not titles:
        return ()
    dropped_ns = max(row.dropped_ns for row in chosen)
    since, until = since_ns or 0, _END if until_ns is None else until_ns
    window = windows.c
    asked = select(window.end_ns).where(window.machine_id == machine_id, window.end_ns >= since, window.end_ns < until)
    # One query each: it finds its end of the index at once, where one for both would look through the index.
    oldest, newest = (
        connection.scalar(asked.order_by(order).limit(1)) for order in (window.end_ns.asc(), window.end_ns.desc())
    )
    found, unit, parts = [each for each in (oldest, newest) if each is not None], 1, list[_Timed]()
    coarse = bool(found) and 2 * (found[-1] - max(since, found[0])) >= bucket_ns * points
    most = min(_SINGLE, _SINGLE_FOR_COARSE) if coarse else _SINGLE
    count = select(func.count()).select_from(asked.limit(most + 1).subquery())
    single = dropped_ns < since and connection.execute(count).scalar_one() <= most
    if not single:
        unit, stored = _stored(connection, machine_id, list(titles), since, until, bucket_ns)
        found += [int(each) for times, _ in stored for each in (times.min(), times.max())]
    if not found:
        return ()
    start = max(since, min(found)) // unit * unit
    end = max(found) + 1 if until_ns is None else until
    shortest = -(-(end - start) // points)
    length = -(-shortest // unit) * unit
    if single:
        parts = [_single(connection, machine_id, list(titles), window.end_ns, start, end)]
    else:
        # Parts of buckets at both ends, from single readings as far as these are still there.
        first, last = since, until
        if since_ns is not None and since > dropped_ns and since % unit:
            first = start + unit
            parts.append(_single(connection, machine_id, list(titles), window.end_ns, since, min(first, until)))
        if until_ns is not None and until // unit * unit > max(dropped_ns, first - 1) and until % unit:
            last = until // unit * unit
            parts.append(_single(connection, machine_id, list(titles), window.end_ns, last, until))
        parts += [_between(each, first, last) for each in stored]
    times = np.concatenate([each for each, _ in parts])
    places, made = add_up(Parts.together([each for _, each in parts]), (times - start) // length)
    # By name, and within a name in the order of time, which they already have.
    rank = {series_id: place for place, series_id in enumerate(sorted(titles, key=titles.__getitem__))}
    order = np.argsort([rank[series_id] for series_id in made["series_id"].tolist()], kind="stable")
    places, made = places[order], made[order]
    with np.errstate(invalid="ignore", over="ignore"):
        means, errors = made["total"] / made["count"], made["errors_total"] / np.maximum(made["errors"], 1)
    return tuple(
        map(
            StoredBucket,
            map(titles.__getitem__, made["series_id"].tolist()),
            (start + places * length).tolist(),
            repeat(length),
            made["count"].tolist(),
            made["minimum"].tolist(),
            means.tolist(),
            made["maximum"].tolist(),
            (error if count else None for count, error in zip(made["errors"].tolist(), errors.tolist(), strict=True)),
        )
    )


def _stored(
    connection: Connection, machine_id: int, series_ids: list[int], since: int, until: int, bucket_ns: int
) -> tuple[int, list[_Timed]]:
    """Length of the longest bucket, and the buckets that begin within a time, those that are being filled last."""
    stored = buckets.c
    query = select(stored.start_ns, stored.length_ns, stored.readings).order_by(stored.start_ns)
    query = query.where(stored.machine_id == machine_id, stored.start_ns >= since, stored.start_ns < until)
    rows = connection.execute(query).all()
    of, records = unpacked([row[2] for row in rows], BUCKET)
    chosen = np.flatnonzero(np.isin(records["series_id"], series_ids))
    times, lengths = (np.array([row[n] for row in rows], np.int64)[of[chosen]] for n in (0, 1))
    bucketed = connection.scalar(select(machines.c.bucketed).where(machines.c.machine_id == machine_id)) or 0
    ends, filling = _single(connection, machine_id, series_ids, windows.c.number, bucketed + 1, _END)
    with_mean = finite(filling)
    starts, filling = ends[with_mean] // bucket_ns * bucket_ns, filling.of(with_mean)
    made = [(times, stored_parts(records, chosen)), _between((starts, filling), since, until)]
    unit = max(int(lengths.max(initial=1)), bucket_ns if len(made[1][0]) else 1)
    return unit, [each for each in made if len(each[0])]


def _single(
    connection: Connection, machine_id: int, series_ids: list[int], column: ColumnElement[int], first: int, end: int
) -> _Timed:
    """Readings one by one, of windows whose end or number is from `first` to before `end`."""
    window = windows.c
    query = select(window.end_ns, window.readings).order_by(column)
    rows = connection.execute(query.where(window.machine_id == machine_id, column >= first, column < end)).all()
    of, readings = unpacked([row[1] for row in rows], READING)
    chosen = np.flatnonzero(np.isin(readings["series_id"], series_ids))
    return np.array([row[0] for row in rows], np.int64)[of[chosen]], singles(readings, chosen)


def _between(timed: _Timed, first: int, end: int) -> _Timed:
    times, parts = timed
    inside = (times >= first) & (times < end)
    return times[inside], parts.of(inside)
