"""A block of samples, the unit that is sent, refused, recorded and replayed; and how its samples are integrated.

Integration amplifies low frequencies, by 1/ω once and 1/ω² twice, so that an accelerometer's drift would drown the
vibration. It needs a high-pass filter, and below its corner the result is not a measurement. Both are done in the
frequency domain (A. Brandt, R. Brincker: Integrating time signals in frequency domain. Comparison with time domain
integration. Measurement 58, 2014, 511-519): the samples' Fourier transform is divided by (jω)ⁿ, exact in amplitude and
phase up to half the sampling rate, where trapezoids would fall short, and multiplied by the gain of a fourth-order
Butterworth high-pass that is run forwards and backwards, 1 / (1 + (f_c / f)⁸), which shifts no phase.
"""

from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
import numpy.typing as npt

BoolArray = npt.NDArray[np.bool_]
IndexArray = npt.NDArray[np.intp]
FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
ComplexArray = npt.NDArray[np.complex128]
SampleArray = Float32Array | FloatArray


def nanoseconds(moment: datetime) -> int:
    """A date and time, UTC if it names no zone, in nanoseconds since 1970-01-01 UTC."""
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    return since // timedelta(microseconds=1) * 1000


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Consecutive samples of all channels of one machine."""

    start_ns: int  # acquisition time of the first sample, nanoseconds since 1970-01-01 UTC
    sequence: int  # counts the blocks of one run of the publisher from 0
    run: int  # changes each time the publisher starts (0 where a device cannot say)
    rate_hz: float  # samples per second and channel
    # (n_samples, n_channels): float32 or float64, in the units of the channel descriptor
    samples: SampleArray
    schema_hash: str = ""  # of the channel descriptor that its sender named; empty if none

    @property
    def end_ns(self) -> int:
        """Acquisition time of the sample after the last one."""
        n_samples: int = self.samples.shape[0]
        return self.start_ns + round(n_samples * 1e9 / self.rate_hz)


class NewestBlocks:
    """The newest blocks without a gap: as few as hold `n_samples` samples, or all if there are fewer samples."""

    def __init__(self, n_samples: int) -> None:
        self._enough = n_samples
        self._blocks: deque[SampleBlock] = deque()
        self._held = 0

    @property
    def blocks(self) -> tuple[SampleBlock, ...]:
        """Oldest first."""
        return tuple(self._blocks)

    def add(self, block: SampleBlock, *, continuous: bool) -> None:
        """Append a block; if it does not continue the others, these are discarded."""
        if not continuous:
            self._blocks.clear()
            self._held = 0
        self._blocks.append(block)
        self._held += block.samples.shape[0]
        while self._held - self._blocks[0].samples.shape[0] >= self._enough:
            self._held -= self._blocks.popleft().samples.shape[0]


_ORDER = 4


def lowest_valid_hz(high_pass_hz: float) -> float:
    """Frequency above which amplitudes are right within 0.4 %: twice the corner of the high-pass."""
    return 2.0 * high_pass_hz


def settling_s(high_pass_hz: float) -> float:
    """How far the ends of a stretch disturb the result, s: five periods of the corner frequency.

    The slowest pole of the filter decays with sin(π/8) of its corner frequency, to 6e-6 within this time.
    """
    return 5.0 / high_pass_hz


def integrated(acceleration: FloatArray, rate_hz: float, times: int, high_pass_hz: float) -> FloatArray:
    """Integrate equally spaced samples without a gap, shape (n,), once to velocity or twice to displacement.

    The result, shape (n,), is in the unit of `acceleration` times s or s². It is valid from `lowest_valid_hz` of the
    high-pass's corner, but for its first and last `settling_s`.

    Examples
    --------
    >>> t = np.arange(4000) / 1000.0
    >>> v = integrated(np.cos(2 * np.pi * 25 * t), 1000.0, 1, 5.0)
    >>> bool(np.allclose(v[1000:3000], np.sin(2 * np.pi * 25 * t[1000:3000]) / (2 * np.pi * 25), atol=1e-7))
    True
    """
    from scipy import fft  # noqa: PLC0415  # most users of blocks do not need it

    count = acceleration.size
    size = fft.next_fast_len(count, real=True)
    frequency = fft.rfftfreq(size, 1 / rate_hz)
    response = np.zeros(frequency.size, dtype=np.complex128)
    above = frequency[1:]
    response[1:] = 1 / ((2j * np.pi * above) ** times * (1 + (high_pass_hz / above) ** (2 * _ORDER)))
    level = acceleration.mean()  # a constant adds nothing to the result; without it, the padding makes no step
    return np.asarray(fft.irfft(fft.rfft(acceleration - level, size) * response, size)[:count], dtype=np.float64)
