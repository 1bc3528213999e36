"""The newest whole revolutions of a live stream, sample by sample."""

from dataclasses import dataclass

import numpy as np

from models.machine import MachineFile
from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import Channel
from service.analysis.snapshots.channels import SnapshotError
from service.analysis.snapshots.revolutions import pulses

MOST_REVOLUTIONS = 64
_MOST_SAMPLES = 20_000


@dataclass(frozen=True, slots=True)
class NewestPath:
    """Consecutive samples of whole revolutions.

    Attributes
    ----------
    samples : ndarray, shape (n_samples, n_channels)
        As streamed.
    start_ns : int or None
        Time of the first sample; None without samples.
    pulses_s : ndarray, shape (n_pulses,)
        When the shaft angle was 0, after `start_ns`.
    reason : str
        Why there are none, or fewer than asked for.
    """

    machine: MachineFile
    samples: FloatArray
    rate_hz: float
    start_ns: int | None
    revolutions: int
    pulses_s: FloatArray
    reason: str

    def values_si(self, channel: Channel) -> FloatArray:
        """Samples of one channel, SI."""
        column = [one.name for one in self.machine.sensors].index(channel.name)
        return np.asarray(self.samples[:, column] * channel.to_si, dtype=np.float64)


def newest_path(
    machine: MachineFile, blocks: tuple[SampleBlock, ...], revolutions: int, speed_rad_s: float | None
) -> NewestPath:
    """Cut the newest revolutions out of the newest blocks.

    Parameters
    ----------
    blocks : tuple of SampleBlock
        Without a gap.
    revolutions : int
        How many are wanted; fewer are taken where there are not so many, or too many samples in them.
    speed_rad_s : float or None
        Mean speed: how long they are where there is no shaft angle.

    Raises
    ------
    SnapshotError
        If `revolutions` is negative or above `MOST_REVOLUTIONS`.
    """
    place = f"{machine.site}/{machine.name}"
    if not 0 <= revolutions <= MOST_REVOLUTIONS:
        raise SnapshotError(f"{place}: revolutions is {revolutions}, expected 0 to {MOST_REVOLUTIONS}")
    rate_hz = machine.rate_hz
    if not revolutions:
        return _none(machine, "none were asked for")
    if not blocks:
        return _none(machine, "no samples have come in")
    samples = np.concatenate([block.samples for block in blocks]).astype(np.float64)
    start_ns = blocks[-1].end_ns - round(samples.shape[0] / rate_hz * 1e9)
    held_s = samples.shape[0] / rate_hz
    if "theta" in machine.descriptor.states:
        at = pulses(samples[:, machine.descriptor.states.index("theta")])[1]
        whole = max(0, at.size - 1)
        reason = ""
    elif speed_rad_s is not None and np.isfinite(speed_rad_s) and speed_rad_s != 0:
        each = 2 * np.pi / abs(speed_rad_s) * rate_hz
        whole = int((samples.shape[0] - 1) // each)
        at = samples.shape[0] - 1 - each * np.arange(whole, -1, -1)
        reason = "the shaft angle is not measured: revolutions are as long as at the mean speed, and begin anywhere"
    else:
        return _none(machine, "neither the shaft angle nor the speed is known, so no revolution can be told")
    if not whole:
        return _none(machine, f"the newest {held_s:.3g} s of samples without a gap hold no whole revolution")
    fit = int(np.count_nonzero(at[-1] - at[:-1] < _MOST_SAMPLES))
    shown = min(revolutions, whole, fit)
    if shown < revolutions:
        limit = f"{held_s:.3g} s of samples without a gap" if whole <= fit else f"{_MOST_SAMPLES} samples"
        reason = "; ".join(filter(None, (f"{shown} of {revolutions} revolutions: there are {limit} at most", reason)))
    if not shown:
        return _none(machine, f"one revolution is longer than {_MOST_SAMPLES} samples")
    marks = at[-1 - shown :]
    first, last = int(np.floor(marks[0])), int(np.ceil(marks[-1]))
    has_marks = "theta" in machine.descriptor.states
    return NewestPath(
        machine=machine,
        samples=samples[first : last + 1],
        rate_hz=rate_hz,
        start_ns=start_ns + round(first / rate_hz * 1e9),
        revolutions=shown,
        pulses_s=np.asarray((marks - first) / rate_hz if has_marks else np.empty(0), dtype=np.float64),
        reason=reason,
    )


def _none(machine: MachineFile, reason: str) -> NewestPath:
    empty = np.empty((0, len(machine.sensors)))
    return NewestPath(machine, empty, machine.rate_hz, None, 0, np.empty(0), reason)
