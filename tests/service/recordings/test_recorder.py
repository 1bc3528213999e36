"""The recorder: everything under a machine's keys, verbatim, whatever the disk does."""

import json
import os
import resource
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from models.signals.link import LinkSettings
from models.signals.recording import (
    RecordedMessage,
    RecordingWriter,
    inspect_recording,
    read_recording,
    salvage_recording,
    summarize_recording,
)
from models.signals.wire import encode_block
from service.recordings.catalogue import Catalogue
from service.recordings.leftovers import is_locked
from service.recordings.recorder import Backlog, MachineRecorder
from service.settings.service import RecordingSettings, ServiceSettings
from tests.loopback import session_of
from tests.service.recordings.test_recorder_killed import Sender
from tests.service.rig.live import LAB, endpoint, feeding, open_session, program, settings, until, worker_of
from tests.sure import sure

KEYS = LAB.keys
NOW_NS = 1_795_271_130_000_000_000  # 2026-11-21 14:25:30 UTC
DESCRIPTOR = RecordedMessage(KEYS.descriptor, b'{"channels": []}', b"", "application/json", NOW_NS, NOW_NS - 10)


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the recorder sync and retry ten times as often as usual."""
    for name in ("_SYNC_S", "_RETRY_S"):
        monkeypatch.setattr(f"service.recordings.recorder.{name}", 0.1)


def blocks(count: int, size: int = 4800, start_ns: int = NOW_NS) -> list[RecordedMessage]:
    """Messages of the stream that do not compress."""
    rng = np.random.default_rng(3)
    return [
        RecordedMessage(KEYS.stream, rng.bytes(size), rng.bytes(32), "x;1", start_ns + 1000 * n, start_ns + 1000 * n)
        for n in range(count)
    ]


def into(directory: Path, **fields: float) -> RecordingSettings:
    return RecordingSettings.model_validate({"directory": str(directory), **fields})


@contextmanager
def recording(directory: Path, **fields: float) -> Iterator[MachineRecorder]:
    recorder = MachineRecorder(LAB, into(directory, **fields), lambda _: (), now_ns=lambda: NOW_NS)
    recorder.start()
    try:
        yield recorder
    finally:
        recorder.stop()


def put(recorder: MachineRecorder, messages: list[RecordedMessage]) -> None:
    for message in messages:
        recorder.put(message)


def files(recorder: MachineRecorder) -> list[Path]:
    return [one.path for one in Catalogue(recorder.directory).recordings()]


def recorded(recorder: MachineRecorder, key: str = KEYS.stream) -> list[RecordedMessage]:
    return [message for path in files(recorder) for message in read_recording(path, keys=[key])]


def test_everything_under_the_machines_keys_is_recorded_verbatim(tmp_path: Path) -> None:
    with feeding(settings(endpoint(), recording=into(tmp_path / "kept"))) as (service, feed):
        sent = []
        feed.session.put(KEYS.descriptor, b'{"channels": []}', encoding="application/json")
        for _ in range(120):
            block = feed.block()
            sent.append(encode_block(block, LAB.descriptor.schema_hash))
            feed.put_raw(*sent[-1])
            feed.sequence, feed.start_ns = feed.sequence + 1, block.end_ns
        note_key, said = f"{KEYS.root}/operator/note", b"\x00\xff bearing changed"
        feed.session.put(note_key, said, attachment=b"\x01\x02", encoding="text/plain;µ")
        feed.session.put("rotorwatch/demo/other/stream", b"another machine")
        until(lambda: service.machines()[0].health().quality.accepted_blocks == 120, "120 accepted blocks")
        recorder = sure(worker_of(service).recorder)
        # Descriptor, note, health, alarm states, and the reports of two hops.
        until(lambda: recorder.status().received >= 126, "messages at the recorder")
        assert service.readiness().machines[0].recording == "recording"
        assert service.readiness().ready
    (path,) = files(recorder)
    found = list(read_recording(path))
    assert [(m.payload, m.attachment, m.encoding) for m in found if m.key == KEYS.stream] == sent
    (note,) = [m for m in found if m.key == note_key]
    assert (note.payload, note.attachment, note.encoding) == (said, b"\x01\x02", "text/plain;µ")
    keys = {message.key for message in found}
    assert {KEYS.health, KEYS.alarm_state, KEYS.report, KEYS.descriptor} <= keys
    assert all(key.startswith(KEYS.root + "/") for key in keys)
    report = next(m for m in found if m.key == KEYS.report)
    assert json.loads(report.payload)["machine"] == "lab"
    # Both times are of this computer's clock, at publishing and at arrival.
    assert all(0 < message.publish_time_ns < message.log_time_ns for message in found if message.key == KEYS.stream)


def test_a_descriptor_announced_before_the_recorder_started_is_queried(tmp_path: Path) -> None:
    listen = endpoint()
    announced = b'{"announced": "by query"}'
    command = ("service", "record", "--machine", "lab", "--out", str(tmp_path / "o"), "--connect", listen)
    with session_of(LinkSettings(listen=(listen,))) as session, program(tmp_path, *command) as recorder:

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(KEYS.descriptor, announced, encoding="application/json")

        session.declare_queryable(KEYS.descriptor, answer)
        session.liveliness().declare_token(KEYS.publisher_alive)
        folder = tmp_path / "o" / "demo" / "lab"

        def both() -> bool:
            # Repeated, as there is no sign of when the recorder has all of its subscriptions.
            session.put(KEYS.stream, b"a block", congestion_control=zenoh.CongestionControl.BLOCK)
            time.sleep(0.1)
            return any(_has(path, announced, b"a block") for path in folder.glob("*.part"))

        until(both, "both in the file")
        assert recorder.stop() == 0
        assert "0 dropped, 0 lost" in recorder.output()


def _has(path: Path, *payloads: bytes) -> bool:
    copy = path.with_name("copy.mcap")
    copy.unlink(missing_ok=True)
    if not inspect_recording(path).count:
        return False
    salvage_recording(path, copy)
    found = {message.payload for message in read_recording(copy)}
    copy.unlink()
    return found >= set(payloads)


def test_files_are_closed_by_size_and_each_has_the_descriptor(tmp_path: Path) -> None:
    content = blocks(600)
    with recording(tmp_path, rotate_mb=0.5) as recorder:
        put(recorder, [DESCRIPTOR, *content])
    names = [path.name for path in files(recorder)]
    assert names[:2] == ["20261121T142530Z.mcap", "20261121T142530Z_002.mcap"]
    assert 4 <= len(names) <= 6
    assert recorded(recorder) == content
    for path in files(recorder):
        first = next(iter(read_recording(path)))
        assert (first.payload, first.publish_time_ns) == (DESCRIPTOR.payload, DESCRIPTOR.publish_time_ns)
        # Logged with the next message, or the file would seem to begin when the descriptor was announced.
        assert summarize_recording(path).start_ns >= NOW_NS
    assert (recorder.status().synced, recorder.status().files) == (len(content) + 1, len(names))
    assert not list(recorder.folder.glob("*.part"))


def test_without_an_announced_descriptor_the_machine_files_is_recorded_as_assumed(tmp_path: Path) -> None:
    with recording(tmp_path) as recorder:
        put(recorder, blocks(1))
    (descriptor,) = recorded(recorder, KEYS.descriptor)
    assert json.loads(descriptor.payload) == LAB.descriptor.model_dump(mode="json")
    assert descriptor.encoding == "application/json;assumed-from-machine-file"


def test_files_are_closed_by_age_even_without_new_messages(tmp_path: Path) -> None:
    time_s = [0.0]

    def clock() -> float:
        time_s[0] += 0.1  # or messages after the last sync would never be confirmed
        return time_s[0]

    recorder = MachineRecorder(LAB, into(tmp_path, rotate_s=300), lambda _: (), clock, lambda: NOW_NS)
    recorder.start()
    put(recorder, blocks(3))
    until(lambda: recorder.status().synced == 3, "confirmed messages")
    assert recorder.status().files == 0
    time_s[0] += 300.0
    until(lambda: recorder.status().files == 1, "closed file")
    put(recorder, blocks(1, start_ns=NOW_NS + 300_000_000_000))
    recorder.stop()
    assert [path.name for path in files(recorder)] == ["20261121T142530Z.mcap", "20261121T143030Z.mcap"]


def test_a_missing_folder_is_retried_without_losing_messages(tmp_path: Path) -> None:
    """As with a late mount; the monitor carries on."""
    place = tmp_path / "disk"
    place.write_text("not a folder")
    with feeding(settings(endpoint(), recording=into(place))) as (service, feed):
        feed.put_good(30)
        until(lambda: service.machines()[0].health().quality.accepted_blocks == 30, "30 accepted blocks")
        until(lambda: "failing" in service.readiness().machines[0].recording, "failing recorder")
        assert "disk/demo/lab: cannot be written" in service.readiness().machines[0].recording
        assert service.readiness().ready
        recorder = sure(worker_of(service).recorder)
        until(lambda: recorder.status().received >= 30, "messages at the recorder")
        place.unlink()
        until(lambda: service.readiness().machines[0].recording == "recording", "recorder that works")
        assert service.machines()[0].health().quality.accepted_blocks == 30
    status = recorder.status()
    assert (status.lost, status.dropped) == (0, 0)
    assert status.failures >= 1
    assert len(recorded(recorder)) == 30


def test_a_vanished_folder_is_noticed_and_created_again(tmp_path: Path) -> None:
    with recording(tmp_path / "disk") as recorder:
        put(recorder, blocks(10))
        until(lambda: recorder.status().synced == 10, "confirmed messages")
        shutil.rmtree(tmp_path / "disk")
        put(recorder, blocks(5, start_ns=NOW_NS + 10**9))
        until(lambda: recorder.status().failures > 0, "noticed failure")
        later = blocks(7, start_ns=NOW_NS + 2 * 10**9)
        put(recorder, later)
        until(lambda: recorder.status().synced == 7, "messages in a new file")
    status = recorder.status()
    assert (status.lost, status.problem) == (15, "")
    assert status.received == status.synced + status.lost == 22
    assert recorded(recorder) == later


def test_a_write_error_is_reported_and_recording_resumes_without_loss(tmp_path: Path) -> None:
    """The file size limit of the process is lowered for a while."""
    listen, place = endpoint(), str(tmp_path / "kept")
    command = ("service", "record", "--machine", "lab", "--json", "--out", place, "--listen", listen)
    with program(tmp_path, *command) as recorder:
        recorder.wait_for("idle")  # it listens and has subscribed
        with open_session(listen, "client") as session:
            send = Sender(session)
            for _ in range(20):
                send()
            until(lambda: recorder.latest().get("synced", 0) >= 20, "confirmed messages")
            unlimited = resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE)
            resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, (300_000, unlimited[1]))
            for _ in range(150):
                send()
            until(lambda: recorder.latest().get("state") == "failing", "failing recorder")
            assert "File too large" in str(recorder.latest()["problem"])
            assert "recording fails, trying again" in recorder.errors()
            resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, unlimited)
            until(lambda: recorder.latest().get("state") == "recording", "recorder that works")
            for _ in range(10):
                send()
            until(lambda: recorder.latest().get("received", 0) >= 180, "all messages")
        assert recorder.stop() == 0
    status = recorder.latest()
    assert (status["lost"], status["dropped"], status["problem"]) == (0, 0, "")
    assert status["failures"] != 0
    listed = Catalogue(tmp_path / "kept").recordings()
    assert len(listed) >= 2
    assert [one for one in listed if not one.complete or one.problem] == []
    found = [(m.payload, m.attachment) for one in listed for m in read_recording(one.path, keys=[KEYS.stream])]
    assert found == send.sent


def test_a_full_queue_drops_and_counts_samples_but_keeps_other_messages() -> None:
    backlog = Backlog(100_000, KEYS.stream)
    alarm = RecordedMessage(KEYS.alarm_event, b"{}", b"", "application/json", NOW_NS, NOW_NS)
    backlog.put(alarm)
    for message in blocks(30):  # 19 and the alarm fit
        backlog.put(message)
    assert (backlog.received, backlog.dropped) == (31, 19)
    assert (backlog.take(0.0), backlog.take(0.0)) == ([alarm, *blocks(30)[19:]], [])
    backlog.put(blocks(1, size=200_000)[0])
    assert backlog.dropped == 20
    for _ in range(400):
        backlog.put(alarm)
    assert 0 < len(backlog.take(0.0)) < 400
    backlog.close()
    backlog.put(alarm)
    assert backlog.exhausted
    assert backlog.received == 432


def test_two_recorders_never_write_into_one_folder(tmp_path: Path) -> None:
    with recording(tmp_path) as first:
        put(first, blocks(3))
        until(lambda: first.status().synced == 3, "confirmed messages")
        assert is_locked(first.folder)
        with recording(tmp_path) as second:
            until(lambda: second.status().state == "failing", "second recorder that waits")
            assert "another recorder writes here" in second.status().problem
            put(second, blocks(2, start_ns=NOW_NS + 10**9))
            first.stop()
            until(lambda: second.status().synced == 2, "second recorder at work")
    assert not is_locked(first.folder)
    assert recorded(first) == [*blocks(3), *blocks(2, start_ns=NOW_NS + 10**9)]


def test_files_left_by_a_crash_are_recovered_at_the_start(tmp_path: Path) -> None:
    folder = tmp_path / "demo" / "lab"
    folder.mkdir(parents=True)
    crashed = RecordingWriter(folder / "20261121T142000Z.mcap")
    for message in blocks(100):
        crashed.write(message)
    crashed.abandon()
    (folder / "20261121T141000Z.mcap.part").write_bytes(b"\x89MCAP0\r\n" + bytes(500))
    (folder / "20261121T141500Z.mcap.recovered.part").write_bytes(b"left by a crash during recovery")
    with recording(tmp_path) as recorder:
        until(lambda: [one.suffix for one in files(recorder)] == [".mcap"], "recovered file")
    assert 0 < len(recorded(recorder)) <= 100
    assert recorded(recorder) == blocks(100)[: len(recorded(recorder))]
    names = {path.name for path in folder.iterdir()}
    assert names == {".lock", "20261121T142000Z.mcap", "20261121T141000Z.mcap.damaged"}


def test_only_the_message_that_cannot_be_written_is_lost(tmp_path: Path) -> None:
    odd = RecordedMessage(f"{KEYS.root}/odd", b"", b"", "text/plain", NOW_NS, 2**70)  # a time beyond the file format
    with recording(tmp_path) as recorder:
        put(recorder, [*blocks(3), odd, *blocks(4, start_ns=NOW_NS + 10**9)])
    assert recorded(recorder) == [*blocks(3), *blocks(4, start_ns=NOW_NS + 10**9)]
    assert (recorder.status().lost, recorder.status().failures) == (1, 1)


def test_contradictory_recording_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"alarm_before_s is 86400, longer than keep_days \(0\.5\)"):
        into(tmp_path, alarm_before_s=86400, keep_days=0.5)
    with pytest.raises(ValueError, match="rotate_mb is 256, more than keep_gb"):
        into(tmp_path, keep_gb=0.1)
    assert ServiceSettings().recording.directory is None
    assert os.fspath(tmp_path) == into(tmp_path).directory
