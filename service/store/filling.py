"""Adds readings to their buckets as they come."""

import math
from collections.abc import Iterable
from typing import Any

from sqlalchemy import case
from sqlalchemy.ext.asyncio import AsyncConnection

from service.store.database import Database
from service.store.tables import buckets

__all__ = ["fill"]


async def fill(
    database: Database,
    connection: AsyncConnection,
    readings: Iterable[tuple[int, int, int, float, float | None]],
    length_ns: int,
) -> None:
    """Add readings to the buckets of one length, within the connection's transaction.

    Parameters
    ----------
    database : Database
    connection : AsyncConnection
    readings : iterable of tuple
        Each with its series, end of its window, time of recording, value and standard error. What is infinite has no
        mean and is left out.
    length_ns : int
        Of the buckets; they begin at multiples of it.
    """
    rows: dict[tuple[int, int], dict[str, Any]] = {}
    for series_id, end_ns, recorded_ns, value, error in readings:
        if not math.isfinite(value) or (error is not None and not math.isfinite(error)):
            continue
        start_ns = end_ns // length_ns * length_ns
        row = rows.setdefault(
            (series_id, start_ns),
            {
                "series_id": series_id, "start_ns": start_ns, "length_ns": length_ns, "recorded_ns": recorded_ns,
                "count": 0, "minimum": value, "maximum": value, "total": 0.0, "errors": 0, "errors_total": 0.0,
            },
        )  # fmt: skip
        row["recorded_ns"] = max(row["recorded_ns"], recorded_ns)
        row["count"] += 1
        row["minimum"], row["maximum"] = min(row["minimum"], value), max(row["maximum"], value)
        row["total"] += value
        row["errors"] += error is not None
        row["errors_total"] += error or 0.0
    if not rows:
        return
    made = database.insert(buckets)
    new, stored = made.excluded, buckets.c
    added = made.on_conflict_do_update(
        index_elements=[stored.series_id, stored.start_ns, stored.length_ns],
        set_={
            "recorded_ns": case((new.recorded_ns > stored.recorded_ns, new.recorded_ns), else_=stored.recorded_ns),
            "count": stored["count"] + new["count"],
            "minimum": case((new.minimum < stored.minimum, new.minimum), else_=stored.minimum),
            "maximum": case((new.maximum > stored.maximum, new.maximum), else_=stored.maximum),
            "total": stored.total + new.total,
            "errors": stored.errors + new.errors,
            "errors_total": stored.errors_total + new.errors_total,
        },
    )
    # In one order, whoever writes: two monitors on one server must not wait for each other.
    await connection.execute(added, [rows[place] for place in sorted(rows)])
