"""Channels without numbers: their sensors are not connected, and the data acquisition sends NaN for them.

The other channels remain usable. Zeros replace the NaN so that computations can go on; every window that contains some
of them reports the channel as a finding, and its data are not used there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from models.checkpoint import checked
from models.diagnosis.sensors.reference import Naming
from models.signals.block import SampleBlock
from models.signals.channels import Channel, state_name
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault


def completed(block: SampleBlock) -> SampleBlock:
    """Replace the channels without numbers in an accepted block by 0; when recalled, it gives the same window."""
    there = np.isfinite(block.samples[0])  # in an accepted block, a channel has all of its samples or none
    return block if there.all() else replace(block, samples=np.where(there, block.samples, block.samples.dtype.type(0)))


def no_data(names: Sequence[str]) -> str:
    """Text that names the channels without numbers; empty if there are none.

    Examples
    --------
    >>> no_data(["y1", "z1"])
    'no data of y1, z1: sent as NaN, not connected'
    """
    return f"no data of {', '.join(names)}: sent as NaN, not connected" if names else ""


class MissingNumbers:
    """Remembers when channels, given in the order of a block's columns, had no numbers."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._states, self._naming = [state_name(channel) for channel in channels], Naming(channels)
        # (2, n_channels), start and end of each channel's newest stretch without numbers; -1 if there is none.
        self._times_ns = np.full((2, len(self._states)), -1, dtype=np.int64)
        self._newest_ns = -1  # newest end of them all

    def take(self, block: SampleBlock) -> SampleBlock:
        """Record which channels of a block have no numbers, and return it `completed`."""
        if self._newest_ns > block.end_ns:  # the clock was set back: forget what is later
            self._times_ns[:, self._times_ns[1] > block.end_ns] = -1
            self._newest_ns = int(self._times_ns.max())
        there = np.isfinite(block.samples[0])
        if there.all():
            return block
        lost = ~there
        apart_ns = np.abs(self._times_ns[1] - block.start_ns)  # not exactly 0 if a device counts its own time
        begun = lost & (apart_ns > (block.end_ns - block.start_ns) // 2)
        self._times_ns[0, begun], self._times_ns[1, lost] = block.start_ns, block.end_ns
        self._newest_ns = block.end_ns
        return completed(block)

    def found(self, start_ns: int, end_ns: int) -> tuple[SensorFault, ...]:
        """Channels that lacked numbers in a window, which may end within the latest block."""
        findings = []
        for state, first_ns, last_ns in zip(self._states, *self._times_ns.tolist(), strict=True):
            if start_ns < last_ns and first_ns < end_ns:
                lost_s = (min(last_ns, end_ns) - max(first_ns, start_ns)) / 1e9
                text = (
                    f"{self._naming.name(state)}: sent as NaN, the last time for {lost_s:.3g} s, expected numbers: its "
                    "sensor is not connected"
                )
                findings.append(SensorFault(states=(state,), kind=FaultKind.MISSING, text=text, value=lost_s))
        return tuple(findings)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """The complete state as named arrays."""
        return {"times_ns": self._times_ns}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the state that `checkpoint` returned."""
        self._times_ns = checked(arrays, "times_ns", np.int64, self._times_ns.shape).copy()
        self._newest_ns = int(self._times_ns.max(initial=-1))
