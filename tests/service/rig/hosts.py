"""Hosts as network namespaces of this computer, each joined to the one in the middle by a cable."""

import ctypes
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Protocol

MIDDLE = "middle"
_CLONE_NEWNET = 0x40000000  # of sched.h; Python has setns from 3.12 on


def why_not() -> str:
    """Why hosts cannot be created on this computer; empty if they can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "network namespaces need ip (Debian: iproute2)"
    probe = f"rw{os.getpid()}probe"
    made = subprocess.run(["ip", "netns", "add", probe], capture_output=True, text=True, check=False)
    if made.returncode:
        return f"network namespaces are refused here: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "del", probe], check=True)
    return ""


class Running(Protocol):
    def kill(self) -> object:
        """kill -9."""


@dataclass(frozen=True, slots=True)
class Hosts:
    """Named hosts: the n-th is 10.77.n.2 and reaches the middle at 10.77.n.1."""

    names: tuple[str, ...]

    def within(self, name: str) -> tuple[str, ...]:
        """Prefix of a command that is to run on a host."""
        return ("ip", "netns", "exec", self._space(name))

    def network(self, name: str) -> str:
        return f"/run/netns/{self._space(name)}"

    def middle_from(self, name: str) -> str:
        """Address of the host in the middle as seen from another."""
        return f"10.77.{self.names.index(name)}.1"

    def address(self, name: str) -> str:
        return f"10.77.{self.names.index(name)}.2"

    def cut(self, name: str) -> None:
        """Cut the cable of a host: connections stay as they are, and nothing arrives any more."""
        _ip("-n", self._space(MIDDLE), "link", "set", self._cable(name), "down")

    def mend(self, name: str) -> None:
        """Put the cable back."""
        _ip("-n", self._space(MIDDLE), "link", "set", self._cable(name), "up")

    def lose(self, name: str, *running: Running) -> None:
        """Power off a host on which these programs run, without notice: no connection is closed."""
        _ip("-n", self._space(MIDDLE), "link", "del", self._cable(name))
        for one in running:
            one.kill()
        self.take_away(name)

    def put(self, name: str) -> None:
        """Create a host with its cable, or again after it was lost."""
        space = self._space(name)
        _ip("netns", "add", space)
        _ip("-n", space, "link", "set", "lo", "up")
        if name == MIDDLE:
            return
        middle, number = self._space(MIDDLE), self.names.index(name)
        _ip("-n", middle, "link", "add", self._cable(name), "type", "veth", "peer", "name", "cable", "netns", space)
        for end, device, last in ((middle, self._cable(name), 1), (space, "cable", 2)):
            _ip("-n", end, "address", "add", f"10.77.{number}.{last}/30", "dev", device)
            _ip("-n", end, "link", "set", device, "up")
        _ip("-n", space, "route", "add", "default", "via", self.middle_from(name))

    def take_away(self, name: str) -> None:
        subprocess.run(["ip", "netns", "del", self._space(name)], capture_output=True, check=False)

    def asked(self, name: str, url: str) -> str:
        def answer() -> str:
            move_to(self.network(name))
            time.sleep(0.15)  # one caller may make 600 requests a minute
            with urllib.request.urlopen(url, timeout=20) as response:  # noqa: S310  # of a monitor of ours
                return str(response.read().decode())

        with ThreadPoolExecutor(1) as asking:  # a thread that moved cannot come back
            return asking.submit(answer).result(60)

    def _cable(self, name: str) -> str:
        return f"to{self.names.index(name)}"

    def _space(self, name: str) -> str:
        return f"rw{os.getpid()}{name}"


@contextmanager
def hosts(*names: str, joined: bool = False) -> Iterator[Hosts]:
    """Hosts with these names and one in the middle, removed with their cables on exit.

    The one in the middle forwards packets between them only if they are `joined`.
    """
    made = Hosts(names)
    with ExitStack() as undo:
        for name in (MIDDLE, *names):
            undo.callback(made.take_away, name)
            made.put(name)
        forward = ["sh", "-c", f"echo {int(joined)} > /proc/sys/net/ipv4/ip_forward"]
        subprocess.run([*made.within(MIDDLE), *forward], check=True)
        yield made


def move_to(network: str) -> None:
    """Move this thread, and what it starts, to a host."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open(network, "rb") as opened:
        if libc.setns(opened.fileno(), _CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), network)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)
