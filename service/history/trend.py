"""Readings over a long time, reduced to as many numbers as a plot can show."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import BigInteger, Connection, Select, Table, case, cast, func, literal, select, union_all

from rotorwatch.records.history import ReadingBucket
from service.history.tables import buckets, evaluations, open_buckets, readings, series

__all__ = ["trend"]

_SINGLE = 20_000
"""Windows whose single readings are reduced when a trend is asked for; over more of them the stored buckets are."""


@dataclass(frozen=True, slots=True)
class _Grid:
    """Stretches of equal length, next to each other, and where the readings within them are taken from.

    Attributes
    ----------
    start_ns, end_ns, length_ns : int
        Of all stretches; of each one.
    of_buckets : tuple of (int, int)
        From when to when stored buckets are taken that begin then.
    of_windows : tuple of (int, int)
        From when to when windows are taken that end then, outside the former.
    """

    start_ns: int
    end_ns: int
    length_ns: int
    of_buckets: tuple[int, int]
    of_windows: tuple[tuple[int, int], ...]


def trend(
    connection: Connection,
    machine_id: int,
    quantity: str,
    names: Sequence[str] | None,
    since_ns: int | None,
    until_ns: int | None,
    points: int,
) -> tuple[ReadingBucket, ...]:
    """Reduce readings, and what older ones have been reduced to, to at most `points` buckets; see `MachineStore`.

    Every reading is in a stored bucket. Where all windows that are asked for are there themselves, and not too many,
    they are taken; otherwise the buckets, and single readings only where since or until lie within a bucket.
    """
    known = series.c
    query = select(known.series_id, known.name, known.dropped_ns).where(
        known.machine_id == machine_id, known.quantity == quantity
    )
    chosen = [row for row in connection.execute(query) if names is None or row.name in names]
    titles = {row.series_id: row.name for row in chosen}
    dropped_ns = max((row.dropped_ns for row in chosen), default=-1)
    grid = _grid(connection, machine_id, list(titles), since_ns, until_ns, points, dropped_ns) if titles else None
    if grid is None:
        return ()
    parts = [_readings(machine_id, list(titles), first, end) for first, end in grid.of_windows]
    if grid.of_buckets[0] < grid.of_buckets[1]:
        parts += [_buckets(table, list(titles), *grid.of_buckets) for table in (buckets, open_buckets)]
    found = union_all(*parts).subquery().c
    place = ((found.at_ns - grid.start_ns) // grid.length_ns).label("place")
    count, errors = (cast(func.sum(column), BigInteger) for column in (found["count"], found.errors))
    reduced = select(
        found.series_id,
        place,
        count,
        func.min(found.minimum),
        func.sum(found.total) / count,
        func.max(found.maximum),
        func.sum(found.errors_total) / func.nullif(errors, 0),
    ).group_by(found.series_id, place)
    made = (
        ReadingBucket(
            name=titles[series_id],
            start_ns=grid.start_ns + number * grid.length_ns,
            length_ns=grid.length_ns,
            count=count,
            minimum=minimum,
            mean=mean,
            maximum=maximum,
            mean_standard_error=mean_error,
        )
        for series_id, number, count, minimum, mean, maximum, mean_error in connection.execute(reduced)
    )
    return tuple(sorted(made, key=lambda each: (each.name, each.start_ns)))


def _grid(
    connection: Connection,
    machine_id: int,
    series_ids: list[int],
    since_ns: int | None,
    until_ns: int | None,
    points: int,
    dropped_ns: int,
) -> _Grid | None:
    """Where the buckets lie; None if there is nothing."""
    since, until = since_ns or 0, 2**63 - 1 if until_ns is None else until_ns
    window = evaluations.c
    asked = select(window.end_ns).where(window.machine_id == machine_id, window.end_ns >= since, window.end_ns < until)
    # One after the other: each is found at an end of the index then, and not by looking through it.
    oldest: int | None = connection.scalar(asked.order_by(window.end_ns.asc()).limit(1))
    newest: int | None = connection.scalar(asked.order_by(window.end_ns.desc()).limit(1))
    count = select(func.count()).select_from(asked.limit(_SINGLE + 1).subquery())
    if dropped_ns < since and connection.execute(count).scalar_one() <= _SINGLE:
        if oldest is None or newest is None:
            return None
        start = oldest if since_ns is None else since
        end = newest + 1 if until_ns is None else until
        return _Grid(start, end, -(-(end - start) // points), (0, 0), ((start, end),))
    found, unit = [value for value in (oldest, newest) if value is not None], 1
    for stored in (buckets.c, open_buckets.c):
        within = (stored.series_id.in_(series_ids), stored.start_ns >= since, stored.start_ns < until)
        bounds = select(func.min(stored.start_ns), func.max(stored.start_ns), func.max(stored.length_ns)).where(*within)
        first_ns, last_ns, length_ns = connection.execute(bounds).one()
        if length_ns is not None:
            found += [first_ns, last_ns]
            unit = max(unit, length_ns)
    if not found:
        return None
    start = (min(found) if since_ns is None else since) // unit * unit
    end = max(found) + 1 if until_ns is None else until
    shortest = -(-(end - start) // points)
    length = -(-shortest // unit) * unit
    # Parts of buckets at both ends, as far as the readings themselves are there.
    first, last = since, until
    windows = []
    if since_ns is not None and since > dropped_ns and since % unit:
        first = start + unit
        windows.append((since, min(first, until)))
    if until_ns is not None and until // unit * unit > max(dropped_ns, first - 1) and until % unit:
        last = until // unit * unit
        windows.append((last, until))
    return _Grid(start, end, length, (first, last), tuple(windows))


def _readings(machine_id: int, series_ids: list[int], first_ns: int, end_ns: int) -> Select[*tuple[Any, ...]]:
    """Readings one by one, in the form of buckets."""
    window, reading = evaluations.c, readings.c
    return (
        select(
            reading.series_id,
            window.end_ns.label("at_ns"),
            literal(1).label("count"),
            reading.value.label("minimum"),
            reading.value.label("maximum"),
            reading.value.label("total"),
            case((reading.standard_error.is_(None), 0), else_=1).label("errors"),
            func.coalesce(reading.standard_error, 0.0).label("errors_total"),
        )
        .join_from(evaluations, readings, (reading.machine_id == window.machine_id) & (reading.number == window.number))
        .where(
            window.machine_id == machine_id,
            window.end_ns >= first_ns,
            window.end_ns < end_ns,
            reading.series_id.in_(series_ids),
        )
    )


def _buckets(table: Table, series_ids: list[int], first_ns: int, end_ns: int) -> Select[*tuple[Any, ...]]:
    stored = table.c
    columns = (stored["count"], stored.minimum, stored.maximum, stored.total, stored.errors, stored.errors_total)
    within = (stored.start_ns >= first_ns, stored.start_ns < end_ns)
    return select(stored.series_id, stored.start_ns.label("at_ns"), *columns).where(
        stored.series_id.in_(series_ids), *within
    )
