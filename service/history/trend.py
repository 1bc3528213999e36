"""Readings over a long time, reduced to as many numbers as a plot can show."""

from collections.abc import Sequence
from itertools import repeat

import numpy as np
import numpy.typing as npt
from sqlalchemy import Connection, func, select
from sqlalchemy.sql.elements import ColumnElement

from service.history.records import StoredBucket
from service.history.tables import buckets, machines, series, windows
from service.history.windows import BUCKET, READING, Parts, add_up, finite, singles, stored_parts, unpacked

_SINGLE = 20_000
"""Most windows whose single readings are reduced for a trend; for more, stored buckets are taken."""
_SINGLE_FOR_COARSE = 2_000
"""The same where stored buckets are at most twice as long as those asked for; they cost a tenth."""
_END = 2**63 - 1
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
