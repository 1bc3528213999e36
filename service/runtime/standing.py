"""State of a machine, sent by the process that monitors it to the one that serves it, and questions in return."""

import dataclasses
import json
from typing import Any

import numpy as np
from pydantic import BaseModel, TypeAdapter

from models.checkpoint import from_bytes, to_bytes
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import SampleBlock
from models.signals.waveform import Waveform
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.health import Health
from rotorwatch.records.windows import Parameter, SensorFault
from service.analysis.snapshots.machine import LatestData
from service.monitor.alarms.operation import OperatorAction
from service.stream.monitored import MachineStatus

_PARTS: dict[str, Any] = {kind.__name__: kind for kind in (LatestData, WindowStatistics, Waveform, SampleBlock)}
_RECORDS: dict[str, type[BaseModel]] = {kind.__name__: kind for kind in (Parameter, SensorFault)}

EVENTS = TypeAdapter(tuple[AlarmCloudEvent, ...])


class Standing(BaseModel, frozen=True, arbitrary_types_allowed=True):
    """The state of a machine; the health is None if it has not changed."""

    process: str
    place: str
    number: int  # larger than in all earlier states of the machine from this process
    sequence: int  # of the latest alarm event
    status: MachineStatus
    # Changes of these are no reason to send the whole health.
    data_age_s: float | None
    accepted_blocks: int
    health: Health | None = None


class Question(BaseModel, frozen=True):
    """A question to the process that monitors a machine."""

    about: str  # ``standing``, ``alarms``, ``detectable``, ``operate``, ``latest``
    change: float | None = None
    include_normal: bool = False
    action: OperatorAction | None = None


def latest_to_bytes(data: LatestData) -> bytes:
    """Latest data of a monitor as bytes that hold nothing but numbers and text."""
    arrays: list[np.ndarray] = []
    form = json.dumps(_to_plain(data, arrays))
    return to_bytes({"form": np.array([form])} | {str(number): array for number, array in enumerate(arrays)})


def latest_from_bytes(content: bytes) -> LatestData:
    """Latest data from the bytes of `latest_to_bytes`.

    Raises
    ------
    CheckpointError
        If the bytes are damaged.
    """
    arrays = from_bytes(content)
    found: LatestData = _from_plain(json.loads(str(arrays["form"][0])), arrays)
    return found


def _to_plain(value: object, arrays: list[np.ndarray]) -> Any:
    """The value for JSON, with its arrays moved to `arrays`; what is not plain becomes a pair of kind and content."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return ["array", str(len(arrays) - 1)]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return ["tuple", [_to_plain(one, arrays) for one in value]]
    if isinstance(value, BaseModel):
        return [type(value).__name__, value.model_dump_json()]
    if dataclasses.is_dataclass(value):
        fields = {one.name: _to_plain(getattr(value, one.name), arrays) for one in dataclasses.fields(value)}
        return [type(value).__name__, fields]
    return value


def _from_plain(form: Any, arrays: dict[str, np.ndarray]) -> Any:
    if not isinstance(form, list):
        return form
    kind, content = form
    if kind == "array":
        return arrays[content]
    if kind == "tuple":
        return tuple(_from_plain(one, arrays) for one in content)
    if kind in _RECORDS:
        return _RECORDS[kind].model_validate_json(content)
    return _PARTS[kind](**{name: _from_plain(one, arrays) for name, one in content.items()})
