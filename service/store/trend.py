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
    """Stretches of equal length, next to each other."""

    start_ns: int
    end_ns: int
    length_ns: int


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

    No reading counts twice: it is either there itself or in a stored bucket.
    """
    async with database.reading() as connection:
        query = select(series.c.series_id, series.c.name).where(
            series.c.machine_id == machine_id, series.c.quantity == quantity
        )
        titles = {
            row.series_id: row.name for row in await connection.execute(query) if names is None or row.name in names
        }
        grid = await _grid(connection, machine_id, list(titles), since_ns, until_ns, points)
        if grid is None:
            return ()
        sums: dict[tuple[str, int], _Sum] = {}
        for chosen in (
            _of_readings(machine_id, list(titles), grid, since_ns),
            _of_buckets(list(titles), grid, since_ns),
        ):
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
) -> _Grid | None:
    """Where the buckets lie; None if there is nothing."""
    since, until = since_ns or 0, 2**63 - 1 if until_ns is None else until_ns
    window, stored = evaluations.c, buckets.c
    of_windows = (
        await connection.execute(
            select(func.min(window.end_ns), func.max(window.end_ns)).where(
                window.machine_id == machine_id, window.end_ns >= since, window.end_ns < until
            )
        )
    ).one()
    of_buckets = (
        await connection.execute(
            select(func.min(stored.start_ns), func.max(stored.start_ns), func.max(stored.length_ns)).where(
                stored.series_id.in_(series_ids), stored.start_ns >= since, stored.start_ns < until
            )
        )
    ).one()
    found = [value for value in (*of_windows, *of_buckets[:2]) if value is not None]
    if not found or not series_ids:
        return None
    unit = of_buckets[2] or 1
    start = (min(found) if since_ns is None else since_ns) // unit * unit
    end = max(found) + 1 if until_ns is None else until_ns
    shortest = -(-(end - start) // points)
    return _Grid(start, end, -(-shortest // unit) * unit)


def _of_readings(machine_id: int, series_ids: list[int], grid: _Grid, since_ns: int | None) -> Select[Any]:
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
            window.end_ns >= max(grid.start_ns, since_ns or 0),
            window.end_ns < grid.end_ns,
            reading.series_id.in_(series_ids),
        )
        .group_by(reading.series_id, "place")
    )


def _of_buckets(series_ids: list[int], grid: _Grid, since_ns: int | None) -> Select[Any]:
    stored = buckets.c
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
            stored.start_ns >= max(grid.start_ns, since_ns or 0),
            stored.start_ns < grid.end_ns,
        )
        .group_by(stored.series_id, "place")
    )
