"""A plant on loopback: a router with users and grants, which collects everything it lets through."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import zenoh

from models.signals.keys import Grant, MachineKeys
from models.signals.link import LinkSettings
from tests.loopback import endpoint, session_of
from tests.service.rig.live import until

PUMP = MachineKeys("demo", "pump")
GRANTS = (
    Grant(who=("lab",), publishes=("demo/lab",)),
    Grant(who=("pump",), publishes=("demo/pump",)),
    Grant(who=("monitor",), monitors=("demo/*",)),
    Grant(who=("all",), views=("demo/*",)),
    Grant(who=("one",), views=("demo/lab",)),
)
USERS = ("lab", "pump", "monitor", "all", "one")


def at_once(hear: Callable[[zenoh.Sample], None]) -> Callable[[zenoh.Sample], None]:
    """Handle samples on the network's own thread: each before the next one on its link is looked at."""
    handler: zenoh.handlers.Callback[zenoh.Sample] = zenoh.handlers.Callback(hear, indirect=False)
    return handler


def kept(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    path.chmod(0o600)
    return path


@dataclass(slots=True)
class Plant:
    """A session with access rules, and how clients connect to it."""

    session: zenoh.Session
    address: str
    folder: Path
    heard: list[tuple[str, str]] = field(default_factory=list)

    def hear(self, sample: zenoh.Sample) -> None:
        self.heard.append((str(sample.key_expr), sample.payload.to_string()))

    def link(self, user: str) -> LinkSettings:
        return LinkSettings(
            mode="client", connect=(self.address,), user=user, password_file=self.folder / f"{user}.password"
        )

    @contextmanager
    def client(self, user: str, **more: str) -> Iterator[zenoh.Session]:
        with session_of(self.link(user), **more) as session:
            yield session

    def until_heard(self, key: str, text: str) -> None:
        until(lambda: (key, text) in self.heard, f"{text} on {key}")


@contextmanager
def plant(folder: Path, mode: Literal["router", "peer"] = "router") -> Iterator[Plant]:
    """Users with passwords and grants; samples that are let through are collected in order."""
    for user in USERS:
        kept(folder / f"{user}.password", f"word of {user}\n")
    passwords = kept(folder / "passwords", "".join(f"{user}:word of {user}\n" for user in USERS))
    address = endpoint()
    link = LinkSettings(mode=mode, listen=(address,), passwords_file=passwords, grants=GRANTS)
    with session_of(link) as session:
        found = Plant(session, address, folder)

        for keys in ("rotorwatch/**", "rotorwatch/**/@adv/**"):
            session.declare_subscriber(keys, at_once(found.hear))
        yield found
