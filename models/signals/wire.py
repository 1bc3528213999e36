"""Wire format of sample blocks: raw array with a fixed header, or an Arrow IPC stream.

The format is described for people without this library in ``docs/wire.md``; the layout below is version 1.
"""

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from models.errors import WireError
from models.signals.arrow import read_arrow, write_arrow
from models.signals.block import SampleBlock

__all__ = [
    "ARROW_ENCODING",
    "BLOCK_ENCODING",
    "HEADER_BYTES",
    "REPLAY_MARK",
    "decode_block",
    "encode_arrow",
    "encode_block",
    "may_be_block",
    "sender_of",
]

BLOCK_ENCODING = "application/x-rotorwatch-block"
ARROW_ENCODING = "application/vnd.apache.arrow.stream"
REPLAY_MARK = ";replay"
"""Ends the encoding of a block that is replayed on a machine's own keys."""

_HEADER = struct.Struct("<qQdBBHI")  # start_ns, sequence, rate_hz, dtype, channels, run, samples
HEADER_BYTES = _HEADER.size
_DTYPES: dict[int, np.dtype[np.float32] | np.dtype[np.float64]] = {1: np.dtype("<f4"), 2: np.dtype("<f8")}
_DTYPE_CODES = {"f4": 1, "f8": 2}
_MAX_SAMPLES, _MAX_CHANNELS = 1_000_000, 255
_SLOWEST_HZ, _FASTEST_HZ = 1e-3, 1e6
_LONGEST_TEXT = 32
_ARROW_OVERHEAD = 65_536
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
    metadata = {name: repr(getattr(block, name)) for name in _ARROW_FIELDS}
    return write_arrow(block.samples, metadata), b"", f"{ARROW_ENCODING};{schema_hash}"


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
    schema_hash = schema_hash[:_LONGEST_TEXT]
    if kind == BLOCK_ENCODING:
        return _decode_raw(payload, attachment), schema_hash
    if kind == ARROW_ENCODING:
        return _decode_arrow(payload), schema_hash
    raise WireError(f"encoding {encoding[:_LONGEST_TEXT]!r} is not {BLOCK_ENCODING!r} or {ARROW_ENCODING!r}")


def sender_of(attachment: bytes, encoding: str) -> tuple[str, int | None]:
    """Who seems to send a message, without decoding it: kind of encoding, and the run if the header has one."""
    run = _HEADER.unpack(attachment)[5] if len(attachment) == HEADER_BYTES else None
    return encoding.partition(";")[0][:_LONGEST_TEXT], run


def may_be_block(payload: bytes, attachment: bytes, encoding: str, n_channels: int, most_samples: int) -> bool:
    """Whether a message may be a block of a machine, as far as its size and header say; costs a microsecond.

    Parameters
    ----------
    payload, attachment, encoding : bytes, bytes, str
    n_channels, most_samples : int
        Of the machine's blocks.
    """
    most = n_channels * most_samples * 8
    kind = encoding.partition(";")[0]
    if kind == ARROW_ENCODING:
        return payload.startswith(b"\xff\xff\xff\xff") and len(payload) <= most + _ARROW_OVERHEAD
    if kind != BLOCK_ENCODING or len(attachment) != HEADER_BYTES:
        return False
    _, _, _, code, channels, _, n_samples = _HEADER.unpack(attachment)
    size = _DTYPES[code].itemsize if code in _DTYPES else 0
    return bool(channels == n_channels and len(payload) == n_samples * n_channels * size <= most)


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
    return _checked(start_ns, sequence, run, rate_hz, samples)


def _decode_arrow(payload: bytes) -> SampleBlock:
    samples, metadata = read_arrow(payload)
    numbers = {field: _metadata_number(metadata, field) for field in _ARROW_FIELDS}
    return _checked(**numbers, samples=samples)


def _metadata_number(metadata: Mapping[str, bytes], field: str) -> Any:
    text = metadata.get(field, b"")[:_LONGEST_TEXT].decode("ascii", "replace")
    try:
        return float(text) if field == "rate_hz" else int(text)
    except ValueError as error:
        raise WireError(f"Arrow schema metadata field {field!r} is {text!r}, expected a number") from error


def _checked(start_ns: int, sequence: int, run: int, rate_hz: float, samples: npt.NDArray[Any]) -> SampleBlock:
    """A block whose fields are within what the header can say, whatever it came in."""
    _check_shape(*samples.shape)
    for field, value, least, most in (
        ("start_ns", start_ns, -(2**63), 2**63 - 1),
        ("sequence", sequence, 0, 2**64 - 1),
        ("run", run, 0, 2**16 - 1),
        ("rate_hz", rate_hz, _SLOWEST_HZ, _FASTEST_HZ),
    ):
        if not least <= value <= most:
            raise WireError(f"header field {field} is {value}, expected {least} to {most}")
    return SampleBlock(start_ns, sequence, run, rate_hz, samples)


def _check_shape(n_samples: int, n_channels: int) -> None:
    if not 1 <= n_samples <= _MAX_SAMPLES:
        raise WireError(f"header field samples is {n_samples}, expected 1 to {_MAX_SAMPLES}")
    if not 1 <= n_channels <= _MAX_CHANNELS:
        raise WireError(f"header field channels is {n_channels}, expected 1 to {_MAX_CHANNELS}")
