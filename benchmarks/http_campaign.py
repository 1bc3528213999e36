"""Attacks a working monitor with slow, silent and too many HTTP callers; measures the effect and the time to recover.

Run: ``python benchmarks/http_campaign.py`` (about twenty minutes), ``--small`` for half a minute. For each number of
files that the monitor may open (256 and 1024), a monitor is started on loopback, a simulated rotor kit sends to it at
pace 1, and one kind of callers after the other attacks its API from the same address; kinds and numbers are in the
printed table. Callers replace connections that are ended until their time is over, and then hold the open ones.

Meanwhile ``/healthz`` is requested, over a new connection each time. Exit code 1 if a request was not answered, a block
was lost, the monitor came near its limit of files, wrote more than 100 kB of log, or did not recover.
"""

import argparse
import re
import resource
import select
import socket
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from running_monitor import ANSWER_S, PLACE, Monitor, monitor

_GET = "GET {} HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n"
_POST = (
    f"POST /api/v1/machines/{PLACE}/alarms/k_by/shelve HTTP/1.1\r\nhost: 127.0.0.1\r\n"
    "content-type: application/json\r\ncontent-length: 100000\r\n\r\n"
)
_LOG_BYTES = 100_000


@dataclass(frozen=True, slots=True)
class Attack:
    """One kind of caller."""

    name: str
    count: int
    sends: str
    trickles: bool = False
    reads: bool = True


ATTACKS = (
    Attack("nothing sent", 900, ""),
    Attack("half a head, then silence", 900, _GET.format("/healthz")[:-2]),
    Attack("a byte of the head every 0.5 s", 300, _GET.format("/healthz")[:-2] + "x-slow: ", trickles=True),
    Attack("a byte of the body every 0.5 s", 300, _POST, trickles=True),
    Attack("event streams", 500, _GET.format("/api/v1/events")),
    Attack("readers that take nothing", 200, _GET.format("/openapi.json") * 15, reads=False),
)


@dataclass(slots=True)
class Callers:
    """Connections of one attack."""

    address: tuple[str, int]
    attack: Attack
    count: int
    opened: int = 0
    ended: int = 0
    statuses: dict[str, int] = field(default_factory=dict)
    held: list[socket.socket] = field(default_factory=list)

    def fill(self) -> None:
        """Open missing connections, a hundred at most."""
        for _ in range(min(100, self.count - len(self.held))):
            one = socket.socket()
            if not self.attack.reads:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            one.settimeout(ANSWER_S)
            try:
                one.connect(self.address)
                one.sendall(self.attack.sends.encode())
            except OSError:
                one.close()
                self.ended += 1
                continue
            one.setblocking(False)
            self.opened += 1
            self.held.append(one)

    def look(self, *, trickle: bool) -> None:
        """Count the answers, send a byte on each connection if `trickle`, and remove connections that were ended."""
        poll = select.poll()
        held = {one.fileno(): one for one in self.held}
        for number in held:
            poll.register(number, select.POLLIN if self.attack.reads else 0)
        over = {held[number] for number, _ in poll.poll(0) if self._over(held[number])}
        if trickle and self.attack.trickles:
            for one in set(self.held) - over:
                try:
                    one.send(b"x")
                except OSError:
                    over.add(one)
        for one in over:
            one.close()
        self.ended += len(over)
        self.held = [one for one in self.held if one not in over]

    def close(self) -> None:
        """Close all connections."""
        while self.held:
            self.held.pop().close()

    def _over(self, one: socket.socket) -> bool:
        try:
            while self.attack.reads:
                text = one.recv(65536)
                if not text:
                    return True
                for status in re.findall(rb"HTTP/1.1 (\d+)", text):
                    self.statuses[status.decode()] = self.statuses.get(status.decode(), 0) + 1
        except BlockingIOError:
            return False
        except OSError:
            return True
        return True  # without reading, poll only reports the end of a connection


def campaign(one: Monitor, attack: Attack, count: int, duration_s: float, limit: int, recovery_s: float) -> list[str]:
    """Attack, print a line of the table, and return the faults found."""
    place = httpx.URL(one.url)
    callers = Callers((place.host, place.port or 0), attack, count)
    before, log_before = one.files(), one.log.stat().st_size
    accepted, lost = one.blocks()
    asked: list[tuple[int, float]] = []
    most = 0
    begin_s = trickled_s = time.monotonic()
    while time.monotonic() < begin_s + duration_s:
        callers.fill()
        now_s = time.monotonic()
        callers.look(trickle=now_s - trickled_s > 0.5)
        if now_s - trickled_s > 0.5:
            trickled_s = now_s
        asked.append(one.asked())
        most = max(most, one.files())
        time.sleep(0.02)
    end_s = time.monotonic()
    opened = callers.opened
    if attack.name == "event streams":  # the monitor may keep answered callers, so these must close
        callers.close()
    while one.files() > before + 5 and time.monotonic() < end_s + recovery_s:
        time.sleep(0.05)
        asked.append(one.asked())
        callers.look(trickle=True)
    took_s = time.monotonic() - end_s
    recovered = one.files() <= before + 5
    callers.close()
    accepted_after, lost_after = one.blocks()
    log = one.log.stat().st_size - log_before
    answers = {status: sum(status == found for found, _ in asked) for status, _ in sorted(asked)}
    answered = ", ".join(f"{number} x {status or 'nothing'}" for status, number in answers.items())
    # While all connections are being answered, 503 is right, until the monitor finds that the clients read nothing.
    unanswered = len(asked) - answers.get(200, 0) - (0 if attack.reads else answers.get(503, 0))
    slowest_s = max(wait_s for _, wait_s in asked)
    told = ", ".join(f"{number} x {status}" for status, number in sorted(callers.statuses.items()))
    print(
        f"| {attack.name} | {count} at once, {opened} in all | {callers.ended} ended{'; ' + told if told else ''} "
        f"| {answered}; {slowest_s:.2f} s at most "
        f"| {most} of {limit} (before: {before}) | {accepted_after - accepted}, {lost_after - lost} lost "
        f"| {log / 1000:.1f} | {f'{took_s:.1f}' if recovered else 'never'} |",
        flush=True,
    )
    faults = {
        f"{unanswered} questions were not answered": bool(unanswered),
        f"{lost_after - lost} blocks were lost": lost_after != lost or accepted_after == accepted,
        f"{most} files were open": most > limit * 2 // 3,
        f"{log} bytes of log": log > _LOG_BYTES,
        f"{one.files()} files are open after {took_s:.0f} s": not recovered,
    }
    return [f"{limit} files, {attack.name}: {text}" for text, found in faults.items() if found]


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--small", action="store_true", help="some dozens of callers for some seconds")
    parser.add_argument("--files", type=int, nargs="+", help="how many files the monitor may open (256 1024)")
    parser.add_argument("--seconds", type=float, help="how long each attack lasts (70; small: 1.2)")
    options = parser.parse_args()
    small = options.small
    if not small:
        _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    names = ("HEAD", "BODY", "SEND")
    timeouts = {f"ROTORWATCH_HTTP__{name}_TIMEOUT_S": "1" for name in names} if small else {}
    seconds = options.seconds or (1.2 if small else 70.0)
    print("| callers | how many | what became of them | /healthz | files open | blocks | log, kB | over after, s |")
    print("|---|---|---|---|---|---|---|---|")
    faults: list[str] = []
    for limit in options.files or ([160] if small else [256, 1024]):
        with tempfile.TemporaryDirectory() as folder, monitor(Path(folder), limit, timeouts) as one:
            for attack in ATTACKS:
                count = min(attack.count // 10, 80) if small else attack.count
                faults += campaign(one, attack, count, seconds, limit, 60.0 if small else 120.0)
            if one.process.poll() is not None:
                faults.append(f"{limit} files: the monitor ended")
    print("\n".join(faults) if faults else "every question was answered, no block was lost, and all was over in time")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
