"""Run-ups and coast-downs: vectors of one order over speed, and the average shaft centreline."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
import numpy.typing as npt

from models.errors import MachineFileError, RotorwatchError
from models.levels.orders import ORDERS
from models.signals.block import FloatArray
from models.signals.channels import Channel
from service.analysis.orbit import in_planes
from service.analysis.past import Past
from service.analysis.recorded import Sampled, begins_again
from service.analysis.revolutions import newest_revolutions
from service.analysis.spectrum import shown_as, unit_shown
from service.analysis.vectors import estimated_vectors, read_vectors

_MOST_POINTS = 400
_LEAST_OF_ALL = 0.5
"""Least length of a stretch cut short by a gap, as a fraction of the full length."""


@dataclass(frozen=True, slots=True)
class RunUp:
    """Vectors of one order of several channels, in order of time."""

    channels: tuple[Channel, ...]
    units: tuple[str, ...]
    order: int
    revolutions: int | None  # per vector; None if each vector is from one window of the monitor
    time_ns: npt.NDArray[np.int64]  # (n,)
    speed_rad_s: FloatArray  # (n,), negative if the shaft turns from z to y
    # (n, n_channels), amplitude in `units`, phase lag 0 to 360°; NaN for windows of a history without the channel's.
    amplitude: FloatArray
    lag_deg: FloatArray
    slow_roll_rpm: float | None  # the mean vector up to this speed was subtracted
    estimated: bool  # whether the speed was estimated from the vibration, so that there is no phase

    @property
    def direction(self) -> int:
        """1 if the shaft turns from y to z, -1 if from z to y."""
        return 1 if np.median(self.speed_rad_s) >= 0 else -1


def _past_run_up(data: Past, channels: tuple[Channel, ...], order: int) -> RunUp:
    """Vectors that the monitor reported for the windows in the history."""
    measure = f"x{order}"
    found = []
    for report in data.reports:
        levels = {one.channel: one for one in report.levels}
        names = (measure, f"{measure}_phase_lag_deg")
        values = [tuple(getattr(levels.get(one.name), name, None) for name in names) for one in channels]
        if report.speed_rad_s is not None and any(None not in pair for pair in values):
            found.append((report.end_ns, report.speed_rad_s, values))
    if not found:
        raise RotorwatchError(
            f"{data.place}: no report of {data.name} has amplitude and phase of {order}x of "
            f"{', '.join(one.name for one in channels)}: phases need a keyphasor, and are kept of 1x and 2x"
        )
    vectors = np.array([row for _, _, row in found], dtype=np.float64)
    told = np.asarray(np.isfinite(vectors).all(axis=2).any(axis=0))
    channels, vectors = tuple(compress(channels, told)), vectors[:, told]
    return RunUp(
        channels=channels,
        units=tuple(shown_as(channel, "amplitude")[0] for channel in channels),
        order=order,
        revolutions=None,
        time_ns=np.array([end_ns for end_ns, _, _ in found], dtype=np.int64),
        speed_rad_s=np.array([speed for _, speed, _ in found]),
        amplitude=vectors[:, :, 0] * np.array([unit_shown(channel)[1] for channel in channels]),
        lag_deg=vectors[:, :, 1],
        slow_roll_rpm=None,
        estimated=False,
    )


def read_run_up(
    data: Sampled | Past,
    channels: tuple[Channel, ...],
    order: int,
    revolutions: int,
    slow_roll_rpm: float | None = None,
    between_rpm: tuple[float, float] | None = None,
) -> RunUp:
    """Vectors of all recorded samples, or of all windows in the history.

    Parameters
    ----------
    order : int
        Multiple of running speed: 1, 2 or 3.
    revolutions : int
        Number of revolutions per vector; the windows of a history are taken as they are.
    slow_roll_rpm : float, optional
        The mean vector up to this speed is subtracted: it is run-out, not vibration (API 670, slow-roll compensation).
    between_rpm : (float, float), optional
        Range in which the speed is estimated from the vibration, if there is no shaft angle.

    Raises
    ------
    MachineFileError
        If the shaft angle is not measured and `between_rpm` is missing, or is measured and `between_rpm` given; or if a
        history is given with options that need samples or phases.
    RotorwatchError
        If the shaft does not turn, or always turns faster than `slow_roll_rpm`.
    """
    if isinstance(data, Past):
        if slow_roll_rpm is not None or between_rpm is not None:
            raise MachineFileError("--slow-roll and --speeds need samples: name recordings instead of --history")
        return _past_run_up(data, channels, order)
    if between_rpm is not None and data.has_angle:
        raise MachineFileError(f"--speeds: {data.name} measures the shaft angle, so its speed is known")
    if between_rpm is not None and slow_roll_rpm is not None:
        raise MachineFileError("--slow-roll needs phases, which --speeds does not find")
    if between_rpm is None:
        vectors = read_vectors(data, channels, revolutions)
    else:
        low, high = (rpm * np.pi / 30 for rpm in between_rpm)
        vectors = estimated_vectors(data, channels, (low, high))
    q = vectors.orders[:, list(ORDERS.values()).index(order)]
    known = np.isfinite(q).all(axis=1)
    q, speed = q[known], vectors.speed_rad_s[known]
    rpm = np.abs(speed) * 30 / np.pi
    if slow_roll_rpm is not None:
        slow = rpm <= slow_roll_rpm
        if not slow.any():
            raise RotorwatchError(f"--slow-roll is {slow_roll_rpm:g} rpm, but the slowest is {rpm.min():.4g} rpm")
        q = q - q[slow].mean(axis=0)
    shown = [shown_as(channel, "amplitude") for channel in channels]
    factors = np.array([factor / channel.to_si for channel, (_, factor) in zip(channels, shown, strict=True)])
    return RunUp(
        channels=channels,
        units=tuple(unit for unit, _ in shown),
        order=order,
        revolutions=revolutions,
        time_ns=vectors.time_ns[known],
        speed_rad_s=speed,
        amplitude=np.abs(q) * factors,
        lag_deg=np.degrees(-np.angle(q) * np.sign(speed)[:, None]) % 360,
        slow_roll_rpm=slow_roll_rpm,
        estimated=between_rpm is not None,
    )


@dataclass(frozen=True, slots=True)
class Centreline:
    """Mean shaft positions at some locations, in order of time (API 670: average shaft centreline)."""

    pairs: tuple[tuple[Channel, Channel], ...]
    each_s: float
    time_ns: npt.NDArray[np.int64]  # (n,), middle of the samples averaged
    speed_rad_s: FloatArray  # (n,), NaN without a shaft angle
    # (n, n_pairs), NaN for windows of a history without the pair's.
    y_um: FloatArray
    z_um: FloatArray


def _past_centreline(data: Past, pairs: Sequence[tuple[Channel, Channel]]) -> Centreline:
    """Mean positions that the monitor reported for the windows in the history."""
    told = {one.channel for report in data.reports for one in report.levels if one.mean is not None}
    pairs = [pair for pair in pairs if told.issuperset(one.name for one in pair)] or pairs
    channels = [channel for pair in pairs for channel in pair]
    rows = []
    for report in data.reports:
        means = {one.channel: one.mean for one in report.levels}
        values = [means.get(channel.name) for channel in channels]
        if any(None not in pair for pair in zip(values[::2], values[1::2], strict=True)):
            rows.append((report.start_ns, report.end_ns, report.speed_rad_s, values))
    if len(rows) < 2:
        raise RotorwatchError(
            f"{data.place}: {len(rows)} reports of {data.name} have the mean positions of "
            f"{', '.join(channel.name for channel in channels)}, expected at least 2 for a centreline"
        )
    start, end, speed, means_ = zip(*rows, strict=True)
    middle_ns = (np.array(start, dtype=np.int64) + np.array(end, dtype=np.int64)) // 2
    y_um, z_um = in_planes(np.array(means_, dtype=np.float64), pairs)
    each_s, speed_rad_s = (end[-1] - start[-1]) / 1e9, np.array(speed, dtype=np.float64)
    return Centreline(tuple(pairs), each_s, middle_ns, speed_rad_s, y_um, z_um)


def read_centreline(data: Sampled | Past, pairs: Sequence[tuple[Channel, Channel]], each_s: float) -> Centreline:
    """Mean positions over stretches of `each_s` seconds, longer in long recordings; of a history, over its windows.

    Raises
    ------
    RotorwatchError
        If there are fewer than two stretches.
    """
    if isinstance(data, Past):
        return _past_centreline(data, pairs)
    each_s = max(each_s, (data.to_ns - data.from_ns) / 1e9 / _MOST_POINTS)
    rows: list[tuple[int, float, FloatArray]] = []
    for stretch in data.stretches([channel for pair in pairs for channel in pair], each_s):
        if stretch.length_s < _LEAST_OF_ALL * each_s:
            continue
        # Average over whole revolutions if there are any, so that 1x vibration does not contribute to the mean.
        whole = newest_revolutions(stretch, stretch.samples.shape[0]).excerpt or stretch
        middle_ns = (whole.start_ns + whole.end_ns) // 2
        while rows and begins_again(rows[-1][0], middle_ns):
            rows.pop()  # if runs overlap in time, the one recorded last is shown
        rows.append((middle_ns, stretch.speed_rad_s, whole.samples.mean(axis=0)))
    if len(rows) < 2:
        raise RotorwatchError(
            f"{data.place}: {len(rows)} stretches of {each_s:g} s of {data.name} without a gap, expected at least 2 "
            "for a centreline; a shorter --window may do"
        )
    times, speeds, means = zip(*rows, strict=True)
    y_um, z_um = in_planes(np.stack(means), pairs)
    return Centreline(tuple(pairs), each_s, np.array(times, dtype=np.int64), np.array(speeds), y_um, z_um)
