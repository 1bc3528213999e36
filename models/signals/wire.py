"""Wire format of sample blocks: raw array with a fixed header, or an Arrow IPC stream.

The format is described for people without this library in ``docs/wire.md``; the layout below is version 1.

Arrow streams of one record batch, uncompressed, are written with Arrow's own library and read without it: on damaged
streams that reader crashes the process, and a few compressed kilobytes become gigabytes (decision 0020). Numbers of
fields and types are those of Arrow's ``Schema.fbs`` and ``Message.fbs``.
"""

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from flatbuffers import number_types as kinds
from flatbuffers.table import Table

from models.errors import WireError
from models.signals.block import SampleBlock

_CONTINUES = b"\xff\xff\xff\xff"
_SCHEMA, _RECORD_BATCH = 1, 3
_FLOATING_POINT, _FIXED_SIZE_LIST = 3, 16
# By the number that stands for a type, in the raw header as in Arrow's schemas.
_DTYPES: dict[int, np.dtype[Any]] = {1: np.dtype("<f4"), 2: np.dtype("<f8")}
_MOST_ENTRIES = 64
_COLUMN = "expected a single column 'samples' of fixed-size lists of float32 or float64"


def write_arrow(samples: npt.NDArray[Any], metadata: dict[str, str]) -> bytes:
    """Write samples, shape (n_samples, n_channels), as one fixed-size-list column."""
    import pyarrow as pa  # noqa: PLC0415  # 50 ms that only users of Arrow should pay

    flat = pa.array(np.ascontiguousarray(samples).reshape(-1))
    column = pa.FixedSizeListArray.from_arrays(flat, samples.shape[1])
    schema = pa.schema([pa.field("samples", column.type)], metadata=metadata)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as writer:
        writer.write_batch(pa.record_batch([column], schema=schema))
    stream: bytes = sink.getvalue().to_pybytes()
    return stream


def _read_arrow(stream: bytes) -> tuple[npt.NDArray[Any], dict[str, bytes]]:
    """Read what `write_arrow` writes, from any Arrow library: samples, a read-only view of the stream, and metadata.

    Whatever the bytes are, nothing larger than the stream is allocated to find out.
    """
    try:
        kind, schema, _, after = _message(stream, 0)
        if kind != _SCHEMA:
            raise WireError("Arrow stream does not begin with a schema")
        dtype, n_channels = _column(schema)
        kind, batch, body, _ = _message(stream, after)
        if kind != _RECORD_BATCH:
            raise WireError("Arrow stream has no record batch after the schema")
        samples = _values(stream, batch, body, dtype, n_channels)
        return samples, {_text(one, 4).decode("utf-8", "replace"): _text(one, 6) for one in _entries(schema, 8)}
    except (struct.error, ValueError, TypeError, IndexError, OverflowError) as error:
        raise WireError(f"Arrow stream is damaged: {error}") from error


def _message(stream: bytes, at: int) -> tuple[int, Table, tuple[int, int], int]:
    """Kind and header of the message at byte `at`, begin and end of its body, and begin of the next message."""
    size = struct.unpack_from("<i", stream, at + 4)[0] if stream[at : at + 4] == _CONTINUES else 0
    start = at + 8
    if not 0 < size <= len(stream) - start:
        raise WireError(f"Arrow stream of {len(stream)} bytes ends or is not an Arrow stream at byte {at}")
    flat = stream[start : start + size]
    message = Table(flat, struct.unpack_from("<I", flat)[0])
    length: int = message.GetSlot(10, 0, kinds.Int64Flags)
    body = start + size
    if not 0 <= length <= len(stream) - body:
        raise WireError(f"Arrow message has a body of {length} bytes, {len(stream) - body} have come")
    return message.GetSlot(6, 0, kinds.Uint8Flags), _child(message, 8), (body, body + length), body + length


def _child(table: Table, slot: int) -> Table:
    """A table within another one."""
    offset = table.Offset(slot)
    if offset == 0:
        raise WireError("Arrow message lacks a part that it must have")
    return Table(table.Bytes, table.Indirect(table.Pos + offset))


def _entries(table: Table, slot: int) -> list[Table]:
    """The tables of a vector."""
    offset = table.Offset(slot)
    count = 0 if offset == 0 else table.VectorLen(offset)
    if count > _MOST_ENTRIES:
        raise WireError(f"Arrow schema has {count} entries in one list, expected at most {_MOST_ENTRIES}")
    start = 0 if count == 0 else table.Vector(offset)
    return [Table(table.Bytes, table.Indirect(start + 4 * number)) for number in range(count)]


def _text(table: Table, slot: int) -> bytes:
    offset = table.Offset(slot)
    text: bytes = b"" if offset == 0 else table.String(table.Pos + offset)
    return text


def _column(schema: Table) -> tuple[np.dtype[Any], int]:
    """Type and list size of the column of samples."""
    fields = _entries(schema, 6)
    if schema.GetSlot(4, 0, kinds.Int16Flags) != 0:
        raise WireError("Arrow stream is big-endian, expected little-endian")
    if [_text(field, 4) for field in fields] != [b"samples"]:
        raise WireError(f"Arrow stream has other columns; {_COLUMN}")
    (field,) = fields
    children = _entries(field, 14)
    kinds_of = [one.GetSlot(8, 0, kinds.Uint8Flags) for one in (field, *children)]
    if kinds_of != [_FIXED_SIZE_LIST, _FLOATING_POINT] or any(one.Offset(12) for one in (field, *children)):
        raise WireError(f"Arrow column 'samples' has types {kinds_of}; {_COLUMN}")
    dtype = _DTYPES.get(_child(children[0], 10).GetSlot(4, 0, kinds.Int16Flags))
    n_channels: int = _child(field, 10).GetSlot(4, 0, kinds.Int32Flags)
    if dtype is None or n_channels < 1:
        raise WireError(f"Arrow column 'samples' has lists of {n_channels}; {_COLUMN}")
    return dtype, n_channels


def _values(
    stream: bytes, batch: Table, body: tuple[int, int], dtype: np.dtype[Any], n_channels: int
) -> npt.NDArray[Any]:
    """The samples of a record batch, where they lie in the stream."""
    if batch.Offset(10):
        raise WireError("Arrow record batch is compressed, expected uncompressed")
    n_samples: int = batch.GetSlot(4, 0, kinds.Int64Flags)
    nodes, buffers = _structs(batch, 6), _structs(batch, 8)
    if [length for length, _ in nodes] != [n_samples, n_samples * n_channels] or len(buffers) != 3:
        raise WireError(f"Arrow record batch of {n_samples} rows does not hold lists of {n_channels}")
    nulls = sum(count for _, count in nodes)
    if nulls:
        raise WireError(f"Arrow column 'samples' has {nulls} nulls, expected none")
    offset, length = buffers[2]
    count = n_samples * n_channels
    start = body[0] + offset
    if n_samples < 0 or offset < 0 or length < count * dtype.itemsize or start + length > body[1]:
        raise WireError(f"Arrow record batch of {n_samples} rows has {length} bytes of samples at {offset}")
    return np.frombuffer(stream, dtype, count, start).reshape(n_samples, n_channels)


def _structs(table: Table, slot: int) -> list[tuple[int, int]]:
    """The entries of a vector of structs (field nodes or buffers), each of two 64-bit numbers."""
    offset = table.Offset(slot)
    if offset == 0 or table.VectorLen(offset) > _MOST_ENTRIES:
        raise WireError("Arrow record batch lacks its lists of lengths or buffers, or has too many")
    start = table.Vector(offset)
    return [struct.unpack_from("<qq", table.Bytes, start + 16 * at) for at in range(table.VectorLen(offset))]


BLOCK_ENCODING = "application/x-rotorwatch-block"
ARROW_ENCODING = "application/vnd.apache.arrow.stream"
REPLAY_MARK = ";replay"  # ends the encoding of a block that is replayed on a machine's own keys
_HEADER = struct.Struct("<qQdBBHI")  # start_ns, sequence, rate_hz, dtype, channels, run, samples
HEADER_BYTES = _HEADER.size
_DTYPE_CODES = {"f4": 1, "f8": 2}
_MAX_SAMPLES, _MAX_CHANNELS = 1_000_000, 64
_SLOWEST_HZ, _FASTEST_HZ = 1e-3, 1e6
_LONGEST_TEXT = 32
_ARROW_OVERHEAD = 65_536
_ARROW_FIELDS = ("start_ns", "sequence", "rate_hz", "run")


def encode_block(block: SampleBlock, schema_hash: str) -> tuple[bytes, bytes, str]:
    """Encode a block as raw little-endian samples: payload, attachment and encoding.

    The payload is in C order, shape (n_samples, n_channels), the attachment the header of 32 bytes, the encoding
    ``application/x-rotorwatch-block;<schema hash>``.
    """
    n_samples, n_channels = block.samples.shape
    code = _DTYPE_CODES[block.samples.dtype.str[1:]]
    header = _HEADER.pack(block.start_ns, block.sequence, block.rate_hz, code, n_channels, block.run, n_samples)
    payload = np.ascontiguousarray(block.samples, dtype=_DTYPES[code]).tobytes()
    return payload, header, f"{BLOCK_ENCODING};{schema_hash}"


def encode_arrow(block: SampleBlock, schema_hash: str) -> tuple[bytes, bytes, str]:
    """Encode a block as a self-contained Arrow IPC stream: one fixed-size-list column, header fields as metadata.

    As `encode_block`; the attachment is empty.
    """
    metadata = {name: repr(getattr(block, name)) for name in _ARROW_FIELDS}
    return write_arrow(block.samples, metadata), b"", f"{ARROW_ENCODING};{schema_hash}"


def decode_block(payload: bytes, attachment: bytes, encoding: str) -> SampleBlock:
    """Decode a block in either encoding.

    In the raw encoding the samples are a read-only view of the payload.

    Raises
    ------
    WireError
        If the bytes do not make a block; the message names the field.
    """
    kind, _, schema_hash = encoding.partition(";")
    schema_hash = schema_hash[:_LONGEST_TEXT]
    if kind == BLOCK_ENCODING:
        return _decode_raw(payload, attachment, schema_hash)
    if kind == ARROW_ENCODING:
        samples, metadata = _read_arrow(payload)
        numbers = {field: _metadata_number(metadata, field) for field in _ARROW_FIELDS}
        return _checked(**numbers, samples=samples, schema_hash=schema_hash)
    raise WireError(f"encoding {encoding[:_LONGEST_TEXT]!r} is not {BLOCK_ENCODING!r} or {ARROW_ENCODING!r}")


def sender_of(attachment: bytes, encoding: str) -> tuple[str, int | None]:
    """Who seems to send a message, without decoding it: kind of encoding, and the run if the header has one."""
    run = _HEADER.unpack(attachment)[5] if len(attachment) == HEADER_BYTES else None
    return encoding.partition(";")[0][:_LONGEST_TEXT], run


def may_be_block(payload: bytes, attachment: bytes, encoding: str, n_channels: int, most_samples: int) -> bool:
    """Whether a message may be a block of a machine, as far as its size and header say; costs a microsecond."""
    most = n_channels * most_samples * 8
    kind = encoding.partition(";")[0]
    if kind == ARROW_ENCODING:
        return payload.startswith(_CONTINUES) and len(payload) <= most + _ARROW_OVERHEAD
    if kind != BLOCK_ENCODING or len(attachment) != HEADER_BYTES:
        return False
    _, _, _, code, channels, _, n_samples = _HEADER.unpack(attachment)
    size = _DTYPES[code].itemsize if code in _DTYPES else 0
    return bool(channels == n_channels and len(payload) == n_samples * n_channels * size <= most)


def _decode_raw(payload: bytes, attachment: bytes, schema_hash: str) -> SampleBlock:
    if len(attachment) != HEADER_BYTES:
        raise WireError(f"header (attachment) has {len(attachment)} bytes, expected {HEADER_BYTES}")
    start_ns, sequence, rate_hz, code, n_channels, run, n_samples = _HEADER.unpack(attachment)
    if code not in _DTYPES:
        raise WireError(f"header field dtype is {code}, expected 1 (float32) or 2 (float64)")
    expected = n_samples * n_channels * _DTYPES[code].itemsize
    _check_shape(n_samples, n_channels)
    if len(payload) != expected:
        shape = f"{n_samples} samples × {n_channels} channels"
        raise WireError(f"payload has {len(payload)} bytes, expected {expected} for {shape}")
    samples: npt.NDArray[Any] = np.frombuffer(payload, dtype=_DTYPES[code]).reshape(n_samples, n_channels)
    return _checked(start_ns, sequence, run, rate_hz, samples, schema_hash)


def _metadata_number(metadata: Mapping[str, bytes], field: str) -> Any:
    text = metadata.get(field, b"")[:_LONGEST_TEXT].decode("ascii", "replace")
    try:
        return float(text) if field == "rate_hz" else int(text)
    except ValueError as error:
        raise WireError(f"Arrow schema metadata field {field!r} is {text!r}, expected a number") from error


def _checked(
    start_ns: int, sequence: int, run: int, rate_hz: float, samples: npt.NDArray[Any], schema_hash: str
) -> SampleBlock:
    """Make a block of fields, in either encoding, that are within what the header can hold."""
    _check_shape(*samples.shape)
    for field, value, least, most in (
        ("start_ns", start_ns, -(2**63), 2**63 - 1),
        ("sequence", sequence, 0, 2**64 - 1),
        ("run", run, 0, 2**16 - 1),
        ("rate_hz", rate_hz, _SLOWEST_HZ, _FASTEST_HZ),
    ):
        if not least <= value <= most:
            raise WireError(f"header field {field} is {value}, expected {least} to {most}")
    return SampleBlock(start_ns, sequence, run, rate_hz, samples, schema_hash)


def _check_shape(n_samples: int, n_channels: int) -> None:
    if not 1 <= n_samples <= _MAX_SAMPLES:
        raise WireError(f"header field samples is {n_samples}, expected 1 to {_MAX_SAMPLES}")
    if not 1 <= n_channels <= _MAX_CHANNELS:
        raise WireError(f"header field channels is {n_channels}, expected 1 to {_MAX_CHANNELS}")
