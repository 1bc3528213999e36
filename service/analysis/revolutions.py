"""Samples without a gap, and the revolutions of the shaft in them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import ChannelDescriptor


@dataclass(frozen=True, slots=True)
class Excerpt:
    """Consecutive samples of some channels, in the units of the channels."""

    start_ns: int  # acquisition time of the first sample
    rate_hz: float
    samples: FloatArray  # (n_samples, n_channels)
    angle_rad: FloatArray | None  # (n_samples,), shaft angle; None if it is not measured

    @property
    def length_s(self) -> float:
        """Duration."""
        return float(self.samples.shape[0] / self.rate_hz)

    @property
    def end_ns(self) -> int:
        """Acquisition time of the sample after the last one."""
        return self.start_ns + round(self.length_s * 1e9)

    @property
    def speed_rad_s(self) -> float:
        """Mean speed, negative if the shaft turns from z to y; NaN without a shaft angle."""
        if self.angle_rad is None or self.angle_rad.size < 2:
            return float("nan")
        whole = np.unwrap(self.angle_rad)
        return float((whole[-1] - whole[0]) / (whole.size - 1) * self.rate_hz)

    def part(self, first: int, end: int) -> "Excerpt":
        """Samples from `first` up to, and without, `end`."""
        return Excerpt(
            self.start_ns + round(first / self.rate_hz * 1e9),
            self.rate_hz,
            self.samples[first:end],
            None if self.angle_rad is None else self.angle_rad[first:end],
        )

    @classmethod
    def of_blocks(cls, blocks: Sequence[SampleBlock], described: ChannelDescriptor) -> "Excerpt":
        """All columns of consecutive blocks, starting after the latest sample whose shaft angle is not finite."""
        samples, states = np.concatenate([block.samples for block in blocks]).astype(np.float64), described.states
        start_ns = blocks[-1].end_ns - round(samples.shape[0] / described.rate_hz * 1e9)
        angle_rad = samples[:, states.index("theta")] if "theta" in states else None
        if angle_rad is None or not np.isfinite(angle_rad[-1]):  # its sensor is not connected
            return cls(start_ns, described.rate_hz, samples, None)
        lost = np.flatnonzero(~np.isfinite(angle_rad))
        whole = cls(start_ns, described.rate_hz, samples, angle_rad)
        return whole.part(int(lost[-1]) + 1, len(samples)) if lost.size else whole


@dataclass(frozen=True, slots=True)
class Revolutions:
    """Samples of whole revolutions."""

    reason: str  # why there are none, or fewer than asked for
    excerpt: Excerpt | None = None  # None if there is no whole revolution
    count: int = 0
    # (count + 1,), positions of shaft angle 0, in samples from the first; empty if the angle is not measured.
    pulses: FloatArray = field(default_factory=lambda: np.empty(0))


def pulses(angle_rad: npt.NDArray[np.floating] | None) -> tuple[int, FloatArray]:
    """Direction of rotation (1 if the angle grows, -1 if it falls), and positions at which the shaft angle passes 0.

    Positions are in samples from the first, interpolated, shape (n_pulses,); empty without an angle.
    """
    if angle_rad is None or angle_rad.size < 2:
        return 1, np.empty(0)
    whole = np.unwrap(angle_rad)
    direction = 1 if whole[-1] >= whole[0] else -1
    onwards = np.maximum.accumulate(direction * whole)  # noise on the angle must not count a pulse twice
    turns = np.arange(np.ceil(onwards[0] / (2 * np.pi)), np.floor(onwards[-1] / (2 * np.pi)) + 1)
    return direction, np.asarray(np.interp(turns * 2 * np.pi, onwards, np.arange(onwards.size)))


def newest_revolutions(
    excerpt: Excerpt, wanted: int, speed_rad_s: float | None = None, most_samples: int | None = None
) -> Revolutions:
    """Cut the newest revolutions out of samples.

    Parameters
    ----------
    wanted : int
        Number of revolutions; fewer are returned if there are fewer, or if they have more than `most_samples`.
    speed_rad_s : float, optional
        Mean speed, from which the length of a revolution is computed if there is no shaft angle.
    """
    size, rate_hz = excerpt.samples.shape[0], excerpt.rate_hz
    reason = ""
    if excerpt.angle_rad is not None:
        at = pulses(excerpt.angle_rad)[1]
        whole = max(0, at.size - 1)
    elif speed_rad_s is not None and np.isfinite(speed_rad_s) and speed_rad_s != 0:
        each = 2 * np.pi / abs(speed_rad_s) * rate_hz
        whole = int((size - 1) // each)
        at = size - 1 - each * np.arange(whole, -1, -1)
        reason = "the shaft angle is not measured: revolutions are as long as at the mean speed, and begin anywhere"
    else:
        return Revolutions("neither the shaft angle nor the speed is known, so no revolution can be told")
    if not whole:
        return Revolutions(f"the newest {excerpt.length_s:.3g} s of samples without a gap hold no whole revolution")
    fit = whole if most_samples is None else int(np.count_nonzero(at[-1] - at[:-1] < most_samples))
    count = min(wanted, whole, fit)
    if count < wanted:
        limit = f"{excerpt.length_s:.3g} s of samples without a gap" if whole <= fit else f"{most_samples} samples"
        reason = "; ".join(filter(None, (f"{count} of {wanted} revolutions: there are {limit} at most", reason)))
    if not count:
        return Revolutions(f"one revolution is longer than {most_samples} samples")
    marks = at[-1 - count :]
    first, last = int(np.floor(marks[0])), int(np.ceil(marks[-1]))
    seen = np.asarray(marks - first if excerpt.angle_rad is not None else np.empty(0), dtype=np.float64)
    return Revolutions(reason, excerpt.part(first, last + 1), count, seen)
