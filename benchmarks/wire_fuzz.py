"""Sends a million messages that no machine would send to a working monitor.

Run: ``python benchmarks/wire_fuzz.py`` (about half an hour), ``--small`` for some seconds.
``wire_flood.py`` sends many bad messages of one kind per second instead.

A monitor is started on loopback. A simulated rotor kit sends to it at pace 1, while `wire_grammar` generates blocks,
descriptors, records, liveliness tokens and queries that are invalid in some way. Two further machines receive what a
faulty publisher might send: one a stream with absurdly large samples, the other blocks that contradict each other.
Meanwhile health and readiness are requested. The result is printed as a table and written as JSON. Exit code 1, with
the seed and the messages, if

- the monitor ended, logged an error or more than 2 kB per second, or was not ready for another reason than that the
  third machine's blocks fill no window;
- the rotor kit lost a block or a window, or had an alarm other than the expected data conflict;
- the monitor's memory grew by more than 50 MB, or the health of a machine is longer than 100 kB;
- the monitor does not stop with exit code 0.
"""

import argparse
import base64
import json
import re
import signal
import sys
import tempfile
import time
from collections import Counter, deque
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import zenoh
from machine_kind import rotor_kit
from rich.console import Console
from rich.progress import Progress
from running_monitor import PLACE, Monitor, monitor
from wire_grammar import GOOD_RUN, Grammar, Message

from models.machine import load_machine
from models.signals.link import LinkSettings
from service.stream.transport import Link

_SECOND, _THIRD = "demo/second", "demo/third"
_AT_ONCE = 500
_GROWTH_MB, _HEALTH_BYTES, _LOG_BYTES_PER_S = 50.0, 100_000, 2_000.0
_ERRORS = re.compile(r"Traceback|\[(error|critical)|panicked|Exception|something was lost", re.IGNORECASE)
_ON_THE_WAY = 10
"""Blocks of the last second, which may be lost when the publisher is stopped; there must be no gaps before them."""
_WARM_MINUTES = 4  # until windows are full and evaluated, and caches filled


@dataclass(slots=True)
class Outcome:
    """Result of a run."""

    seed: int
    messages: int = 0
    elapsed_s: float = 0.0
    kinds: dict[str, int] = field(default_factory=dict)
    unsendable: int = 0
    answers: int = 0
    published: int = 0
    accepted: int = 0
    windows: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    others: dict[str, dict[str, Any]] = field(default_factory=dict)
    memory_mb: list[float] = field(default_factory=list)
    growth_mb: float = 0.0
    health_bytes: int = 0
    log_bytes: int = 0
    faults: list[str] = field(default_factory=list)


class Sender:
    """Sends generated messages on the network; keeps the latest liveliness tokens declared."""

    def __init__(self, endpoint: str, tokens: int = 8) -> None:
        self._link = Link(LinkSettings(connect=(endpoint,)))
        self.session = self._link.session
        self._most_tokens = tokens
        self._tokens: deque[zenoh.LivelinessToken] = deque()
        self.answers = self.unsendable = 0

    def send(self, one: Message) -> None:
        """Send a message, waiting only while the network is congested."""
        wait = zenoh.CongestionControl.BLOCK
        try:
            if one.act == "put":
                self.session.put(
                    one.key, one.payload, attachment=one.attachment, encoding=one.encoding, congestion_control=wait
                )
            elif one.act == "delete":
                self.session.delete(one.key, attachment=one.attachment, congestion_control=wait)
            elif one.act == "declare":
                self._tokens.append(self.session.liveliness().declare_token(one.key))
                if len(self._tokens) > self._most_tokens:
                    self._tokens.popleft().undeclare()  # type: ignore[no-untyped-call]
            else:
                selector = f"{one.key}?{one.encoding}" if one.encoding else one.key
                self.session.get(selector, self._answered, payload=one.payload, timeout=1.0, congestion_control=wait)
        except (zenoh.ZError, ValueError, UnicodeError):  # the library refuses to send it
            self.unsendable += 1

    def _answered(self, _: zenoh.Reply) -> None:
        self.answers += 1

    def close(self) -> None:
        """Close the session."""
        self._link.close()


class Watch:
    """Checks the monitor for faults."""

    def __init__(self, one: Monitor, outcome: Outcome) -> None:
        self._monitor, self._outcome = one, outcome
        self._log_read = 0
        self._begin_s = time.monotonic()

    def look(self) -> list[str]:
        """Check the monitor, and return the faults found since the last check."""
        one, outcome = self._monitor, self._outcome
        if one.process.poll() is not None:
            return [f"the monitor ended with {one.process.returncode}"]
        ready = one.get("/readyz").json()
        faults = [f"not ready: {why}" for why in ready["reasons"] if not self._is_expected(why)]
        for place in (PLACE, _SECOND, _THIRD):
            answer = one.get(f"/api/v1/machines/{place}/health")
            outcome.health_bytes = max(outcome.health_bytes, len(answer.content))
            if answer.json()["worker_errors"]:
                faults.append(f"{place}: {answer.json()['last_worker_error']}")
        if outcome.health_bytes > _HEALTH_BYTES:
            faults.append(f"health of {outcome.health_bytes} bytes")
        with one.log.open("rb") as file:
            file.seek(self._log_read)
            text = file.read()
        self._log_read += len(text)
        outcome.log_bytes = self._log_read
        if self._log_read > 50_000 + _LOG_BYTES_PER_S * (time.monotonic() - self._begin_s):
            faults.append(f"{self._log_read} bytes of log")
        faults += [f"log: {line}" for line in text.decode(errors="replace").splitlines() if _ERRORS.search(line)]
        self._weigh()
        return faults

    def _weigh(self) -> None:
        """Record the monitor's private memory once a minute, and its growth since the warm-up."""
        now_s = time.monotonic() - self._begin_s
        if now_s < 60.0 * len(self._outcome.memory_mb):
            return
        rollup = Path(f"/proc/{self._monitor.process.pid}/smaps_rollup").read_text(encoding="utf-8")
        own_kb = sum(int(size) for size in re.findall(r"Private_(?:Clean|Dirty): +(\d+)", rollup))
        self._outcome.memory_mb.append(round(own_kb / 1000, 1))
        warm, later = self._outcome.memory_mb[:_WARM_MINUTES], self._outcome.memory_mb[_WARM_MINUTES:]
        self._outcome.growth_mb = max(later) - max(warm) if later else 0.0

    @staticmethod
    def _is_expected(why: str) -> bool:
        return why.startswith(f"{_THIRD}: ") and "no window was evaluated" in why

    def finish(self) -> list[str]:
        """Stop the publisher, wait until everything is evaluated, stop the monitor, and return the faults found."""
        one, outcome = self._monitor, self._outcome
        one.publisher.send_signal(signal.SIGINT)
        one.publisher.wait(60)
        told = re.search(r"published (\d+) blocks", one.published.read_text(encoding="utf-8"))
        outcome.published = int(told[1]) if told else 0
        end_s = time.monotonic() + 60
        while metric(one, "queue_blocks", PLACE) and time.monotonic() < end_s:
            time.sleep(0.2)
        health = one.get(f"/api/v1/machines/{PLACE}/health").json()
        quality = health["quality"]
        outcome.accepted, outcome.refused = quality["accepted_blocks"], quality["refused_blocks"]
        outcome.windows = int(metric(one, "windows_total", PLACE))
        for place in (_SECOND, _THIRD):
            found = one.get(f"/api/v1/machines/{place}/health").json()["quality"]
            outcome.others[place] = {
                "accepted": found["accepted_blocks"],
                "windows": int(metric(one, "windows_total", place)),
                "refused": found["refused_blocks"],
                "dropped": found["queue_dropped_blocks"],
            }
        expected = outcome.accepted // 50 - 1  # windows: a block is 0.1 s, a hop 5 s; the first hop may start later
        alarms = {alarm["name"] for alarm in health["alarms"]} - {"data-conflict"}
        faults = {
            f"{outcome.accepted} of {outcome.published} blocks accepted": not 0
            <= outcome.published - outcome.accepted
            <= _ON_THE_WAY,
            f"{outcome.windows} windows, expected {expected}": outcome.windows < expected,
            f"memory grew by {outcome.growth_mb:.0f} MB": outcome.growth_mb > _GROWTH_MB,
            f"gaps: {quality['last_gap']}": quality["gaps"] > 0,
            f"{quality['queue_dropped_blocks']} blocks dropped": quality["queue_dropped_blocks"] > 0,
            f"{quality['link_missed_blocks']} blocks missed on the way": quality["link_missed_blocks"] > 0,
            f"alarms: {', '.join(sorted(alarms))}": bool(alarms),
            f"state {health['state']}: {health['reason']}": health["state"] not in {"healthy", "warming", "watching"},
        }
        one.process.terminate()
        code = one.process.wait(120)
        return [*(text for text, found in faults.items() if found), *([f"exit code {code}"] if code else [])]


def metric(one: Monitor, name: str, place: str) -> float:
    """Value of one of the monitor's metrics for a machine."""
    site, _, machine = place.partition("/")
    found = re.search(
        rf'^rotorwatch_{name}{{machine="{machine}",site="{site}"}} (\S+)$', one.get("/metrics").text, re.MULTILINE
    )
    return float(found[1]) if found else 0.0


def messages(
    outcome: Outcome, grammar: Grammar, first: int, count: int, sender: Sender, watch: Watch, folder: Path
) -> None:
    """Send the messages, `_AT_ONCE` at a time, checking the monitor in between; stop at the first fault."""
    kinds: Counter[str] = Counter()
    begin_s = time.monotonic()
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("messages", total=count)
        for start in range(first, first + count, _AT_ONCE):
            some = [grammar.message(number) for number in range(start, min(start + _AT_ONCE, first + count))]
            for one in some:
                sender.send(one)
            kinds.update(one.kind for one in some)
            faults = watch.look()
            outcome.messages += len(some)
            progress.update(task, advance=len(some))
            if faults:
                kept = folder / "messages.jsonl"
                kept.write_text("".join(f"{json.dumps(shown(one))}\n" for one in some), encoding="utf-8")
                where = f"messages {start} to {start + len(some) - 1} of seed {outcome.seed}, in {kept}"
                outcome.faults += [f"{fault}; {where}" for fault in faults]
                break
    outcome.kinds, outcome.elapsed_s = dict(kinds.most_common()), time.monotonic() - begin_s
    outcome.unsendable, outcome.answers = sender.unsendable, sender.answers


def shown(one: Message) -> dict[str, Any]:
    """A message as a JSON object, bytes as Base64."""
    return {key: base64.b64encode(x).decode() if isinstance(x, bytes) else x for key, x in asdict(one).items()}


def table(outcome: Outcome) -> str:
    """The result as a Markdown table."""
    rows = {
        "messages": f"{outcome.messages} in {outcome.elapsed_s:.0f} s (seed {outcome.seed})",
        "of kinds": ", ".join(f"{count} {kind}" for kind, count in outcome.kinds.items()),
        "not sendable; answers to queries": f"{outcome.unsendable}; {outcome.answers}",
        "good blocks published, accepted; windows": f"{outcome.published}, {outcome.accepted}; {outcome.windows}",
        "refused beside them": ", ".join(f"{count} {why}" for why, count in outcome.refused.items()),
        **{
            f"{place}: accepted, dropped; windows": f"{found['accepted']}, {found['dropped']}; {found['windows']}"
            for place, found in outcome.others.items()
        },
        **{
            f"{place}: refused": ", ".join(f"{count} {why}" for why, count in found["refused"].items())
            for place, found in outcome.others.items()
        },
        "memory in the end, grown by": f"{outcome.memory_mb[-1]:.0f} MB, {outcome.growth_mb:.0f} MB",
        "longest health; log": f"{outcome.health_bytes / 1000:.1f} kB; {outcome.log_bytes / 1000:.1f} kB",
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first message, to repeat a part of a run")
    parser.add_argument("--small", action="store_true", help="a few thousand messages")
    parser.add_argument("--json", type=Path, default=Path("wire_fuzz.json"), help="file for the result")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="wire-fuzz-"))
    others = [folder / f"{place.partition('/')[2]}.toml" for place in (_SECOND, _THIRD)]
    for other in others:
        other.write_text(rotor_kit().replace('name = "lab"', f'name = "{other.stem}"'), encoding="utf-8")
    settings = {
        "ROTORWATCH_MACHINES": json.dumps([{"file": "lab", "bundle": "lab"}, *({"file": str(one)} for one in others)]),
        "ROTORWATCH_RECORDING": json.dumps(
            {"directory": str(folder / "recordings"), "rotate_mb": 5, "keep_gb": 0.02, "alarm_keep_gb": 0.02}
        ),
    }
    outcome = Outcome(options.seed)
    publish = ["--run", str(GOOD_RUN), "--duration", "864000"]
    with monitor(folder, 1024, settings, *publish) as one:
        watch, sender = Watch(one, outcome), Sender(one.endpoint)
        grammar = Grammar(options.seed, load_machine("lab"), *map(load_machine, others))
        count = 3000 if options.small else options.messages
        messages(outcome, grammar, options.first, count, sender, watch, folder)
        sender.close()
        outcome.faults += watch.finish()
    print(table(outcome))
    options.json.write_text(f"{json.dumps(asdict(outcome), indent=1)}\n", encoding="utf-8")
    print("\n".join(outcome.faults) if outcome.faults else "nothing that should not be")
    return 1 if outcome.faults else 0


if __name__ == "__main__":
    sys.exit(main())
