"""Revolutions of the shaft in a stretch of samples, and the newest blocks of a stream that hold them."""

from collections import deque

import numpy as np
import numpy.typing as npt

from models.signals.block import FloatArray, SampleBlock


def pulses(angle_rad: npt.NDArray[np.floating] | None) -> tuple[int, FloatArray]:
    """Direction of rotation, and where the shaft angle passes 0, in samples from the first one, interpolated.

    Parameters
    ----------
    angle_rad : ndarray, shape (n_samples,), or None
        Shaft angle of consecutive samples.

    Returns
    -------
    int
        1 if the angle grows, -1 if it falls.
    ndarray, shape (n_pulses,)
        Empty without an angle.
    """
    if angle_rad is None or angle_rad.size < 2:
        return 1, np.empty(0)
    whole = np.unwrap(angle_rad)
    direction = 1 if whole[-1] >= whole[0] else -1
    onwards = np.maximum.accumulate(direction * whole)  # noise on the angle must not count a pulse twice
    turns = np.arange(np.ceil(onwards[0] / (2 * np.pi)), np.floor(onwards[-1] / (2 * np.pi)) + 1)
    return direction, np.asarray(np.interp(turns * 2 * np.pi, onwards, np.arange(onwards.size)))


class NewestBlocks:
    """The newest accepted blocks of a stream, without a gap between them.

    One thread adds, any thread may read: what is read is replaced as a whole.

    Parameters
    ----------
    length_s : float
        Data that are kept, s.
    """

    def __init__(self, length_s: float = 10.0) -> None:
        self._length_s = length_s
        self._held: deque[SampleBlock] = deque()
        self._n_samples = 0
        self.blocks: tuple[SampleBlock, ...] = ()

    def add(self, block: SampleBlock, *, continuous: bool) -> None:
        """Add the next accepted block; one that does not continue the others takes their place."""
        if not continuous:
            self._held.clear()
            self._n_samples = 0
        self._held.append(block)
        self._n_samples += block.samples.shape[0]
        kept = round(self._length_s * block.rate_hz)
        while len(self._held) > 1 and self._n_samples - self._held[0].samples.shape[0] >= kept:
            self._n_samples -= self._held.popleft().samples.shape[0]
        self.blocks = tuple(self._held)
