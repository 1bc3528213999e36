"""Recordings: messages come back byte by byte, and damage is named."""

import json
import os
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
    inspect_recording,
    read_recording,
    salvage_recording,
    summarize_recording,
)
from tests.sure import sure

messages = st.builds(
    RecordedMessage, key=st.sampled_from(["a/stream", "a/truth", "b/stream"]), payload=st.binary(max_size=300),
    attachment=st.binary(max_size=40),
    encoding=st.sampled_from(["", "application/json", "application/x-rotorwatch-block;0123456789ab", "text/plain;µ"]),
    log_time_ns=st.integers(0, 2**63 - 1), publish_time_ns=st.integers(0, 2**63 - 1),
)  # fmt: skip


def _some(count: int, size: int = 7200) -> list[RecordedMessage]:
    """Messages that do not compress, so that several chunks arise."""
    rng = np.random.default_rng(1)
    return [
        RecordedMessage("m/stream", rng.bytes(size), rng.bytes(32), "x;1", 1000 * n, max(0, 1000 * n - 5))
        for n in range(count)
    ]


def _write(folder: Path, content: list[RecordedMessage]) -> Path:
    path = folder / "run.mcap"
    with RecordingWriter(path) as writer:
        for message in content:
            writer.write(message)
    return path


@settings(max_examples=40)
@given(content=st.lists(messages, max_size=30))
def test_messages_survive_unchanged(tmp_path_factory: pytest.TempPathFactory, content: list[RecordedMessage]) -> None:
    path = _write(tmp_path_factory.mktemp("recording"), content)
    assert list(read_recording(path)) == content
    summary = summarize_recording(path)
    assert sum(summary.messages.values()) == len(content)
    if content:
        times = [message.log_time_ns for message in content]
        assert (summary.start_ns, summary.end_ns) == (min(times), max(times))


def test_reading_can_be_limited_to_a_start_time_and_keys(tmp_path: Path) -> None:
    truth = RecordedMessage("m/truth", b"{}", b"", "application/json", 150_000, 150_000)
    content = [*_some(150), truth, *_some(400)[150:]]
    path = _write(tmp_path, content)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert len(sure(summary).chunk_indexes) > 5
    assert list(read_recording(path)) == content
    chosen = list(read_recording(path, from_ns=100_000))
    assert chosen == [message for message in content if message.log_time_ns >= 100_000]
    assert list(read_recording(path, keys=["m/truth"])) == [truth]
    assert summarize_recording(path).messages == {"m/stream": 400, "m/truth": 1}


def test_json_without_attachment_is_plain_json_for_any_viewer(tmp_path: Path) -> None:
    path = _write(tmp_path, [RecordedMessage("m/truth", b'{"speed_rpm":1320}', b"", "application/json", 1, 1)])
    with path.open("rb") as file:
        ((schema, channel, message),) = make_reader(file).iter_messages()
    assert (sure(schema).encoding, channel.message_encoding) == ("jsonschema", "json")
    assert json.loads(message.data) == {"speed_rpm": 1320}


def test_the_name_appears_when_the_recording_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as writer:
        writer.write(_some(1)[0])
        assert not path.exists()
        assert (tmp_path / "run.mcap.part").exists()
    assert path.exists()
    assert not (tmp_path / "run.mcap.part").exists()
    writer.close()  # a second close does nothing
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
    path = _write(tmp_path, _some(1))
    with pytest.raises(RecordingError, match=r"run\.mcap: already exists"):
        RecordingWriter(path)
    with RecordingWriter(path, overwrite=True):
        pass
    assert list(read_recording(path)) == []


def test_unreadable_and_unwritable_paths_are_named(tmp_path: Path) -> None:
    for read in (lambda path: list(read_recording(path)), summarize_recording):
        with pytest.raises(RecordingError, match=r"none\.mcap: cannot be read \(No such file"):
            read(tmp_path / "none.mcap")
        with pytest.raises(RecordingError, match=r"is a folder, expected a recording \(\.mcap\) in it"):
            read(tmp_path)
    with pytest.raises(RecordingError, match=r"none/run\.mcap\.part: cannot be written"):
        RecordingWriter(tmp_path / "none" / "run.mcap")
    with pytest.raises(RecordingError, match="is a folder, expected the name of a recording"):
        RecordingWriter(Path())


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"\x89PNG\r\n\x1a\n" + bytes(1000), r"not a recording \(MCAP\); rotorwatch import"),
        (b"", "the file is empty, nothing was recorded in it"),
    ],
)
def test_another_kind_of_file_is_named(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "photo.mcap"
    path.write_bytes(content)
    for read in (lambda path: list(read_recording(path)), summarize_recording):
        with pytest.raises(RecordingError, match=rf"photo\.mcap: {told}"):
            read(path)
    with pytest.raises(RecordingError, match=r"photo\.mcap: nothing to recover"):
        salvage_recording(path, tmp_path / "new.mcap")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("part", [0.0, 0.001, 0.3, 0.7, 0.999])
def test_a_cut_off_recording_is_refused_and_can_be_recovered(tmp_path: Path, part: float) -> None:
    content = _some(400)
    cut, new = tmp_path / "cut.mcap", tmp_path / "new.mcap"
    whole = _write(tmp_path, content).read_bytes()
    cut.write_bytes(whole[: int(len(whole) * part)])
    told = "the file is empty" if part == 0.0 else "its intact parts, if any"
    with pytest.raises(RecordingError, match=rf"cut\.mcap: .*{told}"):
        list(read_recording(cut))
    written = "the file is empty" if part == 0.0 else "its recorder is still writing it, or was killed; rotor"
    with pytest.raises(RecordingError, match=written):
        list(read_recording(cut.rename(tmp_path / "cut.mcap.part")))
    (tmp_path / "cut.mcap.part").rename(cut)
    if part < 0.01:  # not one chunk is left
        with pytest.raises(RecordingError, match=r"cut\.mcap: nothing to recover: .* no part of it is intact"):
            salvage_recording(cut, new)
        return
    count = salvage_recording(cut, new).count
    # Chunks are 256 KiB, so at most that many messages are lost.
    assert part * len(content) - 256 * 1024 / 7200 - 1 <= count <= len(content)
    assert list(read_recording(new)) == content[:count]


def test_the_part_left_by_a_crash_is_kept_and_recovered_to_its_name(tmp_path: Path) -> None:
    path = _write(tmp_path, _some(400))
    part = path.rename(tmp_path / "run.mcap.part")
    part.write_bytes(part.read_bytes()[:-1000])
    with pytest.raises(RecordingError, match=r"run\.mcap\.part: already exists"):
        RecordingWriter(path)
    assert salvage_recording(part, path).count == 400
    assert list(read_recording(path)) == _some(400)
    assert sorted(tmp_path.iterdir()) == [path, part]
    with pytest.raises(RecordingError, match=r"run\.mcap: already exists"):
        salvage_recording(part, path)
    with pytest.raises(RecordingError, match=r"none\.part: cannot be read"):
        salvage_recording(tmp_path / "none.part", tmp_path / "none")


def test_a_finished_chunk_is_safe_at_once(tmp_path: Path) -> None:
    """Without another write or closing, as a killed process leaves it."""
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


def test_a_damaged_chunk_is_skipped_and_counted(tmp_path: Path) -> None:
    content = _some(400)
    path, new = _write(tmp_path, content), tmp_path / "new.mcap"
    whole = inspect_recording(path)
    assert (whole.count, whole.complete, whole.lost_bytes, whole.damaged_chunks) == (400, True, 0, 0)
    assert (whole.start_ns, whole.end_ns) == (0, 399_000)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF  # in the middle of a chunk: indexes are a thousandth of the file
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"run\.mcap"):
        list(read_recording(path))
    salvage = salvage_recording(path, new)
    assert (salvage.damaged_chunks, salvage.complete, salvage.unnamed_messages) == (1, False, 0)
    back = list(read_recording(new))
    assert len(back) == salvage.count == salvage.messages["m/stream"]
    assert 400 - 256 * 1024 // 7200 - 1 <= len(back) < 400
    first = next(n for n, (a, b) in enumerate(zip(back, content, strict=False)) if a != b)
    assert back == content[:first] + content[len(content) - len(back) + first :]
    assert 200_000 < salvage.lost_bytes < 300_000


def test_the_chunk_that_names_the_keys_may_be_damaged(tmp_path: Path) -> None:
    content = _some(400)
    path = _write(tmp_path, content)
    data = bytearray(path.read_bytes())
    data[1000] ^= 0xFF
    path.write_bytes(data)
    salvage = inspect_recording(path)  # the index at the end names them as well
    assert (salvage.damaged_chunks, salvage.unnamed_messages) == (1, 0)
    assert salvage.count > 300
    path.write_bytes(data[:-3000])
    salvage = inspect_recording(path)
    assert (salvage.damaged_chunks, salvage.count) == (1, 0)
    assert salvage.unnamed_messages > 300


@settings(max_examples=40)
@given(place=st.floats(0, 1), keep=st.floats(0, 1), flips=st.integers(0, 3))
def test_recovered_messages_were_written_whatever_the_damage(
    tmp_path_factory: pytest.TempPathFactory, place: float, keep: float, flips: int
) -> None:
    folder = tmp_path_factory.mktemp("damage")
    content = _some(150, 5000)
    path = _write(folder, content)
    data = bytearray(path.read_bytes())[: 8 + int(keep * path.stat().st_size)]
    for flip in range(flips):
        data[int(place * (len(data) - 1)) // (flip + 1)] ^= 0x55
    path.write_bytes(data)
    salvage = inspect_recording(path)
    assert 0 <= salvage.lost_bytes <= len(data)
    if salvage.count:
        back = _salvage(path, folder / "new.mcap")
        assert [message for message in content if message in back] == back
    else:
        with pytest.raises(RecordingError, match="nothing to recover"):
            salvage_recording(path, folder / "new.mcap")


def _salvage(path: Path, target: Path) -> list[RecordedMessage]:
    salvage = salvage_recording(path, target)
    back = list(read_recording(target))
    assert salvage.count == len(back)
    return back


def test_a_flushed_message_is_safe_and_an_abandoned_file_keeps_it(tmp_path: Path) -> None:
    content = _some(3)
    writer = RecordingWriter(tmp_path / "run.mcap")
    assert (writer.messages, writer.flushed) == (0, 0)
    writer.write(content[0])
    assert (writer.messages, writer.flushed) == (1, 0)
    writer.flush()
    assert (writer.messages, writer.flushed) == (1, 1)
    writer.write(content[1])
    writer.sync()
    assert (writer.flushed, writer.size_bytes) == (2, writer.part.stat().st_size)
    writer.write(content[2])
    writer.abandon()
    assert not writer.path.exists()
    assert _salvage(writer.part, writer.path) == content[:2]


def test_a_device_or_pipe_is_not_replaced_by_a_recording(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RecordingError, match="pipe: is a device or pipe, expected the name of a recording"):
        RecordingWriter(tmp_path / "pipe", overwrite=True)
    assert [(one.name, one.is_fifo()) for one in tmp_path.iterdir()] == [("pipe", True)]


def test_a_name_that_was_taken_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap")
    writer.write(_some(1)[0])
    writer.path.write_bytes(b"somebody else's")
    with pytest.raises(RecordingError, match=r"run\.mcap: already exists and is not overwritten; see run\.mcap\.part"):
        writer.close()
    assert writer.path.read_bytes() == b"somebody else's"
    assert list(read_recording(writer.part)) == _some(1)


def test_a_full_disk_is_an_error_with_the_file_s_name(tmp_path: Path) -> None:
    (tmp_path / "run.mcap.part").symlink_to("/dev/full")
    with pytest.raises(RecordingError, match=r"run\.mcap\.part: cannot be written \(No space left on device\)"):
        RecordingWriter(tmp_path / "run.mcap", overwrite=True)
    assert list(tmp_path.iterdir()) == []
