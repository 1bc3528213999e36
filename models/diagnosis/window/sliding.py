"""The sliding window: a ring of hop moments.

What is remembered of a window at every hop is small: where its hops begin, and which samples they are made of. The
moments themselves, megabytes, are computed again from the same samples (`recall.py`), unless all of them were stored.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial

import numpy as np

from models.checkpoint import checked, prefixed, unprefixed
from models.diagnosis.window.excluded import KnownLine
from models.diagnosis.window.moments import HopMoments, Plan, hop_moments
from models.diagnosis.window.recall import Piece, Recall, digest_of, pieces_of, samples_of
from models.diagnosis.window.rotation import LEAST_SETTLED
from models.diagnosis.window.statistics import WindowStatistics, levels_of, window_statistics
from models.errors import CheckpointError
from models.levels.measures import WindowLevels
from models.signals.block import FloatArray, SampleArray


class SlidingWindow:
    """Cuts a stream into hops and keeps the latest ones.

    The same samples give the same hops, whatever blocks they come in. A gap costs the hop it falls into; earlier hops
    stay until the window's allowed span has passed.

    Parameters
    ----------
    remembered : bool
        Whether `checkpoint` will be called: it needs a digest of the samples of every hop.
    lines : sequence of KnownLine
        Those of the healthy machine.
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
        self._pieces: deque[Piece] = deque(maxlen=plan.hops)  # the samples that each hop is made of
        self._pending: list[np.ndarray] = []
        self._pending_samples = 0
        self._pending_start_ns = 0
        self._blocks: deque[tuple[int, int]] = deque()  # start and length of the blocks that hold the pending samples
        self._row = 0  # row of the first of these blocks at which the pending samples begin
        self._level: FloatArray | None = None
        self._recall: Recall | None = None

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

    @property
    def latest_hop(self) -> HopMoments | None:
        """The hop that was completed last."""
        return self._hops[-1] if self._hops else None

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
            self._pieces.append(Piece(start_ns, block_ns, row, taken.shape[0], digest_of(taken)))
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
        if self._recall is None:
            return
        self._recall.take(samples, start_ns)
        if newest and self._recall.complete():
            self.give_up()

    def give_up(self) -> int:
        """Continue with the hops that could be recalled; return how many could not."""
        recall, self._recall = self._recall, None
        if recall is None:
            return 0
        there = recall.hops()
        self._pieces = deque((piece for piece, _ in there), maxlen=self.plan.hops)
        self._hops = deque((hop for _, hop in there), maxlen=self.plan.hops)
        found = recall.pending()
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
        last = Piece(start_ns, block_ns, self._row, pending.shape[0], digest_of(pending))
        found: dict[str, np.ndarray] = {
            "level": np.array([] if self._level is None else self._level, dtype=np.float64),
            **pieces_of((*self._pieces, last)),
        }
        if whole:
            found |= {"pending": pending, "pending_blocks": np.array(self._blocks, dtype=np.int64).reshape(-1, 2)}
            for number, hop in enumerate(self._hops):
                found |= prefixed(f"hop_{number}", hop.checkpoint())
        return found

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue where `checkpoint` was called; without moments the window `lacks` its samples until recalled.

        Raises
        ------
        CheckpointError
            If an array is missing or of another form, a hop is missing, or it does not fit the plan; nothing is
            changed then.
        """
        level = checked(arrays, "level", np.float64, (None,))
        if level.size not in (0, len(self.plan.states)):
            raise CheckpointError(f"level has {level.size} values, expected {len(self.plan.states)} or none")
        recall = Recall(self.plan, level, arrays)
        if recall.pieces and level.size != len(self.plan.states):
            raise CheckpointError(
                f"level has no values, expected {len(self.plan.states)} for {len(recall.pieces)} hops"
            )
        if "pending" in arrays:
            pending = samples_of(arrays, "pending", (recall.last.rows, self._width))
            blocks = checked(arrays, "pending_blocks", np.int64, (None, 2))
            ring = [HopMoments.restored(unprefixed(f"hop_{number}", arrays)) for number in range(len(recall.pieces))]
            for hop in ring:
                self._check_fits(hop)
            self._hops, self._pieces = deque(ring, self.plan.hops), deque(recall.pieces, self.plan.hops)
            self._pending, self._pending_samples = ([pending] if pending.size else []), pending.shape[0]
            self._pending_start_ns = recall.last.start_ns
            self._blocks, self._row = deque((start, rows) for start, rows in blocks.tolist()), recall.last.row
        elif recall.pieces or recall.last.rows:
            self._recall = recall
        self._level = level if level.size else None

    def _check_fits(self, hop: HopMoments) -> None:
        """Raise CheckpointError for a hop of other channels, lags or frequencies."""
        plan = self.plan
        n = len(plan.states) + (1 if plan.angle_column is None and plan.speed_rad_s is None else 3)
        products, segments = (plan.lags.size, n, n), (plan.hop // (plan.segment // 2), plan.bins.size, n)
        if hop.products.shape != products or hop.segments.shape != segments:
            raise CheckpointError(
                f"the hop of start_ns {hop.start_ns} has moments of shape {hop.products.shape} and "
                f"{hop.segments.shape}, expected {products} and {segments}: it is that of other channels or settings"
            )

    def levels(self, *, errors: bool = True) -> WindowLevels | None:
        """Levels of the hops that are there, however few; None without any."""
        return levels_of(self.plan, tuple(self._hops), errors=errors) if self._hops else None

    def statistics(
        self, hops: int | None = None, *, lagged: bool = False, lost: tuple[str, ...] = ()
    ) -> WindowStatistics | None:
        """Statistics of a full window, or of its newest `hops`; None while there are too few.

        The newest hops have correlations at all lags, as a full window has, only if `lagged`; otherwise at lag zero.
        For `lost` sensors see `window_statistics`.
        """
        count = self.plan.hops if hops is None else hops
        if not 0 < count <= len(self._hops):
            return None
        lagged = lagged or hops is None
        return window_statistics(self.plan, tuple(self._hops)[-count:], lagged=lagged, lines=self._lines, lost=lost)

    def settled(self, lost: tuple[str, ...] = ()) -> WindowStatistics:
        """Statistics of the hops in which the shaft had one speed (`WindowStatistics.settled`); there must be some."""
        return window_statistics(self.plan, tuple(self._hops), lines=self._lines, settled=True, lost=lost)

    def again(self) -> Callable[[], WindowStatistics] | None:
        """Return a function that makes the statistics of the window as it is judged now; None before it is full.

        Hops in which the speed changed are left out where they are not judged (`settled`). Statistics are megabytes,
        while the hops they are made of are there anyway. The function keeps its result.
        """
        if len(self._hops) < self.plan.hops:
            return None
        return cache(partial(_as_judged, self.plan, tuple(self._hops), self._lines))


def _as_judged(plan: Plan, hops: tuple[HopMoments, ...], lines: Sequence[KnownLine] | None) -> WindowStatistics:
    whole = window_statistics(plan, hops, lines=lines)
    left_out = not whole.settled.all() and whole.settled.mean() >= LEAST_SETTLED
    return window_statistics(plan, hops, lines=lines, settled=True) if left_out else whole
