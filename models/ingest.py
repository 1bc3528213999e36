"""The gate: every block is accepted or refused here, in one place, with a reason. Refusal is a value, not an exception.

::

    contiguous in time and sequence ........................ accept
    later than expected, or the publisher restarted ........ accept, gap reported
    anything else .......................................... refuse, with a reason and a sentence

Time comes from the blocks alone. Blocks of another time (earlier, or far ahead) are believed after a number of
consecutive ones that agree with each other; until then they are refused and counted. If they are of a new run, the
publisher was started anew; if not, its clock was set.

A repetition changes nothing but the count of refused blocks, whenever it comes: the gate remembers the courses of the
stream, also those of earlier runs and from before a clock was set, and those it did not believe.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from models.checkpoint import checked
from models.errors import CheckpointError, WireError
from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.wire import ARROW_ENCODING, decode_block, may_be_block

EARLIER_COURSES = 64  # courses that are remembered, so that repetitions of their blocks are known as such
# The year 2200: a clock that says more is broken, and times beyond 2262 fit nowhere.
_LATEST_NS = 7_258_118_400_000_000_000
_LARGEST = 1e30  # sample; larger ones, as of numbers in another byte order, overflow in levels and spectra
_MANY_S = 999_999.0
_SURELY_S = 1.0  # a block that is next in sequence but later than this has a wrong time rather than a gap before it


def lasting(seconds: float) -> str:
    """A time in words: in days where seconds would have an exponent.

    Examples
    --------
    >>> lasting(12.5), lasting(2846490.0)
    ('12.5 s', '32.9 days')
    """
    return f"{seconds:.6g} s" if abs(seconds) < _MANY_S else f"{seconds / 86_400.0:.1f} days"


class Reason(StrEnum):
    """Why a block was refused."""

    MALFORMED = "malformed"
    CHANNELS = "channels"
    RATE = "rate"
    SHAPE = "shape"
    NOT_FINITE = "not-finite"
    OVERLAP = "overlap"
    SEQUENCE = "sequence"
    PAST = "past"
    FUTURE = "future"
    CONFLICT = "conflict"


@dataclass(frozen=True, slots=True)
class Admission:
    """What became of a block."""

    reason: Reason | None = None  # why it was refused; None if it was accepted
    text: str = ""  # a sentence naming machine, field, value and expectation; empty if there is nothing to say
    gap_s: float = 0.0  # seconds of data missing before an accepted block (0 = contiguous)
    clock_step_s: float = 0.0  # step of the data's time at this block, s, of either sign
    new_run: bool = False  # whether the cause of that step is a restart of the publisher, and not a clock that was set
    new_snapshot: bool = False  # whether the block begins a snapshot, after the silence that was to be expected

    @property
    def accepted(self) -> bool:
        """Whether the samples may be used."""
        return self.reason is None

    @property
    def continuous(self) -> bool:
        """Whether the samples continue the previous block."""
        return self.accepted and not self.text


@dataclass(frozen=True, slots=True)
class Course:
    """Blocks of one run in which sequence and time went on together: what was received, and what comes next."""

    run: int
    # Sequence and time of its first block.
    first: int
    first_ns: int
    # What the next block should start with.
    sequence: int
    start_ns: int

    @classmethod
    def beginning(cls, block: SampleBlock) -> "Course":
        """A course of one block."""
        return cls(block.run, block.sequence, block.start_ns, block.sequence + 1, block.end_ns)

    def extended(self, block: SampleBlock) -> "Course":
        """Return the course up to the end of a later block."""
        return Course(self.run, self.first, self.first_ns, block.sequence + 1, block.end_ns)

    def covers(self, block: SampleBlock) -> bool:
        """Whether a block lies within: it was received, or its place has been passed over."""
        return (
            block.run == self.run
            and self.first <= block.sequence < self.sequence
            and self.first_ns <= block.start_ns < self.start_ns
        )


class Gate:
    """Judges the blocks of one machine in the order of their arrival.

    With `partial`, blocks are accepted in which some channels, but not all, have no finite number at all: their sensors
    are not connected. Where single numbers are missing, samples have been lost, and the block is refused.
    """

    def __init__(self, machine: MachineFile, *, partial: bool = False) -> None:
        self._partial = partial
        self._name = machine.title
        self._settings = machine.ingest
        self._rate_hz = machine.rate_hz
        self._channels = [channel.name for channel in machine.sensors]
        self._schema_hash = machine.descriptor.schema_hash
        self._most_samples = math.ceil(machine.ingest.block_to_s * machine.rate_hz * 1.1)
        self._tolerance_ns = round(machine.ingest.time_tolerance_s * 1e9)
        self._schedule = machine.schedule
        self._expected: Course | None = None
        self._candidate: Course | None = None
        self._earlier: deque[Course] = deque(maxlen=EARLIER_COURSES)
        self._refused: deque[Course] = deque(maxlen=EARLIER_COURSES)
        self._before_restart: list[Course] = []

    @property
    def courses(self) -> tuple[Course, ...]:
        """What was accepted, the present course last; empty before the first block."""
        return (*self._earlier, *(() if self._expected is None else (self._expected,)))

    def knows(self, block: SampleBlock) -> bool:
        """Whether a block's place is among those that were received or passed over."""
        return any(course.covers(block) for course in self.courses)

    def begin(self) -> None:
        """Mark all courses known so far as received before a restart, see `had`."""
        self._before_restart = [*self.courses]

    def had(self, block: SampleBlock) -> bool:
        """Whether a block that was received before a restart comes again for the first time.

        A publisher's cache sends each block once more when it is asked. Further repetitions are refused.
        """
        for number, course in enumerate(self._before_restart):
            if course.covers(block):
                self._before_restart[number] = replace(course, first=block.sequence + 1, first_ns=block.end_ns)
                return True
        return False

    def is_newest(self, block: SampleBlock) -> bool:
        """Whether the block is the latest one received."""
        expected = self._expected
        return expected is not None and expected.covers(block) and block.sequence == expected.sequence - 1

    def could_use(self, payload: bytes, attachment: bytes, encoding: str, *, size_alone: bool = False) -> bool:
        """Whether a message may be one of the machine's blocks, whatever its time; in Arrow by its size alone.

        Takes microseconds and changes nothing: any thread may ask.
        """
        if not may_be_block(payload, attachment, encoding, len(self._channels), self._most_samples):
            return False
        if size_alone or encoding.startswith(ARROW_ENCODING):
            return True
        try:
            return self.form(decode_block(payload, attachment, encoding)) is None
        except WireError:
            return False

    def judge(self, block: SampleBlock, *, formed: bool = False) -> Admission:
        """Accept or refuse a block; `formed` if its `form` has been found right before."""
        return (None if formed else self.form(block)) or self._place(block)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything that is remembered, as named arrays."""
        return {
            "courses": _course_array(self.courses),
            "candidate": _course_array(() if self._candidate is None else (self._candidate,)),
            "refused": _course_array(tuple(self._refused)),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on where `checkpoint` was called; arrays that are not a gate's change nothing."""
        courses, candidates, refused = (_courses(arrays, name) for name in ("courses", "candidate", "refused"))
        self._expected = courses[-1] if courses else None
        self._earlier = deque(courses[:-1], maxlen=EARLIER_COURSES)
        self._refused = deque(refused, maxlen=EARLIER_COURSES)
        self._candidate = candidates[-1] if candidates else None

    def _refuse(self, reason: Reason, text: str) -> Admission:
        return Admission(reason, f"{self._name}: {text}")

    def form(self, block: SampleBlock) -> Admission | None:  # noqa: PLR0911  # one return per reason
        """Refuse a block whose form is wrong, whatever its time."""
        settings, channels, which = self._settings, self._channels, f"block {block.sequence}"
        n_samples, n_channels = block.samples.shape
        if block.schema_hash and block.schema_hash != self._schema_hash:
            text = f"the stream's channel descriptor has hash {block.schema_hash}, expected {self._schema_hash}"
            return self._refuse(Reason.CHANNELS, f"{text} for channels {', '.join(channels)}")
        if n_channels != len(channels):
            text = f"{which} has {n_channels} channels, expected {len(channels)} ({', '.join(channels)})"
            return self._refuse(Reason.CHANNELS, text)
        if abs(block.rate_hz / self._rate_hz - 1) > settings.rate_tolerance:
            return self._refuse(Reason.RATE, f"{which} has rate_hz {block.rate_hz:g}, expected {self._rate_hz:g}")
        if not 0 <= block.start_ns < _LATEST_NS:
            text = f"start_ns of {which} is {block.start_ns}, expected a time from 1970 to 2199"
            return self._refuse(Reason.MALFORMED, text)
        length_s = n_samples / self._rate_hz
        if not settings.block_from_s <= length_s <= settings.block_to_s:
            expected = f"{settings.block_from_s:g} to {settings.block_to_s:g} s"
            return self._refuse(Reason.SHAPE, f"{which} has {n_samples} samples ({length_s:g} s), expected {expected}")
        usable = np.abs(block.samples) <= _LARGEST
        if usable.all():
            return None
        if self._partial and usable.any():
            usable |= ~np.isfinite(block.samples).any(axis=0)
        if not usable.all():
            row, column = (int(where) for where in np.argwhere(~usable)[0])
            found = block.samples[row, column]
            most = f" up to {_LARGEST:g}; are the bytes in little-endian order?" if np.isfinite(found) else ""
            what = f"sample {row} is {found}, expected a finite number{most}"
            return self._refuse(Reason.NOT_FINITE, f"{which}, channel {channels[column]}: {what}")
        return None

    def _place(self, block: SampleBlock) -> Admission:  # noqa: PLR0911  # one return per case of the table
        """Accept a well-formed block if its time and sequence make sense."""
        expected, schedule, which = self._expected, self._schedule, f"block {block.sequence}"
        if expected is None:
            self._follow(block)
            return Admission()
        if any(course.covers(block) for course in self._earlier):
            text = f"{which} of run {block.run} was received before the publisher restarted or its clock was set"
            return self._refuse(Reason.OVERLAP, f"{text}: a repetition")
        if any(course.covers(block) for course in self._refused):
            return self._refuse(Reason.OVERLAP, f"{which} was refused before: a repetition")
        late_ns, restarted = block.start_ns - expected.start_ns, block.run != expected.run
        missed = 0 if restarted else block.sequence - expected.sequence
        if abs(late_ns) <= self._tolerance_ns:
            if missed:
                text = f"sequence is {block.sequence} in a block that continues the previous one in time, expected "
                return self._resynchronise(block, Reason.SEQUENCE, text + str(expected.sequence))
            self._follow(block)
            return Admission(text=f"{self._name}: the publisher restarted") if restarted else Admission()
        late_s = late_ns / 1e9
        if schedule is not None and schedule.is_silence(late_s) and not missed:
            self._follow(block)
            return Admission(new_snapshot=True)
        start, if_it_stays = f"start_ns {block.start_ns}", "accepted if the clock stays there"
        if late_ns < 0:
            if missed < 0:
                before = f"{lasting(-late_s)} before the end of block {expected.sequence - 1}"
                return self._refuse(Reason.OVERLAP, f"{which} starts {before}: a repetition or out of order")
            text = f"{start} of {which} lies {lasting(-late_s)} before what was already received; {if_it_stays}"
            return self._resynchronise(block, Reason.PAST, text)
        if late_s > self._settings.max_jump_s:
            most = f"expected at most {self._settings.max_jump_s:g} s"
            text = f"{start} of {which} lies {lasting(late_s)} ahead, {most}; {if_it_stays}"
            return self._resynchronise(block, Reason.FUTURE, text)
        if not restarted and not missed and late_s > _SURELY_S and schedule is None:
            text = f"{start} lies {lasting(late_s)} ahead although {which} is the next one; {if_it_stays}"
            return self._resynchronise(block, Reason.FUTURE, text)
        what = "the publisher restarted and " if restarted else ""
        blocks = f" ({missed} blocks)" if missed > 0 else ""
        self._follow(block)
        if schedule is not None and late_s > schedule.silence_s:
            gap_s = late_s - schedule.silence_s
            count = max(1, round(gap_s / schedule.every_s))
            missing = "a snapshot is missing" if count == 1 else f"{count} snapshots are missing"
            text = f"{self._name}: {what}{missing}, {lasting(gap_s)}{blocks}"
            return Admission(text=text, gap_s=gap_s, new_snapshot=True)
        return Admission(text=f"{self._name}: {what}{lasting(late_s)} of data are missing{blocks}", gap_s=late_s)

    def _resynchronise(self, block: SampleBlock, reason: Reason, text: str) -> Admission:
        """Refuse, unless enough consecutive blocks agree that this is where the stream is now."""
        candidate = self._candidate
        if candidate is not None and candidate.covers(block):
            return self._refuse(reason, f"{text}; a repetition")
        if (
            candidate is None
            or block.run != candidate.run
            or block.sequence != candidate.sequence
            or abs(block.start_ns - candidate.start_ns) > self._tolerance_ns
        ):
            self._refuse_candidate()
            candidate = Course.beginning(block)
        else:
            candidate = candidate.extended(block)
        self._candidate = candidate
        if candidate.sequence - candidate.first < self._settings.resync_blocks:
            return self._refuse(reason, text)
        previous = self._expected
        step_s = 0.0 if previous is None else (block.start_ns - previous.start_ns) / 1e9
        new_run = candidate.run not in {course.run for course in self.courses}
        self._candidate = None
        self._change_course(candidate)
        text = f"the stream's clock stepped by {lasting(step_s)}; following it"
        if new_run:
            when = "earlier" if step_s < 0 else "later"
            text = f"the publisher restarted, {lasting(abs(step_s))} {when} in data time"
        return Admission(text=f"{self._name}: {text}", clock_step_s=step_s, new_run=new_run)

    def _follow(self, block: SampleBlock) -> None:
        expected = self._expected
        if expected is not None and block.run == expected.run and block.sequence >= expected.sequence:
            self._expected = expected.extended(block)
        else:
            self._change_course(Course.beginning(block))
        self._refuse_candidate()

    def _refuse_candidate(self) -> None:
        """Give up the course that the clock might have been set to."""
        if self._candidate is not None:
            self._refused.append(self._candidate)
            self._candidate = None

    def _change_course(self, course: Course) -> None:
        """Follow another course than before."""
        if self._expected is not None:
            self._earlier.append(self._expected)
        self._expected = course


def _course_array(courses: tuple[Course, ...]) -> np.ndarray:
    """Courses row by row, as text: a sequence may be any whole number."""
    rows = [[str(one.run), str(one.first), str(one.first_ns), str(one.sequence), str(one.start_ns)] for one in courses]
    return np.array(rows, dtype=np.str_).reshape(-1, 5)


def _courses(arrays: Mapping[str, np.ndarray], name: str) -> tuple[Course, ...]:
    rows: list[list[str]] = checked(arrays, name, np.str_, (None, 5)).tolist()
    try:
        return tuple(Course(*map(int, row)) for row in rows)
    except ValueError as error:
        raise CheckpointError(f"{name} of the gate: {error}") from error
