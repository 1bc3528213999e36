"""Wire format of sample blocks: raw array with a fixed header, or an Arrow IPC stream.

The format is described for people without this library in ``docs/wire.md``; the layout below is version 1.
"""

import struct
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from models.errors import WireError
from models.signals.block import SampleBlock

__all__ = ["ARROW_ENCODING", "BLOCK_ENCODING", "HEADER_BYTES", "decode_block", "encode_arrow", "encode_block"]

BLOCK_ENCODING = "application/x-rotorwatch-block"
ARROW_ENCODING = "application/vnd.apache.arrow.stream"

_HEADER = struct.Struct("<qQdBBHI")  # start_ns, sequence, rate_hz, dtype, channels, run, samples
HEADER_BYTES = _HEADER.size
_DTYPES: dict[int, np.dtype[np.float32] | np.dtype[np.float64]] = {1: np.dtype("<f4"), 2: np.dtype("<f8")}
_DTYPE_CODES = {"f4": 1, "f8": 2}
_MAX_SAMPLES = 1_000_000
_ARROW_FIELDS = ("start_ns", "sequence", "rate_hz", "run")


def encode_block(block: SampleBlock, schema_hash: str) -> tuple[bytes, bytes, str]:
    """Encode a block as raw little-endian samples.

    Returns
    -------
    payload : bytes
        Samples, C order, shape (n_samples, n_channels).
    attachment : bytes
        32-byte header.
    encoding : str
        ``application/x-rotorwatch-block;<schema hash>``.
    """
    n_samples, n_channels = block.samples.shape
    code = _DTYPE_CODES[block.samples.dtype.str[1:]]
    header = _HEADER.pack(block.start_ns, block.sequence, block.rate_hz, code, n_channels, block.run, n_samples)
    payload = np.ascontiguousarray(block.samples, dtype=_DTYPES[code]).tobytes()
    return payload, header, f"{BLOCK_ENCODING};{schema_hash}"


def encode_arrow(block: SampleBlock, schema_hash: str) -> tuple[bytes, bytes, str]:
    """Encode a block as a self-contained Arrow IPC stream: one fixed-size-list column, header fields as metadata.

    Returns
    -------
    payload, attachment, encoding
        As `encode_block`; the attachment is empty.
    """
    import pyarrow as pa  # noqa: PLC0415  # 50 ms that only users of Arrow should pay

    n_channels = block.samples.shape[1]
    flat = pa.array(np.ascontiguousarray(block.samples).reshape(-1))
    column = pa.FixedSizeListArray.from_arrays(flat, n_channels)
    metadata = {name: repr(getattr(block, name)) for name in _ARROW_FIELDS}
    schema = pa.schema([pa.field("samples", column.type)], metadata=metadata)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as writer:
        writer.write_batch(pa.record_batch([column], schema=schema))
    return sink.getvalue().to_pybytes(), b"", f"{ARROW_ENCODING};{schema_hash}"


def decode_block(payload: bytes, attachment: bytes, encoding: str) -> tuple[SampleBlock, str]:
    """Decode a block in either encoding.

    Returns
    -------
    block : SampleBlock
        Its samples are a read-only view of `payload` in the raw encoding.
    schema_hash : str
        Schema hash named by the encoding, empty if none was named.

    Raises
    ------
    WireError
        If the bytes do not make a block; the message names the field.
    """
    kind, _, schema_hash = encoding.partition(";")
    if kind == BLOCK_ENCODING:
        return _decode_raw(payload, attachment), schema_hash
    if kind == ARROW_ENCODING:
        return _decode_arrow(payload), schema_hash
    raise WireError(f"encoding {encoding!r} is not {BLOCK_ENCODING!r} or {ARROW_ENCODING!r}")


def _decode_raw(payload: bytes, attachment: bytes) -> SampleBlock:
    if len(attachment) != HEADER_BYTES:
        raise WireError(f"header (attachment) has {len(attachment)} bytes, expected {HEADER_BYTES}")
    start_ns, sequence, rate_hz, code, n_channels, run, n_samples = _HEADER.unpack(attachment)
    if code not in _DTYPES:
        raise WireError(f"header field dtype is {code}, expected 1 (float32) or 2 (float64)")
    expected = n_samples * n_channels * _DTYPES[code].itemsize
    _check_shape(n_samples, n_channels)
    if len(payload) != expected:
        raise WireError(
            f"payload has {len(payload)} bytes, expected {expected} for {n_samples} samples × {n_channels} channels"
        )
    samples: npt.NDArray[Any] = np.frombuffer(payload, dtype=_DTYPES[code]).reshape(n_samples, n_channels)
    return SampleBlock(start_ns, sequence, run, _checked_rate(rate_hz), samples)


def _decode_arrow(payload: bytes) -> SampleBlock:
    import pyarrow as pa  # noqa: PLC0415  # 50 ms that only users of Arrow should pay

    try:
        with pa.ipc.open_stream(payload) as reader:
            table = reader.read_all()
        metadata = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        column = table.column("samples").combine_chunks()
        n_channels = column.type.list_size
        samples = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, n_channels)
    except (pa.ArrowInvalid, pa.ArrowTypeError, KeyError, AttributeError, OSError, UnicodeDecodeError) as error:
        raise WireError(f"Arrow stream without a fixed-size-list column 'samples': {error}") from error
    if samples.dtype not in (np.float32, np.float64):
        raise WireError(f"Arrow column 'samples' holds {samples.dtype}, expected float32 or float64")
    _check_shape(*samples.shape)
    start_ns = _metadata_number(metadata, "start_ns", "int")
    sequence = _metadata_number(metadata, "sequence", "int")
    run = _metadata_number(metadata, "run", "int")
    rate_hz = _metadata_number(metadata, "rate_hz", "float")
    return SampleBlock(int(start_ns), int(sequence), int(run), _checked_rate(rate_hz), samples)


def _metadata_number(metadata: dict[str, str], field: str, kind: Literal["int", "float"]) -> float | int:
    text = metadata.get(field)
    try:
        return int(text or "") if kind == "int" else float(text or "")
    except ValueError as error:
        raise WireError(f"Arrow schema metadata field {field!r} is {text!r}, expected a number") from error


def _check_shape(n_samples: int, n_channels: int) -> None:
    if not 1 <= n_samples <= _MAX_SAMPLES:
        raise WireError(f"header field samples is {n_samples}, expected 1 to {_MAX_SAMPLES}")
    if n_channels < 1:
        raise WireError("header field channels is 0, expected at least 1")


def _checked_rate(rate_hz: float) -> float:
    if not 0 < rate_hz <= 1e6:
        raise WireError(f"header field rate_hz is {rate_hz}, expected above 0 and at most 1e6")
    return rate_hz
