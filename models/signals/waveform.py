"""What the samples of a channel look like before anything is averaged.

A stuck or clipped sensor shows in single samples, not in correlations.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from models.checkpoint import checked
from models.signals.block import FloatArray

CountArray = npt.NDArray[np.int64]

_DROPPED, _JUMPS = 4, 4.0
"""Fewest equal samples in a row that a channel jumps into and out of, and least jump, in median steps."""


@dataclass(frozen=True, slots=True)
class Waveform:
    """Statistics of single channels, without any model; shape (n_channels,), or (n_hops, n_channels) hop by hop."""

    n_samples: int  # samples each value stands for
    # Mean, and root mean square about it, SI units.
    mean: FloatArray
    rms: FloatArray
    # Smallest and largest sample.
    minimum: FloatArray
    maximum: FloatArray
    # Samples exactly at the minimum or maximum that have an equal neighbour: flat tops.
    at_minimum: CountArray
    at_maximum: CountArray
    longest_run: CountArray  # most samples in a row that are exactly equal; 1 if no neighbours are
    # Samples in runs of equal ones that the channel jumps into and out of, as when its line is broken for a moment.
    dropped: CountArray
    # Smallest difference between unequal neighbours: the quantisation step, if there is one. NaN where no neighbours
    # are equal (not quantised) or all are.
    step: FloatArray

    def of(self, columns: Sequence[int]) -> "Waveform":
        """Waveform of some of the channels, in that order."""
        _, *names = (one.name for one in fields(self))
        return Waveform(self.n_samples, *(getattr(self, name)[..., columns] for name in names))

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything as named arrays."""
        return {
            "n_samples": np.array(self.n_samples, dtype=np.int64),
            "levels": np.stack([self.mean, self.rms, self.minimum, self.maximum, self.step]),
            "counts": np.stack([self.at_minimum, self.at_maximum, self.longest_run, self.dropped]),
        }

    @classmethod
    def restored(cls, arrays: Mapping[str, np.ndarray]) -> "Waveform":
        """Waveform of one hop from what `checkpoint` gave, see `models.checkpoint`."""
        mean, rms, minimum, maximum, step = checked(arrays, "levels", np.float64, (5, None))
        at_minimum, at_maximum, longest_run, dropped = checked(arrays, "counts", np.int64, (4, mean.size))
        n_samples = int(checked(arrays, "n_samples", np.int64, ()))
        return cls(n_samples, mean, rms, minimum, maximum, at_minimum, at_maximum, longest_run, dropped, step)


def waveform_of(samples: FloatArray) -> tuple[Waveform, FloatArray]:
    """Describe finite samples of one hop, shape (n_samples, n_channels), at least one.

    Also returns their deviations from the mean, shape (n_channels, n_samples).
    """
    x = np.array(samples.T, order="C")  # a copy: the mean is taken out of it below
    n, n_samples = x.shape
    mean = x.mean(axis=1)
    minimum, maximum = x.min(axis=1), x.max(axis=1)
    equal = x[:, 1:] == x[:, :-1]
    at_minimum, at_maximum = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    longest_run, dropped, step = np.ones(n, dtype=np.int64), np.zeros(n, dtype=np.int64), np.full(n, np.nan)
    for row in np.flatnonzero(equal.any(axis=1)):
        follows = np.flatnonzero(equal[row])  # each is equal to its successor
        breaks = np.flatnonzero(np.diff(follows) != 1)
        first, last = follows[np.append(0, breaks + 1)], follows[np.append(breaks, -1)] + 1
        lengths, levels = last - first + 1, x[row, first]
        at_minimum[row] = lengths[levels == minimum[row]].sum()
        at_maximum[row] = lengths[levels == maximum[row]].sum()
        longest_run[row] = lengths.max()
        if follows.size < n_samples - 1:
            moves = np.abs(np.diff(x[row]))
            step[row] = moves[~equal[row]].min()
            inside = (lengths >= _DROPPED) & (first > 0) & (last < n_samples - 1)
            if inside.any() and 2 * follows.size < n_samples:  # otherwise the channel may be held between values
                jumps = np.minimum(moves[first[inside] - 1], moves[last[inside]])
                dropped[row] = lengths[inside][jumps > _JUMPS * np.median(moves[~equal[row]])].sum()
    x -= mean[:, None]
    rms = np.sqrt(np.einsum("ij,ij->i", x, x) / n_samples)
    return Waveform(n_samples, mean, rms, minimum, maximum, at_minimum, at_maximum, longest_run, dropped, step), x


def stacked_waveform(hops: Sequence[Waveform]) -> Waveform:
    """Put hops of equal length below each other, shape (n_hops, n_channels)."""
    _, *names = (one.name for one in fields(Waveform))
    every = (np.concatenate([getattr(hop, name) for hop in hops]).reshape(len(hops), -1) for name in names)
    return Waveform(hops[0].n_samples, *every)
