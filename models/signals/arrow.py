"""Blocks as Arrow IPC streams, read field by field: schema and one record batch, uncompressed.

Written with Arrow's own library and read without it: on damaged streams that reader crashes the process, and a few
compressed kilobytes become gigabytes (decision 0020). Numbers of fields and types are those of Arrow's ``Schema.fbs``
and ``Message.fbs``.
"""

import struct
from typing import Any

import numpy as np
import numpy.typing as npt
from flatbuffers import number_types as kinds
from flatbuffers.table import Table

from models.errors import WireError

__all__ = ["read_arrow", "write_arrow"]

_CONTINUES = b"\xff\xff\xff\xff"
_SCHEMA, _RECORD_BATCH = 1, 3
_FLOATING_POINT, _FIXED_SIZE_LIST = 3, 16
_PRECISIONS: dict[int, np.dtype[Any]] = {1: np.dtype("<f4"), 2: np.dtype("<f8")}
_MOST_ENTRIES = 64
_FIELD_NODE, _BUFFER = 16, 16
_COLUMN = "expected a single column 'samples' of fixed-size lists of float32 or float64"


def write_arrow(samples: npt.NDArray[Any], metadata: dict[str, str]) -> bytes:
    """Write samples as one fixed-size-list column.

    Parameters
    ----------
    samples : ndarray, shape (n_samples, n_channels)
    metadata : dict of str to str
        Metadata of the schema.
    """
    import pyarrow as pa  # noqa: PLC0415  # 50 ms that only users of Arrow should pay

    flat = pa.array(np.ascontiguousarray(samples).reshape(-1))
    column = pa.FixedSizeListArray.from_arrays(flat, samples.shape[1])
    schema = pa.schema([pa.field("samples", column.type)], metadata=metadata)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as writer:
        writer.write_batch(pa.record_batch([column], schema=schema))
    stream: bytes = sink.getvalue().to_pybytes()
    return stream


def read_arrow(stream: bytes) -> tuple[npt.NDArray[Any], dict[str, bytes]]:
    """Read what `write_arrow` writes, from any Arrow library.

    Returns
    -------
    samples : ndarray, shape (n_samples, n_channels)
        A read-only view of `stream`.
    metadata : dict of str to bytes
        Metadata of the schema.

    Raises
    ------
    WireError
        If it is anything else; nothing larger than the stream is allocated to find out.
    """
    try:
        kind, schema, _, after = _message(stream, 0)
        if kind != _SCHEMA:
            raise WireError("Arrow stream does not begin with a schema")
        dtype, n_channels = _column(schema)
        kind, batch, body, _ = _message(stream, after)
        if kind != _RECORD_BATCH:
            raise WireError("Arrow stream has no record batch after the schema")
        return _values(stream, batch, body, dtype, n_channels), _metadata(schema)
    except (struct.error, ValueError, TypeError, IndexError, OverflowError) as error:
        raise WireError(f"Arrow stream is damaged: {error}") from error


def _message(stream: bytes, at: int) -> tuple[int, Table, tuple[int, int], int]:
    """Kind and header of the message that begins there, where its body begins and ends, and where the next one is."""
    size = struct.unpack_from("<i", stream, at + 4)[0] if stream[at : at + 4] == _CONTINUES else 0
    start = at + 8
    if not 0 < size <= len(stream) - start:
        raise WireError(f"Arrow stream of {len(stream)} bytes ends or is no Arrow stream at byte {at}")
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
    dtype = _PRECISIONS.get(_child(children[0], 10).GetSlot(4, 0, kinds.Int16Flags))
    n_channels: int = _child(field, 10).GetSlot(4, 0, kinds.Int32Flags)
    if dtype is None or n_channels < 1:
        raise WireError(f"Arrow column 'samples' has lists of {n_channels}; {_COLUMN}")
    return dtype, n_channels


def _metadata(schema: Table) -> dict[str, bytes]:
    return {_text(entry, 4).decode("utf-8", "replace"): _text(entry, 6) for entry in _entries(schema, 8)}


def _values(
    stream: bytes, batch: Table, body: tuple[int, int], dtype: np.dtype[Any], n_channels: int
) -> npt.NDArray[Any]:
    """The samples of a record batch, where they lie in the stream."""
    if batch.Offset(10):
        raise WireError("Arrow record batch is compressed, expected uncompressed")
    n_samples: int = batch.GetSlot(4, 0, kinds.Int64Flags)
    nodes, buffers = (_structs(batch, slot, size) for slot, size in ((6, _FIELD_NODE), (8, _BUFFER)))
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


def _structs(table: Table, slot: int, size: int) -> list[tuple[int, int]]:
    """The structs of two 64-bit numbers of a vector."""
    offset = table.Offset(slot)
    if offset == 0 or table.VectorLen(offset) > _MOST_ENTRIES:
        raise WireError("Arrow record batch lacks its lists of lengths or buffers, or has too many")
    start = table.Vector(offset)
    return [struct.unpack_from("<qq", table.Bytes, start + size * at) for at in range(table.VectorLen(offset))]
