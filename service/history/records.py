"""The records that the history takes and returns, how long it keeps them, and its errors.

All times are nanoseconds since 1970 UTC. ``recorded_ns``, ``at_ns``, ``created_ns``, ``expires_ns`` and ``revoked_ns``
are the computer's time, all others data time.
"""

from dataclasses import dataclass

from pydantic import BaseModel, Field

from models.errors import RotorwatchError


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

    `quantity` is ``parameter``, ``equation``, ``level``, ``misfit`` or ``speed``, `name` says which one.
    """

    end_ns: int
    quantity: str
    name: str
    value: float
    standard_error: float | None


@dataclass
class StoredBucket:
    """Readings of one name over a stretch of time: the fields of a `ReadingBucket`, but made in a fraction of the time.

    Neither frozen nor with slots: there are twenty thousand in an answer, and this way they are made and written
    fastest.
    """

    name: str
    start_ns: int
    length_ns: int
    count: int
    minimum: float
    mean: float
    maximum: float
    mean_standard_error: float | None


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
    """The state from which a monitor continues: head, and parts with their names."""

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
    """The results of one block; written whole or not at all."""

    reports: tuple[StoredReport, ...] = ()
    readings: tuple[StoredReading, ...] = ()
    events: tuple[StoredEvent, ...] = ()
    checkpoint: CheckpointStep | None = None


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


class StoreError(RotorwatchError):
    """The history cannot be opened, read or written; the message names database or machine, never a password."""


class DamagedError(StoreError):
    """The file is there but is no usable database; the message says what SQLite found."""


class Retention(BaseModel, extra="forbid", frozen=True):
    """How long the history is kept, by the computer's time of recording; alarm events and audit log are kept for ever.

    Readings are reduced to buckets as they come: count, least, mean and largest value, and mean standard error. Buckets
    never go before the readings in them.
    """

    reports_days: float = Field(
        default=14.0, gt=0.0, le=36_500.0, description="how long full reports are kept, in days; about 2 kB each"
    )
    readings_days: float = Field(
        default=90.0, gt=0.0, le=36_500.0, description="how long every single reading is kept, in days"
    )
    bucket_s: int = Field(
        default=600, ge=1, le=86_400, description="length of the buckets that readings are reduced to, in seconds"
    )
    buckets_days: float = Field(
        default=3650.0, gt=0.0, le=36_500.0, description="how long these reduced readings are kept, in days"
    )
