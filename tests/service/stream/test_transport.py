"""Zenoh sessions, real ones on loopback: nothing lost without being counted, late joiners served, errors seen."""

import json
import threading
import time
from collections import deque
from collections.abc import Callable

import pytest
import zenoh
import zenoh.ext
from structlog.testing import capture_logs

from models.signals.link import LinkSettings
from rotorwatch.records.alarms import AlarmLogPage
from service.history.records import StoreError
from service.stream.inbox import Inbox, Intake, RawBlock
from service.stream.transport import MachineCallbacks, MachineLink, TopicMessage, follow
from tests.service.rig.live import (
    LAB,
    Feed,
    advanced_publisher,
    endpoint,
    ignore,
    machine_link,
    no_events,
    open_session,
    service,
    until,
    until_subscribed,
)
from tests.sure import sure

KEYS = LAB.keys


def test_a_waiting_worker_is_woken_by_enough_blocks_or_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.stream.inbox._PATIENCE_S", 600.0)
    inbox, order = Inbox(100, "drop"), list[bytes]()

    def work() -> None:
        while (item := inbox.get(3)) is not None:
            order.append(item.payload if isinstance(item, RawBlock) else b"call")

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    for number in range(3):
        inbox.put(RawBlock(bytes([number]), b"", ""))
    until(lambda: len(order) == 3, "blocks that were enough", 20.0)
    inbox.put(RawBlock(b"\3", b"", ""))
    time.sleep(0.05)  # long enough to be woken by a single one
    inbox.call(lambda: None)
    until(lambda: len(order) == 5, "a block that a call let be taken", 20.0)
    inbox.close()
    thread.join()
    assert order == [b"\0", b"\1", b"\2", b"call", b"\3"]


@pytest.mark.parametrize(("bound", "odd"), [(2, False), (100, True)])
def test_a_small_inbox_or_a_non_block_ends_the_wait(bound: int, odd: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.stream.inbox._PATIENCE_S", 600.0)
    inbox, taken = Inbox(bound, "wait", may_be_block=lambda _, __: not odd), list[object]()
    thread = threading.Thread(target=lambda: taken.append(inbox.get(50)), daemon=True)
    thread.start()
    inbox.put(RawBlock(b"", b"", ""))
    until(lambda: bool(taken), "a block by itself")
    thread.join()


def test_closing_an_inbox_releases_all_waiting_threads() -> None:
    inbox = Inbox(1, "wait")
    inbox.put(RawBlock(b"", b"", ""))
    threads = [threading.Thread(target=inbox.put, args=(RawBlock(b"", b"", ""),)) for _ in range(2)]
    for thread in threads:
        thread.start()
    inbox.close()
    for thread in threads:
        thread.join(180.0)
        assert not thread.is_alive()
    assert inbox.get() is None


def test_blocks_of_two_sessions_have_different_sources() -> None:
    taken: list[RawBlock] = []
    address = endpoint()
    with machine_link(address, taken.append), open_session(address) as session, open_session(address) as other:
        publishers = [advanced_publisher(one, KEYS.stream, detected=False) for one in (session, other)]
        for number in range(6):
            publishers[number % 2].put(bytes([number % 2]))
        until(lambda: len(taken) == 6, "all blocks")
        sources = [{block.source for block in taken if block.payload == bytes([number])} for number in (0, 1)]
        assert [len(source) for source in sources] == [1, 1]
        assert sources[0] != sources[1]


def test_no_block_is_lost_while_publishers_wait_out_a_long_stall() -> None:
    """A publisher's heartbeat overtakes waiting blocks; with recovery Zenoh would then skip hundreds of them."""
    address, gate = endpoint(), threading.Event()
    inbox: Inbox = Inbox(10, "wait")
    received: list[RawBlock] = []

    def work() -> None:
        gate.wait()
        while (block := inbox.get()) is not None:
            assert isinstance(block, RawBlock)
            received.append(block)

    worker = threading.Thread(target=work)
    worker.start()
    with machine_link(address, inbox.put, wait=True), open_session(address) as session:
        publisher = advanced_publisher(session, KEYS.stream, 300, detected=False)
        sender = threading.Thread(target=lambda: [publisher.put(bytes(7200)) for _ in range(10_000)])
        sender.start()
        # Longer than several heartbeats; a publisher blocked in a put gives no other sign.
        threading.Event().wait(1.5)
        gate.set()
        sender.join()
        until(lambda: len(received) == 10_000, "every block")
        inbox.close()
        worker.join()


def test_an_exception_in_a_callback_is_counted_and_the_next_block_arrives() -> None:
    address = endpoint()
    received: list[RawBlock] = []

    def take(block: RawBlock) -> None:
        received.append(block)
        if len(received) == 2:
            raise RuntimeError("on a foreign thread")

    with machine_link(address, take) as (link, _), open_session(address) as session:
        feed = Feed(session)
        feed.put_good(3)
        until(lambda: len(received) == 3, "third block")
        assert link.errors == 1


def test_nothing_is_delivered_or_published_after_close() -> None:
    address = endpoint()
    first: list[RawBlock] = []
    second: list[RawBlock] = []
    healths: list[str] = []
    callbacks = MachineCallbacks(second.append, ignore, ignore, ignore, lambda: "{}", lambda: "{}", no_events)
    with machine_link(address, first.append) as (link, declared), open_session(address) as session:
        session.declare_subscriber(KEYS.health, lambda sample: healths.append(sample.payload.to_string()))
        feed = Feed(session)
        feed.put_good()
        until(lambda: len(first) == 1, "first block")
        # Published again until the subscription has arrived: there is no other sign of it.
        until(repeating(lambda: declared.publish("health", '"open"'), lambda: bool(healths)), "health")
        declared.close()
        declared.publish("health", '"closed"')
        successor = MachineLink(link, KEYS, callbacks, wait_when_full=False)
        publish_again = repeating(lambda: successor.publish("health", '"successor"'), lambda: '"successor"' in healths)
        until(publish_again, "later health")
        until(repeating(feed.put_good, lambda: bool(second)), "later block")
        successor.close()
    assert len(first) == 1
    assert set(healths) == {'"open"', '"successor"'}
    assert not link.is_open


def repeating(action: Callable[[], None], condition: Callable[[], bool]) -> Callable[[], bool]:
    """The condition, with the action run before every check."""

    def act_and_look() -> bool:
        action()
        return condition()

    return act_and_look


def query(session: zenoh.Session, key: str) -> str:
    found: list[str] = []

    def ask() -> bool:
        replies = session.get(key, timeout=60.0)
        found.extend(reply.ok.payload.to_string() for reply in replies if reply.ok is not None)
        return bool(found)

    until(ask, f"answer on {key}")
    return found[0]


def test_a_follower_gets_the_latest_state_and_then_live_messages() -> None:
    address = endpoint()
    messages: list[TopicMessage] = []
    with machine_link(address, ignore) as (opened, declared):
        declared.publish("health", '{"number": 1}')
        declared.publish("health", '{"number": 2}')
        declared.publish("alarm_state", '{"number": 3}')
        declared.publish("alarm_event", '{"number": 0}')
        link = LinkSettings(mode="client", connect=(address,))
        topics = ("health", "alarm_state", "alarm_event", "report")
        with follow(link, "*/lab", topics, messages.append) as connected:
            until(lambda: len(messages) >= 2, "cached messages")
            kept = {(KEYS.health, '{"number": 2}'), (KEYS.alarm_state, '{"number": 3}')}
            assert {(m.key, m.text) for m in messages} == kept
            for key in (KEYS.alarm_event, KEYS.report):
                until_subscribed(opened.session, key)
            declared.publish("alarm_event", '{"number": 4}')
            declared.publish("report", '{"number": 5}')
            until(lambda: len(messages) == 4, "live messages")
            live = {(KEYS.alarm_event, '{"number": 4}'), (KEYS.report, '{"number": 5}')}
            assert {(m.key, m.text) for m in messages[2:]} == live
            assert connected()


def test_the_alarm_log_can_be_queried_from_a_sequence_number_on() -> None:
    address = endpoint()

    def alarm_events(after: int, limit: int) -> str:
        if after == 99:
            raise StoreError("history: the disk is full")
        return json.dumps([after, limit])

    with machine_link(address, ignore, alarm_events=alarm_events) as (link, _), open_session(address) as session:
        assert query(session, KEYS.alarm_event) == "[-1, 100]"
        assert query(session, f"{KEYS.alarm_event}?after=17;limit=5") == "[17, 5]"
        assert query(session, f"{KEYS.alarm_event}?after=17;_time=[now(-1h)..]") == "[17, 100]"
        for parameters, told in (
            ("after=x", "after is 'x', expected a whole number from -1 to"),
            ("after=-2", "after is '-2', expected a whole number from -1 to"),
            ("limit=0", "limit is '0', expected a whole number from 1 to 1000"),
            ("limit=1001", "limit is '1001', expected a whole number from 1 to 1000"),
            ("since=4", "no parameter since, expected after or limit"),
            ("after=99", "history: the disk is full"),
        ):
            (reply,) = session.get(f"{KEYS.alarm_event}?{parameters}", timeout=60.0)
            assert told in json.loads(sure(reply.err).payload.to_string())["error"]
        assert link.errors == 0


def test_the_alarm_log_can_be_queried_while_the_machine_is_busy() -> None:
    """Requests of operators wait for the machine's thread; the log, and health beside a slow log, do not."""
    address, gate = endpoint(), threading.Event()
    with service(address) as (_, worker), open_session(address) as session:
        worker.inbox.call(lambda: ignore(gate.wait()))  # the thread is stuck
        page = AlarmLogPage.model_validate_json(query(session, KEYS.alarm_event))
        assert page == AlarmLogPage(site="demo", machine="lab", events=(), latest=-1)
        gate.set()
    address, gate = endpoint(), threading.Event()

    def slow(after: int, limit: int) -> str:
        gate.wait(600.0)
        return "[]"

    with machine_link(address, ignore, alarm_events=slow), open_session(address) as session:
        waiting = session.get(KEYS.alarm_event, timeout=60.0)
        assert query(session, KEYS.health) == '{"h": 1}'
        gate.set()
        assert [reply.ok.payload.to_string() for reply in waiting if reply.ok is not None] == ["[]"]


def test_a_publishers_liveliness_is_followed_and_its_descriptor_queried() -> None:
    address = endpoint()
    wrong = LAB.descriptor.model_copy(update={"rate_hz": 1000.0}).model_dump_json()
    with service(address) as (_, worker), open_session(address) as session:
        session.declare_queryable(KEYS.descriptor, lambda q: q.reply(KEYS.descriptor, wrong))
        token = session.liveliness().declare_token(KEYS.publisher_alive)
        until(lambda: worker.health().stream.publisher_alive, "publisher")
        until(lambda: bool(worker.health().stream.descriptor_mismatch), "descriptor by query")
        assert worker.health().stream.descriptor_mismatch == ("rate_hz is 1000.0, expected 2000.0",)
        token.undeclare()  # type: ignore[no-untyped-call]
        until(lambda: not worker.health().stream.publisher_alive, "publisher gone")
        assert worker.health().stream.descriptor_mismatch == ()


def test_a_monitor_warns_of_another_monitor_of_its_machine() -> None:
    def said() -> list[object]:
        return [entry["machine"] for entry in logs if "another monitor" in entry["event"]]

    address = endpoint()
    with capture_logs() as logs, machine_link(address, ignore):
        with machine_link(LinkSettings(mode="client", connect=(address,)), ignore):
            until(lambda: bool(said()), "the warning")
        assert said() == ["demo/lab"]  # logged by the second; the first was alone at its start


def test_an_intake_empties_all_channels_until_each_is_ended() -> None:
    intake, waiting, taken = Intake(), deque([1, 2]), list[int]()
    other, seen = deque[int](), list[int]()

    def empty() -> None:
        taken.extend(waiting.popleft() for _ in range(len(waiting)))

    end = intake.add(empty)
    intake.add(lambda: seen.extend(other.popleft() for _ in range(len(other))))
    try:
        until(lambda: taken == [1, 2], "the first messages")
        waiting.append(3)
        until(lambda: taken == [1, 2, 3], "what came later")
        end()
        waiting.append(4)
        other.append(5)
        until(lambda: seen == [5], "the message of the other channel")
        end()  # a second call changes nothing
    finally:
        intake.close()
    assert taken == [1, 2, 3]
