"""The sliding window: a ring of hop moments, and the statistics of the window they make.

What is remembered of a window with every hop is small: from where to where its hops reach, and which samples they are
made of. The moments themselves, megabytes, are computed again from the same samples (`models.diagnosis.recall`), unless
all of them were stored.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from models.checkpoint import checked, prefixed, unprefixed
from models.diagnosis.moments import (
    ComplexArray,
    HopMoments,
    Plan,
    Rotation,
    SpeedSource,
    angle_jumps,
    divided,
    hop_coefficients,
    hop_moments,
    regression,
    relative_vectors,
    rotation_of,
    through,
)
from models.diagnosis.recall import Piece, Recall, digest_of, pieces_of
from models.diagnosis.stationarity import segment_levels, summed
from models.errors import CheckpointError
from models.levels.measures import WindowLevels, window_levels
from models.signals.block import FloatArray
from models.signals.waveform import Waveform, stacked_waveform


@dataclass(frozen=True)
class WindowStatistics:
    """Everything the diagnosis looks at, for one window."""

    states: tuple[str, ...]  # state variables of all rows and columns below
    # Oldest and newest data in the window.
    start_ns: int
    end_ns: int
    # How much data it holds.
    n_samples: int
    n_segments: int
    lags_s: FloatArray  # (n_lags,), lags of the correlation functions, s
    # (n_lags, n, n): ``correlation[l, i, j]`` estimates R_ij(τ_l) = E{x_i(t) x_j(t+τ_l)} of the part that is neither
    # mean nor rotation-synchronous (Eq. 18), SI units.
    correlation: FloatArray
    # (n_hops, n_lags, n, n): the same of every hop alone (with the window's mean and synchronous part taken out): their
    # scatter gives standard errors
    hop_correlation: FloatArray
    spectrum: ComplexArray  # (n_bins, n, n), Hermitian cross-spectral matrices of the same part, two-sided, SI²/Hz
    frequencies_hz: FloatArray  # (n_bins,), their frequencies
    synchronous: ComplexArray | None  # (n,), q of x_n = Re{q e^{jθ}} over the window; None without a phase reference
    hop_synchronous: ComplexArray | None  # (n_hops, n), the same of every hop alone
    # (n_hops, n): where the speed is estimated: the same of every hop, from an angle at which one state is
    # largest. Lengths and angles between channels hold, the angle to the shaft is unknown; zero in hops without a
    # speed.
    relative_synchronous: ComplexArray | None
    # ``phase reference``, ``estimated`` (from the line in the vibration), or ``unknown``: the rotation was not taken
    # out then
    speed_source: SpeedSource
    speed_rad_s: float  # mean speed (nan if unknown)
    speed_range: tuple[float, float]  # slowest and fastest hop, rad/s (nan if unknown)
    hop_speed_rad_s: FloatArray  # (n_hops,), mean speed of each hop (nan if unknown)
    hop_jump_rad: FloatArray  # (n_hops,), by which the shaft angle jumped in each (nan if unknown)
    removed_by_hop: bool  # whether the rotation was taken out hop by hop, each with its own amplitude
    # (n_bins, n): squared coherence of each bin with the angle or, where the rotation was taken out hop by hop, with
    # itself a segment later: none of noise, all of a line. None without a phase reference
    phase_kept: FloatArray | None
    duration_s: float  # length of the data in the window
    # What the samples of each hop look like: of each of `sensors`, those of `states` first.
    waveforms: tuple[Waveform, ...]
    sensors: tuple[str, ...]
    # (n_pairs, n_bands, 3): powers of the motions that are measured twice, of each hop (`models.diagnosis.motion`)
    pair_powers: tuple[ComplexArray, ...]
    # The same window of the sensors as they are mounted, run-out included, where some of them are at an angle or have a
    # slow-roll vector. `waveforms` and `pair_powers` are those of mounted sensors in either.
    mounted: "WindowStatistics | None" = None
    directed: bool = True  # whether vectors keep their directions: the shaft angle has not jumped since it was set up

    @property
    def as_mounted(self) -> "WindowStatistics":
        """Statistics of the sensors themselves: for whatever judges a sensor."""
        return self if self.mounted is None else self.mounted

    @property
    def rotation_vectors(self) -> ComplexArray | None:
        """Rotation-synchronous vectors of each hop, from an angle that may be another one in each; None if unknown."""
        return self.hop_synchronous if self.relative_synchronous is None else self.relative_synchronous

    @cached_property
    def hop_waveform(self) -> Waveform:
        """The waveforms hop by hop, shape (n_hops, n)."""
        return stacked_waveform(self.waveforms)


def window_statistics(plan: Plan, hops: tuple[HopMoments, ...], *, lagged: bool = True) -> WindowStatistics:
    """Add hops up to a window and take out its mean and its rotation-synchronous part.

    Without `lagged`, correlations are at lag zero alone: the spectra are all that the likelihood asks for.

    With a = (x, n) and β the least-squares coefficients of x on n over the window, the sum of
    (x - βn)(t-τ) (x - βn)ᵀ(t) is the product sum seen through the matrix (I, -β) from both sides.
    """
    n = len(plan.states)
    n_lags = plan.lags_s.size if lagged else 1
    rotation = rotation_of(plan, hops)
    products = np.stack([hop.products[:n_lags] for hop in hops])
    segments = np.concatenate([hop.segments for hop in hops])
    if rotation.source == "unknown":  # a line may ride along, but it is not the shaft's
        products, segments = products[:, :, : n + 1, : n + 1], segments[:, :, : n + 1]
    total = products[0].copy()
    for hop in products[1:]:  # one by one, in order: the sum must not depend on how numpy would pair them
        total += hop
    synchronous = hop_synchronous = relative_synchronous = phase_kept = None
    if rotation.by_hop:
        phase_reference = rotation.source == "phase reference"
        level = regression(total[0] if phase_reference else total[0][: n + 1, : n + 1], n)
        own = hop_coefficients(plan, hops, rotation, level[:, 0])
        remove = np.concatenate([np.broadcast_to(np.eye(n), (len(hops), n, n)), -own.hops], axis=2)[:, np.newaxis]
        hop_correlation = (remove @ products @ remove.transpose(0, 1, 3, 2)) / plan.hop
        correlation = hop_correlation.sum(axis=0) / len(hops)
        cleaned = segments[:, :, :n] - segments[:, :, n:] @ own.segments.transpose(0, 2, 1)
        if phase_reference:
            synchronous = _synchronous(level)
            one, other = cleaned[:-2], cleaned[2:]  # those between overlap both
            powers = (np.abs(one) ** 2).sum(axis=0) * (np.abs(other) ** 2).sum(axis=0)
            phase_kept = _coherence((one * other.conj()).sum(axis=0), powers)
        elif plan.states:
            relative_synchronous = relative_vectors(np.stack([_synchronous(one) for one in own.hops]))
    else:
        beta = regression(total[0], n)
        remove = np.hstack([np.eye(n), -beta])
        hop_correlation = remove @ through(remove, products) / plan.hop
        correlation = (remove @ total @ remove.T) / (len(hops) * plan.hop)
        cleaned = through(remove, segments)
        if plan.angle_column is not None:
            synchronous = _synchronous(beta)
    if plan.angle_column is not None:
        hop_synchronous = _synchronous(regression(products[:, 0], n))
    by_bin = np.ascontiguousarray(cleaned.transpose(1, 0, 2), dtype=np.complex128)
    spectrum = summed(by_bin)
    if synchronous is not None and phase_kept is None:
        angle = segments[:, :, n + 1].T[:, :, None]
        powers = np.einsum("fii->fi", spectrum).real * (np.abs(angle) ** 2).sum(axis=1)
        phase_kept = _coherence((by_bin.transpose(0, 2, 1) @ angle.conj())[:, :, 0], powers)
    levels = segment_levels(by_bin, spectrum, sorted({*range(n)} - {pair.second for pair in plan.pairs}))
    if levels is not None:
        spectrum = summed(by_bin / np.sqrt(levels)[:, np.newaxis])
    speed_rad_s, speed_range = _speeds(rotation, hops, plan)
    found = WindowStatistics(
        states=plan.mounted,
        start_ns=hops[0].start_ns,
        end_ns=hops[-1].end_ns,
        n_samples=len(hops) * plan.hop,
        n_segments=segments.shape[0],
        lags_s=plan.lags_s[:n_lags],
        correlation=correlation,
        hop_correlation=hop_correlation,
        spectrum=divided(spectrum, segments.shape[0]),
        frequencies_hz=plan.frequencies_hz,
        synchronous=synchronous,
        hop_synchronous=hop_synchronous,
        relative_synchronous=relative_synchronous,
        speed_source=rotation.source,
        speed_rad_s=speed_rad_s,
        speed_range=speed_range,
        hop_speed_rad_s=rotation.hop_speed_rad_s,
        hop_jump_rad=angle_jumps(hops),
        removed_by_hop=rotation.by_hop,
        phase_kept=phase_kept,
        duration_s=len(hops) * plan.hop / plan.rate_hz,
        waveforms=tuple(hop.waveform for hop in hops),
        sensors=plan.sensors,
        pair_powers=tuple(hop.pair_powers for hop in hops),
    )
    shaft = found if plan.runout is None else _without(found, plan.runout)
    return shaft if plan.turn is None else _turned(shaft, plan.states, plan.turn)


def _without(window: WindowStatistics, runout: ComplexArray) -> WindowStatistics:
    """The window without what sensors show at running speed although nothing vibrates."""
    known = runout if window.speed_rad_s >= 0 else runout.conj()
    return replace(
        window,
        synchronous=None if window.synchronous is None else window.synchronous - known,
        hop_synchronous=None if window.hop_synchronous is None else window.hop_synchronous - known,
        mounted=window,
    )


def _turned(window: WindowStatistics, states: tuple[str, ...], turn: FloatArray) -> WindowStatistics:
    """Statistics of the states, from those of sensors at an angle: every moment is turned from both sides."""

    def vectors(mounted: ComplexArray | None) -> ComplexArray | None:
        return None if mounted is None else np.asarray(mounted @ turn.T, dtype=np.complex128)

    relative = vectors(window.relative_synchronous)
    return replace(
        window,
        states=states,
        correlation=turn @ window.correlation @ turn.T,
        hop_correlation=turn @ window.hop_correlation @ turn.T,
        spectrum=turn @ window.spectrum @ turn.T,
        synchronous=vectors(window.synchronous),
        hop_synchronous=vectors(window.hop_synchronous),
        relative_synchronous=None if relative is None else relative_vectors(relative),
        mounted=window.as_mounted,
    )


def levels_of(plan: Plan, hops: tuple[HopMoments, ...], *, errors: bool = True) -> WindowLevels:
    """Vibration levels of the window that hops make, see `window_levels`.

    Raises
    ------
    ValueError
        If the plan holds none.
    """
    if plan.levels is None:
        raise ValueError("no levels are planned")
    rotation = rotation_of(plan, hops)
    return window_levels(
        plan.levels,
        [hop.levels for hop in hops if hop.levels is not None],
        rotation.hop_speed_rad_s,
        phase_reference=rotation.source == "phase reference",
        errors=errors,
    )


def _coherence(shared: ComplexArray | FloatArray, powers: FloatArray) -> FloatArray:
    """Squared coherence, shape (n_bins, n), from sums over the segments of cross-products, and of powers."""
    return np.asarray(np.abs(shared) ** 2 / np.maximum(powers, np.finfo(float).tiny), dtype=np.float64)


def _speeds(rotation: Rotation, hops: tuple[HopMoments, ...], plan: Plan) -> tuple[float, tuple[float, float]]:
    """Mean speed, and the slowest and fastest hop."""
    if rotation.source == "phase reference":
        duration_s, turned = len(hops) * plan.hop / plan.rate_hz, [hop.turned_rad for hop in hops]
        slowest, fastest = (edge / duration_s * len(hops) for edge in (min(turned), max(turned)))
        return sum(turned) / duration_s, (slowest, fastest)
    if rotation.source == "unknown":
        return np.nan, (np.nan, np.nan)
    speeds = rotation.hop_speed_rad_s
    return float(np.nanmean(speeds)), (float(np.nanmin(speeds)), float(np.nanmax(speeds)))


def _synchronous(beta: FloatArray) -> ComplexArray:
    return np.asarray(beta[..., 1] - 1j * beta[..., 2], dtype=np.complex128)


class SlidingWindow:
    """Cuts a stream into hops and keeps the latest ones.

    The same samples give the same hops, whatever blocks they come in. A gap costs the hop it falls into; earlier hops
    stay until the window's allowed span has passed.

    Parameters
    ----------
    plan : Plan
    remembered : bool
        Whether `checkpoint` will be asked for: the samples of every hop have their digest taken then.
    """

    def __init__(self, plan: Plan, *, remembered: bool = False) -> None:
        self.plan = plan
        self._remembered = remembered
        self._hops: deque[HopMoments] = deque(maxlen=plan.hops)
        self._pieces: deque[Piece] = deque(maxlen=plan.hops)  # what each of them is made of
        self._pending: list[FloatArray] = []
        self._pending_samples = 0
        self._pending_start_ns = 0
        self._blocks: deque[tuple[int, int]] = deque()  # start and length of those that the pending samples are of
        self._row = 0  # of the first of them, with which the pending samples begin
        self._level: FloatArray | None = None
        self._recall: Recall | None = None

    @property
    def filled(self) -> float:
        """Fraction of a full window that is there."""
        return len(self._hops) / self.plan.hops

    @property
    def lacking(self) -> int:
        """How many samples the next hop lacks, if none are left out before."""
        return self.plan.need - self._pending_samples

    @property
    def hops(self) -> tuple[HopMoments, ...]:
        """The hops that are in the window, oldest first."""
        return tuple(self._hops)

    @property
    def latest_hop(self) -> HopMoments | None:
        """The hop that was completed last."""
        return self._hops[-1] if self._hops else None

    def feed(self, samples: FloatArray, start_ns: int) -> Iterator[int]:
        """Add samples that continue the previous ones, stopping at every completed hop.

        Parameters
        ----------
        samples : ndarray, shape (n_samples, n_states [+ 1])
            Finite SI samples as `Plan.to_si` gives them.

        Yields
        ------
        int
            End time of a hop that became complete and is in the window now. A long block may complete several: ask for
            the statistics between them, and take all, or the rest of the block is lost.
        """
        self.give_up()
        # Anchored anew by every block: the device's clock is the time, however its rate deviates from nominal.
        self._pending_start_ns = start_ns - round(self._pending_samples * 1e9 / self.plan.rate_hz)
        # Rows first, whatever the caller has: sums must not depend on how samples lie in memory.
        self._pending.append(np.ascontiguousarray(samples))
        self._pending_samples += samples.shape[0]
        self._blocks.append((start_ns, samples.shape[0]))
        if self._pending_samples == samples.shape[0]:  # they may be what is to be left after a snapshot
            self._pending = self._pending[-1:]
            self._leave(self._row)
        while self._pending_samples >= self.plan.need:
            first_ns = self._pending_start_ns
            buffer = self._pending[0] if len(self._pending) == 1 else np.concatenate(self._pending)
            block_ns, row = self._blocks[0][0], self._row
            self._pending, self._row = [buffer], self._row + self.plan.stride
            self._leave(self.plan.stride)
            yield self._complete(buffer[: self.plan.need], first_ns, block_ns, row)
        if self._pending and self._pending[0].base is not None:  # a rest would hold all that it is the rest of
            self._pending[0] = self._pending[0].copy()

    def _leave(self, count: int) -> None:
        """Go on so many samples after the first pending one; those that have not come yet are left when they come."""
        if not count:
            return
        (pending,) = self._pending
        rest = pending[count:]
        self._pending, self._pending_samples = [rest], rest.shape[0]
        self._pending_start_ns += round(count * 1e9 / self.plan.rate_hz)
        while self._blocks and self._row >= self._blocks[0][1]:
            self._row -= self._blocks.popleft()[1]

    def _complete(self, samples: FloatArray, first_ns: int, block_ns: int, row: int) -> int:
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
            self._pieces.append(Piece(start_ns, block_ns, row, samples.shape[0], digest_of(samples)))
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
        """Whether samples are to be taken again: `recall` wants them."""
        return self._recall is not None

    def recall(self, samples: npt.NDArray[np.float32] | FloatArray, start_ns: int, *, newest: bool) -> None:
        """Take a block again that was in the window when `checkpoint` was called.

        Parameters
        ----------
        samples : ndarray, shape (n_samples, n_channels)
            As received, not yet in SI units.
        newest : bool
            Whether no later one has been there: everything may be complete now.
        """
        if self._recall is None:
            return
        self._recall.take(samples, start_ns)
        if newest and self._recall.complete():
            self.give_up()

    def give_up(self) -> int:
        """Go on with what could be recalled; how many hops could not."""
        recall, self._recall = self._recall, None
        if recall is None:
            return 0
        there = recall.hops()
        self._pieces = deque((piece for piece, _ in there), maxlen=self.plan.hops)
        self._hops = deque((hop for _, hop in there), maxlen=self.plan.hops)
        found = recall.pending()
        if found is not None:
            samples, blocks = found
            self._pending, self._pending_samples = [samples], samples.shape[0]
            self._blocks, self._row = deque(blocks), recall.last.row
            self._pending_start_ns = recall.last.start_ns
        return len(recall.pieces) - len(there)

    def checkpoint(self, *, whole: bool = False) -> dict[str, np.ndarray]:
        """What a window goes on from, as named arrays, between two blocks.

        Parameters
        ----------
        whole : bool
            With moments and samples, megabytes; otherwise the same samples have to be taken again with `recall`.

        Raises
        ------
        ValueError
            If the window is not one that is remembered.
        """
        if not self._remembered:
            raise ValueError("the window takes no digests: it cannot be remembered")
        if self._recall is not None:
            return dict(self._recall.arrays)
        pending = np.concatenate(self._pending) if self._pending else np.empty((0, self.plan.width))
        block_ns = self._blocks[0][0] if self._blocks else 0
        start_ns = self._pending_start_ns if pending.size else 0  # that of what a gap has taken away is of no use
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
        """Go on where `checkpoint` was called; without moments the window `lacks` its samples until they are recalled.

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
            pending = checked(arrays, "pending", np.float64, (recall.last.rows, self.plan.width))
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

    def statistics(self, hops: int | None = None) -> WindowStatistics | None:
        """Statistics of the window, or of its latest hops, or None while there are not so many.

        Parameters
        ----------
        hops : int, optional
            How many of the latest hops, with correlations at lag zero alone; all hops of a full window without it.
        """
        count = self.plan.hops if hops is None else hops
        if not 0 < count <= len(self._hops):
            return None
        return window_statistics(self.plan, tuple(self._hops)[-count:], lagged=hops is None)
