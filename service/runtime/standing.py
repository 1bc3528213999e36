"""How a machine stands, from the process that monitors it to the one that serves it, and what is asked in between."""

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
from service.analysis.snapshots.heading import LatestData
from service.monitor.alarms.operation import OperatorAction
from service.stream.monitored import MachineStatus

_PARTS: dict[str, Any] = {kind.__name__: kind for kind in (LatestData, WindowStatistics, Waveform, SampleBlock)}
_RECORDS: dict[str, type[BaseModel]] = {kind.__name__: kind for kind in (Parameter, SensorFault)}

EVENTS = TypeAdapter(tuple[AlarmCloudEvent, ...])


class Standing(BaseModel, frozen=True, arbitrary_types_allowed=True):
    """What has changed of a machine; what is None has not."""

    process: str
    place: str
    number: int  # larger than those of all that this process saw of the machine before
    sequence: int  # of the latest alarm event
    status: MachineStatus
    # What is no reason to tell all of its health.
    data_age_s: float | None
    accepted_blocks: int
    health: Health | None = None


class Question(BaseModel, frozen=True):
    """What is asked of the process that monitors a machine."""

    about: str  # ``standing``, ``alarms``, ``detectable``, ``operate``, ``latest``
    change: float | None = None
    include_normal: bool = False
    action: OperatorAction | None = None


def latest_to_bytes(data: LatestData) -> bytes:
    """What a monitor holds, as bytes that hold numbers and text alone."""
    arrays: list[np.ndarray] = []
    form = json.dumps(_form(data, arrays))
    return to_bytes({"form": np.array([form])} | {str(number): array for number, array in enumerate(arrays)})


def latest_from_bytes(content: bytes) -> LatestData:
    """The same from what `latest_to_bytes` gave.

    Raises
    ------
    CheckpointError
        If the bytes are damaged.
    """
    arrays = from_bytes(content)
    found: LatestData = _value(json.loads(str(arrays["form"][0])), arrays)
    return found


def _form(value: object, arrays: list[np.ndarray]) -> Any:
    """The value with its arrays taken out, as JSON has it: what is not plain is a pair of its kind and its content."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return ["array", str(len(arrays) - 1)]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return ["tuple", [_form(one, arrays) for one in value]]
    if isinstance(value, BaseModel):
        return [type(value).__name__, value.model_dump_json()]
    if dataclasses.is_dataclass(value):
        fields = {one.name: _form(getattr(value, one.name), arrays) for one in dataclasses.fields(value)}
        return [type(value).__name__, fields]
    return value


def _value(form: Any, arrays: dict[str, np.ndarray]) -> Any:
    if not isinstance(form, list):
        return form
    kind, content = form
    if kind == "array":
        return arrays[content]
    if kind == "tuple":
        return tuple(_value(one, arrays) for one in content)
    if kind in _RECORDS:
        return _RECORDS[kind].model_validate_json(content)
    return _PARTS[kind](**{name: _value(one, arrays) for name, one in content.items()})
