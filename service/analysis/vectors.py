"""Vectors at orders of running speed, and mean positions, of whole revolutions one after the other."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from models.levels.measures import ORDERS, hop_levels, level_plan
from models.signals.block import FloatArray
from models.signals.channels import Channel
from service.analysis.revolutions import Excerpt, pulses


@dataclass(frozen=True, slots=True)
class Vectors:
    """Of some channels, piece by piece, SI units.

    Attributes
    ----------
    time_ns : ndarray of int, shape (n_pieces,)
        Middle of each.
    speed_rad_s : ndarray, shape (n_pieces,)
        Mean speed; negative where the shaft turns from z to y.
    revolutions : ndarray of int, shape (n_pieces,)
    orders : ndarray of complex, shape (n_pieces, 4, n_channels)
        q of x = Re{q e^{jkθ}} at the orders k of `models.levels.measures.ORDERS`.
    mean : ndarray, shape (n_pieces, n_channels)
    """

    time_ns: npt.NDArray[np.int64]
    speed_rad_s: FloatArray
    revolutions: npt.NDArray[np.int64]
    orders: npt.NDArray[np.complex128]
    mean: FloatArray


def vectors_of(excerpt: Excerpt, channels: Sequence[Channel], revolutions: int) -> Vectors:
    """Vectors of every so many revolutions; fewer at the end are a piece as well.

    Parameters
    ----------
    excerpt : Excerpt
        With shaft angle; its columns are the channels.
    """
    plan = level_plan(channels, excerpt.rate_hz, (0.0, excerpt.rate_hz))
    si = excerpt.samples * np.array([channel.to_si for channel in channels])
    direction, at = pulses(excerpt.angle_rad)
    edges = np.array([*range(0, at.size - 1, revolutions), at.size - 1] if at.size > 1 else [], dtype=np.int64)
    found = []
    for first, last in pairwise(edges):
        rows = slice(int(np.floor(at[first])), int(np.ceil(at[last])) + 1)
        assert excerpt.angle_rad is not None  # noqa: S101  # there are pulses
        x, angle = si[rows], excerpt.angle_rad[rows]
        if last - first == 1:  # seen twice: in one revolution half an order cannot be told from the others
            x, angle = np.concatenate([x, x[1:]]), np.concatenate([angle, angle[1:]])
        levels = hop_levels(plan, x, angle)
        found.append((levels.orders, levels.sums[0]))
    begin, end = at[edges[:-1]], at[edges[1:]]
    counts = np.diff(edges)
    return Vectors(
        excerpt.start_ns + np.round((begin + end) / 2 / excerpt.rate_hz * 1e9).astype(np.int64),
        direction * 2 * np.pi * counts * excerpt.rate_hz / (end - begin),
        counts,
        np.array([orders for orders, _ in found], dtype=np.complex128).reshape(-1, len(ORDERS), len(channels)),
        np.array([mean for _, mean in found]).reshape(-1, len(channels)),
    )
