"""Runs a monitor in its own process on loopback, with a simulated rotor kit that sends to it at pace 1."""

import json
import os
import re
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import httpx

PLACE = "demo/lab"
ANSWER_S = 120.0


@dataclass(slots=True)
class Monitor:
    """A running monitor and its machine."""

    process: subprocess.Popen[bytes]
    publisher: subprocess.Popen[bytes]
    url: str
    endpoint: str
    log: Path
    published: Path

    def files(self) -> int:
        """Number of files that the monitor has open."""
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def get(self, path: str) -> httpx.Response:
        """Answer to a request."""
        # Without verification, because it is not HTTPS: loading certificates takes longer than the answer.
        return httpx.get(f"{self.url}{path}", trust_env=False, timeout=ANSWER_S, verify=False)  # noqa: S501  # plain HTTP

    def asked(self) -> tuple[int, float]:
        """Status of ``/healthz``, 0 without an answer, and the response time, s."""
        begin_s, status = time.monotonic(), 0
        with suppress(httpx.HTTPError):
            status = self.get("/healthz").status_code
        return status, time.monotonic() - begin_s

    def blocks(self) -> tuple[int, int]:
        """Number of blocks accepted, and of those refused, dropped or missing."""
        quality = self.get(f"/api/v1/machines/{PLACE}/health").json()["quality"]
        lost = sum(quality["refused_blocks"].values()) + quality["queue_dropped_blocks"] + quality["gaps"]
        return quality["accepted_blocks"], lost


@contextmanager
def serving(
    folder: Path, environment: dict[str, str], *arguments: str
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Run the service (``run`` by default) until the block is left, output in the folder; yields process and URL."""
    out, log = folder / "out", folder / "log"
    process = started(["service", *(arguments or ("run",))], out, log, environment)
    try:
        yield process, url_of(process, out, log)
    finally:
        process.terminate()
        process.wait(120)


@contextmanager
def monitor(folder: Path, files: int, settings: dict[str, str], *publish: str) -> Iterator[Monitor]:
    """Run a monitor that may open `files` files, with environment `settings`, and a machine with `publish` options."""
    environment, endpoint = on_loopback(folder)
    send = ["simulator.rotorsim", "publish", "--connect", endpoint, "--wait-for-subscriber", "120", *publish]
    out, log, published = folder / "out", folder / "log", folder / "published"
    process = started(["service", "run"], out, log, environment | settings)
    resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (files, files))
    publisher = started(send, published, Path(os.devnull), dict(os.environ))
    try:
        found = Monitor(process, publisher, url_of(process, out, log), endpoint, log, published)
        while found.blocks()[0] < 20:
            time.sleep(0.1)
        yield found
    finally:
        for one in (publisher, process):
            one.terminate()
        for one in (publisher, process):
            one.wait(60)


def on_loopback(folder: Path) -> tuple[dict[str, str], str]:
    """Environment of a monitor that is open to local callers, with a history file; and its Zenoh endpoint."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    return {
        **os.environ,
        "ROTORWATCH_LINK": json.dumps({"listen": [endpoint]}),
        "ROTORWATCH_HTTP__PORT": "0",
        "ROTORWATCH_ACCESS__OPEN_ON_LOOPBACK": "true",
        "ROTORWATCH_ACCESS__LIMITS__REQUESTS_PER_MINUTE": "1000000",
        "ROTORWATCH_HISTORY__URL": f"sqlite:///{folder}/history.sqlite",
    }, endpoint


def started(arguments: list[str], out: Path, err: Path, environment: dict[str, str]) -> subprocess.Popen[bytes]:
    """Start ``python -m ARGUMENTS`` with its output in files."""
    with out.open("wb") as output, err.open("wb") as errors:
        return subprocess.Popen(
            [sys.executable, "-m", *arguments], stdout=output, stderr=errors, env=environment, stdin=subprocess.DEVNULL
        )


def url_of(process: subprocess.Popen[bytes], out: Path, log: Path) -> str:
    """URL that a started monitor prints."""
    while process.poll() is None:
        if (told := re.search(r"HTTP API (http\S+)\s", out.read_text(encoding="utf-8"))) is not None:
            return told[1]
        time.sleep(0.1)
    raise SystemExit(f"the monitor did not start:\n{log.read_text(encoding='utf-8')}")
