"""A block of samples: the unit that travels, is refused, recorded and replayed."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["FloatArray", "NewestBlocks", "SampleBlock"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Consecutive samples of all channels of one machine.

    Attributes
    ----------
    start_ns : int
        Acquisition time of the first sample, nanoseconds since 1970-01-01 UTC.
    sequence : int
        Counts the blocks of one run of the publisher from 0.
    run : int
        Changes each time the publisher starts (0 where a device cannot say).
    rate_hz : float
        Samples per second and channel.
    samples : ndarray, shape (n_samples, n_channels)
        float32 or float64, in the units of the channel descriptor.
    """

    start_ns: int
    sequence: int
    run: int
    rate_hz: float
    samples: npt.NDArray[np.float32] | FloatArray

    @property
    def end_ns(self) -> int:
        """Acquisition time of the sample after the last one."""
        n_samples: int = self.samples.shape[0]
        return self.start_ns + round(n_samples * 1e9 / self.rate_hz)


class NewestBlocks:
    """The newest blocks without a gap, for whoever wants to see samples.

    Parameters
    ----------
    n_samples : int
        As many blocks as hold at least so many samples.
    """

    def __init__(self, n_samples: int) -> None:
        self._enough = n_samples
        self._blocks: deque[SampleBlock] = deque()
        self._held = 0

    @property
    def blocks(self) -> tuple[SampleBlock, ...]:
        """Oldest first."""
        return tuple(self._blocks)

    def add(self, block: SampleBlock, *, continuous: bool) -> None:
        """Append a block; if it does not continue the others, these are forgotten."""
        if not continuous:
            self._blocks.clear()
            self._held = 0
        self._blocks.append(block)
        self._held += block.samples.shape[0]
        while self._held - self._blocks[0].samples.shape[0] >= self._enough:
            self._held -= self._blocks.popleft().samples.shape[0]
