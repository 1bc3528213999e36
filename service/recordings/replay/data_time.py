"""When the data in a recording were taken, which is not when they were recorded.

A stream that comes faster than real time is recorded in less time than it lasts, and a recording that is imported was
taken long before. A person who asks for an hour, or for the latest 20 s, means the time of the data: that of the blocks
or, where the samples were not kept, of the window reports.
"""

import json
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from models.errors import WireError
from models.signals.keys import PREFIX
from models.signals.recording import RecordedMessage, RecordingSummary, read_recording
from models.signals.wire import decode_block

_BACK_NS = 5 * 10**9
_STEADY_NS = 10**9
_LATEST_NS = 2**63


@dataclass(frozen=True, slots=True)
class DataSpan:
    """Data of a machine in a recording."""

    # Beginning of the earliest and end of the latest data.
    start_ns: int
    end_ns: int
    # Beginning of the data recorded first, and end of those recorded last; they differ from the above if the publisher
    # was started again at an earlier time, or its clock was set.
    first_ns: int
    newest_ns: int


@dataclass(frozen=True, slots=True)
class _Taken:
    """When one message's data were taken; sequence and run are None for a report."""

    start_ns: int
    end_ns: int
    sequence: int | None = None
    run: int | None = None


def place_of(key: str) -> str:
    """Common beginning of the keys of a machine; empty for a key that belongs to none.

    Examples
    --------
    >>> place_of("rotorwatch/demo/lab/alarm/event"), place_of("weather")
    ('rotorwatch/demo/lab', '')
    """
    parts = key.split("/")
    return "/".join(parts[:3]) if len(parts) > 3 and parts[0] == PREFIX else ""


def clock_key(keys: Collection[str], place: str) -> str | None:
    """The one of these keys whose messages say when a machine's data were taken; None if there is none."""
    return next((key for key in (f"{place}/stream", f"{place}/report") if place and key in keys), None)


def data_start_ns(message: RecordedMessage) -> int | None:
    """Time of a block's first sample, or of the last one in a report; None if the message cannot be read."""
    taken = _taken(message)
    return None if taken is None else taken.start_ns


def span_of(path: Path, summary: RecordingSummary, key: str) -> DataSpan | None:
    """Time span of the data in the messages of a key; None if none can be read.

    If one run went on without a gap, only the two ends are read.

    Raises
    ------
    RecordingError
        Where damage is met.
    """
    first = next(_all_taken(path, key), None)
    if first is None:
        return None
    last = first
    for last in _all_taken(path, key, from_ns=summary.end_ns - _BACK_NS):  # noqa: B007  # the last one is wanted
        pass
    blocks = 0 if last.sequence is None or first.sequence is None else last.sequence - first.sequence
    expected_ns = blocks * (first.end_ns - first.start_ns)
    steady = last.run == first.run is not None and abs(last.start_ns - first.start_ns - expected_ns) < _STEADY_NS
    if steady and blocks > 0:
        return DataSpan(first.start_ns, last.end_ns, first.start_ns, last.end_ns)
    start_ns, end_ns = first.start_ns, first.end_ns
    for last in _all_taken(path, key):
        start_ns, end_ns = min(start_ns, last.start_ns), max(end_ns, last.end_ns)
    return DataSpan(start_ns, end_ns, first.start_ns, last.end_ns)


def _all_taken(path: Path, key: str, from_ns: int | None = None) -> Iterator[_Taken]:
    found = (_taken(message) for message in read_recording(path, keys={key}, from_ns=from_ns))
    return (taken for taken in found if taken is not None)


def _taken(message: RecordedMessage) -> _Taken | None:
    if message.key.endswith("/report"):
        try:
            end_ns = int(json.loads(message.payload)["end_ns"])
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return None
        return _Taken(end_ns - 1, end_ns) if 0 < end_ns < _LATEST_NS else None
    try:
        block, _ = decode_block(message.payload, message.attachment, message.encoding)
    except WireError:
        return None
    return _Taken(block.start_ns, block.end_ns, block.sequence, block.run)
