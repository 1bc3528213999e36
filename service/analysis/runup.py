"""A run-up or coast-down: vectors at one order over the speed."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.errors import MachineFileError, RotorwatchError
from models.levels.orders import ORDERS
from models.signals.block import FloatArray
from models.signals.channels import Channel
from service.analysis.past import Past
from service.analysis.recorded import Sampled
from service.analysis.spectrum import shown_as, unit_shown
from service.analysis.vectors import estimated_vectors, read_vectors


@dataclass(frozen=True, slots=True)
class RunUp:
    """Vectors of some channels, in order of time."""

    channels: tuple[Channel, ...]
    units: tuple[str, ...]
    order: int
    revolutions: int | None  # that each vector is of; None where it is of a window of the monitor
    time_ns: npt.NDArray[np.int64]  # (n,)
    speed_rad_s: FloatArray  # (n,), negative where the shaft turns from z to y
    # (n, n_channels), in `units`, and 0 to 360°.
    amplitude: FloatArray
    lag_deg: FloatArray
    slow_roll_rpm: float | None  # the mean vector up to this speed was taken away
    estimated: bool  # whether the speed was found in the vibration, so that there is no phase

    @property
    def direction(self) -> int:
        """1 if the shaft turns from y to z, -1 if from z to y."""
        return 1 if np.median(self.speed_rad_s) >= 0 else -1


def _past_run_up(data: Past, channels: tuple[Channel, ...], order: int) -> RunUp:
    """Vectors of the windows of the history, as the monitor reported them.

    Raises
    ------
    RotorwatchError
        If no window has the phases of all of these channels at this order.
    """
    measure = f"x{order}"
    found = []
    for report in data.reports:
        levels = {one.channel: one for one in report.levels}
        names = (measure, f"{measure}_phase_lag_deg")
        values = [tuple(getattr(levels.get(one.name), name, None) for name in names) for one in channels]
        if report.speed_rad_s is not None and all(None not in pair for pair in values):
            found.append((report.end_ns, report.speed_rad_s, values))
    if not found:
        raise RotorwatchError(
            f"{data.place}: no report of {data.name} has amplitude and phase of {order}x of "
            f"{', '.join(one.name for one in channels)}: phases need a keyphasor, and are kept of 1x and 2x"
        )
    vectors = np.array([row for _, _, row in found], dtype=np.float64)
    shown = [unit_shown(channel) for channel in channels]
    return RunUp(
        channels=channels,
        units=tuple(shown_as(channel, "amplitude")[0] for channel in channels),
        order=order,
        revolutions=None,
        time_ns=np.array([end_ns for end_ns, _, _ in found], dtype=np.int64),
        speed_rad_s=np.array([speed for _, speed, _ in found]),
        amplitude=vectors[:, :, 0] * np.array([factor for _, factor in shown]),
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
    """Vectors of everything that was recorded, or of the windows of the history, whatever their length.

    Parameters
    ----------
    order : int
        Multiple of running speed: 1, 2 or 3.
    revolutions : int
        How many each vector is taken of.
    slow_roll_rpm : float, optional
        The mean vector up to this speed is taken away: it is run-out, not vibration (API 670, slow-roll compensation).
    between_rpm : (float, float), optional
        Where the speed is looked for in the vibration, if there is no shaft angle.

    Raises
    ------
    MachineFileError
        If the shaft angle is not measured, and no speeds are named; or it is, and they are; or a history has no samples
        for what is asked.
    RotorwatchError
        If the shaft does not turn, or never as slowly as that.
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
