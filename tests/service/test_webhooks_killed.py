"""A monitor is killed while it tells a receiver of alarms: each arrives, in order, and nothing secret is logged."""

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from service.delivery.webhooks.signature import new_secret
from tests.service.hooked import Got, Hook, hook, settings_for
from tests.service.live import START_NS, Feed, Program, endpoint, machine_file, open_session, program, until
from tests.service.monitored import PLACE

SECRET_PATH = "hush-hush-path"  # noqa: S105  # what must not be logged


@contextmanager
def monitor(folder: Path, address: str) -> Iterator[Program]:
    with program(
        folder, "service.rotorwatch", "run", "--config", str(folder / "plant.toml"), "--listen", address,
        "--http-port", "0",
        ROTORWATCH_HISTORY__URL=f"sqlite:///{folder / 'history.sqlite'}",
    ) as running:  # fmt: skip
        running.url()
        yield running


def shelve(running: Program) -> None:
    """Two events."""
    with httpx.Client(base_url=running.url(), trust_env=False, timeout=180.0, headers={"if-match": "*"}) as http:
        for action in ("shelve", "unshelve"):
            order = {"reason": "a test", **({"duration_s": 60.0} if action == "shelve" else {})}
            answer = http.post(f"{PLACE}/alarms/data-gap/{action}", json=order)
            assert answer.status_code == 200, answer.text


def log(running: Program) -> list[str]:
    answer = httpx.get(f"{running.url()}{PLACE}/alarms/events?limit=1000", trust_env=False, timeout=180.0)
    return [event["id"] for event in sorted(answer.json()["events"], key=lambda event: event["sequence"])]


def status(running: Program) -> dict[str, object]:
    (found,) = httpx.get(f"{running.url()}/api/v1/webhooks", trust_env=False, timeout=180.0).json()["webhooks"]
    assert isinstance(found, dict)
    return found


def raise_gap(address: str) -> None:
    with open_session(address) as session:
        feed = Feed(session, start_ns=START_NS)
        feed.put_good()
        feed.start_ns += 3_000_000_000
        feed.sequence += 30
        feed.put_good()


@pytest.fixture
def receiver() -> Iterator[Hook]:
    with hook(lambda _: (503, {})) as found:
        yield found


def test_killed_monitors_lose_nothing(tmp_path: Path, receiver: Hook) -> None:
    secret = new_secret()
    settings_for(receiver, tmp_path, secret)
    machine_file(tmp_path, ("[operation]", "[ingest]\nno_data_after_s = 3600.0\nreorder_blocks = 0\n\n[operation]"))
    (tmp_path / "plant.toml").write_text(
        '[[machines]]\nfile = "machine.toml"\n\n[log]\nlevel = "debug"\n\n[[webhooks]]\nname = "pager"\n'
        f'url = "{receiver.url}/{SECRET_PATH}"\nsecret_file = "hook.secret"\nlongest_pause_s = 1.0\n',
        encoding="utf-8",
    )
    address = endpoint()
    taken: list[Got] = []

    with monitor(tmp_path, address) as first:  # the receiver takes nothing
        raise_gap(address)
        until(lambda: len(receiver.got) >= 1, "an attempt")
        shelve(first)
        first.kill()

    over = threading.Event()

    def takes_two(got: Got) -> tuple[int, Mapping[str, str]]:
        if len(taken) == 2:
            over.wait(600.0)  # it has the event, and the monitor never hears of it
            return 200, {}
        taken.append(got)
        return 200, {}

    receiver.answer = takes_two
    seen = len(receiver.got)
    with monitor(tmp_path, address) as second:
        until(lambda: len(receiver.got) >= seen + 3, "an attempt that is not answered")
        shelve(second)
        second.kill()
    over.set()
    unanswered = receiver.got[-1]

    def takes_all(got: Got) -> tuple[int, Mapping[str, str]]:
        taken.append(got)
        return 204, {}

    receiver.answer = takes_all
    with monitor(tmp_path, address) as third:
        shelve(third)
        events = log(third)
        assert len(events) == 7
        until(lambda: len(taken) >= len(events), "every event")
        assert [got.id for got in taken] == events
        assert taken[2].id == unanswered.id  # once more, under the same name
        assert taken[2].body == unanswered.body
        assert [got.verified(secret)["data"]["sequence"] for got in taken] == list(range(7))
        until(lambda: (status(third)["state"], status(third)["pending"]) == ("working", 0), "the last answer")
        assert third.stop() == 0
    said = "".join(running.errors() + running.output() for running in (first, second, third))
    assert "not delivered" in said  # what is looked for is looked for in the right place
    assert SECRET_PATH not in said
    assert secret.removeprefix("whsec_") not in said
    with monitor(tmp_path, address) as fourth:
        shelve(fourth)
        until(lambda: len(taken) == 9, "the next two")
        assert [got.id for got in taken] == log(fourth)
