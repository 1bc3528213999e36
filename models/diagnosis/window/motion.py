"""Powers and cross-powers, hop by hop, of channels that measure the same motion.

Displacement, velocity and acceleration of one motion are related by kinematics, not by the machine: v = jωx. Per hop
the powers and the cross-power of jωx and v are kept in a few bands, so that a gain or a delay that drifts shows within
a window.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from models.signals.block import ComplexArray, FloatArray, IndexArray

N_BANDS = 24  # bands in which the powers of a hop are kept


@dataclass(frozen=True, slots=True)
class MotionPair:
    """Two columns that measure one motion."""

    # Column of the motion and of its derivative.
    first: int
    second: int
    order: int  # 1 for the first derivative, 2 for the second


@lru_cache(maxsize=64)
def motion_pairs(states: tuple[str, ...]) -> tuple[MotionPair, ...]:
    """Pairs among measured states, which are given in the order of a plan: displacements first.

    Examples
    --------
    >>> motion_pairs(("y1", "y2", "y1_dot"))
    (MotionPair(first=0, second=2, order=1),)
    >>> motion_pairs(("y1", "y1_ddot"))
    (MotionPair(first=0, second=1, order=2),)
    """
    pairs = []
    for motion in dict.fromkeys(name.removesuffix("_dot").removesuffix("_ddot") for name in states):
        names = [motion, f"{motion}_dot", f"{motion}_ddot"]
        there = [(order, states.index(name)) for order, name in enumerate(names) if name in states]
        pairs += [MotionPair(a, b, j - i) for (i, a), (j, b) in pairwise(there)]
    return tuple(pairs)


@lru_cache(maxsize=64)
def pair_bands(n_bins: int) -> IndexArray:
    """First bin of each band; shape (n_bands,)."""
    edges = np.unique(np.linspace(0, n_bins, min(N_BANDS, n_bins), endpoint=False).astype(np.intp))
    edges.flags.writeable = False
    return edges


def pair_powers(segments: ComplexArray, frequencies_hz: FloatArray, pairs: tuple[MotionPair, ...]) -> ComplexArray:
    """Sum powers of Fourier coefficients, shape (n_segments, n_bins, n), over segments and the bins of each band.

    With z = (jω)ᵒʳᵈᵉʳ x: Σ|z|², Σ z* v, Σ|v|², shape (n_pairs, n_bands, 3).
    """
    edges = pair_bands(frequencies_hz.size)
    powers = np.zeros((len(pairs), edges.size, 3), dtype=np.complex128)
    jw = 2j * np.pi * frequencies_hz
    for number, pair in enumerate(pairs):
        z, v = segments[:, :, pair.first] * jw**pair.order, segments[:, :, pair.second]
        for column, product in enumerate((z.conj() * z, z.conj() * v, v.conj() * v)):
            powers[number, :, column] = np.add.reduceat(product.sum(axis=0), edges)
    return powers
