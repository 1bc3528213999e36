"""What the history keeps, as it goes in and comes out.

All times are nanoseconds since 1970 UTC. ``recorded_ns``, ``at_ns``, ``created_ns``, ``expires_ns`` and ``revoked_ns``
are the computer's time, all others data time.
"""

from dataclasses import dataclass

__all__ = [
    "AuditEntry",
    "Bucket",
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
    """One entry in the log of alarms of a machine.

    Attributes
    ----------
    sequence : int
        0, 1, 2, … per machine, without a gap, across restarts.
    id : str
        Unique within the machine.
    time_ns, recorded_ns : int
        When it happened, in data time, and when it was recorded.
    kind, alarm, severity, state : str
        What happened to which alarm, and the alarm's state after it.
    occurrence : int
        Number of the alarm's occurrence.
    actor : str
        Who did it; empty if the monitor itself.
    text : str
        The CloudEvent, JSON, to the byte.
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
    """One number of one window.

    Attributes
    ----------
    end_ns : int
        End of the window.
    quantity : str
        ``parameter``, ``equation`` or ``misfit``.
    name : str
        Which parameter or equation.
    value : float
        Never NaN.
    standard_error : float or None
        None if there is none; never NaN.
    """

    end_ns: int
    quantity: str
    name: str
    value: float
    standard_error: float | None


@dataclass(frozen=True, slots=True)
class CheckpointHead:
    """State of a monitor after a step, all but the ring of hops.

    Attributes
    ----------
    format : int
        Number of the format of `state`.
    bundle : str or None
        Bundle the monitor ran with.
    machine_hash, code_version : str
        What the state belongs to.
    end_ns, recorded_ns : int
        End of the newest data in it, and when it was recorded.
    alarms : str
        State of the alarms, JSON.
    state : bytes
        Everything else.
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
    """What a monitor goes on from: head and ring of hops, each with the end of its data, oldest first."""

    head: CheckpointHead
    hops: tuple[tuple[int, bytes], ...]


@dataclass(frozen=True, slots=True)
class CheckpointStep:
    """How the checkpoint changes in a step.

    Attributes
    ----------
    head : CheckpointHead
        Replaces the former one.
    new_hops : tuple of (int, bytes)
        Hops that the step completed, with the ends of their data.
    keep : tuple of int
        Ends of the hops that remain; all others are deleted. New hops remain whether they are named or not.
    """

    head: CheckpointHead
    new_hops: tuple[tuple[int, bytes], ...]
    keep: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Step:
    """What one block brought; written whole or not at all."""

    reports: tuple[StoredReport, ...] = ()
    readings: tuple[StoredReading, ...] = ()
    events: tuple[StoredEvent, ...] = ()
    checkpoint: CheckpointStep | None = None


@dataclass(frozen=True, slots=True)
class Bucket:
    """Readings of one quantity over a stretch of time.

    Attributes
    ----------
    quantity, name : str
        Of what.
    start_ns, length_ns : int
        Windows that end in start_ns ≤ end_ns < start_ns + length_ns.
    count : int
        How many readings.
    minimum, mean, maximum : float
        Of their values.
    mean_standard_error : float or None
        Of those that have one; None if none has.
    """

    quantity: str
    name: str
    start_ns: int
    length_ns: int
    count: int
    minimum: float
    mean: float
    maximum: float
    mean_standard_error: float | None


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """Who asked for what over the API, and what came of it.

    Attributes
    ----------
    number : int
        Given by the database in the order of arrival; what is passed when an entry is appended is not looked at.
    at_ns : int
        When.
    actor, address : str
        Name of the token, and where the request came from.
    method, path, status : str, str, int
        The request and its answer.
    action, machine, alarm, reason : str
        What was meant by it; empty where it does not apply. `machine` is ``site/name``.
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
