"""Access to one machine's recorded or live data in a stretch of time: channels by name, and samples without a gap."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from models.diagnosis.sensors.missing import no_data
from models.errors import MachineFileError, RecordingError, WireError
from models.machine import MachineFile
from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import Channel, ChannelDescriptor, Quantity
from models.signals.keys import MachineKeys
from models.signals.recording import RecordedMessage
from models.signals.wire import decode_block
from service.analysis.revolutions import Excerpt
from service.recordings.replay.source import RecordingSource, clock, parse_moment

_TOLERANCE_S = 2e-4
_RATE_TOLERANCE = 1e-4
_SOON_NS = 10_000_000_000


def begins_again(end_ns: int, start_ns: int) -> bool:
    """Whether data start before the end of those recorded before them: a new run, or the clock was set back."""
    return start_ns < end_ns - _TOLERANCE_S * 1e9


class Described(ABC):
    """Data of one machine whose channels are known."""

    name: str  # ``site/machine``
    place: str  # where the data are, in words, for messages

    @property
    @abstractmethod
    def descriptor(self) -> ChannelDescriptor:
        """Names and units of the channels."""

    @property
    def has_angle(self) -> bool:
        """Whether the shaft angle is measured."""
        return "theta" in self.descriptor.states

    def sent(self, channels: Sequence[Channel]) -> tuple[Channel, ...]:
        """The given channels that have numbers."""
        return tuple(channels)

    @property
    def lacking(self) -> str:
        """Message on channels that have no numbers; empty if all have."""
        there = self.descriptor.channels
        return no_data([one.name for one in there if one not in self.sent(there)])

    def channels(self, names: Sequence[str]) -> tuple[Channel, ...]:
        """Channels by name.

        Raises
        ------
        MachineFileError
            If there is no such channel, or it is the shaft angle; the message lists those that can be plotted.
        """
        there = {channel.name: channel for channel in self.descriptor.channels}
        vibration = [name for name, channel in there.items() if channel.quantity is not Quantity.SHAFT_ANGLE]
        for name in names:
            if name not in vibration:
                what = "is the shaft angle" if name in there else "is not a channel"
                raise MachineFileError(
                    f"--channel is {name!r}, which {what} of {self.name}; expected one of {', '.join(vibration)}"
                )
        return tuple(there[name] for name in dict.fromkeys(names))

    def chosen(self, names: Sequence[str]) -> tuple[Channel, ...]:
        """Channels by name; without names, all of the first quantity measured (displacements before velocities).

        Raises
        ------
        MachineFileError
            If there is no such channel, or only the shaft angle.
        RecordingError
            If a named channel has no numbers, or no channel has.
        """
        asked = self.channels(names)
        there = self.sent(asked or self.descriptor.channels)
        first = min((one.quantity for one in there), key=list(Quantity).index, default=None)  # the shaft angle is last
        if self.lacking and (first in {None, Quantity.SHAFT_ANGLE} or (asked and there != asked)):
            raise RecordingError(f"{self.place}: {self.lacking}")
        return asked or self.channels([one.name for one in there if one.quantity is first])


class Sampled(Described):
    """Samples of one machine over a stretch of time."""

    from_ns: int
    to_ns: int
    end_ns: int  # end of the newest data before `to_ns`

    @property
    @abstractmethod
    def newest(self) -> npt.NDArray[np.floating]:
        """The newest sample of every channel; empty if there is none."""

    @property
    def has_angle(self) -> bool:
        """Whether the shaft angle is measured and has numbers."""
        there = self.descriptor.channels
        return any(one.quantity is Quantity.SHAFT_ANGLE for one in self.sent(there))

    def sent(self, channels: Sequence[Channel]) -> tuple[Channel, ...]:
        """The given channels that have numbers in the newest sample."""
        names, found = [one.name for one in self.descriptor.channels], self.newest
        return tuple(one for one in channels if not found.size or np.isfinite(found[names.index(one.name)]))

    @abstractmethod
    def stretches(
        self, channels: Sequence[Channel], longest_s: float | None = None, from_ns: int | None = None
    ) -> Iterator[Excerpt]:
        """Samples of the given channels, cut at gaps and, if given, after `longest_s`; gaps leave shorter pieces."""

    def latest(self, channels: Sequence[Channel], length_s: float) -> list[Excerpt]:
        """The newest `length_s` of data, in pieces if there are gaps."""
        found: list[Excerpt] = []
        for stretch in self.stretches(channels, from_ns=max(self.from_ns, self.end_ns - round(length_s * 1e9))):
            if found and begins_again(found[-1].end_ns, stretch.start_ns):
                found.clear()
            found.append(stretch)
        return found


class Recorded(Sampled):
    """Recorded data of one machine, from `from_ns` up to, and without, `to_ns`."""

    def __init__(self, source: RecordingSource, keys: MachineKeys, from_ns: int, to_ns: int) -> None:
        self.source, self.keys = source, keys
        self.from_ns, self.to_ns = from_ns, to_ns
        self.name = f"{keys.site}/{keys.machine}"
        self.place = ", ".join(path.name for path in source.paths)
        span = source.span(keys)
        self.end_ns = to_ns if to_ns <= span.end_ns else span.newest_ns

    @classmethod
    def find(
        cls,
        files: Sequence[Path],
        key: str | None,
        between: tuple[str | None, str | None],
        at: str | None = None,
        *,
        reports: bool = False,
    ) -> "Recorded":
        """Find a machine's data in recordings.

        Parameters
        ----------
        key : str or None
            ``SITE/MACHINE``, required if the recordings hold several machines.
        between : (str or None, str or None)
            Start and end, in the notation of `parse_moment`.
        at : str or None
            Time at which the latest data end.
        reports : bool
            Whether to accept a machine of which only reports were recorded.

        Raises
        ------
        MachineFileError
            If a file or time cannot be used, or there is no such machine.
        """
        try:
            source = RecordingSource(files)
        except RecordingError as error:
            raise MachineFileError(str(error)) from error  # a file that cannot be used is exit code 2
        keys = source.machine(key, reports=reports)
        from_ns, to_ns = source.between(*between, keys)
        if at is not None:
            span = source.span(keys)
            at_ns = parse_moment(at, span.start_ns, "--at")
            if at_ns > span.end_ns:
                raise MachineFileError(f"--at {at}: the data end at {clock(span.end_ns)} UTC")
            if not from_ns < at_ns:
                raise MachineFileError(f"--at {at}: nothing was recorded before that, from {between[0] or 0} on")
            to_ns = min(to_ns, at_ns)
        return cls(source, keys, from_ns, to_ns)

    @cached_property
    def descriptor(self) -> ChannelDescriptor:
        """Names and units of the channels.

        Raises
        ------
        RecordingError
            If no channel descriptor was recorded, or it cannot be read.
        """
        key = self.keys.descriptor
        message = self.source.descriptor(self.keys, self.to_ns)
        if message is None:
            raise RecordingError(f"{self.place}: no channel descriptor on {key}, so no channel has a name")
        try:
            return ChannelDescriptor.model_validate_json(message.payload)
        except ValidationError as error:
            raise RecordingError(f"{self.place}: the channel descriptor on {key} cannot be read: {error}") from error

    @cached_property
    def newest(self) -> npt.NDArray[np.floating]:
        """The newest sample of every channel."""
        found = [block for block, _ in self._blocks(max(self.from_ns, self.end_ns - _SOON_NS), [])]
        return found[-1].samples[-1] if found else np.empty(0)

    def messages(self, key: str) -> Iterator[RecordedMessage]:
        """Messages recorded under a key."""
        return self.source.messages({key}, from_ns=self.from_ns, to_ns=self.to_ns)

    def stretches(
        self, channels: Sequence[Channel], longest_s: float | None = None, from_ns: int | None = None
    ) -> Iterator[Excerpt]:
        """Samples of the given channels, see `Sampled`.

        Blocks that cannot be decoded, have other channels or contain a non-finite sample are left out and leave a gap.
        """
        names = [channel.name for channel in self.descriptor.channels]
        columns = [names.index(channel.name) for channel in channels]
        used = [*columns, self.descriptor.states.index("theta")] if self.has_angle else columns
        size = None if longest_s is None else max(1, round(longest_s * self.descriptor.rate_hz))
        pending: list[FloatArray] = []
        start_ns = count = 0
        for block, continues in self._blocks(from_ns, used):
            if pending and not continues:
                yield self._stretch(start_ns, np.concatenate(pending))
                pending, count = [], 0
            # Every block's own start time sets the time base anew, as in the monitor: the device's clock decides.
            start_ns = block.start_ns - round(count * 1e9 / self.descriptor.rate_hz)
            pending.append(block.samples[:, used].astype(np.float64))
            count += pending[-1].shape[0]
            while size is not None and count >= size:
                rows = np.concatenate(pending)
                yield self._stretch(start_ns, rows[:size])
                start_ns += round(size * 1e9 / self.descriptor.rate_hz)
                pending, count = [rows[size:]], count - size
        if count:
            yield self._stretch(start_ns, np.concatenate(pending))

    def _stretch(self, start_ns: int, rows: FloatArray) -> Excerpt:
        samples, angle_rad = (rows[:, :-1], rows[:, -1]) if self.has_angle else (rows, None)
        return Excerpt(start_ns, self.descriptor.rate_hz, samples, angle_rad)

    def _blocks(self, from_ns: int | None, used: list[int]) -> Iterator[tuple[SampleBlock, bool]]:
        """Usable blocks, and whether each continues the one before it."""
        descriptor = self.descriptor
        tolerance_ns = round(max(_TOLERANCE_S, 0.5 / descriptor.rate_hz) * 1e9)
        last: SampleBlock | None = None
        since = self.from_ns if from_ns is None else from_ns
        for message in self.source.messages({self.keys.stream}, from_ns=since, to_ns=self.to_ns):
            try:
                block = decode_block(message.payload, message.attachment, message.encoding)
            except WireError:
                continue
            if (
                block.schema_hash not in {"", descriptor.schema_hash}
                or block.samples.shape[1] != len(descriptor.channels)
                or abs(block.rate_hz / descriptor.rate_hz - 1) > _RATE_TOLERANCE
                or not np.isfinite(block.samples[:, used]).all()
            ):
                continue
            late_ns = 0 if last is None else block.start_ns - last.end_ns
            if last is not None and (block.run == last.run and block.sequence <= last.sequence and late_ns < 0):
                continue  # a repetition
            continues = last is not None and abs(late_ns) <= tolerance_ns
            last = block
            yield block, continues


class Held(Sampled):
    """The newest samples that a monitor holds: one or more consecutive blocks without a gap."""

    def __init__(self, machine: MachineFile, blocks: Sequence[SampleBlock]) -> None:
        self._descriptor = machine.descriptor
        self._excerpt = Excerpt.of_blocks(blocks, machine.descriptor)
        self.name, self.place = machine.title, "the newest samples"
        self.from_ns = self._excerpt.start_ns
        self.to_ns = self.end_ns = self._excerpt.end_ns

    @property
    def descriptor(self) -> ChannelDescriptor:
        """Names and units of the channels."""
        return self._descriptor

    @property
    def newest(self) -> npt.NDArray[np.floating]:
        """The newest sample of every channel."""
        newest: FloatArray = self._excerpt.samples[-1]
        return newest

    def stretches(
        self, channels: Sequence[Channel], longest_s: float | None = None, from_ns: int | None = None
    ) -> Iterator[Excerpt]:
        """Samples of the given channels after their last non-finite sample, cut after `longest_s`."""
        names = [channel.name for channel in self._descriptor.channels]
        columns = [names.index(channel.name) for channel in channels]
        whole = replace(self._excerpt, samples=self._excerpt.samples[:, columns])
        begin = 0 if from_ns is None else max(0, round((from_ns - self.from_ns) / 1e9 * whole.rate_hz))
        lacking = np.flatnonzero(~np.isfinite(whole.samples).all(axis=1))
        begin = max(begin, int(lacking[-1]) + 1 if lacking.size else 0)
        size = len(whole.samples) if longest_s is None else max(1, round(longest_s * whole.rate_hz))
        for first in range(begin, len(whole.samples), size):
            yield whole.part(first, first + size)
