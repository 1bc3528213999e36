"""Readings over a long time, reduced to as many numbers as a plot can show."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import BigInteger, Select, cast, func, select
from sqlalchemy.ext.asyncio import AsyncConnection

from service.store.database import Database
from service.store.records import Bucket
from service.store.tables import buckets, evaluations, readings, series

__all__ = ["trend"]

_SINGLE = 20_000
"""Windows whose single readings are reduced when a trend is asked for; over more of them the stored buckets are."""


@dataclass(slots=True)
class _Sum:
    """Readings added up."""

    count: int
    minimum: float
    maximum: float
    total: float
    errors: int
    errors_total: float

    def add(self, other: "_Sum") -> None:
        self.count += other.count
        self.minimum = min(self.minimum, other.minimum)
        self.maximum = max(self.maximum, other.maximum)
        self.total += other.total
        self.errors += other.errors
        self.errors_total += other.errors_total


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


async def trend(
    database: Database,
    machine_id: int,
    quantity: str,
    names: Sequence[str] | None,
    since_ns: int | None,
    until_ns: int | None,
    points: int,
) -> tuple[Bucket, ...]:
    """Reduce readings, and what older ones have been reduced to, to at most `points` buckets; see `MachineStore`.

    Every reading is in a stored bucket. Where all windows that are asked for are there themselves, and not too many,
    they are taken; otherwise the buckets, and single readings only where since or until lie within a bucket.
    """
    async with database.reading() as connection:
        query = select(series.c.series_id, series.c.name, series.c.dropped_ns).where(
            series.c.machine_id == machine_id, series.c.quantity == quantity
        )
        found = [row for row in await connection.execute(query) if names is None or row.name in names]
        titles = {row.series_id: row.name for row in found}
        if not titles:
            return ()
        dropped_ns = max(row.dropped_ns for row in found)
        grid = await _grid(connection, machine_id, list(titles), since_ns, until_ns, points, dropped_ns)
        if grid is None:
            return ()
        sums: dict[tuple[str, int], _Sum] = {}
        single = (_of_readings(machine_id, list(titles), grid, first, end) for first, end in grid.of_windows)
        for chosen in (*single, _of_buckets(list(titles), grid)):
            for row in await connection.execute(chosen):
                series_id, number, *numbers = row
                place, part = (titles[series_id], number), _Sum(*numbers)
                if place in sums:
                    sums[place].add(part)
                else:
                    sums[place] = part
    return tuple(
        Bucket(
            quantity=quantity,
            name=name,
            start_ns=grid.start_ns + number * grid.length_ns,
            length_ns=grid.length_ns,
            count=part.count,
            minimum=part.minimum,
            mean=part.total / part.count,
            maximum=part.maximum,
            mean_standard_error=part.errors_total / part.errors if part.errors else None,
        )
        for (name, number), part in sorted(sums.items())
    )


async def _grid(
    connection: AsyncConnection,
    machine_id: int,
    series_ids: list[int],
    since_ns: int | None,
    until_ns: int | None,
    points: int,
    dropped_ns: int,
) -> _Grid | None:
    """Where the buckets lie; None if there is nothing."""
    since, until = since_ns or 0, 2**63 - 1 if until_ns is None else until_ns
    window, stored = evaluations.c, buckets.c
    asked = select(window.end_ns).where(window.machine_id == machine_id, window.end_ns >= since, window.end_ns < until)
    # One after the other: each is found at an end of the index then, and not by looking through it.
    oldest: int | None = await connection.scalar(asked.order_by(window.end_ns.asc()).limit(1))
    newest: int | None = await connection.scalar(asked.order_by(window.end_ns.desc()).limit(1))
    count = select(func.count()).select_from(asked.limit(_SINGLE + 1).subquery())
    if dropped_ns < since and (await connection.execute(count)).scalar_one() <= _SINGLE:
        if oldest is None or newest is None:
            return None
        start = oldest if since_ns is None else since
        end = newest + 1 if until_ns is None else until
        return _Grid(start, end, -(-(end - start) // points), (0, 0), ((start, end),))
    of_buckets = (
        await connection.execute(
            select(func.min(stored.start_ns), func.max(stored.start_ns), func.max(stored.length_ns)).where(
                stored.series_id.in_(series_ids), stored.start_ns >= since, stored.start_ns < until
            )
        )
    ).one()
    found = [value for value in (oldest, newest, *of_buckets[:2]) if value is not None]
    if not found:
        return None
    unit = of_buckets[2] or 1
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


def _of_readings(machine_id: int, series_ids: list[int], grid: _Grid, first_ns: int, end_ns: int) -> Select[Any]:
    window, reading = evaluations.c, readings.c
    joined = evaluations.join(readings, (reading.machine_id == window.machine_id) & (reading.number == window.number))
    return (
        select(
            reading.series_id,
            ((window.end_ns - grid.start_ns) // grid.length_ns).label("place"),
            func.count(),
            func.min(reading.value),
            func.max(reading.value),
            func.sum(reading.value),
            func.count(reading.standard_error),
            func.coalesce(func.sum(reading.standard_error), 0.0),
        )
        .select_from(joined)
        .where(
            window.machine_id == machine_id,
            window.end_ns >= first_ns,
            window.end_ns < end_ns,
            reading.series_id.in_(series_ids),
        )
        .group_by(reading.series_id, "place")
    )


def _of_buckets(series_ids: list[int], grid: _Grid) -> Select[Any]:
    stored = buckets.c
    first_ns, end_ns = grid.of_buckets
    return (
        select(
            stored.series_id,
            ((stored.start_ns - grid.start_ns) // grid.length_ns).label("place"),
            cast(func.sum(stored["count"]), BigInteger),
            func.min(stored.minimum),
            func.max(stored.maximum),
            func.sum(stored.total),
            cast(func.sum(stored.errors), BigInteger),
            func.sum(stored.errors_total),
        )
        .where(
            stored.series_id.in_(series_ids),
            stored.start_ns >= first_ns,
            stored.start_ns < end_ns,
        )
        .group_by(stored.series_id, "place")
    )
