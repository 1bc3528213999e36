"""Orbits: the shaft's path across its axis, raw and at running speed alone, against the keyphasor."""

from dataclasses import dataclass

import numpy as np

from models.errors import MachineFileError, RotorwatchError
from models.signals.block import FloatArray
from models.signals.channels import Channel
from service.analysis.plots.excerpts import Excerpt, RecordedStream
from service.analysis.snapshots.channels import orbit_pairs
from service.analysis.snapshots.ellipse import Ellipse, phase_lag_deg
from service.analysis.snapshots.revolutions import pulses

_UM = 1e6
_LONGEST_S = 3600.0


@dataclass(frozen=True, slots=True)
class Vector:
    """Vibration of one channel at running speed.

    Attributes
    ----------
    q_um : complex
        q of x = Re{q e^{jθ}}, µm.
    direction : int
        1 if the shaft angle grows, -1 if it falls.
    """

    channel: str
    q_um: complex
    direction: int

    @property
    def peak_to_peak_um(self) -> float:
        """Peak to peak, µm."""
        return 2 * abs(self.q_um)

    @property
    def phase_lag_deg(self) -> float:
        """How far the shaft turns from the keyphasor's pulse to the positive peak, 0 to 360°."""
        return phase_lag_deg(self.q_um, self.direction)


@dataclass(frozen=True, slots=True)
class Orbit:
    """The orbit at one place.

    Attributes
    ----------
    location : str
        ``bearing`` or ``disc``.
    y, z : Vector
        The part at running speed.
    y_um, z_um : ndarray, shape (n,)
        As measured, about the mean.
    marks_um : ndarray, shape (n_pulses, 2)
        Where the shaft was at each pulse of the keyphasor.
    """

    location: str
    y: Vector
    z: Vector
    y_um: FloatArray
    z_um: FloatArray
    marks_um: FloatArray

    def at_running_speed(self, angle_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Y and z of the 1× part at shaft angles, µm."""
        turn = np.exp(1j * angle_rad)
        return np.real(self.y.q_um * turn), np.real(self.z.q_um * turn)

    @property
    def _ellipse(self) -> Ellipse:
        return Ellipse(self.y.q_um, self.z.q_um)

    @property
    def major_um(self) -> float:
        """Long axis of the 1× ellipse from end to end, µm."""
        return 2 * self._ellipse.semi_major

    @property
    def minor_um(self) -> float:
        """Short axis from end to end, µm."""
        return 2 * self._ellipse.semi_minor

    @property
    def precession(self) -> str:
        """``forward``: round the orbit as the shaft turns; ``backward``: against it."""
        return self._ellipse.precession


@dataclass(frozen=True, slots=True)
class Orbits:
    """Orbits of the same revolutions at all places where both directions are measured.

    Attributes
    ----------
    start_ns, end_ns : int
        First and last pulse of the keyphasor.
    speed_rad_s : float
        Mean speed; negative where the shaft turns from z to y.
    """

    start_ns: int
    end_ns: int
    revolutions: int
    speed_rad_s: float
    orbits: tuple[Orbit, ...]

    @property
    def direction(self) -> int:
        """1 if the shaft turns from y to z, -1 if from z to y."""
        return 1 if self.speed_rad_s >= 0 else -1


def read_orbits(stream: RecordedStream, revolutions: int) -> Orbits:
    """Orbits of the latest revolutions of a recorded stream.

    Raises
    ------
    MachineFileError
        If the shaft angle is not measured, or at no place both y and z.
    RotorwatchError
        If there are not so many revolutions without a gap before the end.
    """
    if not stream.has_angle:
        raise MachineFileError(
            f"{stream.place}: {stream.name} has no channel with the shaft angle (keyphasor), and an orbit is seen "
            "against it"
        )
    pairs = _pairs(stream)
    channels = [channel for pair in pairs for channel in pair]
    length_s = 2.0
    while True:
        found = stream.latest(channels, length_s)
        enough = bool(found) and pulses(found[-1].angle_rad)[1].size > revolutions
        interrupted = len(found) > 1
        if enough or interrupted or length_s > min(_LONGEST_S, (stream.to_ns - stream.from_ns) / 1e9):
            break
        length_s *= 2
    if not found:
        raise RotorwatchError(f"{stream.place}: no sample blocks of {stream.name} in this stretch of time")
    return orbits_of(found[-1], pairs, revolutions)


def orbits_of(stretch: Excerpt, pairs: list[tuple[Channel, Channel]], revolutions: int) -> Orbits:
    """Orbits of the latest revolutions of a stretch.

    Parameters
    ----------
    stretch : Excerpt
        Its columns are the channels of `pairs`, one pair after the other.
    pairs : list of (Channel, Channel)
        y and z of each place.

    Raises
    ------
    RotorwatchError
        If the shaft does not turn so often in it.
    """
    direction, marked = pulses(stretch.angle_rad)
    if marked.size <= revolutions:
        raise RotorwatchError(
            f"--revolutions is {revolutions}, but only {max(0, marked.size - 1)} whole revolutions without a gap were "
            f"recorded before this time ({stretch.length_s:.3g} s of samples)"
        )
    first, last = marked[-1 - revolutions], marked[-1]
    rows = slice(int(np.ceil(first)), int(np.floor(last)) + 1)
    assert stretch.angle_rad is not None  # noqa: S101  # there are pulses
    angle = stretch.angle_rad[rows]
    regressors = np.column_stack([np.ones(angle.size), np.cos(angle), np.sin(angle)])
    at = marked[-1 - revolutions :]
    orbits = []
    for number, pair in enumerate(pairs):
        values = stretch.samples[:, 2 * number : 2 * number + 2] * np.array([c.to_si * _UM for c in pair])
        fitted = np.linalg.lstsq(regressors, values[rows], rcond=None)[0]
        q = fitted[1] - 1j * fitted[2]
        about = values - fitted[0]
        marks = np.column_stack([np.interp(at, np.arange(len(about)), about[:, column]) for column in (0, 1)])
        y, z = (Vector(channel.name, complex(q[column]), direction) for column, channel in enumerate(pair))
        orbits.append(Orbit(pair[0].location, y, z, about[rows, 0], about[rows, 1], marks))
    seconds = (last - first) / stretch.rate_hz
    return Orbits(
        start_ns=stretch.start_ns + round(first / stretch.rate_hz * 1e9),
        end_ns=stretch.start_ns + round(last / stretch.rate_hz * 1e9),
        revolutions=revolutions,
        speed_rad_s=float(direction * 2 * np.pi * revolutions / seconds),
        orbits=tuple(orbits),
    )


def _pairs(stream: RecordedStream) -> list[tuple[Channel, Channel]]:
    """Displacement in y and z at each place where both are measured."""
    pairs = orbit_pairs(stream.displacements)
    if not pairs:
        there = ", ".join(channel.name for channel in stream.displacements) or "none"
        raise MachineFileError(
            f"{stream.place}: an orbit needs the displacements in y and z at one place; measured displacements of "
            f"{stream.name}: {there}"
        )
    return pairs
