"""What publishers have kept and what is new, over real sessions on loopback: in order, each once, and nobody waits."""

import json
import threading
import time
from functools import partial
from itertools import count

import pytest
import zenoh

from models.signals.link import LinkSettings
from service.stream.inbox import RawBlock
from tests.loopback import session_of
from tests.service.rig.live import LAB, advanced_publisher, endpoint, machine_link, until, until_subscribed

KEPT, LIVE = 300, 60
SIZE = 30_000


@pytest.mark.parametrize("wait", [True, False], ids=["batch run", "live machine"])
def test_kept_and_live_blocks_arrive_each_once(wait: bool) -> None:
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
            publisher.put(number.to_bytes(4, "little") * (SIZE // 4))
        token = session.liveliness().declare_token(LAB.keys.publisher_alive)
        with machine_link(address, take, wait=wait):
            until(begun.is_set, "first block")
            for number in range(KEPT, KEPT + LIVE):
                publisher.put(number.to_bytes(4, "little") * (SIZE // 4))
            until(lambda: len(set(seen)) == KEPT + LIVE, "all blocks")
        token.undeclare()  # type: ignore[no-untyped-call]
        publisher.undeclare()  # type: ignore[no-untyped-call]
    assert sorted(seen) == list(range(KEPT + LIVE))


def test_nothing_that_is_kept_is_lost_to_blocks_that_come_meanwhile() -> None:
    address = endpoint()
    over = threading.Event()
    with session_of(LinkSettings(listen=(address,))) as session:
        publisher = advanced_publisher(session, LAB.keys.stream, 1199)  # Zenoh would hold back 1200 until all are there

        def send() -> None:
            for number in range(1199):
                publisher.put(number.to_bytes(4, "little") * (SIZE // 4))
                if number >= KEPT and over.wait(0.005):
                    return

        sender = threading.Thread(target=send)
        sender.start()
        try:
            for _ in range(3):
                seen: list[int] = []
                numbered = partial(_numbered, seen)
                with machine_link(LinkSettings(mode="client", connect=(address,)), numbered):
                    until(partial(_more_than, seen, KEPT), "blocks")
                assert seen == list(range(len(seen)))
        finally:
            over.set()
            sender.join()
            publisher.undeclare()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("alive", [True, False], ids=["alive token", "no token"])
def test_a_publisher_that_appears_later_loses_nothing_that_it_has_kept(alive: bool) -> None:
    address, seen = endpoint(), list[int]()
    with machine_link(address, partial(_numbered, seen)), session_of(LinkSettings(connect=(address,))) as before:
        first = advanced_publisher(before, LAB.keys.stream, KEPT)
        until_subscribed(before, LAB.keys.stream)
        first.put((7).to_bytes(4, "little"))
        until(lambda: seen == [7], "the block of the first publisher")
        with session_of(LinkSettings(mode="client", connect=(address,))) as session:
            later = advanced_publisher(session, LAB.keys.stream, KEPT)
            if alive:  # it need not publish any more then
                session.liveliness().declare_token(LAB.keys.publisher_alive)
            for number in range(LIVE):  # the first before it can know of a subscriber
                later.put(number.to_bytes(4, "little"))
                time.sleep(0.01 * (number > LIVE // 2))
            until(lambda: len(seen) == 1 + LIVE, "all blocks")
            later.undeclare()  # type: ignore[no-untyped-call]
        first.undeclare()  # type: ignore[no-untyped-call]
    assert seen == [7, *range(LIVE)]


def test_what_a_publisher_kept_that_connects_again_after_a_start_is_not_lost() -> None:
    """A monitor that listens itself is there before its publishers have connected again."""
    address, seen, sent = endpoint(), list[int](), KEPT + LIVE
    again = {"connect/retry": json.dumps({"period_init_ms": 300, "period_max_ms": 300, "period_increase_factor": 1})}
    with session_of(LinkSettings(connect=(address,)), **again) as session:
        publisher = advanced_publisher(session, LAB.keys.stream, KEPT)
        for number in range(sent):  # more than it keeps
            publisher.put(number.to_bytes(4, "little"))
        with machine_link(address, partial(_numbered, seen)):
            until_subscribed(session, LAB.keys.stream)
            while not seen and sent < 20 * KEPT:
                publisher.put(sent.to_bytes(4, "little"))
                sent += 1
                time.sleep(0.02)
        publisher.undeclare()  # type: ignore[no-untyped-call]
    assert seen[0] < sent - KEPT // 2
    assert seen == list(range(seen[0], seen[0] + len(seen)))


def test_a_small_cache_costs_none_of_the_blocks_that_came_meanwhile() -> None:
    address, stop, sent = endpoint(), threading.Event(), count()
    with session_of(LinkSettings(listen=(address,))) as session:
        publisher = advanced_publisher(session, LAB.keys.stream, 1)

        def send() -> None:
            while not stop.wait(0.005):
                publisher.put(next(sent).to_bytes(4, "little"))

        sender = threading.Thread(target=send)
        sender.start()
        try:
            for _ in range(6):
                seen: list[int] = []
                with machine_link(LinkSettings(mode="client", connect=(address,)), partial(_numbered, seen)):
                    until(partial(_more_than, seen, LIVE), "blocks")
                assert seen == list(range(seen[0], seen[0] + len(seen)))
        finally:
            stop.set()
            sender.join()
            publisher.undeclare()  # type: ignore[no-untyped-call]


def test_a_publisher_that_does_not_answer_holds_up_no_other() -> None:
    address, seen = endpoint(), list[int]()
    with machine_link(address, partial(_numbered, seen)), session_of(LinkSettings(connect=(address,))) as session:
        silent = session.declare_publisher(LAB.keys.stream)
        cache = f"{LAB.keys.stream}/@adv/pub/{silent.id.zid}/{silent.id.eid}/_"
        unanswered = list[zenoh.Query]()
        session.declare_queryable(cache, unanswered.append)
        other = advanced_publisher(session, LAB.keys.stream, KEPT)
        until_subscribed(session, LAB.keys.stream)
        silent.put((7).to_bytes(4, "little"), source_info=zenoh.SourceInfo(silent.id, 5))
        until(lambda: bool(unanswered), "the question for what it has kept")
        for number in range(LIVE):
            other.put(number.to_bytes(4, "little"))
        until(lambda: len(seen) >= LIVE, "the blocks of the other")
        assert seen == list(range(LIVE))
        other.undeclare()  # type: ignore[no-untyped-call]


def _numbered(seen: list[int], block: RawBlock) -> None:
    seen.append(int.from_bytes(block.payload[:4], "little"))


def _more_than(seen: list[int], count: int) -> bool:
    return len(seen) > count
