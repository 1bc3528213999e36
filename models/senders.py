"""Who sends a machine's stream: whether two publishers do, and whether one block has come in two versions.

::

    arrive   A0 A1 A2 B0 B1 B2        a restart: one run ends, another begins
    arrive   A0 B7 A1 B8 A2 B9 ...    two publishers: each goes on after the other
    arrive   A0 A1 A2 A2'             one number, other samples: somebody is not who he says

Only what is new counts: a repetition is a matter of the network. Which of two publishers is the machine's nobody can
tell from the blocks, so it is stated, not decided; of a block in two versions neither is believed.
"""

import hashlib
from collections import deque
from dataclasses import dataclass, field
from itertools import combinations

from models.signals.block import SampleBlock

__all__ = ["Senders"]

_REMEMBERED = 256
_AHEAD = 64
"""Blocks by which a publisher may be ahead of what was heard of it, for it to be the same one."""
_MOST = 8
_RETURNS = 6
"""Times that each of two publishers has gone on after the other: more than blocks out of order can amount to."""
_HORIZON_S = 300.0
"""Length of the data that came in, from all, in which these are counted."""


@dataclass(slots=True, eq=False)
class _Sender:
    """A count of blocks that goes on, and when it went on after which other one had."""

    run: int
    highest: int
    returns: deque[tuple[float, "_Sender"]] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))

    def after(self, other: "_Sender") -> int:
        """How often it has gone on after the other one."""
        return sum(before is other for _, before in self.returns)


class Senders:
    """Watches the blocks of one machine as they arrive.

    Examples
    --------
    >>> import numpy as np
    >>> senders = Senders()
    >>> for n in range(8):
    ...     for run in (1, 2):
    ...         _ = senders.take(SampleBlock(n, n, run, 1.0, np.zeros((1, 1))))
    >>> senders.conflict
    'runs 1 and 2 both send'
    """

    def __init__(self) -> None:
        self._senders: deque[_Sender] = deque(maxlen=_MOST)
        self._latest: _Sender | None = None
        self._heard_s = 0.0
        self._seen: dict[tuple[int, int], tuple[int, int, bytes]] = {}
        self._disputed: dict[tuple[int, int], float] = {}

    def take(self, block: SampleBlock) -> bool:
        """Take note of a block that has arrived.

        Returns
        -------
        bool
            Whether it, or an earlier one of its number and time, is another version of the same block.
        """
        self._heard_s += block.samples.shape[0] / block.rate_hz
        self._follow(block)
        key = (block.run, block.sequence)
        version = (block.start_ns, block.end_ns, _digest(block))
        before = self._seen.setdefault(key, version)
        if len(self._seen) > _REMEMBERED:
            del self._seen[next(iter(self._seen))]
        if before == version:
            return key in self._disputed
        if version[0] >= before[1] or before[0] >= version[1]:
            self._seen[key] = version  # another time: the count began anew
            self._disputed.pop(key, None)
            return False
        self._disputed[key] = self._heard_s
        return True

    @property
    def conflict(self) -> str:
        """Who contradicts whom, in words; empty if nobody does."""
        since_s = self._heard_s - _HORIZON_S
        self._disputed = {key: at for key, at in self._disputed.items() if at > since_s}
        for sender in self._senders:
            while sender.returns and sender.returns[0][0] <= since_s:
                sender.returns.popleft()
        said = [
            f"runs {one.run} and {other.run} both send"
            for one, other in combinations(self._senders, 2)
            if min(one.after(other), other.after(one)) >= _RETURNS
        ]
        if self._disputed:
            run, sequence = next(iter(self._disputed))
            count = len(self._disputed)
            said.append(f"{count} blocks came in two versions, block {sequence} of run {run} first; neither is used")
        return "; ".join(said)

    def _follow(self, block: SampleBlock) -> None:
        """Find out who goes on with this block."""
        for sender in self._senders:
            if sender.run == block.run and -_REMEMBERED <= block.sequence - sender.highest <= _AHEAD:
                break
        else:
            sender = _Sender(block.run, block.sequence)
            self._senders.append(sender)
            self._latest = sender
            return
        if block.sequence <= sender.highest:
            return
        sender.highest = block.sequence
        if self._latest is not None and self._latest is not sender:
            sender.returns.append((self._heard_s, self._latest))
            self._latest = sender


def _digest(block: SampleBlock) -> bytes:
    head = repr((block.start_ns, block.rate_hz, block.samples.shape, block.samples.dtype.str)).encode()
    return hashlib.blake2b(head + block.samples.tobytes(), digest_size=16).digest()
