"""The rotation-synchronous part of a window: at which speed, and what is taken out of every hop and segment.

At a steady speed one set of coefficients serves the whole window. Where the speed changes, the amplitude at the
rotation changes with it, and what one set leaves behind is no longer next to the line. Then every hop has its own, and
a segment of the spectra those between the hops on which its middle lies. Without a phase reference the angle begins
anew in every hop, and each of its segments has its own hop's.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from models.diagnosis.moments import ComplexArray, HopMoments, Plan
from models.diagnosis.rotation import followed_speeds
from models.signals.block import FloatArray

__all__ = [
    "STEADY",
    "HopCoefficients",
    "Rotation",
    "SpeedSource",
    "hop_coefficients",
    "regression",
    "relative_vectors",
    "rotation_of",
]

SpeedSource = Literal["phase reference", "estimated", "unknown"]

STEADY = 0.01
"""Range of the hops' speeds, relative, up to which one set of coefficients serves the window."""


@dataclass(frozen=True, slots=True)
class Rotation:
    """How fast the machine turned.

    Attributes
    ----------
    source : str
        Where the speed is from: ``phase reference``, ``estimated`` from the vibration, or ``unknown``.
    hop_speed_rad_s : ndarray, shape (n_hops,)
        Nan where unknown.
    by_hop : bool
        Whether every hop has its own coefficients.
    """

    source: SpeedSource
    hop_speed_rad_s: FloatArray
    by_hop: bool


@dataclass(frozen=True, slots=True)
class HopCoefficients:
    """What is taken out hop by hop, on the regressors (1, cos θ, sin θ).

    Attributes
    ----------
    hops : ndarray, shape (n_hops, n, 3)
    segments : ndarray, shape (n_segments, n, 3)
    """

    hops: FloatArray
    segments: FloatArray


def rotation_of(plan: Plan, hops: tuple[HopMoments, ...]) -> Rotation:
    """Tell how fast the machine turned in each hop, and whether that was steady."""
    hop_s = plan.hop / plan.rate_hz
    if plan.angle_column is not None:
        speed = np.array([hop.turned_rad for hop in hops]) / hop_s
        return Rotation("phase reference", speed, bool(np.ptp(speed) > STEADY * abs(speed.mean())))
    followed = None
    if plan.speed_rad_s is not None:
        followed = followed_speeds(tuple(hop.line for hop in hops), hop_s)
    if followed is None:
        return Rotation("unknown", np.full(len(hops), np.nan), by_hop=False)
    # The line is known in the middle of all samples of the hop; the hop's own middle comes later.
    sweep = np.array([0.0 if hop.line is None else hop.line.sweep_rad_s2 for hop in hops])
    return Rotation("estimated", followed + sweep * plan.preamble / 2 / plan.rate_hz, by_hop=True)


def regression(zero_lag: FloatArray, n: int) -> FloatArray:
    """β of x on the regressors, shape (n, n_regressors); of least norm where a stuck angle makes them dependent."""
    return np.asarray(np.linalg.lstsq(zero_lag[n:, n:], zero_lag[n:, :n], rcond=None)[0].T, dtype=np.float64)


def hop_coefficients(plan: Plan, hops: tuple[HopMoments, ...], rotation: Rotation, mean: FloatArray) -> HopCoefficients:
    """Coefficients of every hop and segment, with one mean for the whole window.

    Parameters
    ----------
    rotation : Rotation
        Where its speed is nan, nothing but the mean is taken out.
    mean : ndarray, shape (n,)
        Coefficient of the constant.
    """
    n = len(plan.states)
    beta = np.zeros((len(hops), n, 3))
    beta[:, :, 0] = mean
    for number, hop in enumerate(hops):
        if np.isfinite(rotation.hop_speed_rad_s[number]):
            zero_lag = hop.products[0]
            of_x = zero_lag[n + 1 :, :n] - np.outer(zero_lag[n + 1 :, n], mean)
            beta[number, :, 1:] = np.linalg.lstsq(zero_lag[n + 1 :, n + 1 :], of_x, rcond=None)[0].T
    per_hop = hops[0].segments.shape[0]
    segments = np.repeat(beta, per_hop, axis=0)
    if rotation.source == "phase reference":
        for number in range(len(hops)):
            for k in range(per_hop):  # its middle lies k halves of a segment after the hop's beginning
                part = k * (plan.segment // 2) / plan.hop - 0.5
                segments[number * per_hop + k] = _between(hops, beta, number, part)
    return HopCoefficients(beta, segments)


def _between(hops: tuple[HopMoments, ...], beta: FloatArray, number: int, part: float) -> FloatArray:
    """Coefficients at a part of a hop from its middle, on the line through the neighbour; its own next to a gap."""
    for neighbour in (number + 1, number - 1) if part > 0 else (number - 1, number + 1):
        if 0 <= neighbour < len(hops) and _adjoin(hops[min(number, neighbour)], hops[max(number, neighbour)]):
            return np.asarray(beta[number] + part * (neighbour - number) * (beta[neighbour] - beta[number]))
    return np.asarray(beta[number])


def _adjoin(earlier: HopMoments, later: HopMoments) -> bool:
    return abs(later.start_ns - earlier.end_ns) < (earlier.end_ns - earlier.start_ns) // 4


def relative_vectors(vectors: ComplexArray) -> tuple[ComplexArray, int]:
    """Turn each hop's vectors so that the channel with the clearest line is at angle zero.

    Returns
    -------
    vectors : ndarray, shape (n_hops, n)
    channel : int
        The one at angle zero: its amplitude varies least from hop to hop, relative.
    """
    size = np.abs(vectors)
    mean = size.mean(axis=0)
    spread = size.std(axis=0) / np.where(mean > 0, mean, np.nan)
    channel = int(np.nanargmin(spread)) if np.any(np.isfinite(spread)) else 0
    turn = np.exp(-1j * np.angle(vectors[:, channel]))
    return np.asarray(vectors * turn[:, None], dtype=np.complex128), channel
