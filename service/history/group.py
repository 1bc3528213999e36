"""Writes steps of several machines in one transaction."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import zstandard
from sqlalchemy import Connection, Table, bindparam, delete, insert, or_, select, update

from service.history.claim import Claim, StepBundle
from service.history.database import Database
from service.history.records import StoredEvent, StoreError
from service.history.tables import alarm_events, checkpoint_parts, checkpoints, machines, reports, series, windows
from service.history.windows import READING, fill_buckets, packed

SeriesNumbers = dict[int, Mapping[tuple[str, str], int]]
_Rows = defaultdict[Table, list[dict[str, Any]]]

# Built once: building them for every step takes nearly as long as executing them.
_newest = (windows.c.machine_id == machines.c.machine_id) & (windows.c.number == machines.c.windows)
# Every writer locks in this order: two on one server must not wait for each other.
_MACHINES = (
    select(machines, windows.c.end_ns)
    .outerjoin(windows, _newest)
    .with_for_update(of=machines)
    .where(machines.c.machine_id.in_(bindparam("which", expanding=True)))
    .order_by(machines.c.machine_id)
)
_COUNT = update(machines).where(machines.c.machine_id == bindparam("which"))
_EVENTS = select(alarm_events.c.sequence, alarm_events.c.id).where(
    alarm_events.c.machine_id == bindparam("which"),
    or_(alarm_events.c.sequence >= bindparam("first"), alarm_events.c.id.in_(bindparam("identifiers", expanding=True))),
)
_CHECKPOINT = update(checkpoints).where(checkpoints.c.machine_id == bindparam("which"))
_OF_MACHINE = checkpoint_parts.c.machine_id == bindparam("which")
_PARTS = select(checkpoint_parts.c.name).where(_OF_MACHINE)
_GONE = delete(checkpoint_parts).where(_OF_MACHINE, checkpoint_parts.c.name.in_(bindparam("gone", expanding=True)))
_INSERT = {table: insert(table) for table in (alarm_events, checkpoint_parts, reports, windows)}


def write_group(
    database: Database, connection: Connection, claims: Sequence[Claim], known: SeriesNumbers, bucket_ns: int
) -> tuple[dict[Claim, StoreError], SeriesNumbers]:
    """Write the attempts of several machines within the connection's transaction.

    Parameters
    ----------
    known : dict
        Numbers of series by machine, then by quantity and name, as far as they have been looked up.

    Returns
    -------
    tuple
        The attempts that were refused, with the reason, and numbers of series that are valid once the transaction is
        committed.
    """
    which = [claim.machine_id for claim in claims]
    found = {row.machine_id: row for row in connection.execute(_MACHINES, {"which": which})}
    refused: dict[Claim, StoreError] = {}
    new_series: SeriesNumbers = {}
    rows, complete = _Rows(list), list[tuple[int, int, int]]()
    for claim in claims:
        bundle, machine = claim.attempt, found.get(claim.machine_id)
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
        numbers = _numbers(connection, claim.machine_id, bundle, known.get(claim.machine_id, {}))
        new_series[claim.machine_id] = numbers
        new = _new_windows(claim.machine_id, bundle, machine.windows + 1, numbers)
        rows[windows] += new
        # Windows wait until the bucket of their time is complete, which is when a window of another bucket comes.
        places = [(machine.end_ns or 0) // bucket_ns, *(row["end_ns"] // bucket_ns for row in new)]
        others = [number for number, place in enumerate(places, machine.windows) if place != places[-1]]
        bucketed = max(others, default=machine.bucketed)
        if machine.bucketed < bucketed:
            complete.append((claim.machine_id, machine.bucketed, bucketed))
        counted = {
            "which": claim.machine_id,
            "steps": claim.written + 1,
            "reports": machine.reports + len(bundle.reports),
            "windows": machine.windows + len(new),
            "bucketed": bucketed,
        }
        connection.execute(_COUNT, counted)
        _write_checkpoint(connection, claim.machine_id, bundle)
    for table, values in rows.items():
        if values:
            connection.execute(_INSERT[table], values)
    for machine_id, after, last in complete:
        fill_buckets(database, connection, machine_id, after, last, bucket_ns)
    return refused, new_series


def _new_events(connection: Connection, claim: Claim, events: Sequence[StoredEvent]) -> list[StoredEvent]:
    """Events that are not in the log yet; StoreError if these contradict it."""
    if not events:
        return []
    new = {event.sequence: event for event in events}
    places = {"which": claim.machine_id, "first": min(new), "identifiers": [event.id for event in events]}
    for sequence, identifier in connection.execute(_EVENTS, places):
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


def _numbers(
    connection: Connection, machine_id: int, bundle: StepBundle, known: Mapping[tuple[str, str], int]
) -> Mapping[tuple[str, str], int]:
    """Numbers of a machine's series; those of the bundle that have none get one."""
    wanted = {(each.quantity, each.name) for _, step in bundle.readings for each in step}
    if wanted <= known.keys():
        return known
    query = select(series.c.quantity, series.c.name, series.c.series_id).where(series.c.machine_id == machine_id)
    there = {(row.quantity, row.name) for row in connection.execute(query)}
    if missing := sorted(wanted - there):
        rows = [{"machine_id": machine_id, "quantity": quantity, "name": name} for quantity, name in missing]
        connection.execute(insert(series), rows)
    return {(row.quantity, row.name): row.series_id for row in connection.execute(query)}


def _new_windows(
    machine_id: int, bundle: StepBundle, number: int, numbers: Mapping[tuple[str, str], int]
) -> list[dict[str, Any]]:
    """Group readings of one time as windows, numbered from `number` on; a series that recurs begins another one."""
    made: list[tuple[dict[str, int], dict[int, tuple[float, float]]]] = []
    for recorded_ns, reading in ((recorded_ns, each) for recorded_ns, step in bundle.readings for each in step):
        series_id = numbers[reading.quantity, reading.name]
        times = {"end_ns": reading.end_ns, "recorded_ns": recorded_ns}
        if not made or made[-1][0] != times or series_id in made[-1][1]:
            made.append((times, {}))
        error = math.nan if reading.standard_error is None else reading.standard_error
        made[-1][1][series_id] = reading.value, error
    return [
        {"machine_id": machine_id, "number": place}
        | times
        | {"readings": packed(np.array([(series_id, *one) for series_id, one in sorted(held.items())], READING))}
        for place, (times, held) in enumerate(made, number)
    ]


def _write_checkpoint(connection: Connection, machine_id: int, bundle: StepBundle) -> None:
    if bundle.head is None:
        return
    values = asdict(bundle.head) | {"alarms": zstandard.compress(bundle.head.alarms.encode())}
    changed = connection.execute(_CHECKPOINT, {"which": machine_id, **values})
    if changed.rowcount == 0:
        connection.execute(insert(checkpoints).values(machine_id=machine_id, **values))
    there = connection.scalars(_PARTS, {"which": machine_id})
    gone = [name for name in there if name not in bundle.keep or name in bundle.new_parts]
    if gone:
        connection.execute(_GONE, {"which": machine_id, "gone": gone})
    new = [{"machine_id": machine_id, "name": name, "data": part} for name, part in bundle.new_parts.items()]
    if new:
        connection.execute(_INSERT[checkpoint_parts], new)
