"""Recovery: what can still be read of a recording whose writer was killed, or that was damaged later."""

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.reader import make_reader
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from models.errors import RecordingError
from models.signals.recording import DAMAGE, RecordedMessage, RecordingWriter, reading, unpacked, writing


@dataclass(slots=True)
class Salvage:
    """What was recovered from a damaged recording, and what was lost."""

    messages: Counter[str] = field(default_factory=Counter)  # number of messages recovered, by key
    # Earliest and latest log time recovered; both 0 if nothing was.
    start_ns: int = 0
    end_ns: int = 0
    lost_bytes: int = 0  # bytes of it that could not be read; what was still in the writer's memory is not among them
    damaged_chunks: int = 0  # chunks before the end that could not be read and were passed over
    unnamed_messages: int = 0  # messages that were lost because the chunk that names their key is damaged
    complete: bool = False  # whether the file had been closed in order and nothing of it was lost
    written_ns: int = 0  # when the damaged file was last written

    @property
    def count(self) -> int:
        """Number of messages recovered."""
        return self.messages.total()

    @property
    def unaccounted_s(self) -> float:
        """Seconds from the latest message recovered to the time at which the file was last written."""
        return max(0.0, (self.written_ns - self.end_ns) * 1e-9) if self.messages else 0.0


def salvage_recording(damaged: Path, target: Path) -> Salvage:
    """Copy what can be read of an interrupted or damaged recording into a complete one.

    A chunk that cannot be read is passed over; what comes after the place where the file is cut off is lost. The
    damaged file, usually the ``.part`` file of a program that was killed, stays as it is; the target may be the name
    that it was meant to get.

    Raises
    ------
    RecordingError
        If `damaged` is missing or nothing of it can be read, or `target` exists or cannot be written.
    """
    salvage = _nothing_yet(damaged)
    messages = _salvaged(damaged, salvage)
    first = next(messages, None)
    if first is None:
        raise RecordingError(f"{damaged}: nothing to recover: not a recording, or no part of it is intact")
    if target.exists():
        raise RecordingError(f"{target}: already exists and is not overwritten")
    # Not under target's own .part name, which is what the damaged file usually has.
    writer = RecordingWriter(target.with_name(target.name + ".recovered"), overwrite=True)
    try:
        while first is not None:
            writer.write(first)
            first = next(messages, None)
        writer.close()
        with writing(target):
            writer.path.replace(target)
    except BaseException:
        writer.abandon()
        writer.part.unlink(missing_ok=True)
        raise
    return salvage


def inspect_recording(path: Path) -> Salvage:
    """Read a recording from end to end and say what can be read of it; `RecordingError` if it cannot be opened."""
    salvage = _nothing_yet(path)
    for _ in _salvaged(path, salvage):
        pass
    return salvage


def salvaged_messages(path: Path) -> Iterator[RecordedMessage]:
    """Messages that can be read of a recording, cut off or not, in the order in which they were written.

    Raises `RecordingError` if it cannot be opened.
    """
    return _salvaged(path, _nothing_yet(path))


def _nothing_yet(path: Path) -> Salvage:
    with reading(path):
        stat = path.stat()
    return Salvage(lost_bytes=stat.st_size, written_ns=stat.st_mtime_ns)


def _salvaged(damaged: Path, salvage: Salvage) -> Iterator[RecordedMessage]:
    """Messages in the order in which they were written; `salvage` is updated on the way."""
    with reading(damaged), damaged.open("rb") as file, suppress(*DAMAGE):
        channels = _listed_channels(file)
        begin = file.seek(0)
        for record in StreamReader(file, emit_chunks=True).records:
            end = file.tell()
            content = _content(record)
            if content is None:
                salvage.damaged_chunks += 1
            else:
                salvage.lost_bytes -= end - begin
            begin = end
            for inner in content or ():
                if isinstance(inner, Channel):
                    channels[inner.id] = inner
                elif isinstance(inner, Message):
                    if inner.channel_id not in channels:
                        salvage.unnamed_messages += 1
                        continue
                    message = unpacked(channels[inner.channel_id], inner)
                    time_ns = message.log_time_ns
                    salvage.start_ns = min(salvage.start_ns, time_ns) if salvage.messages else time_ns
                    salvage.end_ns = max(salvage.end_ns, time_ns)
                    salvage.messages[message.key] += 1
                    yield message
        salvage.lost_bytes -= file.tell() - begin
        salvage.complete = not salvage.damaged_chunks


def _listed_channels(file: BinaryIO) -> dict[int, Channel]:
    """Channels as the index lists them; none in a file that is cut off, whose chunks introduce them one by one."""
    with suppress(*DAMAGE, StopIteration, OSError):  # the last if the file is shorter than the index's end mark
        summary = make_reader(file).get_summary()
        if summary is not None:
            return dict(summary.channels)
    return {}


def _content(record: McapRecord) -> list[McapRecord] | None:
    """Records of a chunk, or the record itself; None if the chunk is damaged."""
    if not isinstance(record, Chunk):
        return [record]
    try:
        return breakup_chunk(record, validate_crc=True)
    except DAMAGE:
        return None
