"""What the tests of replays share: recordings of simulated machines, and what a running service said, as lines."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from models.alarm_names import STREAM_LOST
from models.machine import Machine
from models.signals.block import SampleBlock
from models.signals.recording import RecordedMessage, RecordingWriter, read_recording
from service.stream.worker import MachineWorker
from simulator.recorder import record
from tests.service.live import LAB


def recording(path: Path, stream: Sequence[SampleBlock], machine: Machine = LAB) -> Path:
    """A recording as the simulator writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    record(machine, ((block, ()) for block in stream), path)
    return path


def write(path: Path, messages: Sequence[RecordedMessage]) -> Path:
    """A recording of these messages."""
    with RecordingWriter(path) as writer:
        for message in messages:
            writer.write(message)
    return path


def hurried(source: Path, path: Path, pace: float = 20.0, at_ns: int = 1_790_000_000 * 10**9) -> Path:
    """The same messages as a recorder has them whose stream came faster than real time, on another day."""
    messages = list(read_recording(source))
    begin_ns = messages[0].log_time_ns
    for number, one in enumerate(messages):
        time_ns = at_ns + round((one.log_time_ns - begin_ns) / pace)
        messages[number] = replace(one, log_time_ns=time_ns, publish_time_ns=time_ns)
    return write(path, messages)


def split(source: Path, folder: Path, at: int) -> list[Path]:
    """The same messages in two files, the later one first."""
    messages = list(read_recording(source))
    return [write(folder / "b.mcap", messages[at:]), write(folder / "a.mcap", messages[:at])]


def lines_of(worker: MachineWorker) -> list[str]:
    """What a live monitor published, as lines: topic and message in the order of time, reports before alarms."""
    keys, most = worker.machine.keys, 1000
    timed = [(one.end_ns, 0, keys.report, one.text) for _, one in reversed(worker.history.reports(limit=most))]
    timed += [
        (event.time_ns, 1, keys.alarm_event, event.text)
        for event in worker.history.events(limit=most)
        if event.alarm != STREAM_LOST  # the silence after the end is part of no recording
    ]
    timed.sort(key=lambda entry: entry[:2])
    return [f'{{"topic": {json.dumps(topic)}, "message": {text}}}' for _, _, topic, text in timed]


def digest_of(worker: MachineWorker) -> str:
    """SHA-256 of these lines."""
    return hashlib.sha256("".join(line + "\n" for line in lines_of(worker)).encode()).hexdigest()
