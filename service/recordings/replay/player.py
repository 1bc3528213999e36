"""Plays recorded messages, at their recorded pace or another one, to a function that takes them."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from models.signals.recording import RecordedMessage
from rotorwatch.records.replays import ReplayProgress
from service.recordings.replay.control import Control
from service.recordings.replay.data_time import place_of
from service.recordings.replay.source import RecordingSource

_LONGEST_PAUSE_NS = 3600 * 10**9
_MOST_LATE_BLOCKS = 10


@dataclass(frozen=True, slots=True)
class PlayPlan:
    """What is replayed, and how fast."""

    keys: Collection[str] | None  # only these keys; None is everything
    pace: float | None  # seconds of data per second; None is as fast as they are taken
    # Times of the data: from `from_ns` up to, and without, `to_ns`.
    from_ns: int
    to_ns: int
    pass_number: int = 1  # which repetition this is, from 1


def play(
    source: RecordingSource,
    put: Callable[[RecordedMessage], None],
    plan: PlayPlan,
    control: Control,
    on_progress: Callable[[ReplayProgress], None] = lambda _: None,
) -> int:
    """Pass the messages of one pass to `put`, byte for byte, until its end or until `control` says stop.

    The time between messages is that between their data, divided by the pace. After a seek, after a pause of more than
    an hour, or where data are earlier than those before, the replay goes on at once.

    Raises
    ------
    RecordingError
        Where a recording is damaged.
    """
    count = 0
    begin_ns: int | None = plan.from_ns

    def tell(at_ns: int) -> None:
        done = (at_ns - plan.from_ns) / max(1, plan.to_ns - 1 - plan.from_ns)
        on_progress(
            ReplayProgress(
                fraction=min(1.0, max(0.0, done)),
                position_ns=at_ns,
                messages=count,
                windows=0,
                alarms=0,
                pass_number=plan.pass_number,
                paused=control.paused,
            )
        )

    control.at(plan.from_ns)
    while begin_ns is not None:
        timetables: dict[str, _Timetable] = {}
        for time_ns, message in source.timed(plan.keys, from_ns=begin_ns, to_ns=plan.to_ns):
            due_s: float | None = None
            if plan.pace is not None:
                machine = timetables.setdefault(place_of(message.key), _Timetable(plan.pace, time_ns, control.now_s()))
                due_s = machine.due_s(time_ns)
            if not control.wait_until(due_s, lambda: tell(control.position_ns)):
                break
            control.at(time_ns)
            put(message)
            count += 1
            tell(time_ns)
        else:
            if control.paused:
                control.wait_until(None, lambda: tell(control.position_ns))  # whoever paused may still go back
        if control.stopped:
            break
        seek_ns = control.take_seek()
        begin_ns = None if seek_ns is None else min(max(seek_ns, plan.from_ns), plan.to_ns)
        if begin_ns is not None:
            control.at(begin_ns)
            tell(begin_ns)
    if not control.stopped:
        tell(plan.to_ns - 1)
    return count


class _Timetable:
    """When the messages of one machine are due."""

    def __init__(self, pace: float, start_ns: int, start_s: float) -> None:
        self._pace = pace
        self._front_ns, self._due_s = start_ns, start_s
        self._late_blocks = 0

    def due_s(self, time_ns: int) -> float:
        """When a message with this time of the data is due, as `Control.now_s` counts."""
        ahead_ns = time_ns - self._front_ns
        # A few blocks that come again, or late, do not set the time back; more than `_MOST_LATE_BLOCKS` in a row do.
        self._late_blocks = self._late_blocks + 1 if ahead_ns < 0 else 0
        if 0 < ahead_ns <= _LONGEST_PAUSE_NS:
            self._due_s += ahead_ns / 1e9 / self._pace
        if ahead_ns > 0 or self._late_blocks > _MOST_LATE_BLOCKS:
            self._front_ns = time_ns
        return self._due_s
