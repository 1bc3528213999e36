"""The monitor itself: liveness and readiness, tokens, history, settings, webhooks, and problems with requests."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from rotorwatch.records.fields import EXAMPLE_NS, REQUEST, OfMachine, Record
from rotorwatch.records.health import State


class Alive(Record):
    """The process answers."""

    alive: bool = Field(description="always true", examples=[True])


class MachineReadiness(OfMachine):
    """Whether one machine's monitor works."""

    state: State
    worker_alive: bool = Field(description="the thread that evaluates the machine's blocks runs", examples=[True])
    worker_errors: int = Field(description="blocks lost to an error inside the monitor", examples=[0])
    last_worker_error: str = Field(description="the latest of them; empty if none", examples=[""])
    worker_busy_s: float = Field(
        description="how long the thread has been working on the same block; more than 60 is a reason", examples=[0.0]
    )
    trouble: str = Field(
        description="why the machine is not monitored as it should be although data come in: no window has been "
        "evaluated for two hops, or the history refuses what happens; empty if it is",
        examples=[""],
    )
    queue_blocks: int = Field(default=0, description="blocks that have arrived and wait for evaluation", examples=[0])
    history_waiting: int = Field(description="steps that are not in the history yet", examples=[0])
    recording: str = Field(
        description="off, idle (nothing has arrived), recording, or failing: why. Monitoring goes on all the same",
        examples=["recording"],
    )


class Readiness(Record):
    """Whether the service can do its work; machines without data are no reason against it."""

    ready: bool = Field(description="there is no reason against it", examples=[True])
    reasons: tuple[str, ...] = Field(description="what is wrong, one sentence each; empty if ready", examples=[()])
    session_open: bool = Field(description="the Zenoh session is open", examples=[True])
    history_open: bool = Field(description="the database is connected, its tables are up to date", examples=[True])
    history_trouble: str = Field(description="why the history cannot be written; empty if it can", examples=[""])
    failing_webhooks: tuple[str, ...] = Field(
        description="webhooks that fail or are disabled, each with what is wrong; no reason against readiness",
        examples=[()],
    )
    machines: tuple[MachineReadiness, ...] = Field(description="machine by machine")


class CallerRights(Record):
    """Who calls, and what that caller may do."""

    name: str = Field(description="name of the token; anonymous where none is needed", examples=["anna"])
    scopes: tuple[str, ...] = Field(
        description="read, operate, configure: those that the token has the way it was given, as a password read alone",
        examples=[("read", "operate")],
    )


ScopeName = Literal["read", "operate", "configure"]


class TokenEntry(Record):
    """A token, without its secret, which nobody has but its user."""

    token_id: str = Field(description="its public part, after rw_", examples=["3fK09aZqT1xB"])
    name: str = Field(description="who uses it, as the audit log says", examples=["control room"])
    scopes: tuple[ScopeName, ...] = Field(description="what it is good for", examples=[("read", "operate")])
    state: Literal["valid", "expired", "revoked"] = Field(description="whether it can be used", examples=["valid"])
    created_ns: int = Field(description="when it was created, this computer's time", examples=[EXAMPLE_NS])
    expires_ns: int | None = Field(
        description="until when it holds; null: until it is revoked", examples=[EXAMPLE_NS + 90 * 86_400 * 10**9]
    )
    revoked_ns: int | None = Field(description="when it was revoked; null if it was not", examples=[None])
    last_used_ns: int | None = Field(
        description="when a request last came with it; null if none has since the monitor started",
        examples=[EXAMPLE_NS],
    )


class TokenList(Record):
    """Every token there ever was."""

    needed: bool = Field(
        description="whether callers need one; false where the API is open to everybody on this computer",
        examples=[True],
    )
    tokens: tuple[TokenEntry, ...] = Field(description="oldest first")


class TokenRequest(BaseModel):
    """A token to be created."""

    model_config = REQUEST

    name: str = Field(
        min_length=1,
        max_length=64,
        description="who will use it, as the audit log shall say: printable, and of no other valid token",
        examples=["control room"],
    )
    scopes: tuple[ScopeName, ...] = Field(
        min_length=1,
        max_length=3,
        description="what it is to be good for; only what the caller's own is good for",
        examples=[("read", "operate")],
    )
    days: int | None = Field(
        default=None, ge=1, le=3650, description="how long it holds; until it is revoked if left out", examples=[90]
    )


class TokenCreated(Record):
    """A new token."""

    token: TokenEntry
    text: str = Field(
        description="the token itself, this once: only a hash of it is kept",
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
    """What is kept, where, and for how long."""

    database: str = Field(
        description="its address, without a password; or that it is in memory",
        examples=["sqlite:////var/lib/history.sqlite"],
    )
    size_bytes: int = Field(description="how large the database is", examples=[48_300_032])
    reports_days: float = Field(description="how long full reports are kept", examples=[14.0])
    readings_days: float = Field(description="how long the readings of single windows are kept", examples=[90.0])
    buckets_days: float = Field(description="how long what they are reduced to is kept", examples=[3650.0])
    machines: tuple[HistorySpan, ...] = Field(description="machine by machine, by name")


class SettingList(Record):
    """Settings of the monitor as they are in use; null is what the file leaves out and has no default."""

    settings: dict[str, dict[str, JsonValue]] = Field(
        description="by table and name; tables that may hold a secret are left out",
        examples=[{"http": {"host": "127.0.0.1", "port": 8080}, "log": {"level": "info", "format": "console"}}],
    )


class Problem(BaseModel):
    """What went wrong with a request, after RFC 9457."""

    model_config = ConfigDict(extra="allow", frozen=True)

    type: str = Field(default="about:blank", description="kind of problem", examples=["about:blank"])
    title: str = Field(description="short, the same for every problem of the kind", examples=["Not Found"])
    status: int = Field(description="HTTP status", examples=[404])
    detail: str = Field(description="what went wrong this time", examples=["no machine demo/pump; there are: demo/lab"])
    instance: str = Field(description="path of the request", examples=["/api/v1/machines/demo/pump"])


class WebhookStatus(Record):
    """One webhook: what it is told, and how that goes. Counts are since the monitor started."""

    name: str = Field(description="from the settings", examples=["pager"])
    target: str = Field(
        description="where it is, without path and query, which may hold a secret", examples=["https://pager.example"]
    )
    machines: tuple[str, ...] = Field(description="machines whose events it receives", examples=[["*/*"]])
    kinds: tuple[str, ...] = Field(description="kinds of event it receives; all if empty", examples=[["raised"]])
    severities: tuple[str, ...] = Field(description="severities it receives; all if empty", examples=[[]])
    annunciated_only: bool = Field(
        description="receives nothing of alarms that are shelved, suppressed or out of service", examples=[True]
    )
    state: Literal["working", "failing", "disabled"] = Field(
        description="failing: the latest attempt failed, and others will follow. disabled: the receiver has answered "
        "410 Gone; it is retried when the monitor is restarted",
        examples=["working"],
    )
    pending: int = Field(
        description="alarm events after the last one delivered, including those that will be left out", examples=[0]
    )
    delivered: int = Field(description="events the receiver has taken", examples=[12])
    failed_attempts: int = Field(description="attempts at which it did not", examples=[1])
    last_delivered_ns: int | None = Field(description="when it last took one", examples=[EXAMPLE_NS])
    last_error: str = Field(
        description="what went wrong last; empty if nothing has", examples=["503 Service Unavailable"]
    )
    last_error_ns: int | None = Field(description="and when", examples=[EXAMPLE_NS - 60_000_000_000])


class WebhookList(Record):
    """All webhooks of the settings."""

    webhooks: tuple[WebhookStatus, ...] = Field(description="in the order of the settings")
