"""Remembered state as bytes: named arrays in, the same arrays out, to the last bit.

::

    RWCP | version | BLAKE2b of the rest | zstd of: length, list of names, types, shapes and orders as JSON, contents

The digest is checked first, so that damaged bytes are refused before anything is read from them. Arrays of Python
objects are refused: nothing in stored bytes is ever executed.

Objects with a state to remember give it in `checkpoint` and take it in `restore` or `restored`, which raise
`CheckpointError` if an array is missing or of another form.
"""

import hashlib
import json
import struct
from collections.abc import Mapping
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt
import zstandard

from models.errors import CheckpointError

_MAGIC = b"RWCP"
_VERSION = 2
_HEADER = struct.Struct("<4sH16s")
_LENGTH = struct.Struct("<I")
_Scalar = TypeVar("_Scalar", bound=np.generic)


def to_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Put named arrays of numbers, truth values and text into bytes; the same arrays give the same bytes.

    They have any shape; the order of elements in memory (rows or columns first) is kept.

    Raises
    ------
    CheckpointError
        If an array holds Python objects.

    Examples
    --------
    >>> from_bytes(to_bytes({"speed_rad_s": np.array([138.2])}))
    {'speed_rad_s': array([138.2])}
    """
    head, contents = [], []
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise CheckpointError(f"{name}: an array of type {array.dtype}, expected numbers, truth values or text")
        order: Literal["C", "F"] = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
        head.append((name, array.dtype.str, array.shape, order))
        contents.append(array.tobytes(order))
    listed = json.dumps(head, separators=(",", ":")).encode()
    payload = zstandard.compress(b"".join((_LENGTH.pack(len(listed)), listed, *contents)))
    return _HEADER.pack(_MAGIC, _VERSION, _digest(payload)) + payload


def from_bytes(data: bytes) -> dict[str, np.ndarray]:
    """Named arrays from what `to_bytes` gave.

    Raises
    ------
    CheckpointError
        If the bytes are damaged, cut short, or something else, or were written by another version of the format.
    """
    if len(data) < _HEADER.size or not data.startswith(_MAGIC):
        raise CheckpointError(f"{len(data)} bytes that begin with {data[:4]!r}, expected a checkpoint ({_MAGIC!r})")
    _, version, digest = _HEADER.unpack_from(data)
    if version != _VERSION:
        raise CheckpointError(f"a checkpoint of format {version}, expected format {_VERSION}")
    payload = data[_HEADER.size :]
    if _digest(payload) != digest:
        raise CheckpointError(f"a checkpoint of {len(data)} bytes is damaged: its checksum does not fit its contents")
    content = zstandard.decompress(payload)
    at = _LENGTH.size + _LENGTH.unpack_from(content)[0]
    found = {}
    for name, kind, shape, order in json.loads(content[_LENGTH.size : at]):
        array: np.ndarray = np.ndarray(shape, np.dtype(kind), content, at, order=order)
        found[name] = array.copy("K")
        at += array.nbytes
    return found


def prefixed(part: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of one part under names that several parts may share a mapping with.

    Examples
    --------
    >>> prefixed("gate", {"start_ns": np.array(5)})
    {'gate/start_ns': array(5)}
    """
    return {f"{part}/{name}": array for name, array in arrays.items()}


def unprefixed(part: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of one part under their own names; empty if there is no such part.

    Examples
    --------
    >>> unprefixed("gate", {"gate/start_ns": np.array(5), "window/level": np.array(1.0)})
    {'start_ns': array(5)}
    """
    start = f"{part}/"
    return {name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)}


def checked(
    arrays: Mapping[str, np.ndarray], name: str, kind: type[_Scalar], shape: tuple[int | None, ...]
) -> npt.NDArray[_Scalar]:
    """Return one array if it is what it should be; the shape is None where any size will do.

    Raises
    ------
    CheckpointError
        If there is no such array, or it has another type or shape: the state is that of another machine or program.
    """
    array = arrays.get(name)
    if array is None:
        raise CheckpointError(f"{name} is missing")
    sizes = zip(shape, array.shape, strict=True)
    fits = len(array.shape) == len(shape) and all(size in (None, found) for size, found in sizes)
    if not fits or array.dtype.type is not kind:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise CheckpointError(
            f"{name} has type {array.dtype} and shape {array.shape}, expected {kind.__name__} and ({wanted})"
        )
    return array


def texts(arrays: Mapping[str, np.ndarray], name: str) -> tuple[str, ...]:
    """Return the texts in one array of any length, `checked`."""
    return tuple(checked(arrays, name, np.str_, (None,)).tolist())


def _digest(payload: bytes) -> bytes:
    return hashlib.blake2b(payload, digest_size=16).digest()
