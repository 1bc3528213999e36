"""Every reason for refusing a block, over a real session to a running service; data of other versions."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.descriptor import descriptor_mismatch
from models.ingest import Reason
from models.machine import load_machine
from models.signals.block import SampleBlock
from models.signals.keys import MachineKeys
from models.signals.recording import RecordedMessage, RecordingWriter, read_recording
from models.signals.wire import decode_block, encode_block
from rotorwatch.client.answers import understood
from rotorwatch.client.log_order import LogOrder
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmLogPage, AlarmStates, EventKind
from rotorwatch.records.example import example
from rotorwatch.records.health import Health, Report
from rotorwatch.records.machines import DetectableChanges, MachineDescription
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot
from rotorwatch.records.windows import SensorFault
from service.analysis.recorded import Recorded
from service.analysis.trend import read_trend
from service.interchange.exported import Table, alarm_table, report_table, stream_table
from service.recordings.replay.source import RecordingSource
from service.runtime.runtime import Runtime
from service.stream.worker import MachineWorker
from tests.interchange.material import selected
from tests.service.rig.live import LAB, Feed, fed_service, machine_file, until
from tests.sure import sure

HASH = LAB.descriptor.schema_hash


def with_one(block: SampleBlock, value: float) -> SampleBlock:
    samples = block.samples.copy()
    samples[12, 3] = value
    return SampleBlock(block.start_ns, block.sequence, block.run, block.rate_hz, samples)


def raw(feed: Feed, *, payload: bytes | None = None, encoding: str | None = None) -> None:
    good = encode_block(feed.block(), HASH)
    feed.put_raw(good[0] if payload is None else payload, good[1], good[2] if encoding is None else encoding)


def elsewhere(number: int, seconds: float) -> Callable[[Feed], None]:
    """Put a block with its number and time shifted by so much."""
    return lambda feed: feed.put(
        feed.block(sequence=feed.sequence + number, start_ns=feed.start_ns + round(seconds * 1e9))
    )


BAD: dict[str, tuple[Reason, Callable[[Feed], None], str]] = {
    "cut off": (Reason.MALFORMED, lambda feed: raw(feed, payload=bytes(7199)), "payload has 7199 bytes"),
    "other encoding": (Reason.MALFORMED, lambda feed: raw(feed, encoding="text/plain"), "encoding 'text/plain' is not"),
    "hash": (Reason.CHANNELS, lambda feed: feed.put(feed.block(), schema_hash="0123456789ab"), f"expected {HASH}"),
    "channels": (
        Reason.CHANNELS,
        lambda feed: feed.put(feed.block(samples=feed.samples()[:, 1:]), schema_hash=""),
        "8 channels",
    ),
    "rate": (Reason.RATE, lambda feed: feed.put(feed.block(rate_hz=2048.0)), "has rate_hz 2048, expected 2000"),
    "a single sample": (Reason.SHAPE, lambda feed: feed.put(feed.block(samples=feed.samples(1))), "1 samples"),
    "too long": (Reason.SHAPE, lambda feed: feed.put(feed.block(samples=feed.samples(5000))), "5000 samples (2.5 s)"),
    "NaN": (Reason.NOT_FINITE, lambda feed: feed.put(with_one(feed.block(), np.nan)), "z1_dot: sample 12 is nan"),
    "too large": (
        Reason.NOT_FINITE,
        lambda feed: feed.put(with_one(feed.block(), 2.0**102)),
        "sample 12 is 5.070602400912918e+30, expected a finite number up to 1e+30; are the bytes in little-end",
    ),
    "infinity": (Reason.NOT_FINITE, lambda feed: feed.put(with_one(feed.block(), np.inf)), "sample 12 is inf"),
    "repeated": (Reason.OVERLAP, elsewhere(-1, -0.3), "a repetition or out of order"),
    "two versions": (Reason.CONFLICT, elsewhere(-1, -0.1), "arrived in two versions"),
    "number skipped": (Reason.SEQUENCE, elsewhere(5, 0.0), "sequence is"),
    "clock set back": (Reason.PAST, elsewhere(0, -60.0), "60 s before what was already received"),
    "clock far ahead": (Reason.FUTURE, elsewhere(0, 7200.0), "lies 7200 s ahead, expected at most 3600 s"),
}


@pytest.fixture(scope="module")
def fed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Runtime, MachineWorker, Feed]]:
    # Missing blocks are waited for no longer than a silence may last.
    quick = ("[operation]", "[ingest]\nno_data_after_s = 1.0\nblock_to_s = 0.5\n\n[operation]")
    with fed_service(machine_file(tmp_path_factory.mktemp("machine"), quick)) as (runtime, worker, feed):
        feed.put_good()
        until(lambda: worker.health().quality.accepted_blocks > 0, "first block")
        yield runtime, worker, feed


def test_every_reason_for_refusal_is_covered() -> None:
    assert {reason for reason, _, _ in BAD.values()} == set(Reason)


@pytest.mark.parametrize("name", BAD)
def test_a_bad_block_is_refused_and_the_next_accepted(fed: tuple[Runtime, MachineWorker, Feed], name: str) -> None:
    runtime, worker, feed = fed
    reason, put_bad, text = BAD[name]
    before = worker.health().quality
    put_bad(feed)
    until(lambda: worker.health().quality.refused_blocks != before.refused_blocks, "refusal")
    refused = worker.health().quality
    assert refused.refused_blocks == before.refused_blocks | {reason: before.refused_blocks.get(reason, 0) + 1}
    assert text in refused.last_refusal
    assert refused.last_refusal.startswith("demo/lab: ")
    assert refused.accepted_blocks == before.accepted_blocks
    feed.put_good()
    until(lambda: worker.health().quality.accepted_blocks == before.accepted_blocks + 1, "good block after the bad one")
    after = worker.health().quality
    assert (after.gaps, after.last_refusal) == (before.gaps, refused.last_refusal)
    assert worker.errors == 0
    assert runtime.readiness().ready


@pytest.mark.parametrize(
    ("field", "other", "named"),
    [
        ('"rate_hz":2000.0', '"rate_hz":2048.0', "rate_hz is 2048.0, expected 2000.0"),
        ('"dtype":"float32"', '"dtype":"float64"', "dtype is 'float64', expected 'float32'"),
        ('"machine":"lab"', '"machine":"pump"', "machine is 'pump', expected 'lab'"),
        ('"unit":"mm/s"', '"unit":"m/s"', "channels.2.unit (y1_dot) is 'm/s', expected 'mm/s'"),
        (
            '{"name":"y1","quantity":"displacement","location":"bearing","direction":"y","unit":"um"},',
            "",
            "the number of channels is 8, expected 9",
        ),
        ('"rate_hz":2000.0', '"rate_hz":"fast"', "descriptor cannot be read: rate_hz: expected a number"),
    ],
)
def test_a_mismatching_descriptor_is_explained(field: str, other: str, named: str) -> None:
    text = LAB.descriptor.model_dump_json()
    assert field in text
    assert descriptor_mismatch(text.replace(field, other).encode(), LAB)[0].startswith(named)


FIXTURES = Path(__file__).parents[2] / "fixtures"
VERSIONS = sorted(folder.name for folder in FIXTURES.iterdir())
KEYS = MachineKeys("demo", "lab")
ANSWERS = (
    AlarmStates, CorrelationSnapshot, DetectableChanges, Health, MachineDescription, OrbitSnapshot, Report,
    SpectrumSnapshot,
)  # fmt: skip


def grown(value: Any) -> Any:
    """JSON as a later version writes it, with more fields."""
    if isinstance(value, list):
        return [grown(one) for one in value]
    if isinstance(value, dict):
        return {name: grown(one) for name, one in value.items()} | {"added_later": {"by": 1}}
    return value


def later(text: str | bytes) -> str:
    return json.dumps(grown(json.loads(text)))


def documents(version: str) -> tuple[str, list[str]]:
    folder = FIXTURES / version
    return (folder / "report.json").read_text(), (folder / "alarm_log.jsonl").read_text().splitlines()


def everything(source: Table) -> list[dict[str, Any]]:
    rows = [row for batch in source.batches for row in batch.to_pylist()]
    assert source.skipped == []
    return rows


@pytest.fixture
def of_later(tmp_path: Path) -> Path:
    """The recording as a later version writes it, with more fields in every JSON message."""
    path = tmp_path / "later.mcap"
    with RecordingWriter(path) as writer:
        for one in read_recording(FIXTURES / VERSIONS[-1] / "recording.mcap"):
            payload = later(one.payload).encode() if one.encoding.startswith("application/json") else one.payload
            said = (one.attachment, one.encoding, one.log_time_ns, one.publish_time_ns)
            writer.write(RecordedMessage(one.key, payload, *said))
    return path


@pytest.mark.parametrize("version", VERSIONS)
def test_reports_alarm_logs_and_recordings_of_every_version_are_read(version: str) -> None:
    report, log = documents(version)
    found = Report.model_validate_json(report)
    assert found.state == "alert"
    assert [one.name for one in sure(found.verdict).changed] == ["k_by"]
    assert [one.name for one in found.parameters] == ["k_by", "c_by", "k_bz", "c_bz", "e", "EI"]
    assert found.parameters[4].vector is not None
    assert [one.equation for one in found.equations] == ["28", "29", "30", "31"]
    events = [AlarmCloudEvent.model_validate_json(line).data for line in log]
    assert [one.sequence for one in events] == list(range(6))
    kinds = ["raised", "acknowledged", "shelved", "unshelved", "removed-from-service", "returned-to-service"]
    assert [one.kind for one in events] == kinds
    path = FIXTURES / version / "recording.mcap"
    blocks = [
        decode_block(one.payload, one.attachment, one.encoding)
        for one in read_recording(path)
        if one.key == KEYS.stream
    ]
    assert [(block.sequence, block.samples.shape) for block in blocks] == [(0, (200, 9)), (1, (200, 9))]
    selection = selected(path)
    assert (len(everything(stream_table(selection))), len(everything(report_table(selection)))) == (400, 1)
    assert len(everything(alarm_table(selection))) == 6


def test_fields_of_later_versions_are_ignored() -> None:
    report, log = documents(VERSIONS[-1])
    assert Report.model_validate_json(later(report)) == Report.model_validate_json(report)
    for line in log:
        assert AlarmCloudEvent.model_validate_json(later(line)) == AlarmCloudEvent.model_validate_json(line)
    page = json.dumps({"site": "demo", "machine": "lab", "events": [json.loads(one) for one in log], "latest": 5})
    order = LogOrder("demo/lab", -1)
    order.read(AlarmLogPage.model_validate_json(later(page)))
    assert order.next() is not None


@pytest.mark.parametrize("model", ANSWERS)
def test_a_client_reads_responses_of_a_later_version(model: Any) -> None:
    answer = {**example(model), "added_later": 1}
    assert understood(model, json.dumps(answer), "here") == model.model_validate(example(model))


def test_unknown_sensor_faults_and_descriptor_fields_are_accepted() -> None:
    fault = example(SensorFault) | {"kind": "wobbling"}
    report = Report.model_validate_json(json.dumps(example(Report) | {"sensors": [fault]}))
    assert report.sensors[0].kind == "wobbling"
    assert json.loads(report.model_dump_json())["sensors"] == [fault]
    machine = load_machine("lab")
    assert descriptor_mismatch(later(machine.descriptor.model_dump_json()).encode(), machine) == ()


def test_recordings_of_a_later_version_are_exported_and_plotted(of_later: Path) -> None:
    now, later_on = selected(FIXTURES / VERSIONS[-1] / "recording.mcap"), selected(of_later)
    for table in (stream_table, report_table, alarm_table):
        assert everything(table(later_on)) == everything(table(now))
    reader = Recorded(RecordingSource([of_later]), KEYS, 0, 2**62)
    trend = read_trend(reader)
    assert trend.origin == "as recorded"
    assert {event.kind for event in trend.alarms} == {EventKind.RAISED}
    assert len(reader.descriptor.channels) == 9
