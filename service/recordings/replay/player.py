"""Plays recorded messages, at their recorded pace or another one, and obeys orders from another thread meanwhile."""

import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass

from models.signals.recording import RecordedMessage
from rotorwatch.records.replays import ReplayProgress
from service.recordings.replay.source import RecordingSource, place_of

_LONGEST_PAUSE_NS = 3600 * 10**9
_MOST_LATE_BLOCKS = 10
# The main thread must wake up now and then: Python runs signal handlers nowhere else.
_SLICE_S = 0.25


class Control:
    """Orders to a running replay; safe to use from several threads.

    The thread that replays calls `wait_until` before each message, and `take_seek` afterwards.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._paused_since_s: float | None = None
        self._paused_total_s = 0.0
        self.stopped = False  # whether the replay is to end
        self.reason = ""  # why it is to end, if that needs saying
        self._seek_ns: int | None = None
        self.position_ns = 0  # where the replay is

    @property
    def paused(self) -> bool:
        """Whether the replay is paused."""
        return self._paused_since_s is not None

    def now_s(self) -> float:
        """Seconds of a clock that stands still while the replay is paused."""
        since_s = self._paused_since_s
        return (time.monotonic() if since_s is None else since_s) - self._paused_total_s

    def stop(self, reason: str = "") -> None:
        """End the replay; the first reason given is kept."""
        with self._changed:
            self.reason = self.reason or reason
            self.stopped = True
            self._changed.notify_all()

    def pause(self) -> None:
        """Wait before the next message."""
        with self._changed:
            if self._paused_since_s is None:
                self._paused_since_s = time.monotonic()
            self._changed.notify_all()

    def resume(self) -> None:
        """Go on."""
        with self._changed:
            if self._paused_since_s is not None:
                self._paused_total_s += time.monotonic() - self._paused_since_s
                self._paused_since_s = None
            self._changed.notify_all()

    def seek(self, to_ns: int) -> None:
        """Go on with the data from this time on; a paused replay stays paused there."""
        with self._changed:
            self._seek_ns = to_ns
            self._changed.notify_all()

    def seek_by(self, seconds: float) -> None:
        """Go on that much later, or earlier if negative, counted from where the replay is."""
        with self._changed:
            base = self.position_ns if self._seek_ns is None else self._seek_ns
            self._seek_ns = base + round(seconds * 1e9)
            self._changed.notify_all()

    def at(self, position_ns: int) -> None:
        """Take note of where the replay is."""
        with self._changed:
            self.position_ns = position_ns

    def wait_until(self, deadline_s: float | None, on_pause: Callable[[], None] | None = None) -> bool:
        """Wait until a moment of `now_s`, or not at all; return False as soon as the replay is to stop or to seek.

        While paused, wait on; `on_pause` is called once when the replay is found paused.
        """
        with self._changed:
            while not (self.stopped or self._seek_ns is not None):
                if self._paused_since_s is not None:
                    if on_pause is not None:
                        on_pause()
                        on_pause = None
                    self._changed.wait(_SLICE_S)
                    continue
                left_s = 0.0 if deadline_s is None else deadline_s - self.now_s()
                if left_s <= 0:
                    return True
                self._changed.wait(min(left_s, _SLICE_S))
            return False

    def take_seek(self) -> int | None:
        """Data time from which to go on, None for no change; the order is then forgotten."""
        with self._changed:
            wish, self._seek_ns = self._seek_ns, None
            return wish


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
