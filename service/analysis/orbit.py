"""Orbits: the path of the shaft's centre in the plane across its axis, unfiltered and at 1x, with keyphasor marks."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from models.errors import MachineFileError, RotorwatchError
from models.levels.measures import level_plan
from models.signals.block import FloatArray
from models.signals.channels import Channel, Quantity, turned_pairs
from service.analysis.recorded import Described, Recorded
from service.analysis.revolutions import Excerpt, newest_revolutions, pulses
from service.analysis.vectors import vectors_of

_Value = TypeVar("_Value", np.float64, np.complex128)
MODELLED = ("bearing", "disc")
"""Locations that the rotor model has."""
_UM = 1e6
_LONGEST_S = 3600.0
_AT_1X = 1
"""Index of 1x among the orders of `Vectors`."""
_REVOLUTIONS_AT_ONCE = 2
"""Revolutions per vector: in two, the orders (from 0.5x on) do not leak into each other."""


@dataclass(frozen=True, slots=True)
class Ellipse:
    """Orbit y = Re{y e^{jθ}}, z = Re{z e^{jθ}} over the shaft angle θ.

    In the plane y + jz it is the sum of a forward and a backward circle: y(θ) + j z(θ) = F e^{jθ} + B e^{-jθ}.

    Examples
    --------
    >>> circle = Ellipse(2.0, -2.0j)
    >>> circle.semi_major, circle.semi_minor, circle.precession
    (2.0, 2.0, 'forward')
    """

    # 1x vectors, both in one unit, which is also that of the axes below.
    y: complex
    z: complex

    @property
    def _forward(self) -> complex:
        return (self.y + 1j * self.z) / 2

    @property
    def _backward(self) -> complex:
        return (self.y.conjugate() + 1j * self.z.conjugate()) / 2

    @property
    def semi_major(self) -> float:
        """Half of the long axis."""
        return abs(self._forward) + abs(self._backward)

    @property
    def semi_minor(self) -> float:
        """Half of the short axis."""
        return abs(abs(self._forward) - abs(self._backward))

    @property
    def precession(self) -> Literal["forward", "backward"]:
        """``forward`` if the orbit is traversed from y to z as θ grows, else ``backward``."""
        return "forward" if abs(self._forward) >= abs(self._backward) else "backward"

    @property
    def tilt_deg(self) -> float:
        """Angle from y, towards z, to the long axis, in (-90°, 90°]."""
        turned = np.degrees(np.angle(self._forward) + np.angle(self._backward)) / 2
        return float(90 - (90 - turned) % 180)


def phase_lag_deg(vector: complex, direction: int) -> float:
    """Phase lag: rotation from shaft angle 0 to the positive peak of Re{vector e^{jθ}}, 0 to 360°.

    Parameters
    ----------
    direction : int
        1 if the shaft angle grows, -1 if it falls.
    """
    return float(np.degrees(-np.angle(vector) * direction) % 360)


@dataclass(frozen=True, slots=True)
class Orbit:
    """The orbit at one location."""

    location: str  # ``bearing`` or ``disc``
    names: tuple[str, str]  # of y and z: the channels' own, or names of the axes to which they are turned
    ellipse: Ellipse  # the part at running speed, µm
    # (n,), unfiltered, mean removed.
    y_um: FloatArray
    z_um: FloatArray
    marks_um: FloatArray  # (n_pulses, 2), y and z at each pulse of the keyphasor


@dataclass(frozen=True, slots=True)
class Orbits:
    """Orbits of the same revolutions at all locations where both directions are measured."""

    # Times of the first and the last keyphasor pulse.
    start_ns: int
    end_ns: int
    revolutions: int
    speed_rad_s: float  # mean speed; negative where the shaft turns from z to y
    orbits: tuple[Orbit, ...]

    @property
    def direction(self) -> int:
        """1 if the shaft turns from y to z, -1 if from z to y."""
        return 1 if self.speed_rad_s >= 0 else -1


def orbit_pairs(channels: Iterable[Channel]) -> list[tuple[Channel, Channel]]:
    """Pairs of displacement sensors at one location, in y and z or inclined to them; locations of the model first."""
    known = [one for one in channels if one.quantity is Quantity.DISPLACEMENT]
    turned = {known[first].location: (known[first], known[second]) for first, second in turned_pairs(known)}
    pairs = [(known[first], known[second]) for first, second in level_plan(known, 1.0, (0.0, 1.0)).pairs]
    pairs = [turned.get(pair[0].location, pair) for pair in pairs]
    return sorted(pairs, key=lambda pair: MODELLED.index(pair[0].location) if pair[0].location in MODELLED else 2)


@dataclass(frozen=True, slots=True)
class Planes:
    """Transformation of two sensors at one location to y and z."""

    names: tuple[str, str]  # of y and z: the channels' own, or names of the axes to which they are turned
    turn: FloatArray | None  # (2, 2), matrix from the sensors' values to y and z; None if the sensors are in y and z

    def turned(self, values: npt.NDArray[_Value]) -> npt.NDArray[_Value]:
        """Transform values of both sensors, shape (2, ...), to y and z."""
        return values if self.turn is None else np.asarray(self.turn @ values, dtype=values.dtype)


def planes_of(pair: tuple[Channel, Channel]) -> Planes:
    """Names and transformation matrix that turn two sensors at one location to y and z."""
    first, second = pair
    seen = np.array([first.axis, second.axis])
    if np.array_equal(seen, np.eye(2)):
        return Planes((first.name, second.name), None)
    both = f"{first.name} and {second.name}"
    return Planes((f"y of {both}", f"z of {both}"), np.linalg.inv(seen))


def in_planes(samples: FloatArray, pairs: Iterable[tuple[Channel, Channel]]) -> tuple[FloatArray, FloatArray]:
    """Motion in y and in z, µm, shape (n_samples, n_pairs) each; columns of `samples` are the channels pair by pair."""
    found = [
        planes_of(pair).turned(samples[:, 2 * at : 2 * at + 2].T * _UM * np.array([[one.to_si] for one in pair]))
        for at, pair in enumerate(pairs)
    ]
    y, z = np.stack(found, axis=-1)
    return y, z


def no_pair(channels: Iterable[Channel]) -> str:
    """Error message for a machine in which `orbit_pairs` finds no pair."""
    there = ", ".join(channel.name for channel in channels if channel.quantity is Quantity.DISPLACEMENT) or "none"
    return f"an orbit needs the displacements in y and z at one place; measured displacements: {there}"


def recorded_pairs(data: Described, place: str | None = None) -> list[tuple[Channel, Channel]]:
    """Pairs of channels, at all locations or at one, of which both have numbers.

    Raises
    ------
    MachineFileError
        If no pair is measured, or none at `place`.
    RotorwatchError
        If in every pair a channel has no numbers.
    """
    pairs = orbit_pairs(data.descriptor.channels)
    if not pairs:
        raise MachineFileError(f"{data.place}, {data.name}: {no_pair(data.descriptor.channels)}")
    there = [pair[0].location for pair in pairs]
    if place is not None and place not in there:
        raise MachineFileError(
            f"--place is {place!r}, where {data.name} has no displacements in y and z; expected one of "
            f"{', '.join(there)}"
        )
    pairs = [pair for pair in pairs if place in (None, pair[0].location)]
    if not (sent := [pair for pair in pairs if data.sent(pair) == pair]):
        raise RotorwatchError(f"{data.place}: {data.lacking}")
    return sent


def read_orbits(data: Recorded, revolutions: int) -> Orbits:
    """Orbits of the latest recorded revolutions.

    Raises
    ------
    MachineFileError
        If the shaft angle is not measured, or no location has both y and z.
    RotorwatchError
        If fewer revolutions without a gap were recorded before the end.
    """
    if not data.has_angle:
        raise MachineFileError(
            f"{data.place}: {data.name} has no channel with the shaft angle (keyphasor), and an orbit needs one"
        )
    pairs = recorded_pairs(data)
    channels = [channel for pair in pairs for channel in pair]
    length_s = 2.0
    while True:
        found = data.latest(channels, length_s)
        enough = bool(found) and pulses(found[-1].angle_rad)[1].size > revolutions
        interrupted = len(found) > 1
        if enough or interrupted or length_s > min(_LONGEST_S, (data.to_ns - data.from_ns) / 1e9):
            break
        length_s *= 2
    if not found:
        raise RotorwatchError(f"{data.place}: no sample blocks of {data.name} in this stretch of time")
    return orbits_of(found[-1], pairs, revolutions)


def orbits_of(excerpt: Excerpt, pairs: list[tuple[Channel, Channel]], revolutions: int) -> Orbits:
    """Orbits of the latest revolutions of an excerpt, whose columns are the channels of `pairs`, pair by pair.

    Raises
    ------
    RotorwatchError
        If the excerpt has fewer revolutions.
    """
    found = newest_revolutions(excerpt, revolutions)
    path = found.excerpt
    if path is None or found.count < revolutions:
        raise RotorwatchError(
            f"--revolutions is {revolutions}, but only {found.count} whole revolutions without a gap were recorded "
            f"before this time ({excerpt.length_s:.3g} s of samples)"
        )
    channels = [channel for pair in pairs for channel in pair]
    vectors = vectors_of(path, channels, _REVOLUTIONS_AT_ONCE)
    q_um = _UM * np.average(vectors.orders[:, _AT_1X], axis=0, weights=vectors.revolutions)
    about = path.samples * (_UM * np.array([channel.to_si for channel in channels]))
    about -= about.mean(axis=0)
    orbits = []
    for at, pair in zip(range(0, len(channels), 2), pairs, strict=True):
        planes = planes_of(pair)
        y, z = planes.turned(about[:, at : at + 2].T)
        marks = np.stack([np.interp(found.pulses, np.arange(len(about)), one) for one in (y, z)], axis=1)
        ellipse = Ellipse(*map(complex, planes.turned(q_um[at : at + 2])))
        orbits.append(Orbit(pair[0].location, planes.names, ellipse, y, z, marks))
    first, last = found.pulses[[0, -1]] / path.rate_hz
    return Orbits(
        start_ns=path.start_ns + round(first * 1e9),
        end_ns=path.start_ns + round(last * 1e9),
        revolutions=revolutions,
        speed_rad_s=float(np.copysign(2 * np.pi * revolutions / (last - first), path.speed_rad_s)),
        orbits=tuple(orbits),
    )
