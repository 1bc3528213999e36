"""The monitor itself: whether it is alive and ready, how its webhooks stand, what was wrong with a request."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from rotorwatch.records.fields import EXAMPLE_NS, Name, Record, Site
from rotorwatch.records.health import State


class Alive(Record):
    """The process answers."""

    alive: bool = Field(description="always true", examples=[True])


class MachineReadiness(Record):
    """Whether one machine's monitor works."""

    site: Site
    machine: Name
    state: State
    worker_alive: bool = Field(description="the thread that evaluates the machine's blocks runs", examples=[True])
    worker_errors: int = Field(description="blocks lost to an error inside the monitor", examples=[0])
    last_worker_error: str = Field(description="the latest of them; empty if none", examples=[""])
    worker_busy_s: float = Field(
        description="how long the thread has been at work on the same block; more than 60 is a reason", examples=[0.0]
    )
    trouble: str = Field(
        description="why the machine is not monitored as it should be although data come in: no window has been "
        "evaluated for two hops, or the history refuses what happens; empty if it is",
        examples=[""],
    )
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
    machines: tuple[str, ...] = Field(description="machines it is told of", examples=[["*/*"]])
    kinds: tuple[str, ...] = Field(description="kinds of event it is told of; all if empty", examples=[["raised"]])
    severities: tuple[str, ...] = Field(description="severities it is told of; all if empty", examples=[[]])
    annunciated_only: bool = Field(
        description="not told of alarms that are shelved, suppressed or out of service", examples=[True]
    )
    state: Literal["working", "failing", "disabled"] = Field(
        description="failing: the latest attempt failed, and others will follow. disabled: the receiver has answered "
        "410 Gone; it is tried again when the monitor is started again",
        examples=["working"],
    )
    pending: int = Field(
        description="alarm events after the last one delivered, those included that will be left out", examples=[0]
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
