"""The monitor itself: liveness and readiness, tokens, history, settings, webhooks, and problems with requests."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from rotorwatch.records.fields import EXAMPLE_NS, OfMachine, Record, Request
from rotorwatch.records.health import State


class Alive(Record):
    """The process answers."""

    alive: bool = Field(description="always true", examples=[True])


class MachineReadiness(OfMachine):
    """Whether one machine's monitor works."""

    state: State
    worker_alive: bool = Field(description="the thread that evaluates the machine's blocks runs", examples=[True])
    worker_errors: int = Field(description="blocks lost to an error inside the monitor", examples=[0])
    last_worker_error: str = Field(description="latest error inside the monitor; empty if none", examples=[""])
    worker_busy_s: float = Field(
        description="how long the thread has worked on the same block; above 60 the service is not ready",
        examples=[0.0],
    )
    trouble: str = Field(
        description="why the machine is not monitored properly although data arrive: no window has been evaluated for "
        "two hops, or the history does not accept the results; empty if there is no trouble",
        examples=[""],
    )
    queue_blocks: int = Field(default=0, description="blocks that have arrived and wait for evaluation", examples=[0])
    history_waiting: int = Field(description="steps (one per block) not yet in the history", examples=[0])
    recording: str = Field(
        description="off, idle (nothing has arrived), recording, or `failing: ` and the reason; monitoring continues "
        "in any case",
        examples=["recording"],
    )


class Readiness(Record):
    """Whether the service can do its work; a machine without data does not make it unready."""

    ready: bool = Field(description="true if there are no `reasons`", examples=[True])
    reasons: tuple[str, ...] = Field(description="what is wrong, one sentence each; empty if ready", examples=[()])
    session_open: bool = Field(description="the Zenoh session is open", examples=[True])
    history_open: bool = Field(description="the database is connected, its tables are up to date", examples=[True])
    history_trouble: str = Field(description="why the history cannot be written; empty if it can", examples=[""])
    failing_webhooks: tuple[str, ...] = Field(
        description="webhooks that fail or are disabled, each with what is wrong; they do not affect `ready`",
        examples=[()],
    )
    machines: tuple[MachineReadiness, ...] = Field(description="machine by machine")


class CallerRights(Record):
    """Name and scopes of a caller."""

    name: str = Field(description="name of the token; anonymous where none is needed", examples=["anna"])
    scopes: tuple[str, ...] = Field(
        description="read, operate, configure: scopes of the token as it was presented; as a password it has only read",
        examples=[("read", "operate")],
    )


ScopeName = Literal["read", "operate", "configure"]


class TokenEntry(Record):
    """A token without its secret, which only its user has."""

    token_id: str = Field(description="public part of the token, after rw_", examples=["3fK09aZqT1xB"])
    name: str = Field(description="who uses the token, as shown in the audit log", examples=["control room"])
    scopes: tuple[ScopeName, ...] = Field(description="what the token allows", examples=[("read", "operate")])
    state: Literal["valid", "expired", "revoked"] = Field(description="whether it can be used", examples=["valid"])
    created_ns: int = Field(description="when it was created, by this computer's clock", examples=[EXAMPLE_NS])
    expires_ns: int | None = Field(
        description="when it expires; null: valid until it is revoked", examples=[EXAMPLE_NS + 90 * 86_400 * 10**9]
    )
    revoked_ns: int | None = Field(description="when it was revoked; null if it was not", examples=[None])
    last_used_ns: int | None = Field(
        description="when it was last used; null if it has not been used since the monitor started",
        examples=[EXAMPLE_NS],
    )


class TokenList(Record):
    """Every token ever created."""

    needed: bool = Field(
        description="whether callers need a token; false if the API is open to everybody on this computer",
        examples=[True],
    )
    tokens: tuple[TokenEntry, ...] = Field(description="oldest first")


class TokenRequest(Request):
    """A token to be created."""

    name: str = Field(
        min_length=1,
        max_length=64,
        description="who will use the token, as shown in the audit log: printable, and not the name of another valid "
        "token",
        examples=["control room"],
    )
    scopes: tuple[ScopeName, ...] = Field(
        min_length=1,
        max_length=3,
        description="what the token allows; only scopes that the caller has",
        examples=[("read", "operate")],
    )
    days: int | None = Field(
        default=None, ge=1, le=3650, description="how many days it is valid; left out: until revoked", examples=[90]
    )


class TokenCreated(Record):
    """A new token."""

    token: TokenEntry
    text: str = Field(
        description="the token itself, shown only in this answer: the monitor keeps only a hash of it",
        examples=["rw_3fK09aZqT1xB_0123456789abcdefghijklmnopqrstuvwxyzABCDEFG"],
    )


class HistorySpan(OfMachine):
    """How far back the history of one machine goes, data time."""

    oldest_event_ns: int | None = Field(description="oldest alarm event; null without any", examples=[EXAMPLE_NS])
    oldest_report_ns: int | None = Field(
        description="end of the oldest window whose report is kept", examples=[EXAMPLE_NS]
    )
    oldest_reading_ns: int | None = Field(
        description="oldest reading, of a window or of a bucket that old windows were reduced to", examples=[EXAMPLE_NS]
    )


class HistoryStatus(Record):
    """Database of the history, its size, and how long records are kept."""

    database: str = Field(
        description="address of the database without a password, or a note that it is in memory",
        examples=["sqlite:////var/lib/history.sqlite"],
    )
    size_bytes: int = Field(description="how large the database is", examples=[48_300_032])
    reports_days: float = Field(description="how long full reports are kept", examples=[14.0])
    readings_days: float = Field(description="how long the readings of single windows are kept", examples=[90.0])
    buckets_days: float = Field(description="how long the buckets of older readings are kept", examples=[3650.0])
    machines: tuple[HistorySpan, ...] = Field(description="machine by machine, by name")


class SettingList(Record):
    """Settings of the monitor that are in use; null if a setting is left out and has no default."""

    settings: dict[str, dict[str, JsonValue]] = Field(
        description="by table and name; tables that may hold a secret are left out",
        examples=[{"http": {"host": "127.0.0.1", "port": 8080}, "log": {"level": "info", "format": "console"}}],
    )


class Problem(BaseModel):
    """Problem details of a request that failed (RFC 9457)."""

    model_config = ConfigDict(extra="allow", frozen=True)

    type: str = Field(default="about:blank", description="kind of problem", examples=["about:blank"])
    title: str = Field(description="short title, the same for every problem of this kind", examples=["Not Found"])
    status: int = Field(description="HTTP status", examples=[404])
    detail: str = Field(description="what went wrong this time", examples=["no machine demo/pump; there are: demo/lab"])
    instance: str = Field(description="path of the request", examples=["/api/v1/machines/demo/pump"])


class WebhookStatus(Record):
    """One webhook: the events it receives, and the state of delivery. Counts are since the monitor started."""

    name: str = Field(description="name in the settings", examples=["pager"])
    target: str = Field(
        description="address without path and query, which may hold a secret", examples=["https://pager.example"]
    )
    machines: tuple[str, ...] = Field(description="machines whose events it receives", examples=[["*/*"]])
    kinds: tuple[str, ...] = Field(description="kinds of event it receives; all if empty", examples=[["raised"]])
    severities: tuple[str, ...] = Field(description="severities it receives; all if empty", examples=[[]])
    annunciated_only: bool = Field(
        description="receives no events of alarms that are shelved, suppressed or out of service", examples=[True]
    )
    state: Literal["working", "failing", "disabled"] = Field(
        description="failing: the latest attempt failed, and more will follow. disabled: the receiver has answered "
        "410 Gone; delivery is tried again when the monitor is restarted",
        examples=["working"],
    )
    pending: int = Field(
        description="alarm events after the last one delivered, including those that will be left out", examples=[0]
    )
    delivered: int = Field(description="events that the receiver has accepted", examples=[12])
    failed_attempts: int = Field(description="failed attempts at delivery", examples=[1])
    last_delivered_ns: int | None = Field(description="when the receiver last accepted an event", examples=[EXAMPLE_NS])
    last_error: str = Field(description="latest error; empty if there was none", examples=["503 Service Unavailable"])
    last_error_ns: int | None = Field(
        description="when the latest error occurred", examples=[EXAMPLE_NS - 60_000_000_000]
    )


class WebhookList(Record):
    """All webhooks of the settings."""

    webhooks: tuple[WebhookStatus, ...] = Field(description="in the order of the settings")
