"""Recordings: messages kept verbatim, with key, attachment, encoding and times, in an MCAP file.

MCAP (https://mcap.dev) has a topic, bytes, two times and per-channel metadata for a message, but no attachment. So:

- the topic is the key, the channel's metadata entry ``encoding`` is the message's encoding string;
- a message without attachment is stored as it is, ``framing`` = ``none`` in the channel's metadata: JSON on its keys
  can be plotted by any MCAP viewer;
- a message with an attachment has ``framing`` = ``attachment-1``: its data is the attachment's length (uint32, little
  endian), the attachment, the payload.

A recording is written to ``NAME.part`` and gets its name when it is closed, so that a name without ``.part`` is always
a complete file. What a crash left behind is a ``.part`` file, which `salvage_recording` turns into a complete one.

Messages are collected in chunks of 256 KiB, compressed with zstd. A chunk reaches the operating system when it is
complete, or with `RecordingWriter.flush`; from then on its messages survive the end of the process, and after
`RecordingWriter.sync` that of the computer.
"""

import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Self

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from models.errors import RecordingError

_CHUNK_BYTES = 256 * 1024
_LENGTH = struct.Struct("<I")
_RECORD_HEAD = 1 + 8  # bytes before a record's contents in the file: its kind and its length
_PLAIN, _PREFIXED = "none", "attachment-1"
# What the mcap library lets through when a file is cut off or overwritten.
DAMAGE = (McapError, CRCValidationError, struct.error, zstandard.ZstdError, ValueError, KeyError, EOFError, MemoryError)


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message as it was on the network."""

    key: str  # Zenoh key
    # Verbatim; an empty attachment is no attachment.
    payload: bytes
    attachment: bytes
    encoding: str  # encoding string, with its schema part
    log_time_ns: int  # when it was recorded, nanoseconds since 1970-01-01 UTC
    publish_time_ns: int  # when it was published


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """What a recording holds."""

    path: Path
    # Earliest and latest log time; both 0 in an empty recording.
    start_ns: int
    end_ns: int
    messages: dict[str, int]  # number of messages by key


class RecordingWriter:
    """Writes a recording; a context manager.

    Leaving the context without an exception gives the file its name. With an exception the file is completed but
    stays ``NAME.part``. Every method raises `RecordingError` if the file cannot be written. With `overwrite`, an
    existing recording is replaced, and a ``.part`` that a crash left.

    Raises
    ------
    RecordingError
        If one of them exists without `overwrite`, or cannot be written, or `path` is a folder or device; the message
        names it.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        if path.is_dir():
            raise RecordingError(f"{path}: is a folder, expected the name of a recording (.mcap)")
        if path.exists() and not path.is_file():  # which the finished file would take the place of
            raise RecordingError(f"{path}: is a device or pipe, expected the name of a recording (.mcap)")
        self.path = path
        self._overwrite = overwrite
        self.part = path.with_name(path.name + ".part")
        for existing in (self.path, self.part):
            if existing.exists() and not overwrite:
                raise RecordingError(f"{existing}: already exists and is not overwritten")
        self._channels: dict[tuple[str, str, str], int] = {}
        self._counts: dict[int, int] = {}
        self.messages = 0  # taken
        self.flushed = 0  # in complete chunks and with the operating system: they survive the end of the process
        self.size_bytes = 0  # of the file, without the chunk in progress
        with writing(self.part):
            self._file = self.part.open("wb")
            self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
            try:
                self._writer.start(profile="rotorwatch-1", library="rotorwatch")
                self._json_schema = self._writer.register_schema("json", "jsonschema", b'{"type":"object"}')
                self._hand_over()
            except OSError:  # the disk is full: no empty file stays behind
                self.abandon()
                self.part.unlink(missing_ok=True)
                raise

    @property
    def channels(self) -> int:
        """Different combinations of key and encoding; a file holds at most 65535."""
        return len(self._channels)

    def write(self, message: RecordedMessage) -> None:
        """Append a message."""
        framing, data = _PLAIN, message.payload
        if message.attachment:
            framing, data = _PREFIXED, _LENGTH.pack(len(message.attachment)) + message.attachment + message.payload
        with writing(self.part):
            channel = self._channel(message.key, message.encoding, framing)
            sequence = self._counts[channel]
            self._counts[channel] = sequence + 1
            self._writer.add_message(channel, message.log_time_ns, data, message.publish_time_ns, sequence & 0xFFFFFFFF)
            self.messages += 1
            if self._file.tell() != self.size_bytes:  # the library writes when a chunk is complete, and only then
                self._hand_over()

    def flush(self) -> None:
        """Complete the chunk in progress and hand it to the operating system."""
        with writing(self.part):
            self._writer.flush()  # type: ignore[no-untyped-call]  # the library's stub
            self._hand_over()

    def sync(self) -> None:
        """`flush`, and wait until the file is on the disk."""
        self.flush()
        with writing(self.part):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Complete the file, wait until it is on the disk, and give it its name.

        Raises
        ------
        RecordingError
            If the file cannot be completed or renamed, or something has taken its name meanwhile.
        """
        if self._file.closed:
            return
        self._complete()
        if self.path.exists() and not self._overwrite:
            raise RecordingError(f"{self.path}: already exists and is not overwritten; see {self.part.name}")
        with writing(self.path):
            self.part.replace(self.path)

    def abandon(self) -> None:
        """Let go of a file that cannot be written any more: it stays ``NAME.part`` with its complete chunks."""
        with suppress(OSError):  # closing tries once more to write what could not be written
            self._file.close()

    def _hand_over(self) -> None:
        self._file.flush()
        self.size_bytes = self._file.tell()
        self.flushed = self.messages

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        elif not self._file.closed:
            self._complete()

    def _complete(self) -> None:
        with writing(self.part):
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]  # the library's stub
                self._hand_over()
                os.fsync(self._file.fileno())
            finally:
                self._file.close()

    def _channel(self, key: str, encoding: str, framing: str) -> int:
        known = self._channels.get((key, encoding, framing))
        if known is not None:
            return known
        json = framing == _PLAIN and encoding.partition(";")[0] == "application/json"
        channel = self._writer.register_channel(
            topic=key,
            message_encoding="json" if json else "x-rotorwatch",
            schema_id=self._json_schema if json else 0,
            metadata={"encoding": encoding, "framing": framing},
        )
        self._channels[key, encoding, framing] = channel
        self._counts[channel] = 0
        return channel


def read_recording(
    path: Path, *, keys: Collection[str] | None = None, from_ns: int | None = None
) -> Iterator[RecordedMessage]:
    """Read messages in the order in which they were written, of some keys only or from a log time on if given.

    Raises
    ------
    RecordingError
        If the file is missing, not a recording, incomplete or damaged; raised where the damage is met.
    """
    # Chunk by chunk, in the order of the file: unless it is asked for the order of time, the library's own iteration
    # collects every message of the file before it gives the first.
    with reading(path), path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
        if summary is None:
            raise RecordingError(f"{path}: the recording has no index")
        wanted = {number for number, channel in summary.channels.items() if keys is None or channel.topic in keys}
        for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
            early = from_ns is not None and index.message_end_time < from_ns
            held = index.message_index_offsets
            if early or (held and not wanted & held.keys()):
                continue
            file.seek(index.chunk_start_offset + _RECORD_HEAD)
            for record in breakup_chunk(Chunk.read(ReadDataStream(file)), validate_crc=True):
                if not isinstance(record, Message) or record.channel_id not in wanted:
                    continue
                if from_ns is None or record.log_time >= from_ns:
                    yield unpacked(summary.channels[record.channel_id], record)


def summarize_recording(path: Path) -> RecordingSummary:
    """Read from its index what a recording holds.

    Raises
    ------
    RecordingError
        If the file is missing, not a recording, incomplete or damaged.
    """
    with reading(path), path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
        if summary is None or summary.statistics is None:
            raise RecordingError(f"{path}: the recording has no index")
        counts = Counter[str]()
        for number, count in summary.statistics.channel_message_counts.items():
            counts[summary.channels[number].topic] += count
        found = summary.statistics
        return RecordingSummary(path, found.message_start_time, found.message_end_time, counts)


def unpacked(channel: Channel, message: Message) -> RecordedMessage:
    """Take a message out of the form in which the file keeps it. Raises ValueError if it is not in that form."""
    framing = channel.metadata.get("framing", _PLAIN)
    encoding = channel.metadata.get("encoding", "")
    attachment, payload = b"", message.data
    if framing == _PREFIXED:
        (length,) = _LENGTH.unpack_from(message.data)
        end = _LENGTH.size + length
        if end > len(message.data):
            raise ValueError(f"attachment of {length} bytes in a message of {len(message.data)} on {channel.topic}")
        attachment, payload = message.data[_LENGTH.size : end], message.data[end:]
    elif framing != _PLAIN:
        raise ValueError(f"framing {framing!r} on {channel.topic} is not {_PLAIN!r} or {_PREFIXED!r}")
    times_ns = message.log_time, message.publish_time
    return RecordedMessage(channel.topic, bytes(payload), bytes(attachment), encoding, *times_ns)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn trouble in writing a file into a `RecordingError` that names it."""
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written ({error.strerror or error})") from error


_RECOVER = "; rotorwatch recover writes its intact parts, if any, to another file"


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn trouble in reading a file, damage included, into a `RecordingError` that names it."""
    try:
        yield
    except IsADirectoryError as error:
        raise RecordingError(f"{path}: is a folder, expected a recording (.mcap) in it") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror or error})") from error
    except DAMAGE as error:
        with path.open("rb") as file:
            begins = file.read(len(MCAP0_MAGIC))
        if not begins:
            why = "the file is empty, nothing was recorded in it"
        elif begins != MCAP0_MAGIC:
            why = "not a recording (MCAP); rotorwatch import makes recordings from files of other programs"
        elif path.suffix == ".part":
            why = f"not complete: its recorder is still writing it, or was killed{_RECOVER}"
        elif isinstance(error, EndOfFile):
            why = f"the recording is incomplete{_RECOVER}"
        else:
            why = f"not a complete recording{_RECOVER} ({error})"
        raise RecordingError(f"{path}: {why}") from error


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
