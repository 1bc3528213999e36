"""Measures the time of writing, recovering and reading recordings of 12 channels at 4 kHz, relative to a plain write.

Run: ``python benchmarks/recording.py [DIRECTORY]``. The yardstick is a plain write of the same bytes to the same folder
with one fsync at the end; absolute times depend on the computer and its disk, ratios less. At the end a hundred such
machines are recorded in real time, each with its own file and its own fsync every second.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from models.machine import Machine, load_machine
from models.signals.block import SampleBlock
from models.signals.recording import (
    RecordedMessage,
    RecordingWriter,
    read_recording,
    salvage_recording,
    summarize_recording,
)
from models.signals.wire import encode_block
from service.recordings.recorder import MachineRecorder
from service.settings.service import LogSettings, RecordingSettings
from service.terminal.logs import configure_logging

REPETITIONS = 5
RATE_HZ, CHANNELS, BLOCK = 4000.0, 12, 400
DATA_S = 300.0
START_NS = time.time_ns()
MACHINES, LIVE_S = 100, 10.0


def messages(key: str) -> list[RecordedMessage]:
    """Five minutes of a 30 Hz vibration with noise, quantised as by a 16-bit converter."""
    rng = np.random.default_rng(1)
    time_s = np.arange(BLOCK) / RATE_HZ
    found = []
    for number in range(round(DATA_S * RATE_HZ / BLOCK)):
        wave = np.sin(2 * np.pi * 30.0 * (time_s + number * BLOCK / RATE_HZ))[:, None]
        samples = np.round((wave + 0.3 * rng.standard_normal((BLOCK, CHANNELS))) * 8000) / 8000
        at_ns = START_NS + round(number * BLOCK / RATE_HZ * 1e9)
        block = SampleBlock(start_ns=at_ns, sequence=number, run=1, rate_hz=RATE_HZ, samples=samples.astype(np.float32))
        payload, attachment, encoding = encode_block(block, "0123456789ab")
        found.append(RecordedMessage(key, payload, attachment, encoding, at_ns, at_ns))
    return found


def median_s(work: Callable[[], object], clean: Callable[[], object]) -> float:
    """Median time of the work over the repetitions."""
    times = []
    for _ in range(REPETITIONS):
        clean()
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def live(machine: Machine, content: list[RecordedMessage], out: Path) -> tuple[float, int, float]:
    """Record many machines in real time; return the fraction of a core, messages not synced at the end, and MB/s."""
    settings = RecordingSettings(directory=str(out))
    recorders = [
        MachineRecorder(machine.model_copy(update={"name": f"m{n}"}), settings, lambda _: ()) for n in range(MACHINES)
    ]
    for recorder in recorders:
        recorder.start()
    begin, cpu, count = time.perf_counter(), time.process_time(), round(LIVE_S * RATE_HZ / BLOCK)
    for number in range(count):
        time.sleep(max(0.0, begin + number * BLOCK / RATE_HZ - time.perf_counter()))
        for recorder in recorders:
            recorder.put(content[number])
    share = (time.process_time() - cpu) / (time.perf_counter() - begin)
    for recorder in recorders:
        recorder.stop()
    statuses = [recorder.status() for recorder in recorders]
    size_mb = sum(len(m.payload) for m in content[:count]) * MACHINES / 1e6
    return share, sum(status.received - status.synced for status in statuses), size_mb / LIVE_S


def main() -> None:
    """Measure and print."""
    configure_logging(LogSettings(level="error"))
    machine = load_machine("lab")
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as name:
        place = Path(name)
        content = messages(machine.keys.stream)
        total_mb = sum(len(m.payload) + len(m.attachment) for m in content) / 1e6
        plain, run, new = place / "plain", place / "run.mcap", place / "new.mcap"
        out = place / "out"

        def write_plainly() -> None:
            with plain.open("wb") as file:
                for message in content:
                    file.write(message.attachment)
                    file.write(message.payload)
                file.flush()
                os.fsync(file.fileno())

        def write() -> None:
            with RecordingWriter(run) as writer:
                for message in content:
                    writer.write(message)

        def record() -> None:
            settings = RecordingSettings(directory=str(out), queue_mb=2 * total_mb)
            recorder = MachineRecorder(machine, settings, lambda _: ())
            recorder.start()
            for message in content:
                recorder.put(message)
            recorder.stop()
            status = recorder.status()
            if status.synced != len(content) or status.lost or status.dropped:
                raise SystemExit(f"the recorder lost something: {status}")

        def nothing() -> None:
            return

        base_s = median_s(write_plainly, lambda: plain.unlink(missing_ok=True))
        times = {
            "plain write and fsync (yardstick)": base_s,
            "writing a recording": median_s(write, lambda: run.unlink(missing_ok=True)),
            "recorder: queue, thread, fsyncs": median_s(record, lambda: shutil.rmtree(out, ignore_errors=True)),
            "recovering": median_s(lambda: salvage_recording(run, new), lambda: new.unlink(missing_ok=True)),
            "reading everything": median_s(lambda: sum(1 for _ in read_recording(run)), nothing),
            "summary from the index": median_s(lambda: summarize_recording(run), nothing),
        }
        size_mb = run.stat().st_size / 1e6
        share, missing, rate_mb = live(machine, content, out)
    print(f"{DATA_S:g} s of {CHANNELS} channels at {RATE_HZ:g} Hz: {total_mb:.1f} MB, recorded {size_mb:.1f} MB")
    for name, seconds in times.items():
        print(f"  {name:<36} {1e3 * seconds:9.1f} ms {total_mb / seconds:9.0f} MB/s {seconds / base_s:8.2f} x")
    print(f"  real time / recorder: {DATA_S / times['recorder: queue, thread, fsyncs']:.0f}")
    print(f"{MACHINES} machines in real time, {rate_mb:.1f} MB/s: {share:.0%} of a core, {missing} messages missing")


if __name__ == "__main__":
    main()
