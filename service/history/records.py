"""What the history keeps, as it goes in and comes out.

All times are nanoseconds since 1970 UTC. ``recorded_ns``, ``at_ns``, ``created_ns``, ``expires_ns`` and ``revoked_ns``
are the computer's time, all others data time.
"""

from dataclasses import dataclass

__all__ = [
    "AuditEntry",
    "Checkpoint",
    "CheckpointHead",
    "CheckpointStep",
    "Dropped",
    "Step",
    "StoredEvent",
    "StoredReading",
    "StoredReport",
    "TokenRecord",
]


@dataclass(frozen=True, slots=True)
class StoredEvent:
    """One entry in the log of alarms of a machine: what happened to which alarm, and the alarm's state after it.

    `sequence` is 0, 1, 2, … per machine, without a gap, across restarts; `id` is unique within the machine; `actor` is
    empty if it was the monitor itself; `text` is the CloudEvent, JSON, to the byte.
    """

    sequence: int
    id: str
    time_ns: int
    recorded_ns: int
    kind: str
    alarm: str
    severity: str
    state: str
    occurrence: int
    actor: str
    text: str


@dataclass(frozen=True, slots=True)
class StoredReport:
    """The report on one window: state and filling as columns, all of it as JSON in `text`."""

    start_ns: int
    end_ns: int
    state: str
    filled: float
    text: str


@dataclass(frozen=True, slots=True)
class StoredReading:
    """One number of the window that ended at `end_ns`; neither value nor standard error is ever NaN.

    `quantity` is ``parameter``, ``equation``, ``misfit`` or ``speed``, `name` says which one.
    """

    end_ns: int
    quantity: str
    name: str
    value: float
    standard_error: float | None


@dataclass(frozen=True, slots=True)
class CheckpointHead:
    """State of a monitor after a step, all but its large parts.

    `format` is that of `state`; `bundle`, `machine_hash` and `code_version` are what it belongs to; `end_ns` is the end
    of the newest data in it; `alarms` is the state of the alarms, JSON.
    """

    format: int
    bundle: str | None
    machine_hash: str
    code_version: str
    end_ns: int
    recorded_ns: int
    alarms: str
    state: bytes


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """What a monitor goes on from: head and parts, each with its name."""

    head: CheckpointHead
    parts: tuple[tuple[str, bytes], ...]


@dataclass(frozen=True, slots=True)
class CheckpointStep:
    """How the checkpoint changes in a step: a new head, new parts, and the names of those that remain.

    All other parts are deleted. New ones remain whether they are named or not.
    """

    head: CheckpointHead
    new_parts: tuple[tuple[str, bytes], ...]
    keep: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Step:
    """What one block brought; written whole or not at all."""

    reports: tuple[StoredReport, ...] = ()
    readings: tuple[StoredReading, ...] = ()
    events: tuple[StoredEvent, ...] = ()
    checkpoint: CheckpointStep | None = None


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """Who asked for what over the API, and what came of it.

    `number` is given by the database in the order of arrival; `actor` is the name of the token; `machine` is
    ``site/name``, and empty, as `action`, `alarm` and `reason` are, where it does not apply.
    """

    number: int
    at_ns: int
    actor: str
    address: str
    method: str
    path: str
    status: int
    action: str
    machine: str
    alarm: str
    reason: str


@dataclass(frozen=True, slots=True)
class TokenRecord:
    """A token of access, without its secret, of which only a hash is kept."""

    token_id: str
    name: str
    scopes: tuple[str, ...]
    secret_hash: bytes
    created_ns: int
    expires_ns: int | None
    revoked_ns: int | None


@dataclass(frozen=True, slots=True)
class Dropped:
    """What retention removed: reports, windows with their readings, and buckets."""

    reports: int = 0
    windows: int = 0
    buckets: int = 0
