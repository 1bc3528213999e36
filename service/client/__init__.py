"""The client of a monitor: machines, alarms, history and events over HTTP.

``service.client.alarm_log`` follows alarm logs over Zenoh instead; ``docs/client.md`` shows both.
"""

from service.client.errors import (
    AccessRefused,
    ClientError,
    Conflict,
    LogReplaced,
    NoAnswer,
    NotFound,
    RequestRefused,
    Unavailable,
)
from service.client.event_stream import ServiceEvent
from service.client.rotorwatch import Rotorwatch

__all__ = [
    "AccessRefused",
    "ClientError",
    "Conflict",
    "LogReplaced",
    "NoAnswer",
    "NotFound",
    "RequestRefused",
    "Rotorwatch",
    "ServiceEvent",
    "Unavailable",
]
