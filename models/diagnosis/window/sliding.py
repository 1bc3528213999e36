"""The sliding window: a ring of hop moments, which are computed again from their samples after a restart.

What is remembered of a window at every hop is small: where its hops begin, and which samples they are made of. The
moments themselves, megabytes, are computed again from the same samples, unless all of them were stored.

::

    remembered   level | hops: start, first block, row in it, digest of the samples | the same of the unfinished hop
    taken again  blocks ------------------------------------------------------------> those whose digest fits

A hop is either the same to the last bit or missing: its samples, recorded or sent once more, are checked by their
digest, so neither refused blocks nor other data of the same time can get into it.
"""

import hashlib
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from models.checkpoint import checked, prefixed, unprefixed
from models.diagnosis.window.excluded import KnownLine
from models.diagnosis.window.moments import HopMoments, Plan, hop_moments
from models.diagnosis.window.statistics import WindowStatistics, levels_of, window_statistics
from models.errors import CheckpointError
from models.levels.measures import WindowLevels
from models.signals.block import FloatArray, SampleArray

_DIGEST = 16


@dataclass(frozen=True, slots=True)
class _Piece:
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


class _Recall:
    """Blocks that are taken again, and the hops that can be computed from them.

    The pieces in `arrays` are the hops, oldest first, and last the unfinished one; `level`, shape (n_states,) or (0,),
    was subtracted from all samples.
    """

    def __init__(self, plan: Plan, level: FloatArray, arrays: Mapping[str, np.ndarray]) -> None:
        numbers = checked(arrays, "pieces", np.int64, (None, 4))
        digests = checked(arrays, "digests", np.uint8, (len(numbers), _DIGEST))
        *hops, last = [
            _Piece(start_ns, block_ns, row, rows, digest.tobytes())
            for (start_ns, block_ns, row, rows), digest in zip(numbers.tolist(), digests, strict=True)
        ]
        self.arrays: dict[str, np.ndarray] = {"level": level, "pieces": numbers, "digests": digests}  # as given
        self.pieces, self.last = tuple(hops), last
        self._plan, self._level = plan, level
        self._oldest_ns = min(one.block_ns for one in (*hops, last) if one.rows) if hops or last.rows else 0
        self._blocks: dict[int, SampleArray] = {}
        self._found: dict[_Piece, HopMoments] = {}

    def take(self, samples: SampleArray, start_ns: int) -> None:
        """Take a block; one from before the window is ignored."""
        if start_ns >= self._oldest_ns:
            self._blocks[start_ns] = samples

    def hops(self) -> tuple[tuple[_Piece, HopMoments], ...]:
        """The hops whose samples are there, oldest first."""
        for piece in self.pieces:
            if piece not in self._found and (found := self.samples(piece)) is not None:
                self._found[piece] = hop_moments(self._plan, self._plan.to_si(found[0]), self._level, piece.start_ns)
        return tuple((piece, self._found[piece]) for piece in self.pieces if piece in self._found)

    def samples(self, piece: _Piece) -> tuple[SampleArray, tuple[tuple[int, int], ...]] | None:
        """Samples of a piece, and start and length of the blocks they are from; None if incomplete."""
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


class SlidingWindow:
    """Cuts a stream into hops and keeps the latest ones.

    The same samples give the same hops, whatever blocks they come in. A gap costs the hop it falls into; earlier hops
    stay until the window's allowed span has passed. `lines` are those of the healthy machine.

    Parameters
    ----------
    remembered : bool
        Whether `checkpoint` will be called: it needs a digest of the samples of every hop.
    channels : int, optional
        Number of channels if samples come as they were received; without it they are SI. Pending samples are then kept
        as received, which takes less memory, and conversion hop by hop takes less time than block by block.
    """

    def __init__(
        self, plan: Plan, *, remembered: bool = False, lines: Sequence[KnownLine] = (), channels: int | None = None
    ) -> None:
        self.plan = plan
        self._received, self._width = channels is not None, channels or plan.width
        self._lines = lines
        self._remembered = remembered
        self._hops: deque[HopMoments] = deque(maxlen=plan.hops)
        self._pieces: deque[_Piece] = deque(maxlen=plan.hops)  # the samples that each hop is made of
        self._pending: list[np.ndarray] = []
        self._pending_samples = 0
        self._pending_start_ns = 0
        self._blocks: deque[tuple[int, int]] = deque()  # start and length of the blocks that hold the pending samples
        self._row = 0  # row of the first of these blocks at which the pending samples begin
        self._level: FloatArray | None = None
        self._recall: _Recall | None = None

    @property
    def filled(self) -> float:
        """Fraction of a full window that is there."""
        return len(self._hops) / self.plan.hops

    @property
    def lacking(self) -> int:
        """How many samples the next hop lacks, apart from any to be skipped before it."""
        return self.plan.need - self._pending_samples

    @property
    def hops(self) -> tuple[HopMoments, ...]:
        """The hops that are in the window, oldest first."""
        return tuple(self._hops)

    @property
    def first_ns(self) -> int:
        """When the oldest samples in the window begin, including the history that its first hop needs."""
        return self._hops[0].start_ns - round((self.plan.need - self.plan.fresh) * 1e9 / self.plan.rate_hz)

    def feed(self, samples: SampleArray, start_ns: int) -> Iterator[int]:
        """Add samples that continue the previous ones, and yield the end time of every completed hop.

        The samples are finite: in SI units as `Plan.to_si` gives them, shape (n_samples, width), or, if the window was
        given `channels`, as received, shape (n_samples, channels). A long block may complete several hops: ask for the
        statistics between them, and exhaust the iterator, or the rest of the block is lost.
        """
        self.give_up()
        # Every block sets the time anew: the device's clock counts, however its rate deviates from nominal.
        self._pending_start_ns = start_ns - round(self._pending_samples * 1e9 / self.plan.rate_hz)
        # Row-major, whatever the caller has: sums must not depend on how samples lie in memory.
        self._pending.append(np.ascontiguousarray(samples))
        self._pending_samples += samples.shape[0]
        self._blocks.append((start_ns, samples.shape[0]))
        if self._pending_samples == samples.shape[0]:  # they may be samples to skip after a snapshot
            self._pending = self._pending[-1:]
            self._drop_pending(self._row)
        while self._pending_samples >= self.plan.need:
            first_ns = self._pending_start_ns
            buffer = self._joined()
            block_ns, row = self._blocks[0][0], self._row
            self._pending, self._row = [buffer], self._row + self.plan.stride
            self._drop_pending(self.plan.stride)
            yield self._complete(buffer[: self.plan.need], first_ns, block_ns, row)
        if self._pending and self._pending[0].base is not None:  # a view would keep the whole buffer in memory
            self._pending[0] = self._pending[0].copy()

    def _joined(self) -> np.ndarray:
        """All pending samples."""
        if len(self._pending) == 1:
            return self._pending[0]
        return np.concatenate(self._pending or [np.empty((0, self._width), np.float32)])

    def _drop_pending(self, count: int) -> None:
        """Drop the first `count` pending samples; those that have not come yet are dropped when they come."""
        if not count:
            return
        (pending,) = self._pending
        rest = pending[count:]
        self._pending, self._pending_samples = [rest], rest.shape[0]
        self._pending_start_ns += round(count * 1e9 / self.plan.rate_hz)
        while self._blocks and self._row >= self._blocks[0][1]:
            self._row -= self._blocks.popleft()[1]

    def _complete(self, taken: SampleArray, first_ns: int, block_ns: int, row: int) -> int:
        samples = self.plan.to_si(taken) if self._received else np.asarray(taken, dtype=np.float64)
        if self._level is None or not self._hops:
            # The median: one wild sample must not become the level of everything that follows.
            self._level = np.median(samples[:, : len(self.plan.states)], axis=0)
        start_ns = first_ns + round((self.plan.need - self.plan.fresh) * 1e9 / self.plan.rate_hz)
        hop = hop_moments(self.plan, samples, self._level, start_ns)
        while self._hops and hop.end_ns - self._hops[0].start_ns > self.plan.max_span_ns:
            self._hops.popleft()
            if self._remembered:
                self._pieces.popleft()
        self._hops.append(hop)
        if self._remembered:
            self._pieces.append(_Piece(start_ns, block_ns, row, taken.shape[0], digest_of(taken)))
        return hop.end_ns

    def gap(self) -> None:
        """Forget the unfinished hop: what comes next does not continue it."""
        self.give_up()
        self._pending = []
        self._pending_samples = self._row = 0
        self._blocks.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.gap()
        self._hops.clear()
        self._pieces.clear()

    @property
    def lacks(self) -> bool:
        """Whether samples are to be taken again with `recall`."""
        return self._recall is not None

    def recall(self, samples: SampleArray, start_ns: int, *, newest: bool) -> None:
        """Take a block again, as received, that was in the window when `checkpoint` was called.

        `newest` says that there was no later block: everything may be complete now.
        """
        recall = self._recall
        if recall is None:
            return
        recall.take(samples, start_ns)
        if newest and len(recall.hops()) == len(recall.pieces) and recall.samples(recall.last) is not None:
            self.give_up()

    def give_up(self) -> int:
        """Continue with the hops that could be recalled; return how many could not."""
        recall, self._recall = self._recall, None
        if recall is None:
            return 0
        there = recall.hops()
        self._pieces = deque((piece for piece, _ in there), maxlen=self.plan.hops)
        self._hops = deque((hop for _, hop in there), maxlen=self.plan.hops)
        found = recall.samples(recall.last)
        if found is not None:
            samples, blocks = found
            self._pending, self._pending_samples = ([samples] if samples.size else []), samples.shape[0]
            self._blocks, self._row = deque(blocks), recall.last.row
            self._pending_start_ns = recall.last.start_ns
        return len(recall.pieces) - len(there)

    def checkpoint(self, *, whole: bool = False) -> dict[str, np.ndarray]:
        """State from which a window continues, as named arrays; call it between two blocks.

        If `whole`, it has the moments and samples, megabytes; otherwise the same samples must be taken again with
        `recall`.

        Raises
        ------
        ValueError
            If the window was not made to be `remembered`.
        """
        if not self._remembered:
            raise ValueError("the window takes no digests: it cannot be remembered")
        if self._recall is not None:
            return dict(self._recall.arrays)
        pending = self._joined()
        block_ns = self._blocks[0][0] if self._blocks else 0
        start_ns = self._pending_start_ns if pending.size else 0  # the time of samples lost to a gap is of no use
        last = _Piece(start_ns, block_ns, self._row, pending.shape[0], digest_of(pending))
        pieces = *self._pieces, last
        numbers = [(one.start_ns, one.block_ns, one.row, one.rows) for one in pieces]
        found: dict[str, np.ndarray] = {
            "level": np.array([] if self._level is None else self._level, dtype=np.float64),
            "pieces": np.array(numbers, dtype=np.int64),
            "digests": np.frombuffer(b"".join(one.digest for one in pieces), np.uint8).reshape(-1, _DIGEST),
        }
        if whole:
            found |= {"pending": pending, "pending_blocks": np.array(self._blocks, dtype=np.int64).reshape(-1, 2)}
            for number, hop in enumerate(self._hops):
                found |= prefixed(f"hop_{number}", hop.checkpoint())
        return found

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue where `checkpoint` was called; without moments the window `lacks` its samples until recalled.

        Raises CheckpointError if an array is missing or of another form, a hop is missing, or it does not fit the plan;
        nothing is changed then.
        """
        level = checked(arrays, "level", np.float64, (None,))
        if level.size not in (0, len(self.plan.states)):
            raise CheckpointError(f"level has {level.size} values, expected {len(self.plan.states)} or none")
        recall = _Recall(self.plan, level, arrays)
        if recall.pieces and level.size != len(self.plan.states):
            raise CheckpointError(
                f"level has no values, expected {len(self.plan.states)} for {len(recall.pieces)} hops"
            )
        if "pending" in arrays:
            shape = recall.last.rows, self._width
            pending: SampleArray = (
                checked(arrays, "pending", np.float32, shape)
                if arrays["pending"].dtype == np.float32
                else checked(arrays, "pending", np.float64, shape)
            )
            blocks = checked(arrays, "pending_blocks", np.int64, (None, 2))
            ring = [HopMoments.restored(unprefixed(f"hop_{number}", arrays)) for number in range(len(recall.pieces))]
            plan, n = self.plan, len(self.plan.states)
            n += 1 if plan.angle_column is None and plan.speed_rad_s is None else 3
            products, segments = (plan.lags.size, n, n), (plan.hop // (plan.segment // 2), plan.bins.size, n)
            for hop in ring:
                if hop.products.shape != products or hop.segments.shape != segments:
                    raise CheckpointError(
                        f"the hop of start_ns {hop.start_ns} has moments of shape {hop.products.shape} and "
                        f"{hop.segments.shape}, expected {products} and {segments}: it is that of other channels or "
                        "settings"
                    )
            self._hops, self._pieces = deque(ring, self.plan.hops), deque(recall.pieces, self.plan.hops)
            self._pending, self._pending_samples = ([pending] if pending.size else []), pending.shape[0]
            self._pending_start_ns = recall.last.start_ns
            self._blocks, self._row = deque((start, rows) for start, rows in blocks.tolist()), recall.last.row
        elif recall.pieces or recall.last.rows:
            self._recall = recall
        self._level = level if level.size else None

    def levels(self, *, errors: bool = True) -> WindowLevels | None:
        """Levels of the hops that are there, however few; None without any."""
        return levels_of(self.plan, self.hops, errors=errors) if self._hops else None

    def statistics(
        self, hops: int | None = None, *, lagged: bool = False, lost: tuple[str, ...] = ()
    ) -> WindowStatistics | None:
        """Statistics of a full window, or of its newest `hops`; None while there are too few.

        The newest hops have correlations at all lags, as a full window has, only if `lagged`; otherwise at lag zero.
        For `lost` sensors see `window_statistics`.
        """
        count, lagged = (self.plan.hops, True) if hops is None else (hops, lagged)
        if not 0 < count <= len(self._hops):
            return None
        return window_statistics(self.plan, self.hops[-count:], lagged=lagged, lines=self._lines, lost=lost)

    def settled(self, lost: tuple[str, ...] = ()) -> WindowStatistics:
        """Statistics of the hops in which the shaft had one speed (`WindowStatistics.settled`); there must be some."""
        return window_statistics(self.plan, self.hops, lines=self._lines, settled=True, lost=lost)

    def again(self) -> Callable[[], WindowStatistics] | None:
        """Return a function that makes the statistics of the window as it is judged now; None before it is full.

        Hops in which the speed changed are left out where they are not judged (`settled`). Statistics are megabytes,
        while the hops they are made of are there anyway. The function keeps its result.
        """
        if len(self._hops) < self.plan.hops:
            return None
        made = partial(window_statistics, self.plan, self.hops, lines=self._lines)

        @cache
        def judged() -> WindowStatistics:
            whole = made()
            return made(settled=True) if whole.partly_settled else whole

        return judged
