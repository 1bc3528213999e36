"""Tables from recordings: the stream, the reports, the alarms.

A table is a schema, whose fields carry ``unit`` and ``description`` in their metadata, and batches of rows.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pydantic import BaseModel, ValidationError

from models.errors import RecordingError, WireError
from models.levels.limits import unit_of
from models.mistakes import mistakes
from models.physics.rotor import PARAMETER_TEXT
from models.signals.block import SampleBlock
from models.signals.channels import ChannelDescriptor
from models.signals.keys import MachineKeys
from models.signals.recording import RecordedMessage
from models.signals.wire import decode_block
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.health import MEASURES, Report
from rotorwatch.records.levels import ChannelLevels
from service.monitor.conversion import rfc3339
from service.recordings.replay.source import RecordingSource

_ROWS = 65536
_MESSAGES = 1000
_READINGS = {
    "relative_change": "relative change",
    "standard_error": "standard error of the relative change",
    "z": "change over its standard error",
}
_Row = dict[str, object]


class _Levels(BaseModel):
    """The part of a report that determines its columns."""

    end_ns: int
    levels: tuple[ChannelLevels, ...] = ()


@dataclass(frozen=True, slots=True)
class Selection:
    """Data to be exported from recordings."""

    source: RecordingSource
    keys: MachineKeys
    # Data time, start included, end excluded.
    from_ns: int | None = None
    to_ns: int | None = None
    si: bool = False  # whether samples are converted to SI units

    def wants(self, time_ns: int) -> bool:
        """Whether a time is within the limits."""
        return (self.from_ns is None or time_ns >= self.from_ns) and (self.to_ns is None or time_ns < self.to_ns)

    def overlaps(self, block: SampleBlock) -> bool:
        """Whether part of a block is within the limits."""
        begins = self.to_ns is None or block.start_ns < self.to_ns
        return begins and (self.from_ns is None or block.end_ns > self.from_ns)


@dataclass(slots=True)
class Table:
    """Columns with units, and rows."""

    schema: pa.Schema
    batches: Iterator[pa.RecordBatch]
    rows: int = 0  # rows read so far
    skipped: list[str] = field(default_factory=list)  # messages that could not be used, and why


def stream_table(selection: Selection) -> Table:
    """Samples, one row per instant: ``time_ns`` and a column per channel, gaps kept.

    Raises
    ------
    RecordingError
        If there is no stream or no descriptor, or the channels change within the recordings.
    """
    descriptor = _descriptor(selection)
    fields = [_field("time_ns", pa.int64(), "ns", "acquisition time since 1970-01-01 UTC")]
    factors = [channel.to_si if selection.si else 1.0 for channel in descriptor.channels]
    kind = pa.float32() if descriptor.dtype == "float32" and not selection.si else pa.float64()
    for channel in descriptor.channels:
        unit = channel.si_unit if selection.si else channel.unit
        fields.append(_field(channel.name, kind, unit, f"{channel.quantity}, {channel.location}, {channel.way}"))
    metadata = {
        "site": descriptor.site,
        "machine": descriptor.machine,
        "rate_hz": repr(descriptor.rate_hz),
        "descriptor": descriptor.model_dump_json(),
    }
    table = Table(pa.schema(fields, metadata=metadata), iter(()))
    table.batches = _stream_batches(selection, descriptor, factors, table)
    return table


def report_table(selection: Selection) -> Table:
    """Reports, one row per window."""
    fields = [
        _field("start_ns", pa.int64(), "ns", "oldest data in the window"),
        _field("end_ns", pa.int64(), "ns", "end of the newest data in the window"),
        _field("state", pa.string(), "", "health after this window"),
        _field("filled", pa.float64(), "1", "fraction of a full window"),
        *(
            _field(field, pa.float64(), measure.unit, str(Report.model_fields[field].description))
            for field, measure in MEASURES.values()
        ),
        _field("suspect", pa.string(), "", "what explains the misfit best"),
        _field("verdict", pa.string(), "", "what has changed, in words"),
        _field("changed", pa.string(), "", "parameters that have changed"),
        _field("confidence", pa.float64(), "1", "that it is exactly these"),
        _field("low_confidence", pa.bool_(), "", "whether it was found in data outside the model"),
        _field("reason", pa.string(), "", "why the window was not evaluated"),
    ]
    fields += [
        _field(f"{name}.{value}", pa.float64(), "1", f"{text}: {meaning}")
        for name, text in PARAMETER_TEXT.items()
        for value, meaning in _READINGS.items()
    ]
    fields += _level_fields(selection)
    fields += [
        _field("bundle", pa.string(), "", "bundle in use; empty without one"),
        _field("machine_hash", pa.string(), "", "hash of the machine file in use"),
    ]
    return _message_table(selection, selection.keys.report, fields, _report_row, "end_ns")


def _level_fields(selection: Selection) -> list[pa.Field]:
    """A column for each level of each channel that occurs in any report; refused if its unit changes."""
    found: dict[str, pa.Field] = {}
    for message in selection.source.messages({selection.keys.report}):
        with suppress(ValidationError):  # reported when its row is read
            report = _Levels.model_validate_json(message.payload)
            for levels in report.levels if selection.wants(report.end_ns) else ():
                pp = levels.detection == "peak to peak"
                for measure in _level_values(levels):
                    unit = "deg" if measure.endswith("_deg") else unit_of(levels.unit, measure, pp) or "1"
                    text = f"{levels.channel}: {ChannelLevels.model_fields[measure].description}"
                    name = f"{levels.channel}.{measure}"
                    column = found.setdefault(name, _field(name, pa.float64(), unit, text))
                    if (before := column.metadata[b"unit"].decode()) != unit:
                        raise RecordingError(
                            f"the unit of {name} has changed from {before} to {unit} at {rfc3339(report.end_ns)}; "
                            "export what is before and after that by itself, with --to-time and --from"
                        )
    return list(found.values())


def _level_values(levels: ChannelLevels) -> dict[str, float]:
    """A channel's levels and phases that have values, by name."""
    return {name: value for name, value in vars(levels).items() if isinstance(value, float)}


def alarm_table(selection: Selection) -> Table:
    """Alarm events, one row each."""
    fields = [
        _field("time_ns", pa.int64(), "ns", "data time of the event"),
        _field("name", pa.string(), "", "the alarm"),
        _field("kind", pa.string(), "", "raised, escalated, cleared, or what an operator or a rule did"),
        _field("severity", pa.string(), "", "alert or danger"),
        _field("text", pa.string(), "", "the event in a sentence"),
        _field("relative_change", pa.float64(), "1", "relative change that decided"),
        _field("standard_error", pa.float64(), "1", "its standard error"),
        _field("low_confidence", pa.bool_(), "", "whether it was found in data outside the model"),
        _field("raised_ns", pa.int64(), "ns", "when this occurrence was raised"),
        _field("occurrence", pa.int64(), "1", "how often it was raised"),
        _field("sequence", pa.int64(), "1", "counts the machine's events"),
        _field("state", pa.string(), "", "of the alarm after the event"),
        _field("actor", pa.string(), "", "who did it; empty for the monitor"),
        _field("reason", pa.string(), "", "why"),
        _field("id", pa.string(), "", "the same however often the event is delivered"),
    ]
    return _message_table(selection, selection.keys.alarm_event, fields, _alarm_row, "time_ns")


def _field(name: str, kind: pa.DataType, unit: str, description: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "description": description})


def _descriptor(selection: Selection) -> ChannelDescriptor:
    """The channel descriptor of the selected blocks; all of them must have the same."""
    found: dict[str, ChannelDescriptor] = {}
    source, key = selection.source, selection.keys.descriptor
    for message in source.messages({key}):
        descriptor = _described(message)
        found[descriptor.schema_hash] = descriptor
    if not found:
        names = ", ".join(map(str, source.paths))
        raise RecordingError(f"{names}: no channel descriptor on {key}, so the columns have no names and units")
    latest = next(iter(found.values()))
    used: ChannelDescriptor | None = None
    for message in source.messages({key, selection.keys.stream}) if len(found) > 1 else ():
        if message.key == key:
            latest = _described(message)
            continue
        with suppress(WireError):  # named when the samples are read
            block = decode_block(message.payload, message.attachment, message.encoding)
            own = found.get(block.schema_hash, latest)
            if not selection.overlaps(block):
                continue
            if used is not None and own != used:
                raise RecordingError(
                    f"the channels on {key} have changed at {rfc3339(block.start_ns)}; export what is before "
                    "and after that by itself, with --to-time and --from"
                )
            used = own
    return used or latest


def _described(message: RecordedMessage) -> ChannelDescriptor:
    try:
        return ChannelDescriptor.model_validate_json(message.payload)
    except ValidationError as error:
        told = "; ".join(text for _, text in mistakes(error, ChannelDescriptor))
        raise RecordingError(f"the channel descriptor on {message.key} cannot be read: {told}") from error


def _stream_batches(
    selection: Selection, descriptor: ChannelDescriptor, factors: Sequence[float], table: Table
) -> Iterator[pa.RecordBatch]:
    """Collect blocks in batches; blocks that overlap or cannot be used are left out and listed in `skipped`."""
    pending: list[tuple[npt.NDArray[np.int64], npt.NDArray[np.floating]]] = []
    count, last_ns = 0, -(2**63)
    tolerance_ns = round(5e8 / descriptor.rate_hz)
    for message in selection.source.messages({selection.keys.stream}):
        try:
            block = decode_block(message.payload, message.attachment, message.encoding)
        except WireError as error:
            table.skipped.append(f"a block recorded at {rfc3339(message.log_time_ns)}: {error}")
            continue
        if not selection.overlaps(block):
            continue
        if block.schema_hash not in {"", descriptor.schema_hash} or block.samples.shape[1] != len(factors):
            table.skipped.append(f"block {block.sequence} has other channels than the descriptor")
            continue
        if block.start_ns < last_ns - tolerance_ns:
            table.skipped.append(f"block {block.sequence} starts before the end of the one before it")
            continue
        last_ns = block.end_ns
        time_ns = block.start_ns + np.rint(np.arange(block.samples.shape[0]) * (1e9 / block.rate_hz)).astype(np.int64)
        low = 0 if selection.from_ns is None else int(np.searchsorted(time_ns, selection.from_ns))
        high = time_ns.size if selection.to_ns is None else int(np.searchsorted(time_ns, selection.to_ns))
        if low < high:
            pending.append((time_ns[low:high], block.samples[low:high]))
            count += high - low
        if count >= _ROWS:
            yield _batch(pending, factors, table)
            pending, count = [], 0
    if pending:
        yield _batch(pending, factors, table)


def _batch(
    pending: list[tuple[npt.NDArray[np.int64], npt.NDArray[np.floating]]], factors: Sequence[float], table: Table
) -> pa.RecordBatch:
    times = np.concatenate([time_ns for time_ns, _ in pending])
    samples = np.concatenate([rows for _, rows in pending])
    columns = [pa.array(times)]
    for number, factor in enumerate(factors):
        column = samples[:, number]
        values = column if factor == 1.0 else column.astype(np.float64) * factor
        kind = table.schema.field(number + 1).type.to_pandas_dtype()
        columns.append(pa.array(np.ascontiguousarray(values, dtype=kind)))
    table.rows += times.size
    return pa.record_batch(columns, schema=table.schema)


def _message_table(
    selection: Selection, key: str, fields: list[pa.Field], row: Callable[[bytes], _Row], time: str
) -> Table:
    """Rows from JSON messages; messages that violate their schema are left out and listed in `skipped`."""
    table = Table(pa.schema(fields, metadata={"key": key}), iter(()))

    def rows() -> Iterator[_Row]:
        for message in selection.source.messages({key}):
            try:
                found = row(message.payload)
            except ValidationError as error:
                table.skipped.append(f"a message on {key} cannot be read: {error}")
                continue
            when = found[time]
            if isinstance(when, int) and selection.wants(when):
                yield {name: found.get(name) for name in table.schema.names}

    def batches() -> Iterator[pa.RecordBatch]:
        wanted = rows()
        while some := list(islice(wanted, _MESSAGES)):
            yield pa.RecordBatch.from_pylist(some, schema=table.schema)
            table.rows += len(some)

    table.batches = batches()
    return table


def _report_row(payload: bytes) -> _Row:
    report = Report.model_validate_json(payload)
    row: _Row = dict(vars(report))
    if (verdict := report.verdict) is not None:
        row |= {"verdict": verdict.text, "changed": " ".join(finding.name for finding in verdict.changed)}
        row |= {"confidence": verdict.confidence, "low_confidence": verdict.low_confidence}
    for reading in report.parameters:
        row |= {f"{reading.name}.{value}": getattr(reading, value) for value in _READINGS}
    for levels in report.levels:
        row |= {f"{levels.channel}.{name}": value for name, value in _level_values(levels).items()}
    return row


def _alarm_row(payload: bytes) -> _Row:
    event = AlarmCloudEvent.model_validate_json(payload)
    return {**vars(event.data), "id": event.id}
