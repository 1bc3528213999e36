"""What the tests of replays share: recordings of simulated machines, and the output of a running service as lines."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from models.alarm_names import STREAM_LOST
from models.machine import Machine
from models.signals.block import FloatArray, SampleBlock
from models.signals.recording import RecordedMessage, RecordingWriter, read_recording
from service.analysis.recorded import Recorded
from service.recordings.replay.source import RecordingSource
from service.stream.worker import MachineWorker
from simulator.stream import record
from tests.service.rig.live import LAB, START_NS

NAMES = [channel.name for channel in LAB.sensors]
S = 10**9


def recording(path: Path, stream: Sequence[SampleBlock], machine: Machine = LAB) -> Path:
    """A recording as the simulator writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    record(machine, ((block, ()) for block in stream), path)
    return path


def write(path: Path, messages: Sequence[RecordedMessage]) -> Path:
    with RecordingWriter(path) as writer:
        for message in messages:
            writer.write(message)
    return path


def hurried(source: Path, path: Path, pace: float = 20.0, at_ns: int = 1_790_000_000 * 10**9) -> Path:
    """The same messages as recorded from a stream faster than real time, on another day."""
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
    return hashlib.sha256("".join(line + "\n" for line in lines_of(worker)).encode()).hexdigest()


def machine_blocks(
    signals: dict[str, Callable[[FloatArray], FloatArray]], seconds: float, without: Sequence[int] = ()
) -> list[SampleBlock]:
    """Blocks of 0.1 s with these signals, in the units of the channels; some blocks may be missing."""
    size = round(0.1 * LAB.rate_hz)
    time_s = np.arange(round(seconds * LAB.rate_hz)) / LAB.rate_hz
    samples = np.zeros((time_s.size, len(NAMES)))
    for name, signal in signals.items():
        samples[:, NAMES.index(name)] = signal(time_s)
    return [
        SampleBlock(START_NS + round(k * 0.1 * S), k, 1, LAB.rate_hz, samples[k * size : (k + 1) * size])
        for k in range(time_s.size // size)
        if k not in without
    ]


def without_angle(path: Path, stream: Sequence[SampleBlock]) -> Path:
    """A recording of the rotor kit without its keyphasor."""
    machine = LAB.model_copy(update={"sensors": LAB.sensors[:-1]})
    return recording(path, [replace(one, samples=one.samples[:, :-1].copy()) for one in stream], machine)


def made(
    folder: Path, signals: dict[str, Callable[[FloatArray], FloatArray]], seconds: float, without: Sequence[int] = ()
) -> Recorded:
    """A recording of `machine_blocks`, opened."""
    return recorded(recording(folder / "made.mcap", machine_blocks(signals, seconds, without)))


def recorded(path: Path, seconds: tuple[float, float] | None = None) -> Recorded:
    """A recording of the rotor kit, opened in full or between two times."""
    source = RecordingSource([path])
    from_ns, to_ns = source.span().start_ns, source.span().end_ns + 1
    if seconds is not None:
        from_ns, to_ns = (START_NS + round(limit * S) for limit in seconds)
    return Recorded(source, LAB.keys, from_ns, to_ns)
