"""Recordings: messages come back byte by byte, and damage is named."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from models.errors import RecordingError
from models.signals.recording import (
    RecordedMessage,
    RecordingWriter,
    read_recording,
    summarize_recording,
)
from models.signals.salvage import salvage_recording

messages = st.builds(
    RecordedMessage,
    key=st.sampled_from(["a/stream", "a/truth", "b/stream"]),
    payload=st.binary(max_size=300),
    attachment=st.binary(max_size=40),
    encoding=st.sampled_from(["", "application/json", "application/x-rotorwatch-block;0123456789ab", "text/plain;µ"]),
    log_time_ns=st.integers(0, 2**63 - 1),
    publish_time_ns=st.integers(0, 2**63 - 1),
)


def _some(count: int, size: int = 7200) -> list[RecordedMessage]:
    """Messages that do not compress, so that several chunks arise."""
    rng = np.random.default_rng(1)
    return [
        RecordedMessage("m/stream", rng.bytes(size), rng.bytes(32), "x;1", 1000 * n, max(0, 1000 * n - 5))
        for n in range(count)
    ]


def _write(path: Path, content: list[RecordedMessage]) -> None:
    with RecordingWriter(path) as writer:
        for message in content:
            writer.write(message)


@settings(deadline=None, max_examples=40)
@given(content=st.lists(messages, max_size=30))
def test_messages_come_back_verbatim_and_in_order(
    tmp_path_factory: pytest.TempPathFactory, content: list[RecordedMessage]
) -> None:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    _write(path, content)
    assert list(read_recording(path)) == content
    summary = summarize_recording(path)
    assert sum(summary.messages.values()) == len(content)
    if content:
        times = [message.log_time_ns for message in content]
        assert (summary.start_ns, summary.end_ns) == (min(times), max(times))


def test_several_chunks_keep_their_order(tmp_path: Path) -> None:
    content = _some(400)
    path = tmp_path / "run.mcap"
    _write(path, content)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) > 5
    assert list(read_recording(path)) == content


def test_a_time_range_and_keys_can_be_chosen(tmp_path: Path) -> None:
    truth = RecordedMessage("m/truth", b"{}", b"", "application/json", 150_000, 150_000)
    content = [*_some(150), truth, *_some(400)[150:]]
    path = tmp_path / "run.mcap"
    _write(path, content)
    chosen = list(read_recording(path, from_ns=100_000, to_ns=200_000))
    assert chosen == [message for message in content if 100_000 <= message.log_time_ns < 200_000]
    assert list(read_recording(path, keys=["m/truth"])) == [truth]
    assert summarize_recording(path).messages == {"m/stream": 400, "m/truth": 1}


def test_json_without_attachment_is_plain_json_for_any_viewer(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    _write(path, [RecordedMessage("m/truth", b'{"speed_rpm":1320}', b"", "application/json", 1, 1)])
    with path.open("rb") as file:
        ((schema, channel, message),) = make_reader(file).iter_messages()
    assert schema is not None
    assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
    assert json.loads(message.data) == {"speed_rpm": 1320}


def test_the_name_appears_when_the_recording_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as writer:
        writer.write(_some(1)[0])
        assert not path.exists()
        assert (tmp_path / "run.mcap.part").exists()
    assert path.exists()
    assert not (tmp_path / "run.mcap.part").exists()
    writer.close()  # once more does nothing
    assert list(read_recording(path)) == _some(1)


def _fail_while_writing(path: Path) -> None:
    with RecordingWriter(path) as writer:
        writer.write(_some(1)[0])
        raise KeyboardInterrupt


def test_an_exception_leaves_a_readable_part(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with pytest.raises(KeyboardInterrupt):
        _fail_while_writing(path)
    assert not path.exists()
    assert list(read_recording(tmp_path / "run.mcap.part")) == _some(1)


def test_an_existing_recording_is_kept_unless_asked(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    _write(path, _some(1))
    with pytest.raises(RecordingError, match=r"run\.mcap: exists already"):
        RecordingWriter(path)
    with RecordingWriter(path, overwrite=True):
        pass
    assert list(read_recording(path)) == []


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"none/run\.mcap\.part: cannot be written"):
        RecordingWriter(tmp_path / "none" / "run.mcap")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    for read in (lambda path: list(read_recording(path)), summarize_recording):
        with pytest.raises(RecordingError, match=r"none\.mcap: cannot be read \(No such file"):
            read(tmp_path / "none.mcap")


def test_another_kind_of_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "photo.mcap"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(1000))
    for read in (lambda path: list(read_recording(path)), summarize_recording):
        with pytest.raises(RecordingError, match=r"photo\.mcap: not a complete recording"):
            read(path)
    with pytest.raises(RecordingError, match=r"photo\.mcap: nothing to recover"):
        salvage_recording(path, tmp_path / "new.mcap")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("part", [0.0, 0.001, 0.3, 0.7, 0.999])
def test_a_cut_off_recording_is_refused_and_can_be_recovered(tmp_path: Path, part: float) -> None:
    content = _some(400)
    path, cut, new = (tmp_path / name for name in ("run.mcap", "cut.mcap", "new.mcap"))
    _write(path, content)
    whole = path.read_bytes()
    cut.write_bytes(whole[: int(len(whole) * part)])
    with pytest.raises(RecordingError, match=r"cut\.mcap"):
        list(read_recording(cut))
    if part < 0.01:  # not one chunk is left
        with pytest.raises(RecordingError, match=r"cut\.mcap: nothing to recover"):
            salvage_recording(cut, new)
        return
    count = salvage_recording(cut, new).count
    # Chunks are 256 KiB, so at most that many messages are lost.
    assert part * len(content) - 256 * 1024 / 7200 - 1 <= count <= len(content)
    assert list(read_recording(new)) == content[:count]


def test_what_a_crash_left_is_kept_and_recovered_to_its_name(tmp_path: Path) -> None:
    path, part = tmp_path / "run.mcap", tmp_path / "run.mcap.part"
    _write(path, _some(400))
    path.rename(part)
    part.write_bytes(part.read_bytes()[:-1000])
    with pytest.raises(RecordingError, match=r"run\.mcap\.part: exists already"):
        RecordingWriter(path)
    assert salvage_recording(part, path).count == 400
    assert list(read_recording(path)) == _some(400)
    assert sorted(tmp_path.iterdir()) == [path, part]
    with pytest.raises(RecordingError, match=r"run\.mcap: exists already"):
        salvage_recording(part, path)
    with pytest.raises(RecordingError, match=r"none\.part: cannot be read"):
        salvage_recording(tmp_path / "none.part", tmp_path / "none")


def test_a_flipped_byte_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    _write(path, _some(400))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF  # in the middle of a chunk: indexes are a thousandth of the file
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"run\.mcap"):
        list(read_recording(path))


def test_a_finished_chunk_is_safe_at_once(tmp_path: Path) -> None:
    """Without a write more, without closing: what a killed process leaves behind."""
    part, new = tmp_path / "run.mcap.part", tmp_path / "new.mcap"
    still = RecordedMessage("m/stream", bytes(7200), bytes(32), "x;1", 1, 1)  # compresses to less than a file buffer
    content = [still] * 100
    with RecordingWriter(tmp_path / "run.mcap") as writer:
        writer.write(still)
        begin, count = part.stat().st_size, 1
        while part.stat().st_size == begin:
            writer.write(content[count])
            count += 1
        assert salvage_recording(part, new).count == count
        assert 30 < count < 50  # 256 KiB
    assert list(read_recording(new)) == content[:count]
