"""What a receiver of webhooks gets, in which order, and how its responses are handled: real history, real HTTP."""

import socket
import ssl
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import trustme
from standardwebhooks.webhooks import WebhookVerificationError

from service.delivery.webhooks.dispatcher import Dispatcher
from service.delivery.webhooks.receiver import CONTENT_TYPE, Receiver
from service.delivery.webhooks.signature import new_secret
from service.history.machine import MachineStore
from service.history.records import Step, StoredEvent, StoreError
from service.history.shared import WebhookCursors
from service.history.store import Store
from service.settings.webhooks import WebhookSettings
from tests.service.delivery.hooked import Answering, Got, Hook, alarm_event, hook, settings_for
from tests.service.rig.guarded import Clock
from tests.service.rig.live import until
from tests.service.rig.postgres import opened

PLACES = ("demo/lab", "demo/pump")


@dataclass
class Plant:
    store: Store
    logs: Mapping[str, MachineStore]

    def happen(self, *events: StoredEvent, place: str = "demo/lab") -> None:
        for event in events:
            self.logs[place].commit(Step(events=(event,)))
            until(lambda: self.logs[place].claim.steps == 0, "event in the history")


@contextmanager
def plant(file: Path) -> Iterator[Plant]:
    with opened(f"sqlite:///{file}", timeout_s=1.0) as store:
        yield Plant(store, {place: store.machine(*place.split("/")) for place in PLACES})


@pytest.fixture
def history(tmp_path: Path) -> Iterator[Plant]:
    with plant(tmp_path / "history.sqlite") as found:
        yield found


@dataclass
class Turned:
    """A dispatcher whose turns and clock are driven by the test."""

    dispatcher: Dispatcher
    clock: Clock

    def turns(self, most: int = 1000) -> float:
        for _ in range(most):
            if pause := self.dispatcher.turn():
                return pause
        raise AssertionError("no end")


@contextmanager
def turned(settings: WebhookSettings, plant: Plant, cursors: WebhookCursors | None = None) -> Iterator[Turned]:
    receiver, clock = Receiver(settings), Clock()
    made = Dispatcher(
        settings, receiver, plant.logs, cursors or plant.store.webhooks, clock=clock, now_ns=lambda: 77,
        chance=lambda: 1.0,
    )  # fmt: skip
    try:
        yield Turned(made, clock)
    finally:
        receiver.close()


@contextmanager
def delivering(
    folder: Path, plant: Plant, answer: Answering = lambda _: (200, {}), **settings: Any
) -> Iterator[tuple[Hook, Turned]]:
    with hook(answer) as receiver, turned(settings_for(receiver, folder, **settings), plant) as webhook:
        yield receiver, webhook


def test_the_receiver_gets_the_stored_event_with_a_valid_signature(tmp_path: Path, history: Plant) -> None:
    secret, former = new_secret(), new_secret()
    with hook() as receiver, turned(settings_for(receiver, tmp_path, f"{secret}\n\n{former}"), history) as webhook:
        event = alarm_event(0)
        history.happen(event)
        webhook.turns()
        (got,) = receiver.got
        assert got.body.decode() == event.text
        assert (got.id, got.path, got.headers["content-type"]) == (event.id, "/hook", CONTENT_TYPE)
        assert got.headers["user-agent"].startswith("rotorwatch/")
        for valid in (secret, former):
            assert got.verified(valid)["id"] == event.id
        with pytest.raises(WebhookVerificationError):
            got.verified(new_secret())
        with pytest.raises(WebhookVerificationError):
            Got(got.path, got.headers, got.body + b" ").verified(secret)
        with pytest.raises(WebhookVerificationError):
            Got(got.path, {**got.headers, "webhook-id": "another"}, got.body).verified(secret)
        assert webhook.dispatcher.status().model_dump() == {
            "name": "pager", "target": receiver.url.removesuffix("/hook"), "machines": ("*/*",), "kinds": (),
            "severities": (), "annunciated_only": False, "state": "working", "pending": 0, "delivered": 1,
            "failed_attempts": 0, "last_delivered_ns": 77, "last_error": "", "last_error_ns": None,
        }  # fmt: skip


def test_events_arrive_in_order_over_one_connection_and_not_those_of_before(tmp_path: Path, history: Plant) -> None:
    history.happen(*(alarm_event(number) for number in range(3)))
    baked = (200, {"set-cookie": "who=me; path=/"})
    with delivering(tmp_path, history, lambda _: baked) as (receiver, webhook):
        new = [alarm_event(number) for number in range(3, 133)]  # more than a page
        history.logs["demo/lab"].commit(Step(events=tuple(new)))
        pumps = [alarm_event(number, "demo/pump") for number in range(5)]
        history.happen(*pumps, place="demo/pump")
        webhook.turns()
        ids = receiver.ids()
        assert [one for one in ids if one.startswith("demo/lab")] == [event.id for event in new]
        assert [one for one in ids if one.startswith("demo/pump")] == [event.id for event in pumps]
        assert ids[1::2][:5] == [event.id for event in pumps]  # many events of one machine do not delay another's
        assert receiver.connections == 1
        assert webhook.turns() > 0.0
        assert not any("cookie" in got.headers for got in receiver.got)
        assert len(receiver.got) == 135


def test_only_events_that_pass_the_filters_are_sent(tmp_path: Path, history: Plant) -> None:
    wishes: dict[str, Any] = {"machines": ["demo/l*"], "kinds": ["raised", "escalated"], "severities": ["danger"]}
    with delivering(tmp_path, history, annunciated_only=True, **wishes) as (receiver, webhook):
        wanted = alarm_event(4, severity="danger", kind="escalated")
        history.happen(
            alarm_event(0, severity="danger", kind="cleared"), alarm_event(1),
            alarm_event(2, severity="danger", annunciated=False),
            alarm_event(3, severity="danger", kind="acknowledged"), wanted, alarm_event(5),
        )  # fmt: skip
        history.happen(alarm_event(0, "demo/pump", severity="danger"), place="demo/pump")
        webhook.turns()
        assert receiver.ids() == [wanted.id]
        assert webhook.dispatcher.status().pending == 0


def test_failures_lead_to_ever_longer_pauses_and_no_event_is_skipped(tmp_path: Path, history: Plant) -> None:
    statuses = (500, 503, 429, 408, 425, 502, 500, 500)
    answers = iter((*statuses, *[200] * 4))
    with delivering(tmp_path, history, lambda _: (next(answers), {}), longest_pause_s=20.0) as (receiver, webhook):
        history.happen(*(alarm_event(number) for number in range(3)))
        history.happen(alarm_event(0, "demo/pump"), place="demo/pump")
        pauses = []
        for attempt, refusal in enumerate(statuses, start=1):
            pauses.append(webhook.turns())
            assert len(receiver.got) == attempt
            status = webhook.dispatcher.status()
            assert (status.state, status.failed_attempts, status.delivered) == ("failing", attempt, 0)
            assert status.last_error.startswith(f"{refusal} ")
            webhook.clock.now_s += 0.99 * pauses[-1]
            assert webhook.turns() == pytest.approx(0.01 * pauses[-1])
            assert len(receiver.got) == attempt  # no attempt before its time
            webhook.clock.now_s += 0.011 * pauses[-1]
        assert pauses == pytest.approx([1.0, 2.0, 4.0, 8.0, 16.0, 20.0, 20.0, 20.0])
        webhook.turns()
        assert [one for one in receiver.ids()[8:] if one.startswith("demo/lab")] == [
            alarm_event(number).id for number in range(3)
        ]
        status = webhook.dispatcher.status()
        assert (status.state, status.pending, status.delivered) == ("working", 0, 4)
        assert status.last_error == "500 Internal Server Error"


@pytest.mark.parametrize("status", [404, 307])
def test_a_refused_event_holds_up_its_own_machine_only(tmp_path: Path, history: Plant, status: int) -> None:
    def answer(got: Got) -> tuple[int, Mapping[str, str]]:
        return (status, {"location": target}) if got.id.startswith("demo/lab/1/") and refuse else (200, {})

    with hook() as elsewhere, delivering(tmp_path, history, answer) as (receiver, webhook):
        refuse, target = True, elsewhere.url
        history.happen(*(alarm_event(number) for number in range(3)))
        history.happen(*(alarm_event(number, "demo/pump") for number in range(4)), place="demo/pump")
        assert 0.0 < webhook.turns() <= 60.0
        assert len([one for one in receiver.ids() if one.startswith("demo/pump")]) == 4
        assert [one for one in receiver.ids() if one.startswith("demo/lab")] == [
            alarm_event(0).id, alarm_event(1).id
        ]  # fmt: skip
        found = webhook.dispatcher.status()
        assert (found.state, found.pending) == ("failing", 2)
        assert found.last_error.startswith(str(status))
        webhook.clock.now_s += 59.0
        webhook.turns()
        assert len(receiver.got) == 6
        webhook.clock.now_s += 1.1
        webhook.turns()
        assert len(receiver.got) == 7
        webhook.clock.now_s += 119.0  # slower and slower
        webhook.turns()
        assert len(receiver.got) == 7
        refuse = False
        webhook.clock.now_s += 1.1
        webhook.turns()
        assert receiver.ids()[7:] == [alarm_event(1).id, alarm_event(2).id]
        assert webhook.dispatcher.status().state == "working"
        assert elsewhere.got == []


def test_a_refusal_shows_that_the_receiver_is_up_and_resets_the_pauses(tmp_path: Path, history: Plant) -> None:
    """Pauses start from the shortest again after it."""
    statuses = [500, 500, 500, 404, 500]
    with delivering(tmp_path, history, lambda _: (statuses.pop(0), {})) as (_, webhook):
        history.happen(alarm_event(0))
        history.happen(alarm_event(0, "demo/pump"), place="demo/pump")
        for pause in (1.0, 2.0, 4.0, 1.0):
            assert webhook.turns() == pause
            webhook.clock.now_s += pause
        assert statuses == []


def test_the_cursor_is_saved_after_each_delivery(tmp_path: Path, history: Plant) -> None:
    with delivering(tmp_path, history) as (receiver, webhook):
        history.happen(alarm_event(0), alarm_event(1))
        for number in (1, 2):
            assert webhook.dispatcher.turn() == 0.0
            assert history.store.webhooks.get("pager", "demo/lab") == number == len(receiver.got)


def test_410_gone_disables_a_webhook_until_the_next_start(tmp_path: Path, history: Plant) -> None:
    with hook(lambda _: (410, {})) as receiver:
        settings = settings_for(receiver, tmp_path)
        with turned(settings, history) as webhook:
            history.happen(alarm_event(0), alarm_event(1))
            webhook.turns()
            webhook.clock.now_s += 1e6
            webhook.turns()
            assert receiver.ids() == [alarm_event(0).id]
            found = webhook.dispatcher.status()
            assert (found.state, found.last_error, found.pending) == ("disabled", "410 Gone", 2)
        receiver.answer = lambda _: (200, {})
        with turned(settings, history) as webhook:
            webhook.turns()
            assert receiver.ids()[1:] == [alarm_event(0).id, alarm_event(1).id]


def test_undelivered_events_are_sent_after_the_next_start(tmp_path: Path) -> None:
    """Even where nothing had ever been delivered: a webhook that began with an empty log is not a new one."""
    file = tmp_path / "history.sqlite"
    with hook(lambda _: (503, {})) as receiver:
        settings = settings_for(receiver, tmp_path)
        with plant(file) as first, turned(settings, first) as webhook:
            webhook.turns()
            first.happen(alarm_event(0))
        with plant(file) as second, turned(settings, second) as webhook:
            webhook.turns()
            second.happen(alarm_event(1))
        receiver.answer = lambda _: (200, {})
        receiver.got.clear()
        with plant(file) as third, turned(settings, third) as webhook:
            third.happen(alarm_event(2))
            webhook.turns()
            assert receiver.ids() == [alarm_event(number).id for number in range(3)]
        with plant(file) as fourth, turned(settings, fourth) as webhook:
            webhook.turns()
            fourth.happen(alarm_event(3))
            webhook.turns()
            assert receiver.ids() == [alarm_event(number).id for number in range(4)]
        with plant(file) as fifth, turned(settings_for(receiver, tmp_path, name="other"), fifth) as webhook:
            webhook.turns()
            assert len(receiver.got) == 4  # a new one begins now


class Failing(WebhookCursors):
    """Cursors of a real history, which fail while `broken`."""

    broken = False

    def set(self, name: str, machine_key: str, sequence: int) -> None:
        if self.broken:
            raise StoreError("the disk is full")
        super().set(name, machine_key, sequence)


def test_alarms_are_delivered_even_when_the_cursor_cannot_be_saved(tmp_path: Path, history: Plant) -> None:
    cursors = Failing(history.store.webhooks._database)
    with hook() as receiver:
        settings = settings_for(receiver, tmp_path)
        with turned(settings, history, cursors) as webhook:
            webhook.turns()
            cursors.broken = True
            history.happen(alarm_event(0), alarm_event(1))
            assert webhook.turns() == 1.0  # until it tries to save again
            assert receiver.ids() == [alarm_event(0).id, alarm_event(1).id]
            assert webhook.dispatcher.status().last_error == "the disk is full"
        with turned(settings, history, cursors) as webhook:  # as after a kill: once more, with the same ids
            webhook.turns()
            assert receiver.ids()[2:] == receiver.ids()[:2]
            cursors.broken = False
            webhook.clock.now_s += 1.1
            webhook.turns()
        with turned(settings, history, cursors) as webhook:
            webhook.turns()
            assert len(receiver.got) == 4


def test_an_unreadable_history_pauses_delivery_and_is_reported(tmp_path: Path) -> None:
    with plant(tmp_path / "history.sqlite") as history, hook() as receiver:
        with turned(settings_for(receiver, tmp_path), history) as webhook:
            webhook.turns()
            history.happen(alarm_event(0))
            history.store.close()
            assert webhook.turns() == 1.0
            assert "history is closed" in webhook.dispatcher.status().last_error
            assert webhook.turns() == 1.0  # no earlier, whatever is new
            webhook.clock.now_s += 0.5
            assert webhook.turns() == 0.5
        assert receiver.got == []


@pytest.fixture
def silent() -> Iterator[Answering]:
    """A response that does not come before the test is over."""
    over = threading.Event()

    def answer(_: Got) -> tuple[int, Mapping[str, str]]:
        over.wait(600.0)
        return 200, {}

    yield answer
    over.set()


def test_a_slow_receiver_times_out_and_is_tried_again(tmp_path: Path, history: Plant, silent: Answering) -> None:
    with delivering(tmp_path, history, silent, timeout_s=2.0) as (receiver, webhook):
        history.happen(alarm_event(0))
        assert (webhook.turns(), webhook.dispatcher.status().last_error) == (1.0, "no answer within 2 s")
        receiver.answer = lambda _: (200, {})
        webhook.clock.now_s += 1.1
        webhook.turns()
        assert receiver.ids() == 2 * [alarm_event(0).id]
        assert webhook.dispatcher.status().state == "working"


def test_a_receiver_that_answers_byte_by_byte_times_out(tmp_path: Path, history: Plant) -> None:
    """Every byte comes in time, the end of the response never does."""
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def drip() -> None:
            connection, _ = listening.accept()
            with connection:
                connection.recv(65_536)
                connection.sendall(b"HTTP/1.1 200 OK\r\nx-slow: ")
                while not over.wait(0.02):
                    try:
                        connection.sendall(b"x")
                    except OSError:
                        return

        thread = threading.Thread(target=drip, daemon=True)
        thread.start()
        url = f"http://127.0.0.1:{listening.getsockname()[1]}/"
        with turned(settings_for(url, tmp_path, timeout_s=0.3), history) as webhook:
            history.happen(alarm_event(0))
            assert (webhook.turns(), webhook.dispatcher.status().last_error) == (1.0, "no answer within 0.3 s")
        over.set()
        thread.join(180)


def test_stopping_does_not_wait_for_a_receiver(tmp_path: Path, history: Plant, silent: Answering) -> None:
    with hook(silent) as receiver:
        settings = settings_for(receiver, tmp_path, timeout_s=300.0)
        dispatcher = Dispatcher(settings, Receiver(settings), history.logs, history.store.webhooks)
        dispatcher.start()
        history.happen(alarm_event(0))
        dispatcher.wake()
        until(lambda: len(receiver.got) == 1, "the attempt")
        dispatcher.stop()
        assert not any(thread.name == "webhook pager" for thread in threading.enumerate())
        assert dispatcher.status().failed_attempts == 0


def test_an_unreachable_receiver_pauses_delivery_and_is_reported(tmp_path: Path, history: Plant) -> None:
    with hook() as receiver:
        pass
    with turned(settings_for(receiver, tmp_path), history) as webhook:
        history.happen(alarm_event(0))
        assert webhook.turns() == 1.0
        assert webhook.dispatcher.status().last_error.startswith("no connection: ")


def test_https_accepts_only_certificates_of_the_configured_authority(tmp_path: Path, history: Plant) -> None:
    authority = trustme.CA(key_type=trustme.KeyType.ECDSA)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("127.0.0.1", key_type=trustme.KeyType.ECDSA).configure_cert(context)
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    history.happen(alarm_event(0))
    with hook(context=context) as receiver:
        believed = settings_for(receiver, tmp_path, ca_file=tmp_path / "ca.pem", name="believed")
        with turned(believed, history) as webhook:
            history.happen(alarm_event(1))
            webhook.turns()
            assert receiver.ids() == [alarm_event(1).id]
        with turned(settings_for(receiver, tmp_path, name="doubted"), history) as webhook:
            history.happen(alarm_event(2))
            webhook.turns()
            assert "certificate verify failed" in webhook.dispatcher.status().last_error
        assert len(receiver.got) == 1
