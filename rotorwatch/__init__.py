"""Records that a rotorwatch monitor publishes, and clients for it.

`Client` uses the HTTP API; ``rotorwatch.client.alarm_log`` follows alarm logs over Zenoh instead, and needs
eclipse-zenoh. ``docs/client.md`` shows both.
"""

from typing import TYPE_CHECKING

from rotorwatch.client.errors import (
    AccessRefused,
    ClientError,
    Conflict,
    LogReplaced,
    NoAnswer,
    NotFound,
    RequestRefused,
    Unavailable,
)
from rotorwatch.records.alarms import (
    Alarm,
    AlarmCloudEvent,
    AlarmEventData,
    AlarmState,
    AlarmStates,
    EventKind,
    Severity,
)
from rotorwatch.records.health import Health, HealthState, Quality, Report, StreamStatus
from rotorwatch.records.history import AlarmEvidence, AuditRecord, Reading, ReadingBucket
from rotorwatch.records.machines import (
    Channel,
    DetectableChanges,
    DetectableParameter,
    MachineConfiguration,
    MachineDescription,
)
from rotorwatch.records.operations import OperationDone
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot
from rotorwatch.records.windows import Finding, Parameter, SensorFault, Verdict

if TYPE_CHECKING:
    from rotorwatch.client.client import Client
    from rotorwatch.client.event_stream import ServiceEvent

__version__ = "0.1.0"

__all__ = [
    "AccessRefused",
    "Alarm",
    "AlarmCloudEvent",
    "AlarmEventData",
    "AlarmEvidence",
    "AlarmState",
    "AlarmStates",
    "AuditRecord",
    "Channel",
    "Client",
    "ClientError",
    "Conflict",
    "CorrelationSnapshot",
    "DetectableChanges",
    "DetectableParameter",
    "EventKind",
    "Finding",
    "Health",
    "HealthState",
    "LogReplaced",
    "MachineConfiguration",
    "MachineDescription",
    "NoAnswer",
    "NotFound",
    "OperationDone",
    "OrbitSnapshot",
    "Parameter",
    "Quality",
    "Reading",
    "ReadingBucket",
    "Report",
    "RequestRefused",
    "SensorFault",
    "ServiceEvent",
    "Severity",
    "SpectrumSnapshot",
    "StreamStatus",
    "Unavailable",
    "Verdict",
    "__version__",
]


def __getattr__(name: str) -> object:
    """Import the client on first access, so that users of the records alone do not import an HTTP client."""
    if name in {"Client", "ServiceEvent"}:
        from rotorwatch.client import client  # noqa: PLC0415

        return getattr(client, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
