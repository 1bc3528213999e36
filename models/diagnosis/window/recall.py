"""A window's hops, computed again from their samples, which were recorded or are sent once more.

::

    remembered   level | hops: start, first block, row in it, digest of the samples | the same of the unfinished hop
    taken again  blocks ------------------------------------------------------------> those whose digest fits

A hop is either the same to the last bit or missing: its samples are checked by their digest, so neither refused blocks
nor other data of the same time can get into it.
"""

import hashlib
from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from models.checkpoint import checked
from models.diagnosis.window.moments import HopMoments, Plan, hop_moments
from models.signals.block import FloatArray, SampleArray

_DIGEST = 16


@dataclass(frozen=True, slots=True)
class Piece:
    """Consecutive samples, identified by where they begin and by their digest."""

    start_ns: int  # time of the hop, or of the first pending sample
    # Start of the block that holds the first sample, and the sample's row there.
    block_ns: int
    row: int
    rows: int  # how many samples, those before the hop included
    digest: bytes


def digest_of(samples: SampleArray) -> bytes:
    """Digest of samples as received, whatever precision they came in."""
    with np.errstate(over="ignore"):
        single = samples.astype(np.float32, copy=False)
    samples = single if single is samples or np.array_equal(single, samples) else samples
    # Processors have instructions for SHA-256: half the time of blake2b, which took a fiftieth of that of a hop.
    return hashlib.sha256(np.ascontiguousarray(samples).data).digest()[:_DIGEST]


def pieces_of(pieces: Iterable[Piece]) -> dict[str, np.ndarray]:
    """Pieces as named arrays."""
    found = tuple(pieces)
    numbers = [(one.start_ns, one.block_ns, one.row, one.rows) for one in found]
    return {
        "pieces": np.array(numbers, dtype=np.int64),
        "digests": np.frombuffer(b"".join(one.digest for one in found), np.uint8).reshape(-1, _DIGEST),
    }


def samples_of(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, int]) -> SampleArray:
    """Samples among named arrays, in the precision in which they were received; raises as `checked`."""
    there = arrays.get(name)
    single = there is not None and there.dtype == np.float32
    return checked(arrays, name, np.float32, shape) if single else checked(arrays, name, np.float64, shape)


class Recall:
    """Blocks that are taken again, and the hops that can be computed from them.

    `arrays` are from `pieces_of`: the hops, oldest first, and last the unfinished one; `level`, shape (n_states,) or
    (0,), was subtracted from all samples.

    Raises
    ------
    CheckpointError
        If an array is missing or of another form.
    """

    def __init__(self, plan: Plan, level: FloatArray, arrays: Mapping[str, np.ndarray]) -> None:
        numbers = checked(arrays, "pieces", np.int64, (None, 4))
        digests = checked(arrays, "digests", np.uint8, (len(numbers), _DIGEST))
        *hops, last = [
            Piece(start_ns, block_ns, row, rows, digest.tobytes())
            for (start_ns, block_ns, row, rows), digest in zip(numbers.tolist(), digests, strict=True)
        ]
        self.arrays: dict[str, np.ndarray] = {"level": level, "pieces": numbers, "digests": digests}  # as given
        self.pieces, self.last = tuple(hops), last
        self._plan, self._level = plan, level
        self._oldest_ns = min(one.block_ns for one in (*hops, last) if one.rows) if hops or last.rows else 0
        self._blocks: dict[int, SampleArray] = {}
        self._found: dict[Piece, HopMoments] = {}

    def take(self, samples: SampleArray, start_ns: int) -> None:
        """Take a block; one from before the window is ignored."""
        if start_ns >= self._oldest_ns:
            self._blocks[start_ns] = samples

    def complete(self) -> bool:
        """Whether the blocks hold all hops and the unfinished one."""
        return len(self.hops()) == len(self.pieces) and self.pending() is not None

    def hops(self) -> tuple[tuple[Piece, HopMoments], ...]:
        """The hops whose samples are there, oldest first."""
        for piece in self.pieces:
            if piece not in self._found and (found := self._samples(piece)) is not None:
                self._found[piece] = hop_moments(self._plan, self._plan.to_si(found[0]), self._level, piece.start_ns)
        return tuple((piece, self._found[piece]) for piece in self.pieces if piece in self._found)

    def pending(self) -> tuple[SampleArray, tuple[tuple[int, int], ...]] | None:
        """Samples of the unfinished hop, and start and length of the blocks they are from; None if incomplete."""
        return self._samples(self.last)

    def _samples(self, piece: Piece) -> tuple[SampleArray, tuple[tuple[int, int], ...]] | None:
        if not piece.rows:
            return np.empty((0, 0), np.float32), ()
        starts = sorted(self._blocks)
        rows, blocks, samples = -piece.row, [], []
        for start_ns in starts[bisect_left(starts, piece.block_ns) :]:
            if rows >= piece.rows:
                break
            samples.append(np.ascontiguousarray(self._blocks[start_ns]))
            blocks.append((start_ns, len(samples[-1])))
            rows += len(samples[-1])
        if not samples:
            return None
        found = np.concatenate(samples)[piece.row : piece.row + piece.rows]
        return (found, tuple(blocks)) if digest_of(found) == piece.digest else None
