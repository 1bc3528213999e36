"""Moments of one hop of samples, of which a window is the sum, and the part of them that turns with the shaft.

A window's statistics are sums over its hops, so a sliding window is a ring of hop moments that are added up anew each
time. Nothing is ever subtracted: a running sum would keep the rounding of everything that went through it.

The rotation-synchronous part and the mean are not removed sample by sample. The regressors n = (1, cos θ, sin θ) are
treated as further channels, and the window removes their part by algebra (`statistics.py`). That is exact for any
window and needs no second pass over samples.

The rotation is taken out of every hop and segment. At a steady speed one set of coefficients serves the whole window.
Where the speed changes, the 1x amplitude changes with it, and the residue of a single set would no longer lie next to
the line. Then every hop has its own coefficients, and a segment of the spectra has those interpolated at its middle.
Without a phase reference the angle begins anew in every hop, and each segment has the coefficients of its own hop.
"""

import itertools
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from models.checkpoint import checked, prefixed, unprefixed
from models.diagnosis.window.equaliser import Equaliser, equaliser_of
from models.diagnosis.window.lagged import lagged_products
from models.diagnosis.window.motion import MotionPair, motion_pairs, pair_powers
from models.diagnosis.window.rotation import RotationLine, followed_speeds, rotation_line, settled_hops
from models.levels.contact import contact
from models.levels.measures import CONTACT, HopLevels, LevelPlan, hop_levels, level_plan
from models.machine import MachineFile
from models.physics.rotor import STATE_INDEX
from models.signals.block import BoolArray, ComplexArray, FloatArray, IndexArray, SampleArray
from models.signals.channels import ACCELERATIONS, parts_seen, state_name
from models.signals.keyphasor import jump_within_a_turn
from models.signals.waveform import Waveform, waveform_of


@dataclass(frozen=True, slots=True)
class Plan:
    """Sizes and columns derived once from a machine file."""

    rate_hz: float  # sampling rate
    # Measured state variables (``y1`` … ``phi_dot``), then accelerations (``y1_ddot`` …), in the order of the
    # statistics' columns.
    states: tuple[str, ...]
    # Column of the stream, and factor to SI, for each of `states` and then for channels at other places, which have
    # levels only.
    columns: IndexArray
    scales: FloatArray
    # Column of the shaft angle; without it the regressors are the mean and, where `speed_rad_s` is given, the most
    # likely line near it.
    angle_column: int | None
    # Samples per hop, samples of history a hop needs before it, samples per spectral segment.
    hop: int
    preamble: int
    segment: int
    lags: IndexArray  # lags of the correlation functions, samples
    bins: IndexArray  # frequency bins of a segment's Fourier transform that are kept
    # Samples from the start of a hop to that of the next: more than a hop has if there is silence between snapshots.
    stride: int
    hops: int  # hops in a full window
    max_span_ns: int  # oldest data a window may hold
    time_scale: float = 1.0  # of the machine, see `models.stream_settings.time_scale`
    # Speed to look for where there is no shaft angle; None: the rotation is not looked for.
    speed_rad_s: float | None = None
    speed_tolerance: float = 0.0  # how far the speed may be off, relative
    others: tuple[str, ...] = ()  # channels at other places, of which only levels are taken
    levels: LevelPlan | None = None  # of all `columns`; None where no levels are wanted
    thorough: bool = True  # whether levels include those that are only compared with a healthy machine
    # Where sensors are at an angle: what each column of `states` is as mounted (``bearing@45``), and the matrix that
    # turns those, shape (n, n), states = turn @ mounted.
    angled: tuple[str, ...] = ()
    turn: FloatArray | None = None
    # Run-out of each sensor of `states` at running speed: q of x = Re{q e^{jθ}} for an increasing angle; None if no
    # run-out is known.
    runout: ComplexArray | None = None
    equaliser: Equaliser | None = None  # of the sensors of `states`, if any has a high-pass or a delay

    @property
    def need(self) -> int:
        """Samples that a hop is made of, its history included."""
        return self.preamble + self.hop

    @property
    def fresh(self) -> int:
        """How many of them, the last ones, belong to no other hop; all in a snapshot."""
        return min(self.need, self.stride)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Columns of a waveform: the mounted sensors, the shaft angle if there is one, and channels elsewhere."""
        return (*self.mounted, *(() if self.angle_column is None else ("theta",)), *self.others)

    @property
    def width(self) -> int:
        """Columns of SI samples."""
        return self.columns.size + (self.angle_column is not None)

    @property
    def lags_s(self) -> FloatArray:
        """Lags in seconds."""
        return np.asarray(self.lags / self.rate_hz, dtype=np.float64)

    @property
    def frequencies_hz(self) -> FloatArray:
        """Frequencies of the kept bins."""
        return np.asarray(self.bins * (self.rate_hz / self.segment), dtype=np.float64)

    @property
    def mounted(self) -> tuple[str, ...]:
        """What each column of `states` is as mounted."""
        return self.states if self.turn is None else self.angled

    def states_without(self, lost: Collection[str]) -> tuple[str, ...]:
        """States measured without the `lost` mounted sensors; at an angle, both sensors of a place are needed."""
        turn = np.eye(len(self.states)) if self.turn is None else self.turn
        part = np.abs(turn[:, np.isin(self.mounted, list(lost))]).sum(axis=1)
        return tuple(state for state, gone in zip(self.states, part.tolist(), strict=True) if not gone)

    def gain(self, sensor: str, factor: float) -> FloatArray:
        """Matrix, shape (n, n), by which the states change if the gain of a mounted sensor changes by a factor."""
        turn = np.eye(len(self.states)) if self.turn is None else self.turn
        factors = np.where(np.array(self.mounted) == sensor, factor, 1.0)
        return np.asarray((turn * factors) @ np.linalg.inv(turn), dtype=np.float64)

    def motions(self, alive: BoolArray) -> list[int]:
        """Columns of sensors that are alive, one for each motion."""
        twice = {pair.second for pair in self.pairs if alive[pair.first]}
        return [column for column in np.flatnonzero(alive).tolist() if column not in twice]

    @property
    def pairs(self) -> tuple[MotionPair, ...]:
        """Columns that measure the same motion."""
        return motion_pairs(self.mounted)

    def to_si(self, samples: SampleArray) -> FloatArray:
        """Sensors as mounted, and other channels, in SI units and, last, the shaft angle if there is one.

        The shape is (n_samples, width), with each channel's samples contiguous in memory.
        """
        si = np.empty((self.width, samples.shape[0]))
        np.multiply(samples.T[self.columns], self.scales[:, np.newaxis], out=si[: self.columns.size])
        if self.angle_column is not None:
            si[-1] = samples[:, self.angle_column]
        return si.T


def states_of(machine: MachineFile) -> tuple[str, ...]:
    """Measured motions of bearing and disc, in the order of a plan; if there are none, there are only levels."""
    measured = machine.descriptor.states
    return tuple(name for name in (*STATE_INDEX, *ACCELERATIONS) if name in measured and machine.holds_band)


def plan_for(machine: MachineFile, *, lagged: bool = True, levels: bool = False, thorough: bool = True) -> Plan:
    """Derive the plan of a machine.

    With `lagged`, correlations are taken at all lags, as the networks need them, otherwise at lag zero alone; with
    `levels`, levels are taken, and if `thorough`, `models.levels.contact` and the lines of `models.levels.bands` too, a
    fifth of the time that a hop's moments take.
    """
    window, operation, rate_hz = machine.window, machine.operation, machine.rate_hz
    order = {name: column for column, name in enumerate(machine.descriptor.states)}
    states = states_of(machine)
    others = tuple(name for name in order if name not in states and name != "theta")
    columns = np.array([order[name] for name in (*states, *others)], dtype=np.intp)
    channels = [machine.sensors[column] for column in columns]
    rows = [[parts_seen(one).get(name, 0.0) for name in states] for one in channels[: len(states)]]
    seen = np.array(rows).reshape(len(states), len(states))
    runout = np.array([one.runout for one in channels], dtype=np.complex128)
    band_hz = machine.levels.band(None if operation is None else operation.speed_rpm)
    segment = round(window.segment_s * rate_hz)
    lag_step = round(window.lag_step_s * rate_hz)
    lags = np.arange(0, round(window.lag_to_s * rate_hz) + 1, lag_step)
    first, last = (max(1, round(edge * window.segment_s)) for edge in window.band_hz)  # a mean is no vibration
    preamble = max(int(lags[-1]), segment // 2)
    # A snapshot has no history but its own beginning.
    hop = math.floor(machine.hop_data_s * rate_hz + 1e-6) - (0 if machine.schedule is None else preamble)
    return Plan(
        rate_hz=rate_hz,
        states=states,
        columns=columns,
        scales=np.array([channel.to_si for channel in channels]),
        angle_column=order.get("theta"),
        hop=hop,
        preamble=preamble,
        segment=segment,
        lags=lags if lagged else lags[:1],
        bins=np.arange(first, last + 1),
        stride=round(window.hop_s * rate_hz),
        hops=window.hops,
        max_span_ns=round(window.max_span_s * 1e9),
        time_scale=machine.time_scale,
        speed_rad_s=None if operation is None else operation.speed_rad_s,
        speed_tolerance=0.0 if operation is None else operation.speed_tolerance,
        others=others,
        levels=level_plan(channels, rate_hz, band_hz, runout, lines=thorough) if levels else None,
        thorough=thorough,
        angled=tuple(state_name(one) for one in channels[: len(states)]),
        turn=None if np.array_equal(seen, np.eye(len(states))) else np.linalg.inv(seen),
        runout=runout[: len(states)] if np.any(runout[: len(states)]) else None,
        equaliser=equaliser_of(channels[: len(states)]),
    )


@dataclass(frozen=True, slots=True)
class HopMoments:
    """Sums over one hop of the signals x of the sensors as mounted, followed by the regressors n."""

    # Time of the first sample and of the one after the last.
    start_ns: int
    end_ns: int
    # (n_lags, n, n): ``products[l, i, j] = Σ_t a_i(t - lag_l) a_j(t)`` over the t of the hop, a = (x, n)
    products: FloatArray
    # (n_segments, n_bins, n): Fourier coefficients of Hann-windowed segments, scaled so that their squared magnitude
    # estimates the two-sided power spectral density per Hz. Kept in single precision, which is that of the samples.
    segments: npt.NDArray[np.complex64]
    turned_rad: float  # shaft angle covered in the hop (nan without a phase reference)
    jump_rad: float  # jump of the angle in it or just before (nan without a phase reference)
    # The most likely rotation where there is no phase reference. The regressors follow it, from an unknown angle.
    line: RotationLine | None
    waveform: Waveform  # of the samples, with the columns of `Plan.sensors`
    # (n_pairs, n_bands, 3): powers of the motions that are measured twice, their mean taken out
    # (`motion.pair_powers`)
    pair_powers: ComplexArray
    levels: HopLevels | None = None

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything as named arrays."""
        line = self.line
        return {
            "times_ns": np.array([self.start_ns, self.end_ns], dtype=np.int64),
            "products": self.products,
            "segments": self.segments,
            "turned_rad": np.array([self.turned_rad, self.jump_rad], dtype=np.float64),
            "line": np.array(
                [] if line is None else [line.speed_rad_s, line.sweep_rad_s2, line.strength, *line.swing], np.float64
            ),
            "pair_powers": self.pair_powers,
            **prefixed("waveform", self.waveform.checkpoint()),
            **({} if self.levels is None else prefixed("levels", self.levels.checkpoint())),
        }

    @classmethod
    def restored(cls, arrays: Mapping[str, np.ndarray]) -> "HopMoments":
        """Moments from what `checkpoint` gave."""
        start_ns, end_ns = checked(arrays, "times_ns", np.int64, (2,)).tolist()
        line = checked(arrays, "line", np.float64, (None,)).tolist()
        turned_rad, jump_rad = checked(arrays, "turned_rad", np.float64, (2,)).tolist()
        return cls(
            start_ns=start_ns,
            end_ns=end_ns,
            products=checked(arrays, "products", np.float64, (None, None, None)),
            segments=checked(arrays, "segments", np.complex64, (None, None, None)),
            turned_rad=turned_rad,
            jump_rad=jump_rad,
            line=RotationLine(line[0], line[1], line[2], tuple(line[3:])) if line else None,
            waveform=Waveform.restored(unprefixed("waveform", arrays)),
            pair_powers=checked(arrays, "pair_powers", np.complex128, (None, None, 3)),
            levels=HopLevels.restored(levels) if (levels := unprefixed("levels", arrays)) else None,
        )


def hop_moments(plan: Plan, samples: FloatArray, level: FloatArray, start_ns: int) -> HopMoments:
    """Compute the moments of one hop, whose own first sample is from `start_ns`.

    The samples are as `Plan.to_si` gives them, shape (preamble + hop, width), without a gap; the first `preamble` rows
    are history. `level`, shape (n_states,), is subtracted before anything is summed: a proximity probe's gap voltage
    may be a million times its fluctuation; squared, it would swallow every digit.
    """
    n_states = len(plan.states)
    rows = np.ascontiguousarray(samples.T)  # each channel's samples contiguous: all that follows runs along them
    a = np.empty((n_states + (1 if plan.angle_column is None and plan.speed_rad_s is None else 3), rows.shape[1]))
    np.subtract(rows[:n_states], level[:, np.newaxis], out=a[:n_states])
    a[n_states] = 1
    turned_rad, jump_rad, line = np.nan, np.nan, None
    theta = None
    if plan.angle_column is not None:
        theta = rows[-1]
        steps = np.diff(theta)
        steps -= 2 * np.pi * np.floor((steps + np.pi) / (2 * np.pi))  # half the time of a remainder
        turned_rad = float(np.sum(steps[plan.preamble - 1 :]))
        jump_rad = jump_within_a_turn(steps)
    elif plan.speed_rad_s is not None:
        every = np.concatenate([a[:n_states], rows[n_states : plan.columns.size]])
        line = rotation_line(every, plan.rate_hz, plan.speed_rad_s, plan.speed_tolerance)
        t_s = (np.arange(rows.shape[1]) - rows.shape[1] / 2) / plan.rate_hz
        theta = np.zeros_like(t_s) if line is None else line.angle(t_s)
    if theta is not None:
        np.cos(theta, out=a[-2])
        np.sin(theta, out=a[-1])
    spectra = _segment_spectra(a, plan)
    segments = np.ascontiguousarray(spectra[:, :, plan.bins[0] : plan.bins[-1] + 1].transpose(1, 2, 0))
    own = rows[:, -plan.fresh :].T
    waveform, deviations = waveform_of(own)
    levels = None
    if plan.levels is not None:
        turned = None if theta is None or (line is None and plan.angle_column is None) else theta[-plan.fresh :]
        spectrum = None
        if plan.segment == plan.fresh and plan.segment % 2 == 0 and not plan.others:
            spectrum = spectra[:n_states, -1]  # the last segment is the hop itself
            spectrum[:, :2] -= (waveform.mean[:n_states] - level)[:, None] * spectra[n_states, -1, :2]
        levels = hop_levels(plan.levels, waveform, deviations, turned, spectrum)
        if plan.thorough and turned is not None and plan.states:
            speed_rad_s = turned_rad * plan.rate_hz / plan.hop if line is None else line.speed_rad_s
            turning, turns = a[-2:, -plan.fresh :], speed_rad_s * plan.fresh / plan.rate_hz / (2 * np.pi)
            for *pair, skew in plan.levels.contacts:
                how = skew, bool(plan.levels.velocities[pair[0]])
                levels.sums[CONTACT, pair] = contact(deviations[pair], turning, turns, plan.rate_hz, *how)
    if plan.angle_column is not None and plan.others:
        last = own.shape[1] - 1
        waveform = waveform.of([*range(n_states), last, *range(n_states, last)])
    # The mean leaks from zero frequency into the lowest bins; the rotation obeys v = jωx and stays.
    moving = segments[:, :, :n_states] - (waveform.mean[:n_states] - level) * segments[:, :, n_states, None]
    if plan.equaliser is not None:
        moving /= plan.equaliser.response(plan.frequencies_hz)
    return HopMoments(
        start_ns=start_ns,
        end_ns=start_ns + round(own.shape[0] * 1e9 / plan.rate_hz),
        products=lagged_products(a, plan.lags, plan.preamble),
        segments=segments.astype(np.complex64),
        turned_rad=turned_rad,
        jump_rad=jump_rad,
        line=line,
        waveform=waveform,
        pair_powers=pair_powers(moving, plan.frequencies_hz, plan.pairs),
        levels=levels,
    )


def _segment_spectra(a: FloatArray, plan: Plan) -> ComplexArray:
    """Fourier coefficients of the half-overlapping segments that end within the hop; (n, n_segments, n_frequencies)."""
    half = plan.segment // 2
    taper = _hann(plan.segment, plan.rate_hz)
    first = plan.preamble + half - plan.segment
    pieces = np.lib.stride_tricks.sliding_window_view(a[:, first:], plan.segment, axis=1)[:, ::half]
    return np.fft.rfft(pieces[:, : plan.hop // half] * taper)


@lru_cache(maxsize=8)
def _hann(size: int, rate_hz: float) -> FloatArray:
    """Taper of segments, so that squared magnitudes of their transforms are densities per Hz."""
    taper = np.hanning(size + 1)[:-1]
    taper /= np.sqrt(rate_hz * np.sum(taper**2))
    taper.flags.writeable = False
    return taper


SpeedSource = Literal["phase reference", "estimated", "unknown"]
_DEPENDENT = 1e-15  # eigenvalue over the largest one, below which regressors are linearly dependent
STEADY = 0.01  # range of the hops' speeds, relative, up to which one set of coefficients serves the window


@dataclass(frozen=True, slots=True)
class Rotation:
    """How fast the machine turned."""

    # Where the speed is from: ``phase reference``, ``estimated`` from the vibration, or ``unknown``.
    source: SpeedSource
    hop_speed_rad_s: FloatArray  # (n_hops,), nan where unknown
    by_hop: bool  # whether every hop has its own coefficients
    settled: BoolArray  # (n_hops,), whether it had one speed in each, see `settled_hops`


def rotation_of(plan: Plan, hops: tuple[HopMoments, ...]) -> Rotation:
    """Tell how fast the machine turned in each hop, and whether that was steady."""
    hop_s, settled = plan.hop / plan.rate_hz, np.full(len(hops), True)
    if plan.angle_column is not None:
        speeds = [hop.turned_rad / hop_s for hop in hops]
        by_hop = max(speeds) - min(speeds) > STEADY * abs(sum(speeds) / len(speeds))
        return Rotation("phase reference", np.array(speeds), by_hop, settled)
    lines = tuple(hop.line for hop in hops)
    followed = None if plan.speed_rad_s is None else followed_speeds(lines, hop_s)
    if followed is None:
        return Rotation("unknown", np.full(len(hops), np.nan), by_hop=False, settled=settled)
    # The line's speed is that in the middle of the hop with its history; the middle of the hop itself is later.
    sweep = np.array([0.0 if hop.line is None else hop.line.sweep_rad_s2 for hop in hops])
    speeds_rad_s = followed + sweep * plan.preamble / 2 / plan.rate_hz
    return Rotation("estimated", speeds_rad_s, by_hop=True, settled=settled_hops(lines, followed, hop_s))


def regression(zero_lag: FloatArray, n: int) -> FloatArray:
    """β of x on the regressors, shape (…, n, n_regressors); of least norm where a stuck angle makes them dependent."""
    values, vectors = np.linalg.eigh(zero_lag[..., n:, n:])
    kept = np.abs(values) > _DEPENDENT * np.abs(values).max(axis=-1, keepdims=True)
    between = (vectors * (kept / np.where(kept, values, 1.0))[..., None, :]) @ vectors.swapaxes(-1, -2)
    return np.asarray((between @ zero_lag[..., n:, :n]).swapaxes(-1, -2), dtype=np.float64)


def hop_coefficients(
    plan: Plan, hops: tuple[HopMoments, ...], rotation: Rotation, mean: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Coefficients of every hop, shape (n_hops, n, 3), and segment, (n_segments, n, 3), on (1, cos θ, sin θ).

    The mean, shape (n,), is one for the whole window; where the rotation's speed is nan, nothing else is taken out.
    """
    n = len(plan.states)
    beta = np.zeros((len(hops), n, 3))
    beta[:, :, 0] = mean
    for number, hop in enumerate(hops):
        if np.isfinite(rotation.hop_speed_rad_s[number]) and turns(hop):
            zero_lag = hop.products[0]
            of_x = zero_lag[n + 1 :, :n] - np.outer(zero_lag[n + 1 :, n], mean)
            beta[number, :, 1:] = np.linalg.lstsq(zero_lag[n + 1 :, n + 1 :], of_x, rcond=None)[0].T
    per_hop = hops[0].segments.shape[0]
    segments = np.repeat(beta, per_hop, axis=0)
    if rotation.source == "phase reference":
        for number in range(len(hops)):
            for k in range(per_hop):  # its middle lies k halves of a segment after the hop's beginning
                part = k * (plan.segment // 2) / plan.hop - 0.5
                segments[number * per_hop + k] = _interpolated(hops, beta, number, part)
    return beta, segments


def _interpolated(hops: tuple[HopMoments, ...], beta: FloatArray, number: int, part: float) -> FloatArray:
    """Coefficients at a part of a hop from its middle, on the line through an adjoining hop; its own without one."""
    for neighbour in (number + 1, number - 1) if part > 0 else (number - 1, number + 1):
        if 0 <= neighbour < len(hops) and _adjoin(hops[min(number, neighbour)], hops[max(number, neighbour)]):
            return np.asarray(beta[number] + part * (neighbour - number) * (beta[neighbour] - beta[number]))
    return np.asarray(beta[number])


def turns(hop: HopMoments) -> bool:
    """Whether the shaft made a quarter turn: rotation cannot be told from slow motion otherwise. True if unknown."""
    return not abs(hop.turned_rad) < np.pi / 2


def angle_jumps(hops: tuple[HopMoments, ...]) -> FloatArray:
    """Jump of the shaft angle in each hop; nan if unknown, because the hop before does not adjoin."""
    known = [one.jump_rad if _adjoin(before, one) else np.nan for before, one in itertools.pairwise(hops)]
    return np.array([np.nan, *known])


def _adjoin(earlier: HopMoments, later: HopMoments) -> bool:
    return abs(later.start_ns - earlier.end_ns) < (earlier.end_ns - earlier.start_ns) // 4


_Number = TypeVar("_Number", np.float64, np.complex128)


def through(matrix: FloatArray, rows: npt.NDArray[_Number]) -> npt.NDArray[_Number]:
    """Multiply rows by a matrix, ``rows @ matrix.T``, in one large product: many small ones take longer."""
    seen = rows.reshape(-1, rows.shape[-1]) @ matrix.T
    return np.asarray(seen.reshape(*rows.shape[:-1], matrix.shape[0]), dtype=rows.dtype)


def divided(values: ComplexArray, by: int | FloatArray) -> ComplexArray:
    """Divide a contiguous array by real numbers in place, which takes a fifth of the time of a complex division."""
    parts = values.view(np.float64)
    parts /= by
    return values
