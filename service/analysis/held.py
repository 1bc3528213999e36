"""The newest samples of a live machine, as a stretch of data like any that was recorded."""

from collections.abc import Iterator, Sequence

from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.channels import Channel, ChannelDescriptor
from service.analysis.recorded import Sampled
from service.analysis.revolutions import Excerpt


class Held(Sampled):
    """What a monitor holds of the newest samples.

    Parameters
    ----------
    blocks : sequence of SampleBlock
        At least one, without a gap between them.
    """

    def __init__(self, machine: MachineFile, blocks: Sequence[SampleBlock]) -> None:
        self._descriptor = machine.descriptor
        self._excerpt = Excerpt.of_blocks(blocks, machine.rate_hz, None)
        self.name, self.place = f"{machine.site}/{machine.name}", "the newest samples"
        self.from_ns, self.to_ns = self._excerpt.start_ns, self._excerpt.end_ns

    @property
    def descriptor(self) -> ChannelDescriptor:
        """Names and units of the channels."""
        return self._descriptor

    def stretches(
        self, channels: Sequence[Channel], longest_s: float | None = None, from_ns: int | None = None
    ) -> Iterator[Excerpt]:
        """Samples of some channels, cut after `longest_s`."""
        names = [channel.name for channel in self._descriptor.channels]
        columns = [names.index(channel.name) for channel in channels]
        rows = self._excerpt.samples
        angle = rows[:, self._descriptor.states.index("theta")] if self.has_angle else None
        whole = Excerpt(self.from_ns, self._excerpt.rate_hz, rows[:, columns], angle)
        begin = 0 if from_ns is None else max(0, round((from_ns - self.from_ns) / 1e9 * whole.rate_hz))
        size = len(rows) if longest_s is None else max(1, round(longest_s * whole.rate_hz))
        for first in range(begin, len(rows), size):
            yield whole.part(first, first + size)

    def latest(self, channels: Sequence[Channel], length_s: float) -> list[Excerpt]:
        """The newest `length_s`."""
        return list(self.stretches(channels, from_ns=self.to_ns - round(length_s * 1e9)))
