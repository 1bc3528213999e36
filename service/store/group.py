"""Writes what several machines brought in one transaction."""

from collections import ChainMap
from collections.abc import MutableMapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from sqlalchemy import delete, insert, or_, select, update
from sqlalchemy.ext.asyncio import AsyncConnection

from service.store.backlog import Backlog, Bundle
from service.store.database import Database
from service.store.errors import StoreError
from service.store.filling import fill
from service.store.records import StoredEvent
from service.store.tables import (
    alarm_events,
    checkpoint_hops,
    checkpoints,
    evaluations,
    machines,
    readings,
    reports,
    series,
)

__all__ = ["Claim", "SeriesNumbers", "write_group"]

SeriesNumbers = dict[tuple[int, str, str], int]
_Row = dict[str, Any]


@dataclass(slots=True, eq=False)
class Claim:
    """The right to write one machine, and what is to be written.

    Attributes
    ----------
    machine_id, title : int, str
        Number in the database, and ``site/name``.
    owner : str
        Mark of this monitor in the database.
    backlog : Backlog
        What is to be written.
    steps : int
        Number of the latest attempt that is known to be in the database.
    locked : bool
        Whether the lock in PostgreSQL is held, as far as is known.
    lost : StoreError or None
        Why this monitor must not write the machine any more.
    trouble : str
        Why the database, which works, does not take what waits; empty if it does.
    retry_s : float
        When that is tried again, by the clock of the history's loop.
    generation : int
        Goes up when the history goes on in another file, which may lack what was written before.
    """

    machine_id: int
    title: str
    owner: str
    backlog: Backlog
    steps: int
    locked: bool = True
    lost: StoreError | None = None
    trouble: str = ""
    retry_s: float = 0.0
    generation: int = 0


@dataclass(slots=True)
class _Rows:
    """Rows of all machines, table by table."""

    events: list[_Row] = field(default_factory=list)
    reports: list[_Row] = field(default_factory=list)
    evaluations: list[_Row] = field(default_factory=list)
    readings: list[_Row] = field(default_factory=list)
    in_buckets: list[tuple[int, int, int, float, float | None]] = field(default_factory=list)


async def write_group(
    database: Database, connection: AsyncConnection, claims: Sequence[Claim], known: SeriesNumbers, bucket_ns: int
) -> tuple[dict[Claim, StoreError], SeriesNumbers]:
    """Write the attempts of several machines within the connection's transaction.

    Parameters
    ----------
    database : Database
    connection : AsyncConnection
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
    found = {row.machine_id: row for row in await connection.execute(query)}
    refused: dict[Claim, StoreError] = {}
    new_series: SeriesNumbers = {}
    rows = _Rows()
    for claim in claims:
        bundle, machine = claim.backlog.attempt, found.get(claim.machine_id)
        if bundle is None:
            continue
        if machine is None or machine.owner != claim.owner:
            refused[claim] = claim.lost = StoreError(f"another monitor has taken over the history of {claim.title}")
            continue
        if machine.steps > claim.steps:
            continue  # the former attempt did reach the database, only its answer was lost
        events, error = await _new_events(connection, claim, bundle.events)
        if error is not None:
            refused[claim] = error
            continue
        numbers = ChainMap(new_series, known)
        await _add_series(connection, claim.machine_id, bundle, numbers)
        counted = _collect(rows, claim.machine_id, bundle, machine.reports, machine.evaluations, numbers)
        rows.events.extend({"machine_id": claim.machine_id, **asdict(event)} for event in events)
        await connection.execute(
            update(machines).where(machines.c.machine_id == claim.machine_id).values(steps=claim.steps + 1, **counted)
        )
        await _write_checkpoint(connection, claim.machine_id, bundle)
    for table, values in (
        (alarm_events, rows.events),
        (reports, rows.reports),
        (evaluations, rows.evaluations),
        (readings, rows.readings),
    ):
        if values:
            await connection.execute(insert(table), values)
    await fill(database, connection, rows.in_buckets, bucket_ns)
    return refused, new_series


async def _new_events(
    connection: AsyncConnection, claim: Claim, events: Sequence[StoredEvent]
) -> tuple[list[StoredEvent], StoreError | None]:
    """Events that are not in the log yet, or why these cannot go in."""
    if not events:
        return [], None
    log = alarm_events.c
    new = {event.sequence: event for event in events}
    query = select(log.sequence, log.id).where(
        log.machine_id == claim.machine_id,
        or_(log.sequence >= min(new), log.id.in_([event.id for event in events])),
    )
    for sequence, identifier in await connection.execute(query):
        event = new.pop(sequence, None)
        if event is not None and event.id != identifier:
            return [], StoreError(
                f"{claim.title}: alarm event {sequence} has the id {event.id}, but the history has it with the id "
                f"{identifier}"
            )
        twin = next((each.sequence for each in new.values() if each.id == identifier), None)
        if twin is not None:
            return [], StoreError(
                f"{claim.title}: alarm event {twin} has the id {identifier}, which alarm event {sequence} has already"
            )
    return list(new.values()), None


async def _add_series(
    connection: AsyncConnection, machine_id: int, bundle: Bundle, numbers: MutableMapping[tuple[int, str, str], int]
) -> None:
    wanted = {(machine_id, reading.quantity, reading.name) for _, reading in bundle.readings}
    if wanted <= numbers.keys():
        return
    of_machine = select(series.c.quantity, series.c.name, series.c.series_id).where(series.c.machine_id == machine_id)
    for quantity, name, series_id in await connection.execute(of_machine):
        numbers[machine_id, quantity, name] = series_id
    missing = sorted(wanted - numbers.keys())
    if missing:
        rows = [{"machine_id": machine_id, "quantity": quantity, "name": name} for _, quantity, name in missing]
        await connection.execute(insert(series), rows)
        for quantity, name, series_id in await connection.execute(of_machine):
            numbers[machine_id, quantity, name] = series_id


def _collect(
    rows: _Rows,
    machine_id: int,
    bundle: Bundle,
    n_reports: int,
    n_evaluations: int,
    numbers: MutableMapping[tuple[int, str, str], int],
) -> dict[str, int]:
    """Number reports and windows on from what the machine has, and return the new numbers."""
    for packed in bundle.reports:
        n_reports += 1
        rows.reports.append(
            {
                "machine_id": machine_id,
                "number": n_reports,
                "start_ns": packed.report.start_ns,
                "end_ns": packed.report.end_ns,
                "recorded_ns": packed.recorded_ns,
                "state": packed.report.state,
                "filled": packed.report.filled,
                "text": packed.text,
            }
        )
    window, seen = None, set[int]()
    for recorded_ns, reading in bundle.readings:
        series_id = numbers[machine_id, reading.quantity, reading.name]
        if window != (recorded_ns, reading.end_ns) or series_id in seen:
            window, seen = (recorded_ns, reading.end_ns), set()
            n_evaluations += 1
            rows.evaluations.append(
                {
                    "machine_id": machine_id,
                    "number": n_evaluations,
                    "end_ns": reading.end_ns,
                    "recorded_ns": recorded_ns,
                }
            )
        seen.add(series_id)
        rows.in_buckets.append((series_id, reading.end_ns, recorded_ns, reading.value, reading.standard_error))
        rows.readings.append(
            {
                "machine_id": machine_id,
                "number": n_evaluations,
                "series_id": series_id,
                "value": reading.value,
                "standard_error": reading.standard_error,
            }
        )
    return {"reports": n_reports, "evaluations": n_evaluations}


async def _write_checkpoint(connection: AsyncConnection, machine_id: int, bundle: Bundle) -> None:
    if bundle.head is None:
        return
    values = asdict(bundle.head)
    changed = await connection.execute(update(checkpoints).where(checkpoints.c.machine_id == machine_id).values(values))
    if changed.rowcount == 0:
        await connection.execute(insert(checkpoints).values(machine_id=machine_id, **values))
    hops = checkpoint_hops.c
    there = await connection.scalars(select(hops.end_ns).where(hops.machine_id == machine_id))
    gone = [end_ns for end_ns in there if end_ns not in bundle.keep or end_ns in bundle.new_hops]
    if gone:
        await connection.execute(delete(checkpoint_hops).where(hops.machine_id == machine_id, hops.end_ns.in_(gone)))
    new = [{"machine_id": machine_id, "end_ns": end, "moments": hop} for end, hop in bundle.new_hops.items()]
    if new:
        await connection.execute(insert(checkpoint_hops), new)
