"""Floods a monitor with ten thousand bad messages a second, kind after kind; measures the effect on a machine's blocks.

Run: ``python benchmarks/wire_flood.py`` (about five minutes). A monitor is started on loopback, and a simulated rotor
kit sends to it at pace 1, while another program on the same computer sends to the same keys at the given rate, without
dropping anything itself. The messages sent and the fate of the rotor kit's blocks are printed as a table. Exit code 1
if a good block was lost.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from running_monitor import PLACE, Monitor, monitor
from wire_fuzz import Sender, metric
from wire_grammar import GOOD_RUN, Message

from models.machine import load_machine
from models.signals.block import SampleBlock
from models.signals.wire import ARROW_ENCODING, BLOCK_ENCODING, encode_arrow, encode_block

_LAB = load_machine("lab")
_KEYS = _LAB.keys
_HASH = _LAB.descriptor.schema_hash
_START_NS = 1_767_225_600_000_000_000
_MADE = 500
_STEP_S = 0.01


def _block(
    number: int, run: int, samples: float | None = None, n_samples: int = 200, rate_hz: float = 2000.0
) -> SampleBlock:
    """A block with any time but the present one; noise, whose last value is `samples` if given."""
    rng = np.random.default_rng(number)
    sequence = int(rng.integers(100_000))
    values = rng.standard_normal((n_samples, len(_LAB.sensors))).astype(np.float32)
    if samples is not None:
        values[-1, -1] = samples
    return SampleBlock(_START_NS + sequence * 10**8, sequence, run, rate_hz, values)


_NAN = float("nan")


BLOCKS: dict[str, Callable[[int], tuple[bytes, bytes, str]]] = {
    "text": lambda _: (b"rubbish", b"", "text/plain"),
    "header of 31 bytes": lambda _: (b"\0" * 7200, b"\0" * 31, BLOCK_ENCODING),
    "one sample, run of the machine": lambda n: encode_block(_block(n, GOOD_RUN, n_samples=1), _HASH),
    "another rate, run of the machine": lambda n: encode_block(_block(n, GOOD_RUN, rate_hz=1000.0), _HASH),
    "another hash, run of the machine": lambda n: encode_block(_block(n, GOOD_RUN), "0" * 12),
    "not finite, run of the machine": lambda n: encode_block(_block(n, GOOD_RUN, _NAN), _HASH),
    "not finite, other runs": lambda n: encode_block(_block(n, 1000 + n, _NAN), _HASH),
    "Arrow, not finite": lambda n: encode_arrow(_block(n, GOOD_RUN, _NAN), _HASH),
    "Arrow, cut off": lambda n: (encode_arrow(_block(n, 8), _HASH)[0][:-100], b"", ARROW_ENCODING),
    "another time, other runs": lambda n: encode_block(_block(n, 1000 + n), _HASH),
    "another time, run of the machine": lambda n: encode_block(_block(n, GOOD_RUN), _HASH),
}
BESIDE: dict[str, Callable[[int], Message]] = {
    "descriptors": lambda n: Message(n, "", "put", _KEYS.descriptor, b'{"site": "%d"}' % n),
    "heartbeats": lambda n: Message(n, "", "put", f"{_KEYS.stream}/@adv/pub/{n + 1:x}/1/_", bytes(4)),
    "alarm events": lambda n: Message(n, "", "put", _KEYS.alarm_event, b"[" * 1000),
    "publishers that come and go": lambda n: Message(n, "", "declare", _KEYS.publisher_alive),
    "questions for health": lambda n: Message(n, "", "ask", _KEYS.health),
    "questions for the alarm log": lambda n: Message(n, "", "ask", _KEYS.alarm_event),
}
FLOODS = (*BLOCKS, *BESIDE)


def _made(kind: str, number: int) -> Message:
    if kind in BESIDE:
        return BESIDE[kind](number)
    return Message(number, kind, "put", _KEYS.stream, *BLOCKS[kind](number))


def send(endpoint: str, kind: str, rate: float, seconds: float) -> None:
    """Send messages of one kind at `rate` per second, and print the rate reached."""
    made = [_made(kind, number) for number in range(_MADE)]
    sender = Sender(endpoint, tokens=0)
    time.sleep(1.0)
    sent, begin_s = 0, time.monotonic()
    while (now_s := time.monotonic() - begin_s) < seconds:
        while sent < rate * now_s and time.monotonic() - begin_s < seconds:
            sender.send(made[sent % _MADE])
            sent += 1
        time.sleep(_STEP_S)
    took_s = time.monotonic() - begin_s
    print(sent / took_s, flush=True)
    sender.close()


def flood(one: Monitor, kind: str, rate: float, seconds: float) -> list[str]:
    """Send one kind of messages, print a row of the table, and return the faults found."""
    path = f"/api/v1/machines/{PLACE}/health"
    before = one.get(path).json()["quality"]
    command = [sys.executable, __file__, "--send", kind, "--rate", str(rate), "--seconds", str(seconds)]
    oldest_s = 0.0
    with subprocess.Popen([*command, "--endpoint", one.endpoint], stdout=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            oldest_s = max(oldest_s, one.get(path).json()["stream"]["data_age_s"] or 0.0)
            time.sleep(0.2)
        reached = float(process.communicate()[0] or 0)
    end_s = time.monotonic()
    while metric(one, "queue_blocks", PLACE) > 1 and time.monotonic() < end_s + 60:
        time.sleep(0.1)
    over_s = time.monotonic() - end_s
    health = one.get(path).json()
    after = health["quality"]
    good, gaps, dropped, missed = (
        after[name] - before[name] for name in ("accepted_blocks", "gaps", "queue_dropped_blocks", "link_missed_blocks")
    )
    refused = sum(after["refused_blocks"].values()) - sum(before["refused_blocks"].values())
    print(
        f"| {kind} | {reached:.0f} | {refused} | {good} | {gaps} | {dropped} | {oldest_s:.2f} | {over_s:.1f} |",
        flush=True,
    )
    faults = {
        f"{gaps} gaps: {after['last_gap']}": gaps,
        f"{dropped} blocks dropped": dropped,
        f"{missed} missed on the way": missed,
        "no good block": not good,
        "the monitor ended": one.process.poll() is not None,
    }
    return [f"{kind}: {text}" for text, found in faults.items() if found]


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rate", type=float, default=10_000.0, help="messages per second")
    parser.add_argument("--seconds", type=float, default=15.0, help="seconds for which each kind is sent")
    parser.add_argument("--kinds", nargs="+", choices=FLOODS, default=FLOODS)
    parser.add_argument("--send", choices=FLOODS, help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.send is not None:
        send(options.endpoint, options.send, options.rate, options.seconds)
        return 0
    settings = {"ROTORWATCH_MACHINES": json.dumps([{"file": "lab", "bundle": "lab"}])}
    faults: list[str] = []
    print("| flood | a second | refused | good blocks | gaps | dropped | longest without one, s | over after, s |")
    print("|---|---|---|---|---|---|---|---|")
    with (
        tempfile.TemporaryDirectory() as folder,
        monitor(Path(folder), 1024, settings, "--run", str(GOOD_RUN), "--duration", "86400") as one,
    ):
        for kind in options.kinds:
            faults += flood(one, kind, options.rate, options.seconds)
    print("\n".join(faults) if faults else "no good block was lost")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
