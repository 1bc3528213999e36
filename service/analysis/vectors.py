"""Vectors at the orders of running speed, estimated from consecutive pieces of whole revolutions."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from models.diagnosis.window.rotation import rotation_line
from models.errors import MachineFileError, RotorwatchError
from models.levels.measures import hop_levels, level_plan
from models.levels.orders import ORDERS
from models.signals.block import FloatArray
from models.signals.channels import Channel
from models.signals.waveform import waveform_of
from service.analysis.recorded import Sampled, begins_again
from service.analysis.revolutions import Excerpt, pulses

_LONGEST_S = 20.0
_ESTIMATED_S = 2.0
_LEAST_LINE_STRENGTH = 15.0
"""Least strength of a line over its surroundings: noise reaches 3 to 8 in 2 s (`models.diagnosis.window.rotation`)."""
_MOST_SPEED_STEP, _LONGEST_STEP_S = 0.05, 2.5 * _ESTIMATED_S
"""Largest difference between consecutive lines of one shaft: relative speed, and time in s."""


@dataclass(frozen=True, slots=True)
class Vectors:
    """Vectors of several channels, piece by piece, SI units."""

    time_ns: npt.NDArray[np.int64]  # (n_pieces,), middle of each piece
    speed_rad_s: FloatArray  # (n_pieces,), mean speed; negative if the shaft turns from z to y
    revolutions: npt.NDArray[np.int64]  # (n_pieces,)
    # (n_pieces, 4, n_channels), q of x = Re{q e^{jkθ}} at the orders k of `models.levels.measures.ORDERS`.
    orders: npt.NDArray[np.complex128]


def vectors_of(excerpt: Excerpt, channels: Sequence[Channel], revolutions: int) -> Vectors:
    """Vectors of an excerpt with shaft angle, divided into equal pieces of about `revolutions` whole revolutions."""
    plan = level_plan(channels, excerpt.rate_hz, (0.0, excerpt.rate_hz))
    si = excerpt.samples * np.array([channel.to_si for channel in channels])
    direction, at = pulses(excerpt.angle_rad)
    whole = max(0, at.size - 1)
    edges = np.unique(np.linspace(0, whole, max(1, round(whole / revolutions)) + 1).round().astype(np.int64))
    found = []
    for first, last in pairwise(edges):
        rows = slice(int(np.floor(at[first])), int(np.ceil(at[last])) + 1)
        assert excerpt.angle_rad is not None  # noqa: S101  # there are pulses
        x, angle = si[rows], excerpt.angle_rad[rows]
        if last - first == 1:  # repeated: within one revolution, order 0.5 cannot be separated from the others
            x, angle = np.concatenate([x, x[1:]]), np.concatenate([angle, angle[1:]])
        found.append(hop_levels(plan, *waveform_of(x), angle).orders)
    begin, end = at[edges[:-1]], at[edges[1:]]
    counts = np.diff(edges)
    return Vectors(
        excerpt.start_ns + np.round((begin + end) / 2 / excerpt.rate_hz * 1e9).astype(np.int64),
        direction * 2 * np.pi * counts * excerpt.rate_hz / (end - begin),
        counts,
        np.array(found, dtype=np.complex128).reshape(-1, len(ORDERS), len(channels)),
    )


def read_vectors(data: Sampled, channels: Sequence[Channel], revolutions: int) -> Vectors:
    """Vectors of all recorded samples, each of about `revolutions` revolutions.

    Raises
    ------
    MachineFileError
        If the shaft angle is not measured.
    RotorwatchError
        If the shaft does not turn in any stretch.
    """
    if not data.has_angle:
        raise MachineFileError(
            f"{data.place}: {data.name} has no channel with the shaft angle (keyphasor): without it vibration has no "
            "phase, and the speed is not known. rotorwatch plot bode --speeds RPM-RPM looks for the speed in the "
            "vibration, and shows amplitudes"
        )
    found = _one_after_the_other(
        (stretch, vectors_of(stretch, channels, revolutions)) for stretch in data.stretches(channels, _LONGEST_S)
    )
    if found is None:
        raise RotorwatchError(f"{data.place}: the shaft of {data.name} does not turn in this stretch of time")
    return found


def estimated_vectors(data: Sampled, channels: Sequence[Channel], between_rad_s: tuple[float, float]) -> Vectors:
    """Vectors relative to an angle that is estimated from the vibration itself, so their phase is meaningless.

    The strongest line between the two speeds, which must be that of 1×, is used if it stands out clearly and a line of
    similar speed precedes or follows it: random vibration, at a resonance for instance, has no such line.

    Raises
    ------
    RotorwatchError
        If no line stands out.
    """
    low, high = between_rad_s
    found = _one_after_the_other(
        (stretch, _estimated(stretch, channels, (low + high) / 2, (high - low) / (high + low)))
        for stretch in data.stretches(channels, _ESTIMATED_S)
    )
    if found is not None:
        near = (np.diff(found.time_ns) < _LONGEST_STEP_S * 1e9) & (
            np.abs(np.diff(found.speed_rad_s)) < _MOST_SPEED_STEP * found.speed_rad_s[1:]
        )
        follows = np.append(near, False) | np.insert(near, 0, False)
        found = Vectors(*(getattr(found, field.name)[follows] for field in fields(Vectors))) if follows.any() else None
    if found is None:
        raise RotorwatchError(
            f"{data.place}: no line between {low * 30 / np.pi:g} and {high * 30 / np.pi:g} rpm stands out "
            f"from the vibration of {data.name} as that of its rotation would"
        )
    return found


def _estimated(stretch: Excerpt, channels: Sequence[Channel], speed_rad_s: float, tolerance: float) -> Vectors | None:
    si = stretch.samples * np.array([channel.to_si for channel in channels])
    line = rotation_line(si.T, stretch.rate_hz, speed_rad_s, tolerance)
    if line is None or line.strength <= _LEAST_LINE_STRENGTH:
        return None
    t_s = np.asarray((np.arange(len(si)) - (len(si) - 1) / 2) / stretch.rate_hz, dtype=np.float64)
    plan = level_plan(channels, stretch.rate_hz, (0.0, stretch.rate_hz))
    return Vectors(
        np.array([(stretch.start_ns + stretch.end_ns) // 2], dtype=np.int64),
        np.array([line.speed_rad_s], dtype=np.float64),
        np.array([round(stretch.length_s * line.speed_rad_s / (2 * np.pi))], dtype=np.int64),
        np.array([hop_levels(plan, *waveform_of(si), line.angle(t_s)).orders], dtype=np.complex128),
    )


def _one_after_the_other(pieces: Iterable[tuple[Excerpt, Vectors | None]]) -> Vectors | None:
    found: list[Vectors] = []
    for stretch, vectors in pieces:
        while found and begins_again(int(found[-1].time_ns[-1]), stretch.start_ns):
            found.pop()  # if runs overlap in time, the one recorded last is shown
        if vectors is not None and vectors.time_ns.size:
            found.append(vectors)
    if not found:
        return None
    return Vectors(*(np.concatenate([getattr(one, field.name) for one in found]) for field in fields(Vectors)))
