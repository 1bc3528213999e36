"""Cached and new blocks of publishers, over real sessions on loopback: in order, each once, none held up."""

import json
import threading
import time
from functools import partial
from itertools import count
from typing import Any

import pytest
import zenoh

from models.signals.link import LinkSettings
from service.stream.inbox import RawBlock
from service.stream.transport import Link, MachineCallbacks, MachineLink
from tests.loopback import session_of
from tests.service.rig.live import (
    LAB,
    advanced_publisher,
    endpoint,
    ignore,
    machine_link,
    no_events,
    until,
    until_subscribed,
)

KEPT, LIVE = 300, 60
SIZE = 30_000


@pytest.mark.parametrize("wait", [True, False], ids=["batch run", "live machine"])
def test_cached_and_live_blocks_arrive_once_each(wait: bool) -> None:
    address = endpoint()
    patience = {"transport/link/tx/queue/congestion_control/block/wait_before_close": json.dumps(60_000_000)}
    seen: list[int] = []
    begun = threading.Event()

    def take(block: RawBlock) -> None:
        begun.set()
        seen.append(int.from_bytes(block.payload[:4], "little"))
        time.sleep(0.001)  # slow enough for live blocks to arrive in between

    with session_of(LinkSettings(connect=(address,)), **patience) as session:
        publisher = advanced_publisher(session, LAB.keys.stream, KEPT, priority=zenoh.Priority.DATA_HIGH)
        for number in range(KEPT):
            publisher.put(_payload(number) * (SIZE // 4))
        _token = session.liveliness().declare_token(LAB.keys.publisher_alive)
        with machine_link(address, take, wait=wait):
            until(begun.is_set, "first block")
            for number in range(KEPT, KEPT + LIVE):
                publisher.put(_payload(number) * (SIZE // 4))
            until(lambda: len(set(seen)) == KEPT + LIVE, "all blocks")
    assert sorted(seen) == list(range(KEPT + LIVE))


# With 1200 cached blocks Zenoh would hold back all until the last has come.
@pytest.mark.parametrize(
    ("kept", "at_once", "turns"),
    [(1199, KEPT, (False, True) * 2), (1, 0, (False,) * 6)],
    ids=["all are kept", "one is kept"],
)
def test_blocks_published_during_a_start_are_not_lost(kept: int, at_once: int, turns: tuple[bool, ...]) -> None:
    address, over = endpoint(), threading.Event()
    with session_of(LinkSettings(listen=(address,))) as session:
        publisher = advanced_publisher(session, LAB.keys.stream, kept)

        def send() -> None:
            for number in range(kept) if at_once else count():
                publisher.put(_payload(number) * (SIZE // 4))
                if number >= at_once and over.wait(0.005):
                    return

        sender = threading.Thread(target=send)
        sender.start()
        try:
            for wait in turns:
                seen: list[int] = []
                numbered = partial(_numbered, seen)
                with machine_link(LinkSettings(mode="client", connect=(address,)), numbered, wait=wait):
                    until(partial(_more_than, seen, at_once + LIVE), "blocks")
                assert seen == list(range(seen[0], seen[0] + len(seen)))
                assert seen[0] == 0 or not at_once
        finally:
            over.set()
            sender.join()


@pytest.mark.parametrize("alive", [True, False], ids=["alive token", "no token"])
def test_cached_blocks_of_a_publisher_that_appears_later_arrive(alive: bool) -> None:
    address, seen = endpoint(), list[int]()
    with machine_link(address, partial(_numbered, seen)), session_of(LinkSettings(connect=(address,))) as before:
        first = advanced_publisher(before, LAB.keys.stream, KEPT)
        until_subscribed(before, LAB.keys.stream)
        first.put(_payload(7))
        until(lambda: seen == [7], "the block of the first publisher")
        with session_of(LinkSettings(mode="client", connect=(address,))) as session:
            later = advanced_publisher(session, LAB.keys.stream, KEPT)
            if alive:  # then it need not publish again
                session.liveliness().declare_token(LAB.keys.publisher_alive)
            for number in range(LIVE):  # the first ones before it can know of a subscriber
                later.put(_payload(number))
                time.sleep(0.01 * (number > LIVE // 2))
            until(lambda: len(seen) == 1 + LIVE, "all blocks")
    assert seen == [7, *range(LIVE)]


def test_cached_blocks_of_a_reconnecting_publisher_arrive() -> None:
    """A listening monitor has started before its publishers reconnect."""
    address, seen, sent = endpoint(), list[int](), KEPT + LIVE
    again = {"connect/retry": json.dumps({"period_init_ms": 300, "period_max_ms": 300, "period_increase_factor": 1})}
    with session_of(LinkSettings(connect=(address,)), **again) as session:
        publisher = advanced_publisher(session, LAB.keys.stream, KEPT)
        for number in range(sent):  # more than it keeps
            publisher.put(_payload(number))
        with machine_link(address, partial(_numbered, seen)):
            until_subscribed(session, LAB.keys.stream)
            while not seen and sent < 20 * KEPT:
                publisher.put(_payload(sent))
                sent += 1
                time.sleep(0.02)
    assert seen[0] < sent - KEPT // 2
    assert seen == list(range(seen[0], seen[0] + len(seen)))


def test_a_publisher_that_does_not_reply_holds_up_no_other() -> None:
    address, seen = endpoint(), list[int]()
    with machine_link(address, partial(_numbered, seen)), session_of(LinkSettings(connect=(address,))) as session:
        silent = session.declare_publisher(LAB.keys.stream)
        unanswered = list[zenoh.Query]()
        session.declare_queryable(_cache(silent), unanswered.append)
        other = advanced_publisher(session, LAB.keys.stream, KEPT)
        until_subscribed(session, LAB.keys.stream)
        silent.put(_payload(7), source_info=_source(silent, 5))
        until(lambda: bool(unanswered), "the question for what it has kept")
        for number in range(LIVE):
            other.put(_payload(number))
        until(lambda: len(seen) >= LIVE, "the blocks of the other")
        assert seen == list(range(LIVE))


def test_a_gap_between_cached_and_new_blocks_is_queried_again() -> None:
    """As when it published while the subscription was on its way, or a link broke."""
    address, seen = endpoint(), list[int]()
    with session_of(LinkSettings(listen=(address,))) as session:
        publisher = advanced_publisher(session, LAB.keys.stream, KEPT)
        publisher.put(_payload(0))
        publisher.put(_payload(1))
        with machine_link(LinkSettings(mode="client", connect=(address,)), partial(_numbered, seen)):
            until(lambda: seen == [0, 1], "what it has kept")
            # Zenoh drops blocks older than those it has delivered: the next ones are as good as lost.
            session.put(LAB.keys.stream, _payload(5), source_info=_source(publisher, 5))
            for number in range(2, 7):
                publisher.put(_payload(number))
            until(lambda: 6 in seen, "what comes now")
    assert seen == list(range(7))


def test_replies_of_at_most_64_publishers_are_waited_for() -> None:
    """Anybody can claim to be another publisher."""
    address, seen = endpoint(), list[int]()
    with (
        machine_link(address, partial(_numbered, seen)) as (link, _),
        session_of(LinkSettings(connect=(address,))) as session,
    ):
        session.liveliness().declare_token(f"{LAB.keys.stream}/@adv/pub/*/**")
        unanswered = list[zenoh.Query]()
        session.declare_queryable(f"{LAB.keys.stream}/@adv/pub/**", unanswered.append)
        until_subscribed(session, LAB.keys.stream)
        for number in range(65):
            publisher = session.declare_publisher(LAB.keys.stream)
            publisher.put(_payload(number), source_info=_source(publisher, 5))
        until(lambda: bool(seen), "a block of one that is not waited for")
        until(lambda: sum("_sn=" in str(one.parameters) for one in unanswered) == 64, "64 questions")
        assert (seen, link.errors) == ([64], 0)
        unanswered.clear()  # which ends the queries


def test_blocks_of_a_publisher_with_timestamps_only_arrive_in_order() -> None:
    address, seen = endpoint(), list[int]()
    stamped = {"timestamping/enabled": "true"}
    with session_of(LinkSettings(listen=(address,)), **stamped) as session:
        publisher = zenoh.ext.declare_advanced_publisher(
            session, LAB.keys.stream, cache=zenoh.ext.CacheConfig(max_samples=KEPT + LIVE), publisher_detection=True
        )
        for number in range(KEPT):
            publisher.put(_payload(number))
        with machine_link(LinkSettings(mode="client", connect=(address,)), partial(_numbered, seen)):
            for number in range(KEPT, KEPT + LIVE):
                publisher.put(_payload(number))
                time.sleep(0.002)
            until(lambda: len(seen) >= KEPT + LIVE, "all blocks")
    assert seen == list(range(KEPT + LIVE))


def test_a_machine_that_holds_up_its_publisher_does_not_starve_others() -> None:
    address, order = endpoint(), list[str]()
    other = LAB.model_copy(update={"name": "other"})

    def slowly(_: RawBlock) -> None:
        order.append("slow")
        time.sleep(0.002)

    with (
        machine_link(address, slowly, wait=True) as (link, _),
        session_of(LinkSettings(connect=(address,))) as session,
        session_of(LinkSettings(connect=(address,))) as another,
    ):
        taken = MachineCallbacks(lambda _: order.append("other"), ignore, ignore, ignore, str, str, no_events)
        declared = MachineLink(link, other.keys, taken, wait_when_full=True)
        flood = advanced_publisher(session, LAB.keys.stream, KEPT)
        beside = advanced_publisher(another, other.keys.stream, KEPT)
        until_subscribed(session, LAB.keys.stream)
        until_subscribed(another, other.keys.stream)
        sender = threading.Thread(target=lambda: [flood.put(_payload(n)) for n in range(1000)])
        sender.start()
        while order.count("slow") < 1000:
            beside.put(_payload(len(order)))
            time.sleep(0.01)
        sender.join()
        declared.close()
    turns = "".join(one[0] for one in order).split("o")
    assert max(len(turn) for turn in turns) < 200


def _payload(number: int) -> bytes:
    return number.to_bytes(4, "little")


def _source(publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher, number: int) -> zenoh.SourceInfo:
    return zenoh.SourceInfo(publisher.id, number)


def _cache(publisher: zenoh.Publisher) -> str:
    return f"{LAB.keys.stream}/@adv/pub/{publisher.id.zid}/{publisher.id.eid}/_"


def _numbered(seen: list[int], block: RawBlock) -> None:
    seen.append(int.from_bytes(block.payload[:4], "little"))


def _more_than(seen: list[int], count: int) -> bool:
    return len(seen) > count


def test_heartbeats_do_not_hold_up_replies_from_a_cache() -> None:
    """The publisher connects, as most do: Zenoh then serves its socket from the thread that sends heartbeats."""
    with Link(LinkSettings(listen=(address := endpoint(),))).session as session:
        stream = LAB.keys.stream
        with session_of(LinkSettings(connect=(address,))) as publishing:
            publisher = advanced_publisher(publishing, stream, KEPT, heartbeat_s=0.01)
            for number in range(KEPT):
                publisher.put(_payload(number) * (SIZE // 4))
            caches = f"{stream}/@adv/pub/**"
            heartbeats: Any = zenoh.handlers.RingChannel(1)
            subscriber = session.declare_subscriber(caches, heartbeats)
            until(lambda: subscriber.try_recv() is not None, "heartbeat")
            few: Any = zenoh.handlers.FifoChannel(1)
            answers = session.get(
                f"{caches}?_max={KEPT}", few, consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY, timeout=60.0,
            )  # fmt: skip
            until(lambda: answers.try_recv() is not None, "first answer")
            time.sleep(0.5)  # several heartbeats, while no reply is taken
            assert sum(answer.ok is not None for answer in answers) == KEPT - 1
