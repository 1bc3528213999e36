"""Blocks as the network delivers them: putting them into the order in which they were sent, and finding two publishers.

::

    arrive   0 1 3 4 2 5        a block that leaves a hole waits ...
    go on    0 1     2 3 4 5    ... until the missing one is there

    arrive   0 1 3 4 5 6 7      ... or until more than `bound` blocks wait (here 4): then the hole is given up,
    go on    0 1         3…7    and the gate (`models.ingest`) states the gap

Nothing is lost or refused here: refusing is the gate's work. It has to see every block in its place, and repetitions
behind their originals, where they change nothing.

Whether two publishers send::

    arrive   A0 A1 A2 B0 B1 B2        a restart: one run ends, another begins
    arrive   A0 B7 A1 B8 A2 B9 ...    two publishers: each goes on after the other
    arrive   A0 A1 A2 A2'             one number, other samples: somebody is not who he says

Only new blocks count: repetitions come from the network. The blocks do not show which of two publishers is the
machine's, so the conflict is stated, not decided; if a block comes in two versions, neither is used.
"""

import hashlib
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from models.ingest import EARLIER_COURSES, Course
from models.signals.block import SampleBlock


class Arrivals:
    """Puts the blocks of one machine in the order of their sequence, run by run.

    A run begins at sequence 0: if its first blocks are overtaken, the others wait for them. If the stream has run for
    longer, it begins with the first block that arrives. At most `bound` blocks wait for a missing one; 0 hands on
    everything as it comes.

    Examples
    --------
    >>> import numpy as np
    >>> arrivals = Arrivals(20)
    >>> blocks = [SampleBlock(n, n, 1, 1e9, np.zeros((1, 1))) for n in range(4)]
    >>> [[one.sequence for one in arrivals.take(blocks[n])] for n in (0, 2, 3, 1)]
    [[0], [], [], [1, 2, 3]]
    """

    def __init__(self, bound: int) -> None:
        self._bound = bound
        self._run: int | None = None
        self._next = 0
        self._waiting: dict[int, list[SampleBlock]] = {}
        self._courses: deque[Course] = deque(maxlen=EARLIER_COURSES + 1)  # of what has gone on, the present one last

    @property
    def waiting(self) -> int:
        """How many blocks wait, repetitions not counted."""
        return len(self._waiting)

    def take(self, block: SampleBlock) -> tuple[SampleBlock, ...]:
        """Take a block as it arrives, and return those that may go to the gate now, in order.

        Repetitions of blocks that have gone on do so at once and change nothing here; those of waiting blocks follow
        their originals.
        """
        if self._bound == 0 or any(course.covers(block) for course in self._courses):
            return (block,)
        if block.run == self._run and block.sequence >= self._next:
            if block.sequence > self._next or self._waiting:
                return self._place(block)
            self._note(block)
            self._next += 1
            return (block,)
        # Another run, or a count that began anew: the missing blocks of the old one are given up.
        gone_on, known = self.flush(), 0
        if block.run != self._run:
            known = max((course.sequence for course in self._courses if course.run == block.run), default=0)
        self._run = block.run
        self._next = known if known <= block.sequence <= known + self._bound else block.sequence
        return gone_on + self._place(block)

    def withdraw(self, run: int, sequence: int) -> bool:
        """Take back a block, and say whether it waited; its place stays open."""
        return run == self._run and self._waiting.pop(sequence, None) is not None

    def flush(self) -> tuple[SampleBlock, ...]:
        """Hand on everything that waits: the stream is silent, or the recording has ended."""
        found: list[SampleBlock] = []
        while self._waiting:
            self._next = min(self._waiting)
            found += self._continued()
        return tuple(found)

    def resume(self, courses: Iterable[Course]) -> None:
        """Continue after the courses of a restored gate, of which the present one is the last."""
        self._waiting.clear()
        self._courses = deque((*courses,)[-EARLIER_COURSES:], self._courses.maxlen)
        self._run, self._next = (self._courses[-1].run, self._courses[-1].sequence) if self._courses else (None, 0)

    def _place(self, block: SampleBlock) -> tuple[SampleBlock, ...]:
        """Put a block of the present run in its place, and hand on what is complete."""
        copies = self._waiting.setdefault(block.sequence, [])
        if not copies or _digest(copies[0]) != _digest(block):
            copies.append(block)
        elif len(copies) <= self._bound:
            copies.append(copies[0])  # takes no memory, and the gate can count it
        found = self._continued()
        held = sum(len({id(one) for one in copies}) for copies in self._waiting.values())  # blocks in memory
        if held > self._bound:
            self._next = min(self._waiting)
            found += self._continued()
        return tuple(found)

    def _continued(self) -> list[SampleBlock]:
        """Hand on blocks from the next one up to a hole."""
        found: list[SampleBlock] = []
        while (copies := self._waiting.pop(self._next, None)) is not None:
            found += copies
            self._note(copies[0])
            self._next += 1
        return found

    def _note(self, block: SampleBlock) -> None:
        """Remember a block that goes on, so that its repetitions are known."""
        now = self._courses[-1] if self._courses else None
        if now and block.run == now.run and block.sequence >= now.sequence and block.end_ns > now.start_ns:
            self._courses[-1] = now.extended(block)
        else:
            self._courses.append(Course.beginning(block))


_REMEMBERED = 256
_MOST_AHEAD = 64  # most blocks by which a publisher may jump ahead and still be taken for the same one
_MOST_SENDERS = 8
# How often each of two publishers must have gone on after the other: blocks out of order cannot amount to as much.
_RETURNS = 6
_HORIZON_S = 300.0  # length of the data, from all publishers together, in which these are counted


@dataclass(slots=True, eq=False)
class _Sender:
    """Blocks of one publisher: its highest sequence, and when it went on after which other publisher."""

    run: int
    highest: int
    returns: deque[tuple[float, "_Sender"]] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))

    def after(self, other: "_Sender") -> int:
        """How often this publisher has gone on after the other one."""
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
        self._senders: deque[_Sender] = deque(maxlen=_MOST_SENDERS)
        self._latest: _Sender | None = None
        self._heard_s = 0.0
        self._seen: dict[tuple[int, int], tuple[int, int, bytes]] = {}
        self._disputed: dict[tuple[int, int], float] = {}

    def take(self, block: SampleBlock) -> bool:
        """Take note of a block, and say whether it came in two versions: equal run, number and time, other contents."""
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
        if not self._disputed and len(self._senders) < 2:
            return ""
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
            more = f", and {len(self._disputed) - 1} after it" if len(self._disputed) > 1 else ""
            said.append(f"block {sequence} of run {run}{more} arrived in two versions; neither is used")
        return "; ".join(said)

    def _follow(self, block: SampleBlock) -> None:
        """Find the publisher that goes on with this block, and note after which other one it does."""
        for sender in self._senders:
            if sender.run == block.run and -_REMEMBERED <= block.sequence - sender.highest <= _MOST_AHEAD:
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
    digest = hashlib.sha256(head)
    digest.update(np.ascontiguousarray(block.samples).data)
    return digest.digest()[:16]
