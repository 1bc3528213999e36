"""Recorded messages handed out at their recorded pace; who takes them is somebody else's business."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Protocol

from models.signals.recording import RecordedMessage
from rotorwatch.records.replays import ReplayProgress
from service.replay.control import Control
from service.replay.source import RecordingSource

__all__ = ["PlayPlan", "Sink", "play"]


class Sink(Protocol):
    """Where replayed messages go; `service.replay_link.ReplayLink` is one."""

    def put(self, message: RecordedMessage) -> None:
        """Publish a message as it was."""


@dataclass(frozen=True, slots=True)
class PlayPlan:
    """What is replayed, and how fast.

    Attributes
    ----------
    keys : collection of str or None
        Only these keys; None is everything.
    pace : float or None
        Recorded seconds per second; None is as fast as the sink takes it.
    from_ns, to_ns : int
        Times of recording: from `from_ns` up to, and without, `to_ns`.
    pass_number : int
        Which repetition this is, from 1.
    """

    keys: Collection[str] | None
    pace: float | None
    from_ns: int
    to_ns: int
    pass_number: int = 1


def play(
    source: RecordingSource,
    sink: Sink,
    plan: PlayPlan,
    control: Control,
    on_progress: Callable[[ReplayProgress], None] | None = None,
) -> int:
    """Hand out the messages of one pass, byte for byte, until its end or until `control` says stop.

    Messages go out at the distances in time at which they were recorded, divided by the pace. After a seek the replay
    goes on at the new place at once.

    Returns
    -------
    int
        Number of messages handed out.

    Raises
    ------
    RecordingError
        Where a recording is damaged.
    """
    count = 0
    begin_ns: int | None = plan.from_ns
    control.at(plan.from_ns)
    while begin_ns is not None:
        anchor_ns: int | None = None
        anchor_s = 0.0
        for message in source.messages(plan.keys, from_ns=begin_ns, to_ns=plan.to_ns):
            if anchor_ns is None:
                anchor_ns, anchor_s = message.log_time_ns, control.now_s()
            due_s = None if plan.pace is None else anchor_s + (message.log_time_ns - anchor_ns) / 1e9 / plan.pace
            if not control.wait_until(due_s):
                break
            control.at(message.log_time_ns)
            sink.put(message)
            count += 1
            if on_progress is not None:
                on_progress(_progress(plan, control, message.log_time_ns, count))
        if control.stopped:
            break
        seek_ns = control.take_seek()
        begin_ns = None if seek_ns is None else min(max(seek_ns, plan.from_ns), plan.to_ns)
        if begin_ns is not None:
            control.at(begin_ns)
    return count


def _progress(plan: PlayPlan, control: Control, at_ns: int, count: int) -> ReplayProgress:
    done = (at_ns - plan.from_ns) / max(1, plan.to_ns - 1 - plan.from_ns)
    return ReplayProgress(
        fraction=min(1.0, max(0.0, done)),
        position_ns=at_ns,
        messages=count,
        windows=0,
        alarms=0,
        pass_number=plan.pass_number,
        paused=control.paused,
    )
