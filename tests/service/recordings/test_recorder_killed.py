"""kill -9 of the recorder at random moments: messages reported safe are there, the loss is bounded and stated."""

import os
import re
import subprocess
from contextlib import ExitStack
from dataclasses import dataclass
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
)
from service.recordings.leftovers import DAMAGED
from tests.loopback import session_of
from tests.service.rig.live import LAB, Program, endpoint, program, until
from tests.service.rig.preloaded import ran

KEY = LAB.keys.stream
ROUNDS, BESIDE = 2, 3
WINDOW = 100  # most messages that the sender is ahead of the slowest recorder's safe count
CHUNK_BYTES = 256 * 1024 + 20_000  # a chunk ends with the message that fills it
NS = 1_000_000_000


def recover(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return ran("service", "recover", *arguments)


class Sender:
    """Publishes messages of many sizes on the stream's key and keeps a copy."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.rng = np.random.default_rng(77)
        self.sent: list[tuple[bytes, bytes]] = []

    def __call__(self) -> None:
        payload, attachment = self.rng.bytes(int(self.rng.integers(1, 9600))), self.rng.bytes(32)
        self.sent.append((payload, attachment))
        self.session.put(
            KEY, payload, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK, encoding="x;1"
        )


@dataclass
class Victim:
    """A recorder, the folder it writes into, and what was found there so far."""

    folder: Path
    recorder: Program
    kill_at: int

    @property
    def safe(self) -> int:
        return int(self.recorder.latest().get("safe", 0))


def on_disk(folder: Path, scratch: Path) -> list[tuple[bytes, bytes]]:
    """Everything that can be read in a folder, with the unfinished file recovered elsewhere."""
    found = []
    for path in sorted(folder.glob("*.mcap*")):
        readable = path
        if ".recovered" in path.name:  # a copy interrupted by the kill: the next recorder deletes it
            continue
        if inspect_recording(path).count == 0:  # killed before its first chunk was complete
            assert path.suffix in {".part", DAMAGED}
            assert path.stat().st_size < CHUNK_BYTES
            continue
        if path.suffix == ".part":
            readable = scratch / f"{folder.parents[1].name}-{path.stem}"
            readable.unlink(missing_ok=True)
            salvage_recording(path, readable)
        found += [(m.payload, m.attachment) for m in read_recording(readable, keys=[KEY])]
    return found


@pytest.mark.slow
def test_no_message_reported_safe_is_lost_when_the_recorder_is_killed_repeatedly(tmp_path: Path) -> None:
    listen = endpoint()
    moments = np.random.default_rng(20)
    folders = [tmp_path / f"disk{n}" / "demo" / "lab" for n in range(BESIDE)]
    before: dict[Path, list[tuple[bytes, bytes]]] = {folder: [] for folder in folders}
    losses: list[int] = []
    with session_of(LinkSettings(listen=(listen,))) as session:
        for number in range(ROUNDS):
            send = Sender(session)
            with ExitStack() as stack:
                victims = []
                for folder in folders:
                    place = tmp_path / f"{number}-{folder.parents[1].name}"
                    place.mkdir()
                    options = ["--machine", "lab", "--out", str(folder.parents[1]), "--rotate-mb", "0.7", "--json"]
                    recorder = stack.enter_context(program(place, "service", "record", *options, "--connect", listen))
                    victims.append(Victim(folder, recorder, int(moments.integers(5, 600))))
                for victim in victims:
                    victim.recorder.wait_for('"state"')
                alive = list(victims)
                while alive:
                    send()
                    for victim in [one for one in alive if len(send.sent) >= one.kill_at]:
                        victim.recorder.kill()
                        alive.remove(victim)
                        losses.append(check(victim, send.sent, before, tmp_path))
                    until(
                        lambda a=alive, s=send: all(len(s.sent) - one.safe < WINDOW for one in a),  # type: ignore[misc]
                        "confirmation of what was sent",
                    )
    assert len(losses) == ROUNDS * BESIDE
    assert any(losses)  # otherwise no kill interrupted any writing
    found = [path for folder in folders for path in folder.glob("*.part") if ".recovered" not in path.name]
    parts = [path for path in found if inspect_recording(path).count]
    completed = sum(inspect_recording(part).complete for part in parts)  # killed before its final rename
    done = recover(*parts)
    assert done.returncode == (0 if parts else 2), done.stderr
    for part in parts:
        target = part.with_suffix("")
        count = sum(1 for _ in read_recording(target))
        assert f"{part}: {count} messages recovered into {target}" in done.stdout
        part.unlink()
    assert done.stdout.count("bytes that cannot be read") == len(parts) - completed
    assert done.stdout.count("only its name was missing") == completed
    for folder in folders:
        assert on_disk(folder, tmp_path) == before[folder]


def check(
    victim: Victim, sent: list[tuple[bytes, bytes]], before: dict[Path, list[tuple[bytes, bytes]]], scratch: Path
) -> int:
    """Compare the disk with what was sent; return the number of lost messages."""
    found = on_disk(victim.folder, scratch)
    earlier = before[victim.folder]
    assert found[: len(earlier)] == earlier  # files of earlier rounds are still there, recovered by this recorder
    new = found[len(earlier) :]
    assert len(new) >= victim.safe
    if new:
        first = sent.index(new[0])
        assert new == sent[first : first + len(new)]  # byte by byte, none missing in between
    before[victim.folder] = found
    lost = len(sent) - len(new)
    assert lost <= WINDOW
    return lost


def half_written(path: Path, count: int = 200) -> tuple[Path, list[RecordedMessage]]:
    """A file whose writer was killed; its messages are of 1970."""
    rng = np.random.default_rng(4)
    messages = [
        RecordedMessage(f"k/{'stream' if n % 10 else 'report'}", rng.bytes(7200), b"", "x", NS * n // 10, 0)
        for n in range(1, count + 1)
    ]
    writer = RecordingWriter(path)
    for message in messages:
        writer.write(message)
    writer.abandon()
    return writer.part, messages


def test_recover_states_what_was_recovered_and_what_was_lost(tmp_path: Path) -> None:
    part, messages = half_written(tmp_path / "run.mcap")
    data = part.read_bytes()
    part.write_bytes(data[:-500])
    done = recover(part)
    assert (done.returncode, done.stderr) == (0, "")
    back = list(read_recording(tmp_path / "run.mcap"))
    assert back == messages[: len(back)]
    assert 100 < len(back) < 200
    reports = sum(message.key == "k/report" for message in back)
    assert f"run.mcap.part: {len(back)} messages recovered into {tmp_path}/run.mcap" in done.stdout
    assert re.search(rf"k/report +{reports} messages\n +k/stream +{len(back) - reports} messages", done.stdout)
    end_s = back[-1].log_time_ns / NS
    assert f"from 1970-01-01 00:00:00.100000 to 1970-01-01 00:00:{end_s:09.6f} UTC ({end_s - 0.1:.3f} s)" in done.stdout
    lost_bytes = int(re.search(r"lost: (\d+) bytes that cannot be read", done.stdout)[1])  # type: ignore[index]
    assert 0 < lost_bytes <= 256 * 1024
    assert "how much is not known, because the file was written long after the times in it" in done.stdout
    assert part.exists()
    again = recover(part)
    assert again.returncode == 1
    assert f"{tmp_path}/run.mcap: already exists and is not overwritten" in again.stderr
    os.utime(part, ns=(0, back[-1].log_time_ns + 2 * NS))
    other = recover(part, "--out", tmp_path / "other.mcap")
    assert other.returncode == 0
    assert "the file was last written 2.000 s after its last readable message" in other.stdout
    assert list(read_recording(tmp_path / "other.mcap")) == back


def test_recover_continues_after_a_file_that_it_cannot_recover(tmp_path: Path) -> None:
    part, _ = half_written(tmp_path / "run.mcap")
    with RecordingWriter(tmp_path / "whole.mcap") as writer:
        writer.write(RecordedMessage("k", b"data", b"", "x", 1, 1))
    done = recover(tmp_path / "none.part", part, tmp_path / "whole.mcap")
    assert done.returncode == 2
    assert "none.part: cannot be read (No such file" in done.stderr
    assert "run.mcap.part:" in done.stdout
    assert "whole.mcap: complete, nothing to recover" in done.stdout
    two = recover(part, part, "--out", tmp_path / "new.mcap")
    assert two.returncode == 2
    assert "--out names one file, and there are 2" in two.stderr
