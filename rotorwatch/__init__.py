"""What a rotorwatch monitor says, as records, and its client.

`Client` asks a monitor over HTTP; ``rotorwatch.client.alarm_log`` follows alarm logs over Zenoh instead, and needs
eclipse-zenoh. ``docs/client.md`` shows both.
"""

from rotorwatch.client.client import Client
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
from rotorwatch.client.event_stream import ServiceEvent
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
from rotorwatch.records.history import AuditRecord, Reading, ReadingBucket
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

__version__ = "0.1.0"

__all__ = [
    "AccessRefused",
    "Alarm",
    "AlarmCloudEvent",
    "AlarmEventData",
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
