"""How webhooks stand, as JSON."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["WebhookList", "WebhookStatus"]

_JSON = ConfigDict(extra="forbid", frozen=True)
_EXAMPLE_NS = 1767225805000000000


class WebhookStatus(BaseModel):
    """One webhook: what it is told, and how that goes. Counts are since the monitor started."""

    model_config = _JSON

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
    last_delivered_ns: int | None = Field(description="when it last took one", examples=[_EXAMPLE_NS])
    last_error: str = Field(
        description="what went wrong last; empty if nothing has", examples=["503 Service Unavailable"]
    )
    last_error_ns: int | None = Field(description="and when", examples=[_EXAMPLE_NS - 60_000_000_000])


class WebhookList(BaseModel):
    """All webhooks of the settings."""

    model_config = _JSON

    webhooks: tuple[WebhookStatus, ...] = Field(description="in the order of the settings")
