"""Writes what several machines brought in one transaction."""

import math
from collections import ChainMap, defaultdict
from collections.abc import Iterable, Mapping, MutableMapping, Sequence
from dataclasses import asdict
from typing import Any

import zstandard
from sqlalchemy import ColumnElement, Connection, Table, case, delete, insert, or_, select, update

from service.history.claim import Bundle, Claim
from service.history.database import Database
from service.history.records import StoredEvent, StoreError
from service.history.tables import (
    alarm_events,
    buckets,
    checkpoint_parts,
    checkpoints,
    evaluations,
    machines,
    open_buckets,
    readings,
    reports,
    series,
)

__all__ = ["SeriesNumbers", "write_group"]

SeriesNumbers = dict[tuple[int, str, str], int]
_ADDED = ("count", "total", "errors", "errors_total")
_GREATEST = ("recorded_ns", "maximum")
_Rows = defaultdict[Table, list[dict[str, Any]]]


def write_group(
    database: Database, connection: Connection, claims: Sequence[Claim], known: SeriesNumbers, bucket_ns: int
) -> tuple[dict[Claim, StoreError], SeriesNumbers]:
    """Write the attempts of several machines within the connection's transaction.

    Parameters
    ----------
    database, connection : Database, Connection
        Within a transaction.
    claims : sequence of Claim
        Each with an attempt.
    known : dict
        Numbers of series by machine, quantity and name, as far as they have been looked up.
    bucket_ns : int
        Length of the buckets that readings are added to.

    Returns
    -------
    tuple
        The attempts that were refused, with the reason, and numbers of series that are valid once the transaction is
        committed.
    """
    query = select(machines).where(machines.c.machine_id.in_([claim.machine_id for claim in claims])).with_for_update()
    found = {row.machine_id: row for row in connection.execute(query)}
    refused: dict[Claim, StoreError] = {}
    new_series: SeriesNumbers = {}
    rows = _Rows(list)
    for claim in claims:
        bundle, machine = claim.attempt, found.get(claim.machine_id)
        if bundle is None:
            continue
        if machine is None or machine.owner != claim.owner:
            refused[claim] = claim.lost = StoreError(f"another monitor has taken over the history of {claim.title}")
            continue
        if machine.steps > claim.written:
            continue  # the former attempt did reach the database, only its answer was lost
        try:
            events = _new_events(connection, claim, bundle.events)
        except StoreError as error:
            refused[claim] = error
            continue
        of = {"machine_id": claim.machine_id}
        rows[alarm_events] += [of | asdict(event) for event in events]
        rows[reports] += [
            of | asdict(report) | {"number": number, "recorded_ns": recorded_ns, "text": packed}
            for number, (recorded_ns, report, packed) in enumerate(bundle.reports, machine.reports + 1)
        ]
        numbers = ChainMap(new_series, known)
        _add_series(connection, claim.machine_id, bundle, numbers)
        counted = {
            "steps": claim.written + 1,
            "reports": machine.reports + len(bundle.reports),
            "evaluations": _add_readings(rows, of, bundle, machine.evaluations, numbers, bucket_ns),
        }
        connection.execute(update(machines).where(machines.c.machine_id == claim.machine_id).values(counted))
        _write_checkpoint(connection, claim.machine_id, bundle)
    in_buckets = rows.pop(buckets, [])
    for table, values in rows.items():
        if values:
            connection.execute(insert(table), values)
    if in_buckets:
        _fill_buckets(database, connection, in_buckets)
    return refused, new_series


def _new_events(connection: Connection, claim: Claim, events: Sequence[StoredEvent]) -> list[StoredEvent]:
    """Events that are not in the log yet; StoreError if these contradict it."""
    if not events:
        return []
    log = alarm_events.c
    new = {event.sequence: event for event in events}
    query = select(log.sequence, log.id).where(
        log.machine_id == claim.machine_id, or_(log.sequence >= min(new), log.id.in_([event.id for event in events]))
    )
    for sequence, identifier in connection.execute(query):
        event = new.pop(sequence, None)
        if event is not None and event.id != identifier:
            raise StoreError(
                f"{claim.title}: alarm event {sequence} has the id {event.id}, but the history has it with the id "
                f"{identifier}"
            )
        twin = next((each.sequence for each in new.values() if each.id == identifier), None)
        if twin is not None:
            raise StoreError(
                f"{claim.title}: alarm event {twin} has the id {identifier}, which alarm event {sequence} has already"
            )
    return list(new.values())


def _add_series(
    connection: Connection, machine_id: int, bundle: Bundle, numbers: MutableMapping[tuple[int, str, str], int]
) -> None:
    """Look up the numbers of the bundle's series, and give numbers to new ones."""
    wanted = {(machine_id, reading.quantity, reading.name) for _, reading in bundle.readings}
    if wanted <= numbers.keys():
        return
    of_machine = select(series.c.quantity, series.c.name, series.c.series_id).where(series.c.machine_id == machine_id)
    numbers.update({(machine_id, row.quantity, row.name): row.series_id for row in connection.execute(of_machine)})
    if missing := sorted(wanted - numbers.keys()):
        rows = [{"machine_id": machine_id, "quantity": quantity, "name": name} for _, quantity, name in missing]
        connection.execute(insert(series), rows)
        numbers.update({(machine_id, row.quantity, row.name): row.series_id for row in connection.execute(of_machine)})


def _add_readings(
    rows: _Rows,
    of: dict[str, int],
    bundle: Bundle,
    number: int,
    numbers: Mapping[tuple[int, str, str], int],
    bucket_ns: int,
) -> int:
    """Number windows on from what the machine has; return the last number."""
    window, seen = None, set[int]()
    for recorded_ns, reading in bundle.readings:
        series_id = numbers[of["machine_id"], reading.quantity, reading.name]
        value, error = reading.value, reading.standard_error
        if window != (recorded_ns, reading.end_ns) or series_id in seen:
            window, seen = (recorded_ns, reading.end_ns), set()
            number += 1
            rows[evaluations].append(of | {"number": number, "end_ns": reading.end_ns, "recorded_ns": recorded_ns})
        seen.add(series_id)
        rows[readings].append(of | {"number": number, "series_id": series_id, "value": value, "standard_error": error})
        if math.isfinite(value) and (error is None or math.isfinite(error)):  # what is infinite has no mean
            start_ns = reading.end_ns // bucket_ns * bucket_ns
            rows[buckets].append(
                {
                    "series_id": series_id, "start_ns": start_ns, "length_ns": bucket_ns, "recorded_ns": recorded_ns,
                    "count": 1, "minimum": value, "maximum": value, "total": value,
                    "errors": int(error is not None), "errors_total": error or 0.0,
                }
            )  # fmt: skip
    return number


def _fill_buckets(database: Database, connection: Connection, rows: list[dict[str, Any]]) -> None:
    """Add readings to the open buckets; those that they lie beyond are closed."""
    filling = open_buckets.c
    wanted = filling.series_id.in_({row["series_id"] for row in rows})
    # Locked in one order, whoever writes: two monitors on one server must not wait for each other.
    query = select(open_buckets).where(wanted).order_by(filling.series_id).with_for_update()
    there = {row["series_id"]: dict(row) for row in connection.execute(query).mappings()}
    closed: dict[tuple[int, int, int], dict[str, Any]] = {}
    for row in rows:
        before = there.get(row["series_id"])
        if before is not None and _place(before) == _place(row):
            _add(before, row)
            continue
        if before is not None:
            _add(closed.setdefault(_place(before), before), before)
        there[row["series_id"]] = row
    _upsert(database, connection, open_buckets, there.values(), filling.series_id)
    if closed:
        stored = buckets.c
        _upsert(database, connection, buckets, closed.values(), stored.series_id, stored.start_ns, stored.length_ns)


def _place(row: Mapping[str, Any]) -> tuple[int, int, int]:
    return row["series_id"], row["start_ns"], row["length_ns"]


def _add(bucket: dict[str, Any], more: Mapping[str, Any]) -> None:
    if bucket is not more:
        bucket |= {name: bucket[name] + more[name] for name in _ADDED}
        bucket |= {name: max(bucket[name], more[name]) for name in _GREATEST}
        bucket["minimum"] = min(bucket["minimum"], more["minimum"])


def _upsert(
    database: Database, connection: Connection, table: Table, rows: Iterable[dict[str, Any]], *key: ColumnElement[int]
) -> None:
    """Write open buckets as they are, and add closed ones to what is stored of them."""
    made, stored = database.insert(table), table.c
    new = made.excluded
    changes: dict[str, Any] = {one.name: new[one.name] for one in stored if one.name != "series_id"}
    if table is buckets:
        changes = {name: stored[name] + new[name] for name in _ADDED}
        changes |= {name: case((new[name] > stored[name], new[name]), else_=stored[name]) for name in _GREATEST}
        changes["minimum"] = case((new.minimum < stored.minimum, new.minimum), else_=stored.minimum)
    connection.execute(made.on_conflict_do_update(index_elements=key, set_=changes), sorted(rows, key=_place))


def _write_checkpoint(connection: Connection, machine_id: int, bundle: Bundle) -> None:
    if bundle.head is None:
        return
    values = asdict(bundle.head) | {"alarms": zstandard.compress(bundle.head.alarms.encode())}
    changed = connection.execute(update(checkpoints).where(checkpoints.c.machine_id == machine_id).values(values))
    if changed.rowcount == 0:
        connection.execute(insert(checkpoints).values(machine_id=machine_id, **values))
    parts = checkpoint_parts.c
    there = connection.scalars(select(parts.name).where(parts.machine_id == machine_id))
    gone = [name for name in there if name not in bundle.keep or name in bundle.new_parts]
    if gone:
        connection.execute(delete(checkpoint_parts).where(parts.machine_id == machine_id, parts.name.in_(gone)))
    new = [{"machine_id": machine_id, "name": name, "data": part} for name, part in bundle.new_parts.items()]
    if new:
        connection.execute(insert(checkpoint_parts), new)
