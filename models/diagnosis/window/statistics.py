"""Statistics of a window, from the moments of its hops."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from models.diagnosis.window.equaliser import Equaliser
from models.diagnosis.window.excluded import (
    LOBE,
    ExcludedLine,
    KnownLine,
    excluded_lines,
    of_one_level,
    segment_levels,
    summed,
)
from models.diagnosis.window.moments import (
    HopMoments,
    Plan,
    Rotation,
    SpeedSource,
    angle_jumps,
    divided,
    hop_coefficients,
    regression,
    rotation_of,
    through,
    turns,
)
from models.diagnosis.window.motion import pair_bands
from models.diagnosis.window.rotation import LEAST_SETTLED, relative_vectors
from models.levels.measures import WindowLevels, window_levels
from models.signals.block import BoolArray, ComplexArray, FloatArray
from models.signals.waveform import Waveform, stacked_waveform

_DRIFT = 0.1  # drift of a channel's mean, over its rms, above which every hop's own mean is removed
_VARIED = 0.06  # relative range of a speed found in the vibration up to which levels at its multiples are taken
_SAME_SPEED = 0.03  # relative distance from speeds up to which a window is comparable with windows of them
_BESIDE = 3  # bins on either side of a line between whose means the spectra are interpolated
_SMOOTH = 0.5  # largest ratio of a drift's squared steps from hop to hop to its squared deviations; 2 by chance


@dataclass(frozen=True, eq=False)
class WindowStatistics:
    """Everything the diagnosis looks at, for one window."""

    states: tuple[str, ...]  # state variables of all rows and columns below
    # Oldest and newest data in the window.
    start_ns: int
    end_ns: int
    # How much data it holds.
    n_samples: int
    n_segments: int  # those its spectra are means of, see `of_one_level`
    lags_s: FloatArray  # (n_lags,), lags of the correlation functions, s
    # (n_lags, n, n): ``correlation[l, i, j]`` estimates R_ij(τ_l) = E{x_i(t) x_j(t+τ_l)} of the part that is neither
    # mean nor rotation-synchronous (Eq. 18), SI units.
    correlation: FloatArray
    # (n_hops, n_lags, n, n): the same of every hop alone (with the window's mean and synchronous part taken out): their
    # scatter gives standard errors
    hop_correlation: FloatArray
    spectrum: ComplexArray  # (n_bins, n, n), Hermitian cross-spectral matrices of the same part, two-sided, SI²/Hz
    segments: ComplexArray  # (n_bins, n_segments, n), Fourier coefficients whose products `spectrum` is the mean of
    frequencies_hz: FloatArray  # (n_bins,), their frequencies
    synchronous: ComplexArray | None  # (n,), q of x_n = Re{q e^{jθ}} over the window; None without a phase reference
    hop_synchronous: ComplexArray | None  # (n_hops, n), the same of every hop alone; 0 without a quarter turn
    # (n_hops, n), if the speed is estimated: the same of every hop, from an angle at which one state is largest.
    # Amplitudes and angles between channels are valid, the angle to the shaft is unknown; zero in hops without a speed.
    relative_synchronous: ComplexArray | None
    # ``phase reference``, ``estimated`` (from the line in the vibration), or ``unknown`` (the rotation was not removed)
    speed_source: SpeedSource
    speed_rad_s: float  # mean speed (nan if unknown)
    speed_range: tuple[float, float]  # slowest and fastest hop, rad/s (nan if unknown)
    hop_speed_rad_s: FloatArray  # (n_hops,), mean speed of each hop (nan if unknown)
    # (n_hops,), how far the most likely rotation stands out in each (`RotationLine.strength`); nan with an angle
    hop_strength: FloatArray
    settled: BoolArray  # (n_hops,), whether each had one speed that was taken out, see `settled_hops`
    hop_jump_rad: FloatArray  # (n_hops,), jump of the shaft angle in each (nan if unknown)
    removed_by_hop: bool  # whether the rotation was taken out hop by hop, each with its own amplitude
    # (n_bins, n): squared coherence of each bin with the angle or, where the rotation was taken out hop by hop, with
    # itself a segment later: 0 for noise, 1 for a line. None without a phase reference
    phase_kept: FloatArray | None
    duration_s: float  # length of the data in the window
    # Waveform of the samples of each hop, with a column for each of `sensors`, those of `states` first.
    waveforms: tuple[Waveform, ...]
    sensors: tuple[str, ...]
    # (n_pairs, n_bands, 3): powers of the motions that are measured twice, of each hop (`motion.py`)
    pair_powers: tuple[ComplexArray, ...]
    # The same window for the sensors as mounted, run-out included, if some of them are at an angle or have a slow-roll
    # vector. `waveforms` and `pair_powers` are those of mounted sensors in either; a high-pass and a delay that the
    # file states for a sensor are divided out of all but the waveforms.
    mounted: "WindowStatistics | None" = None
    lines: tuple[ExcludedLine, ...] = ()  # lines that say nothing about the machine
    time_scale: float = 1.0  # how much slower the machine moves than usual (`models.stream_settings.time_scale`)
    lost: tuple[str, ...] = ()  # sensors, as mounted, that it was made without
    directed: bool = True  # whether vectors keep their directions: the shaft angle has not jumped since it was set up

    @property
    def as_mounted(self) -> "WindowStatistics":
        """Statistics of the sensors as mounted, high-pass and delay divided out: for whatever judges a sensor."""
        return self if self.mounted is None else self.mounted

    def of(self, states: tuple[str, ...]) -> "WindowStatistics":
        """The same window with some of its states only, without waveforms, pairs and mounted sensors."""
        if states == self.states:
            return self
        kept = [self.states.index(state) for state in states]
        return replace(
            self.with_vectors(lambda vectors: vectors[..., kept]),
            states=states,
            correlation=self.correlation[..., kept, :][..., kept],
            hop_correlation=self.hop_correlation[..., kept, :][..., kept],
            spectrum=self.spectrum[:, kept][:, :, kept],
            segments=self.segments[:, :, kept],
            phase_kept=None if self.phase_kept is None else self.phase_kept[:, kept],
            waveforms=(),
            sensors=(),
            pair_powers=(),
            mounted=None,
            lines=tuple(line.turned(np.eye(len(self.states))[kept]) for line in self.lines),
        )

    def with_vectors(self, change: Callable[[ComplexArray], ComplexArray]) -> "WindowStatistics":
        """The same window with its rotation-synchronous vectors, shape (…, n), changed."""
        vectors = (self.synchronous, self.hop_synchronous, self.relative_synchronous)
        synchronous, by_hop, relative = (None if one is None else change(one) for one in vectors)
        return replace(self, synchronous=synchronous, hop_synchronous=by_hop, relative_synchronous=relative)

    def turned(self, turn: FloatArray) -> "WindowStatistics":
        """The same window with its states multiplied by a matrix, shape (n, n); sensors as mounted stay as they are."""
        return _turned(self, self.states, turn)

    @property
    def rotation_vectors(self) -> ComplexArray | None:
        """Rotation-synchronous vectors of each hop, each from an angle that may be its own; None if unknown."""
        return self.hop_synchronous if self.relative_synchronous is None else self.relative_synchronous

    @property
    def partly_settled(self) -> bool:
        """Whether some hops are not `settled`, but enough others are to judge the window without them."""
        return bool(LEAST_SETTLED <= self.settled.mean() < 1)

    @cached_property
    def line_bins(self) -> BoolArray:
        """Bins in which `lines` are seen, shape (n_bins,)."""
        away = [np.abs(self.frequencies_hz - line.frequency_hz) <= line.reach_hz for line in self.lines]
        return np.logical_or.reduce(away, axis=0) if away else np.zeros(self.frequencies_hz.size, dtype=np.bool_)

    @property
    def spectrum_without_lines(self) -> ComplexArray:
        """Spectra interpolated linearly over the bins of `lines`, for what needs a value in every bin.

        Unchanged if lines are in all bins.
        """
        found, clear = self.spectrum, ~self.line_bins
        if clear.all() or not clear.any():
            return found
        edges = np.flatnonzero(np.diff(self.line_bins, prepend=False, append=False)).reshape(-1, 2).tolist()
        for first, end in edges:
            before, after = found[:first][clear[:first]][-_BESIDE:], found[end:][clear[end:]][:_BESIDE]
            ends = [part.mean(axis=0) for part in (before, after) if part.size]
            way = (np.arange(1, end - first + 1) / (end - first + 1))[:, np.newaxis, np.newaxis]
            found = found.copy() if found is self.spectrum else found
            found[first:end] = ends[0] + way * (ends[-1] - ends[0])
        return found

    @cached_property
    def banded_spectrum(self) -> ComplexArray:
        """Sums of the spectra over the bins of `pair_bands`, shape (n_bands, n, n)."""
        return np.asarray(np.add.reduceat(self.spectrum, pair_bands(self.frequencies_hz.size)), dtype=np.complex128)

    def speed_beyond(self, slowest: float, fastest: float) -> str:
        """Why the window is not comparable with others of these speeds, rad/s; empty if it is."""
        now, rpm = self.speed_rad_s, 30 / np.pi
        if not np.isfinite(now):
            return "its speed is not known"
        if slowest * (1 - _SAME_SPEED) <= now <= fastest * (1 + _SAME_SPEED):
            return ""
        return f"speed {now * rpm:.0f} rpm, commissioned at {slowest * rpm:.0f} to {fastest * rpm:.0f} rpm"

    @property
    def without_lines(self) -> "WindowStatistics":
        """The same window without `lines` in its correlations and spectra.

        A line is equally strong at all lags: it has no relation to a bearing's motion, and outlasts any force's memory.
        """
        return self if all(line.power is None for line in self.lines) else self._cleared

    @cached_property
    def _cleared(self) -> "WindowStatistics":
        lines = [line for line in self.lines if line.power is not None]
        turns = np.exp(-2j * np.pi * self.lags_s[:, None] * [line.centre_hz for line in lines])
        gone = np.tensordot(turns, np.stack([line.power for line in lines if line.power is not None]), axes=1).real
        spectrum = replace(self, lines=tuple(lines)).spectrum_without_lines
        correlation, hop_correlation = self.correlation - gone, self.hop_correlation - gone
        return replace(self, correlation=correlation, hop_correlation=hop_correlation, spectrum=spectrum, lines=())

    @property
    def with_steady_rotation(self) -> "WindowStatistics":
        """The same window without what a drifting 1x vector, less its mean, leaves in correlations and spectra.

        That residue is equally strong at all lags, like a line, and no relation between motions holds for it. Vectors
        that scatter from hop to hop are noise and stay in.
        """
        vectors = self.hop_synchronous
        if vectors is None or self.removed_by_hop or (vectors == 0).all(axis=1).any():
            return self
        rest = vectors - vectors.mean(axis=0)
        squares, steps = np.abs(rest) ** 2, np.abs(np.diff(rest, axis=0)) ** 2
        smooth = steps.sum(axis=0) < _SMOOTH * squares.sum(axis=0)
        if not np.any(smooth & (squares.max(axis=0) > _DRIFT**2 * np.abs(np.diag(self.correlation[0])))):
            return self
        turns = np.exp(-1j * self.speed_rad_s * self.lags_s)[:, np.newaxis, np.newaxis]
        power = (rest[:, :, np.newaxis] * rest[:, np.newaxis].conj() / 2)[:, np.newaxis]
        gone = np.asarray((turns * power).real, dtype=np.float64)
        step_hz = float(self.frequencies_hz[1] - self.frequencies_hz[0])
        line = ExcludedLine(abs(self.speed_rad_s) / (2 * np.pi), LOBE * step_hz)
        return replace(
            self,
            correlation=self.correlation - gone.mean(axis=0),
            hop_correlation=self.hop_correlation - gone,
            spectrum=replace(self, lines=(line,)).spectrum_without_lines,
        )

    @cached_property
    def hop_waveform(self) -> Waveform:
        """The waveforms hop by hop, shape (n_hops, n)."""
        return stacked_waveform(self.waveforms)


def window_statistics(
    plan: Plan,
    hops: tuple[HopMoments, ...],
    *,
    lagged: bool = True,
    lines: Sequence[KnownLine] | None = (),
    settled: bool = False,
    lost: tuple[str, ...] = (),
) -> WindowStatistics:
    """Add hops up to a window and take out its mean and its rotation-synchronous part.

    Without `lagged`, correlations are at lag zero only, and no lines are searched for: only the spectra are wanted. For
    `lines` see `excluded_lines`. With `settled`, hops that are not (see `settled_hops`) are left out. Mounted sensors
    that are `lost` are not used for the states, the level of forces or the lines.

    With a = (x, n) and β the least-squares coefficients of x on n over the window, the sum of
    (x - βn)(t-τ) (x - βn)ᵀ(t) is the product sum multiplied by the matrix (I, -β) from both sides.
    """
    n = len(plan.states)
    n_lags = plan.lags_s.size if lagged else 1
    rotation = rotation_of(plan, hops)
    hops, rotation = _settled(hops, rotation) if settled else (hops, rotation)
    products = np.stack([hop.products[:n_lags] for hop in hops])
    segments = np.concatenate([hop.segments.swapaxes(0, 1) for hop in hops], axis=1, dtype=np.complex128)  # bin by bin
    if rotation.source == "unknown":  # the regressors may follow a line, but it is not the shaft's
        products, segments = products[:, :, : n + 1, : n + 1], segments[:, :, : n + 1]
    total = products[0].copy()
    for hop in products[1:]:  # one by one, in order: the sum must not depend on how numpy would pair them
        total += hop
    synchronous = hop_synchronous = relative_synchronous = phase_kept = angle = None
    if rotation.by_hop:
        phase_reference = rotation.source == "phase reference"
        level = regression(total[0] if phase_reference else total[0][: n + 1, : n + 1], n)
        of_hops, of_segments = hop_coefficients(plan, hops, rotation, level[:, 0])
        remove = np.concatenate([np.broadcast_to(np.eye(n), (len(hops), n, n)), -of_hops], axis=2)[:, np.newaxis]
        hop_correlation = (remove @ products @ remove.transpose(0, 1, 3, 2)) / plan.hop
        correlation = hop_correlation.sum(axis=0) / len(hops)
        by_bin = segments[:, :, :n] - (segments[:, :, n:].swapaxes(0, 1) @ of_segments.swapaxes(1, 2)).swapaxes(0, 1)
        if phase_reference:
            synchronous = _synchronous(level)
            one, other = by_bin[:, :-2], by_bin[:, 2:]  # the segments between overlap both
            powers = (np.abs(one) ** 2).sum(axis=1) * (np.abs(other) ** 2).sum(axis=1)
            phase_kept = _coherence((one * other.conj()).sum(axis=1), powers)
        elif plan.states:
            relative_synchronous = relative_vectors(np.stack([_synchronous(one) for one in of_hops]))
    else:
        beta = regression(total[0], n)
        remove = np.hstack([np.eye(n), -beta])
        hop_correlation, correlation = _correlations(plan, hops, products, total, remove)
        by_bin = through(remove, segments)
        if plan.angle_column is not None:
            synchronous = _synchronous(beta)
    if plan.angle_column is not None:
        hop_synchronous = np.where([[turns(hop)] for hop in hops], _synchronous(regression(products[:, 0], n)), 0)
        angle = segments[:, :, n + 1].copy()
    del segments, products  # megabytes that nothing below needs
    spectrum = summed(by_bin)
    if angle is not None and phase_kept is None:
        powers = np.einsum("fii->fi", spectrum).real * (np.abs(angle) ** 2).sum(axis=1, keepdims=True)
        phase_kept = _coherence((by_bin.transpose(0, 2, 1) @ angle[:, :, np.newaxis].conj())[:, :, 0], powers)
    alive = ~np.isin(plan.mounted, lost)
    motions = plan.motions(alive)
    levels = segment_levels(by_bin, spectrum, motions)
    evaluated = by_bin if levels is None else of_one_level(by_bin, levels, motions)
    spectrum = spectrum if levels is None else summed(evaluated)
    speed_rad_s, speed_range = _speeds(rotation, hops, plan)
    found = WindowStatistics(
        states=plan.mounted,
        start_ns=hops[0].start_ns,
        end_ns=hops[-1].end_ns,
        n_samples=len(hops) * plan.hop,
        n_segments=evaluated.shape[1],
        lags_s=plan.lags_s[:n_lags],
        correlation=correlation,
        hop_correlation=hop_correlation,
        spectrum=divided(spectrum, evaluated.shape[1]),
        segments=evaluated,
        frequencies_hz=plan.frequencies_hz,
        synchronous=synchronous,
        hop_synchronous=hop_synchronous,
        relative_synchronous=relative_synchronous,
        speed_source=rotation.source,
        speed_rad_s=speed_rad_s,
        speed_range=speed_range,
        hop_speed_rad_s=rotation.hop_speed_rad_s,
        hop_strength=np.array([np.nan if hop.line is None else hop.line.strength for hop in hops]),
        settled=rotation.settled,
        hop_jump_rad=angle_jumps(hops),
        removed_by_hop=rotation.by_hop,
        phase_kept=phase_kept,
        time_scale=plan.time_scale,
        duration_s=len(hops) * plan.hop / plan.rate_hz,
        waveforms=tuple(hop.waveform for hop in hops),
        sensors=plan.sensors,
        pair_powers=tuple(hop.pair_powers for hop in hops),
        lines=excluded_lines(
            by_bin,
            spectrum,
            plan.frequencies_hz,
            speed_range,
            lines,
            None if angle is None else angle.T,
            alive & np.any([hop.waveform.minimum[:n] < hop.waveform.maximum[:n] for hop in hops], axis=0),
        )
        if lagged
        else (),
    )
    return _shaft_motion(found, plan, by_bin, lost)


def _settled(hops: tuple[HopMoments, ...], rotation: Rotation) -> tuple[tuple[HopMoments, ...], Rotation]:
    """The hops in which the shaft had one speed, and their rotation as found from all hops."""
    kept, speeds = rotation.settled, rotation.hop_speed_rad_s
    found = replace(rotation, hop_speed_rad_s=speeds[kept], settled=kept[kept])
    return tuple(hop for hop, there in zip(hops, kept, strict=True) if there), found


def _shaft_motion(
    window: WindowStatistics, plan: Plan, by_bin: ComplexArray, lost: tuple[str, ...]
) -> WindowStatistics:
    """The window of the shaft's motion, from that of the samples; `by_bin` has shape (n_bins, n_segments, n)."""
    window = window if plan.equaliser is None else _equalised(window, plan.equaliser, by_bin)
    if plan.runout is not None:  # what sensors show at running speed although nothing vibrates
        known = plan.runout if window.speed_rad_s >= 0 else plan.runout.conj()
        synchronous, by_hop = (
            None if one is None else one - known for one in (window.synchronous, window.hop_synchronous)
        )
        window = replace(window, synchronous=synchronous, hop_synchronous=by_hop, mounted=window)
    window = window if plan.turn is None else _turned(window, plan.states, plan.turn)
    return replace(window.of(plan.states_without(lost)), lost=lost) if lost else window


def _equalised(window: WindowStatistics, equaliser: Equaliser, by_bin: ComplexArray) -> WindowStatistics:
    """The window with the response of the sensors divided out."""
    n_bins, _, n = by_bin.shape
    by_hop = by_bin.swapaxes(0, 1).reshape(len(window.waveforms), -1, n_bins, n)
    missing = equaliser.missing(by_hop, window.frequencies_hz, window.lags_s)
    response = equaliser.response(window.frequencies_hz)
    at_speed = equaliser.response(np.asarray(window.speed_rad_s) / (2 * np.pi))
    at_speeds = equaliser.response(window.hop_speed_rad_s / (2 * np.pi))
    relative = window.relative_synchronous
    return replace(
        window,
        correlation=window.correlation + missing.mean(axis=0),
        hop_correlation=window.hop_correlation + missing,
        spectrum=window.spectrum / (response[:, :, np.newaxis] * response[:, np.newaxis].conj()),
        segments=window.segments / response[:, np.newaxis],
        synchronous=None if window.synchronous is None else window.synchronous / at_speed,
        hop_synchronous=None if window.hop_synchronous is None else window.hop_synchronous / at_speeds,
        relative_synchronous=None if relative is None else relative_vectors(relative / at_speeds),
        lines=tuple(line.turned(np.diag(1 / equaliser.response(np.array(line.centre_hz)))) for line in window.lines),
    )


def _turned(window: WindowStatistics, states: tuple[str, ...], turn: FloatArray) -> WindowStatistics:
    """Statistics of the states, from those of sensors at an angle: every moment is multiplied from both sides."""
    found = window.with_vectors(lambda mounted: np.asarray(mounted @ turn.T, dtype=np.complex128))
    relative = found.relative_synchronous
    return replace(
        found,
        states=states,
        correlation=turn @ window.correlation @ turn.T,
        hop_correlation=turn @ window.hop_correlation @ turn.T,
        spectrum=turn @ window.spectrum @ turn.T,
        segments=window.segments @ turn.T,
        relative_synchronous=None if relative is None else relative_vectors(relative),
        lines=tuple(line.turned(turn) for line in window.lines),
        mounted=window.as_mounted,
    )


def levels_of(plan: Plan, hops: tuple[HopMoments, ...], *, errors: bool = True) -> WindowLevels:
    """Vibration levels of the window that hops make, see `window_levels`; raises ValueError if none are planned."""
    if plan.levels is None:
        raise ValueError("no levels are planned")
    rotation = rotation_of(plan, hops)
    speeds, (slowest, fastest) = rotation.hop_speed_rad_s, _speeds(rotation, hops, plan)[1]
    if rotation.source == "estimated" and not (rotation.settled.all() and fastest < (1 + _VARIED) * slowest):
        speeds = np.full(len(hops), np.nan)  # while the speed changes, orders are not at multiples of the speed found
    found = window_levels(
        plan.levels,
        [hop.levels for hop in hops if hop.levels is not None],
        speeds,
        phase_reference=rotation.source == "phase reference",
        errors=errors,
    )
    return replace(found, settled=rotation.settled)


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


def _correlations(
    plan: Plan, hops: tuple[HopMoments, ...], products: FloatArray, total: FloatArray, remove: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Correlations of every hop, and of all: about each hop's own mean if means drift, otherwise about their mean.

    A drift is no vibration, though it correlates at any lag; means that scatter from hop to hop are no drift.
    """
    n, correlation = len(remove), (remove @ total @ remove.T) / (len(hops) * plan.hop)
    means = products[:, 0, n, :n] / plan.hop
    steps, deviations = np.diff(means, axis=0), means - means.mean(axis=0)
    smooth = (steps**2).sum(axis=0) < _SMOOTH * (deviations**2).sum(axis=0)
    if not np.any(smooth & (np.ptp(means, axis=0) > _DRIFT * np.sqrt(np.abs(np.diag(correlation[0]))))):
        return remove @ through(remove, products) / plan.hop, correlation
    own = np.broadcast_to(remove, (len(hops), *remove.shape)).copy()
    own[:, :, n] = -means - products[:, 0, n, n + 1 :] @ remove[:, n + 1 :].T / plan.hop
    at_hops = np.array([hop.start_ns - hops[0].start_ns for hop in hops]) * 1e-9 * plan.rate_hz / plan.hop
    trend = np.gradient(means, at_hops, axis=0)[:, np.newaxis]
    within = trend.swapaxes(1, 2) @ trend / 12  # variance of a straight line about its mean
    own = own[:, np.newaxis]
    by_hop = own @ products @ own.swapaxes(2, 3) / plan.hop - within[:, np.newaxis]
    return by_hop, by_hop.sum(axis=0) / len(hops)
