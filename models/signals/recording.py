"""Recordings: messages kept verbatim, with key, attachment, encoding and times, in an MCAP file.

MCAP (https://mcap.dev) has a topic, bytes, two times and per-channel metadata for a message, but no attachment. So:

- the topic is the key, the channel's metadata entry ``encoding`` is the message's encoding string;
- a message without attachment is stored as it is, ``framing`` = ``none`` in the channel's metadata: JSON on its keys
  can be plotted by any MCAP viewer;
- a message with an attachment has ``framing`` = ``attachment-1``: its data is the attachment's length (uint32, little
  endian), the attachment, the payload.

A recording is written to ``NAME.part`` and gets its name when it is closed, so that a name without ``.part`` is always
a complete file. What a crash left behind is a ``.part`` file, which `recover_recording` turns into a complete one.
"""

import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Self

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import CompressionType, Writer

from models.errors import RecordingError

__all__ = [
    "RecordedMessage",
    "RecordingSummary",
    "RecordingWriter",
    "read_recording",
    "recover_recording",
    "summarize_recording",
]

_CHUNK_BYTES = 256 * 1024
_LENGTH = struct.Struct("<I")
_PLAIN, _PREFIXED = "none", "attachment-1"
_LIBRARY = "rotorwatch"
_PROFILE = "rotorwatch-1"
# What the mcap library lets through when a file is cut off or overwritten.
_DAMAGE = (
    McapError,
    CRCValidationError,
    struct.error,
    zstandard.ZstdError,
    ValueError,
    KeyError,
    EOFError,
    MemoryError,
)


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message as it was on the network.

    Attributes
    ----------
    key : str
        Zenoh key.
    payload, attachment : bytes
        Verbatim; an empty attachment is no attachment.
    encoding : str
        Encoding string, with its schema part.
    log_time_ns : int
        When it was recorded, nanoseconds since 1970-01-01 UTC.
    publish_time_ns : int
        When it was published.
    """

    key: str
    payload: bytes
    attachment: bytes
    encoding: str
    log_time_ns: int
    publish_time_ns: int


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """What a recording holds.

    Attributes
    ----------
    start_ns, end_ns : int
        Earliest and latest log time; both 0 in an empty recording.
    messages : dict of str to int
        Number of messages by key.
    """

    start_ns: int
    end_ns: int
    messages: dict[str, int]


class RecordingWriter:
    """Writes a recording; a context manager.

    Leaving the context without an exception gives the file its name. With an exception the file is completed but
    stays ``NAME.part``.

    Parameters
    ----------
    path : Path
        Final name.
    overwrite : bool
        Replace a recording that is already there, or a ``.part`` that a crash left.

    Raises
    ------
    RecordingError
        If one of them exists, or cannot be written; the message names it.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self.path = path
        self.part = path.with_name(path.name + ".part")
        for existing in (self.path, self.part):
            if existing.exists() and not overwrite:
                raise RecordingError(f"{existing}: exists already and is not overwritten")
        self._channels: dict[tuple[str, str, str], int] = {}
        self._counts: dict[int, int] = {}
        with _writing(self.part):
            self._file = self.part.open("wb")
            self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile=_PROFILE, library=_LIBRARY)
            self._json_schema = self._writer.register_schema("json", "jsonschema", b'{"type":"object"}')

    def write(self, message: RecordedMessage) -> None:
        """Append a message.

        Raises
        ------
        RecordingError
            If the file cannot be written.
        """
        framing = _PREFIXED if message.attachment else _PLAIN
        data = message.payload
        if message.attachment:
            data = _LENGTH.pack(len(message.attachment)) + message.attachment + message.payload
        with _writing(self.part):
            channel = self._channel(message.key, message.encoding, framing)
            sequence = self._counts[channel]
            self._counts[channel] = sequence + 1
            self._writer.add_message(channel, message.log_time_ns, data, message.publish_time_ns, sequence & 0xFFFFFFFF)
            self._file.flush()  # a finished chunk reaches the operating system and survives this process

    def close(self) -> None:
        """Complete the file and give it its name.

        Raises
        ------
        RecordingError
            If the file cannot be completed or renamed.
        """
        if self._file.closed:
            return
        self._complete()
        with _writing(self.path):
            self.part.replace(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        elif not self._file.closed:
            self._complete()

    def _complete(self) -> None:
        with _writing(self.part):
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]  # the library's stub
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
    path: Path, *, keys: Collection[str] | None = None, from_ns: int | None = None, to_ns: int | None = None
) -> Iterator[RecordedMessage]:
    """Read messages in the order in which they were written.

    Parameters
    ----------
    path : Path
    keys : collection of str, optional
        Only these keys.
    from_ns, to_ns : int, optional
        Only log times from `from_ns` up to, and without, `to_ns`.

    Raises
    ------
    RecordingError
        If the file is missing, not a recording, incomplete or damaged; raised where the damage is met.
    """
    with _reading(path), path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        _ = reader.get_summary()
        messages = reader.iter_messages(
            topics=None if keys is None else list(keys), starting_at=from_ns, ending_before=to_ns, log_time_order=False
        )
        for _, channel, message in messages:
            yield _unpacked(channel, message)


def summarize_recording(path: Path) -> RecordingSummary:
    """Read from its index what a recording holds.

    Raises
    ------
    RecordingError
        If the file is missing, not a recording, incomplete or damaged.
    """
    with _reading(path), path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
        if summary is None or summary.statistics is None:
            raise RecordingError(f"{path}: the recording has no index")
        counts: dict[str, int] = {}
        for number, count in summary.statistics.channel_message_counts.items():
            key = summary.channels[number].topic
            counts[key] = counts.get(key, 0) + count
        return RecordingSummary(summary.statistics.message_start_time, summary.statistics.message_end_time, counts)


def recover_recording(damaged: Path, target: Path) -> int:
    """Copy what can be read of an interrupted recording into a complete one.

    Parameters
    ----------
    damaged : Path
        Usually the ``.part`` file of a program that was killed; it stays.
    target : Path
        Must not exist; may be the name that `damaged` was to get.

    Returns
    -------
    int
        Number of messages recovered.

    Raises
    ------
    RecordingError
        If `damaged` is missing or nothing of it can be read, or `target` exists.
    """
    messages = _salvaged(damaged)
    first = next(messages, None)
    if first is None:
        raise RecordingError(f"{damaged}: nothing to recover: not a recording, or no part of it was completed")
    if target.exists():
        raise RecordingError(f"{target}: exists already and is not overwritten")
    # Not under target's own .part name, which is what the damaged file usually has.
    with RecordingWriter(target.with_name(target.name + ".recovered"), overwrite=True) as writer:
        count = 0
        for message in chain([first], messages):
            writer.write(message)
            count += 1
    with _writing(target):
        writer.path.replace(target)
    return count


def _salvaged(damaged: Path) -> Iterator[RecordedMessage]:
    """Messages in the order in which they were written, up to the damage."""
    channels: dict[int, Channel] = {}
    with _reading(damaged), damaged.open("rb") as file, suppress(*_DAMAGE):
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                yield _unpacked(channels[record.channel_id], record)


def _unpacked(channel: Channel, message: Message) -> RecordedMessage:
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
    return RecordedMessage(
        channel.topic, bytes(payload), bytes(attachment), encoding, message.log_time, message.publish_time
    )


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written ({error.strerror or error})") from error


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror or error})") from error
    except EndOfFile as error:
        raise RecordingError(f"{path}: the recording is incomplete; recover it from what is there") from error
    except _DAMAGE as error:
        raise RecordingError(f"{path}: not a complete recording: {error}") from error
