"""Steady lines in the spectrum that do not belong to the rotation: something else drives the machine.

A line has the same strength in every segment, noise has not: of a steady line the mean fourth power of the Fourier
coefficient is the square of the mean second power, of noise twice that.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its sub-packages are loaded when they are first used

from models.commissioning.healthy import HealthyRecording
from models.diagnosis.window import window_statistics

__all__ = ["Line", "foreign_lines"]

_STEADY = 1.35
"""Fourth power over the square of the second: 2 for noise, 1 for a line; between them with little data."""
_STANDS_OUT = 8.0
_NEIGHBOURHOOD_HZ = 4.0
_LOBE = 2
"""A Hann window spreads a line over two bins on either side."""
_FEWEST_SEGMENTS = 6
_HARMONICS = 12


@dataclass(frozen=True, slots=True)
class Line:
    """A line.

    Attributes
    ----------
    state : str
        Where it is strongest.
    share : float
        Of the power of that channel's random part.
    """

    state: str
    frequency_hz: float
    share: float


def foreign_lines(recording: HealthyRecording) -> tuple[Line, ...]:
    """Lines that are neither noise nor a multiple of the speed, strongest first."""
    hops = recording.hops
    segments = np.concatenate([hop.segments for hop in hops]) if hops else np.empty((0, 0, 0))
    if segments.shape[0] < _FEWEST_SEGMENTS:
        return ()
    states = recording.plan.states
    power = np.abs(segments[:, :, : len(states)]) ** 2
    mean = power.mean(axis=0)
    steadiness = (power**2).mean(axis=0) / np.maximum(mean**2, np.finfo(float).tiny)
    frequencies_hz = recording.plan.frequencies_hz
    step_hz = float(frequencies_hz[1] - frequencies_hz[0])
    size = max(5, 2 * round(_NEIGHBOURHOOD_HZ / step_hz / 2) + 1)
    floor = scipy.ndimage.median_filter(mean, size=(size, 1), mode="nearest")
    window = window_statistics(recording.plan, hops, lagged=False)
    total = np.maximum(np.diag(window.correlation[0]), np.finfo(float).tiny)
    speed_hz = window.speed_rad_s / (2 * np.pi)
    rotation = _near_rotation(frequencies_hz, speed_hz, step_hz)
    found: dict[int, Line] = {}
    candidates = np.argwhere((mean > _STANDS_OUT * floor) & (steadiness < _STEADY) & ~rotation[:, None])
    for at, column in candidates:
        lobe = slice(max(0, at - _LOBE), at + _LOBE + 1)
        if mean[at, column] < mean[lobe, column].max():
            continue
        share = float(2 * step_hz * mean[lobe, column].sum() / total[column])
        if at not in found or share > found[at].share:
            found[at] = Line(states[column], float(frequencies_hz[at]), min(1.0, share))
    return tuple(sorted(found.values(), key=lambda line: -line.share))


def _near_rotation(
    frequencies_hz: "np.ndarray[tuple[int], np.dtype[np.float64]]", speed_hz: float, step_hz: float
) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    if not np.isfinite(speed_hz):
        return np.zeros(frequencies_hz.size, dtype=np.bool_)
    multiples = speed_hz * np.arange(1, _HARMONICS + 1)
    return np.asarray(np.min(np.abs(frequencies_hz[:, None] - multiples), axis=1) <= (_LOBE + 1) * step_hz)
