"""What we publish and store is read by other versions: fields that are added later, and documents of every version."""

import json
from pathlib import Path
from typing import Any

import pytest

from models.machine import load_machine
from models.signals.keys import MachineKeys
from models.signals.recording import RecordedMessage, RecordingWriter, read_recording
from models.signals.wire import decode_block
from rotorwatch.client.answers import understood
from rotorwatch.client.log_order import LogOrder
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmLogPage, AlarmStates, EventKind
from rotorwatch.records.example import example
from rotorwatch.records.health import Health, Report
from rotorwatch.records.machines import DetectableChanges, MachineDescription
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot
from rotorwatch.records.windows import SensorFault
from service.analysis.plots.excerpts import RecordedStream
from service.analysis.plots.trend import read_trend
from service.interchange.exported import Selection, Table, alarm_table, report_table, stream_table
from service.monitor.descriptor import descriptor_mismatch
from service.recordings.replay.source import RecordingSource

FIXTURES = Path(__file__).parents[1] / "fixtures"
VERSIONS = sorted(folder.name for folder in FIXTURES.iterdir())
KEYS = MachineKeys("demo", "lab")
ANSWERS = (
    AlarmStates,
    CorrelationSnapshot,
    DetectableChanges,
    Health,
    MachineDescription,
    OrbitSnapshot,
    Report,
    SpectrumSnapshot,
)


def grown(value: Any) -> Any:
    """JSON of a version that says more."""
    if isinstance(value, list):
        return [grown(one) for one in value]
    if isinstance(value, dict):
        return {name: grown(one) for name, one in value.items()} | {"added_later": {"by": 1}}
    return value


def later(text: str | bytes) -> str:
    return json.dumps(grown(json.loads(text)))


def documents(version: str) -> tuple[str, list[str]]:
    """A report, and the alarm log."""
    folder = FIXTURES / version
    return (folder / "report.json").read_text(), (folder / "alarm_log.jsonl").read_text().splitlines()


def everything(source: Table) -> list[dict[str, Any]]:
    rows = [row for batch in source.batches for row in batch.to_pylist()]
    assert source.skipped == []
    return rows


@pytest.fixture
def of_later(tmp_path: Path) -> Path:
    """The recording, by a version that says more in every JSON message."""
    path = tmp_path / "later.mcap"
    with RecordingWriter(path) as writer:
        for one in read_recording(FIXTURES / VERSIONS[-1] / "recording.mcap"):
            payload = later(one.payload).encode() if one.encoding.startswith("application/json") else one.payload
            said = (one.attachment, one.encoding, one.log_time_ns, one.publish_time_ns)
            writer.write(RecordedMessage(one.key, payload, *said))
    return path


@pytest.mark.parametrize("version", VERSIONS)
def test_reports_and_alarm_logs_of_every_version_are_read(version: str) -> None:
    report, log = documents(version)
    found = Report.model_validate_json(report)
    assert found.state == "alert"
    assert found.verdict is not None
    assert [one.name for one in found.verdict.changed] == ["k_by"]
    assert [one.name for one in found.parameters] == ["k_by", "c_by", "k_bz", "c_bz", "e", "EI"]
    assert found.parameters[4].vector is not None
    assert [one.equation for one in found.equations] == ["28", "29", "30", "31"]
    events = [AlarmCloudEvent.model_validate_json(line).data for line in log]
    assert [one.sequence for one in events] == list(range(6))
    assert [one.kind for one in events] == [
        EventKind.RAISED,
        EventKind.ACKNOWLEDGED,
        EventKind.SHELVED,
        EventKind.UNSHELVED,
        EventKind.REMOVED_FROM_SERVICE,
        EventKind.RETURNED_TO_SERVICE,
    ]


@pytest.mark.parametrize("version", VERSIONS)
def test_recordings_of_every_version_are_read(version: str) -> None:
    path = FIXTURES / version / "recording.mcap"
    blocks = [
        decode_block(one.payload, one.attachment, one.encoding)[0]
        for one in read_recording(path)
        if one.key == KEYS.stream
    ]
    assert [(block.sequence, block.samples.shape) for block in blocks] == [(0, (200, 9)), (1, (200, 9))]
    selection = Selection((path,))
    assert len(everything(stream_table(selection))) == 400
    assert len(everything(report_table(selection))) == 1
    assert len(everything(alarm_table(selection))) == 6


def test_fields_added_later_change_nothing_in_what_is_read() -> None:
    report, log = documents(VERSIONS[-1])
    assert Report.model_validate_json(later(report)) == Report.model_validate_json(report)
    for line in log:
        assert AlarmCloudEvent.model_validate_json(later(line)) == AlarmCloudEvent.model_validate_json(line)
    page = json.dumps({"site": "demo", "machine": "lab", "events": [json.loads(one) for one in log], "latest": 5})
    order = LogOrder("demo/lab", -1)
    order.read(AlarmLogPage.model_validate_json(later(page)))
    assert order.next() is not None


@pytest.mark.parametrize("model", ANSWERS)
def test_a_client_reads_answers_of_a_later_version(model: Any) -> None:
    answer = {**example(model), "added_later": 1}
    assert understood(model, json.dumps(answer), "here") == model.model_validate(example(model))


def test_a_kind_of_fault_that_only_a_later_version_has_is_told_by_its_name() -> None:
    fault = example(SensorFault) | {"kind": "wobbling"}
    report = Report.model_validate_json(json.dumps(example(Report) | {"sensors": [fault]}))
    assert report.sensors[0].kind == "wobbling"
    assert json.loads(report.model_dump_json())["sensors"] == [fault]


def test_recordings_of_a_later_version_are_exported_and_plotted(of_later: Path) -> None:
    now, later_on = Selection((FIXTURES / VERSIONS[-1] / "recording.mcap",)), Selection((of_later,))
    for table in (stream_table, report_table, alarm_table):
        assert everything(table(later_on)) == everything(table(now))
    source = RecordingSource([of_later])
    trend = read_trend(source, KEYS, None, 0, 2**62)
    assert trend.origin == "as recorded"
    assert {event.kind for event in trend.alarms} == {EventKind.RAISED}
    reader = RecordedStream(source, KEYS, 0, 2**62)
    assert len(reader.descriptor.channels) == 9


def test_a_publisher_of_a_later_version_may_describe_its_channels_further() -> None:
    machine = load_machine("lab")
    assert descriptor_mismatch(later(machine.descriptor.model_dump_json()).encode(), machine) == ()
